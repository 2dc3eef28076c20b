"""The policy-side face of L1: a module that turns the actor's action into the executed input."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.data import Composite
from torchrl.envs.transforms import TensorDictPrimer

from torchrl_l1.compilation import CompileMode
from torchrl_l1.control.affine import make_step
from torchrl_l1.control.config import L1Config
from torchrl_l1.control.jacobian import Predicts
from torchrl_l1.control.layout import (
    L1_KEY,
    Dynamics,
    Layout,
    advance,
    as_action_jacobian,
    declared_dimension,
)
from torchrl_l1.control.state import state_names


class L1Controller(TensorDictModuleBase):
    """L1 adaptive control after an actor (arXiv 2403.14860, Algorithm 2).

    Reads the observation, the actor's action and the controller's state; replaces the action
    by the executed input, keeps the actor's under ``(key, "u_rl")`` and writes the next state,
    the executed input ``u_exec`` and the diagnostics
    (:class:`~torchrl_l1.control.L1Diagnostics`) under ``("next", key)``. The environment
    needs the primer of :meth:`make_primer`, which starts the state at each reset and carries
    it from step to step. No gradient flows through the controller: log-probabilities belong
    to ``(key, "u_rl")``.

    :class:`~torchrl_l1.control.L1Transform` does the same inside the environment, with ``action``
    left as the policy's; prefer it unless the environment cannot be wrapped.

    The model is referred to, not registered: its weights are not among this module's
    parameters, and updating them in place is seen at the next step.

    Args:
        dynamics: the learned model, see :class:`~torchrl_l1.control.ActionJacobian`; an
            ``ActionJacobian`` is used as it is.
        config: the settings. Without action bounds in it the executed input is not clipped.
        observation_key: key of the observation.
        action_key: key of the action, replaced by the executed input.
        key: name of the nested tensordict with the controller's entries.
        observation_dim: width of the observation; needed by :meth:`make_primer` if the model
            has no attribute of that name.
        action_dim: width of the action, likewise.
        compile: ``True`` compiles the step, ``"auto"`` does so where a compiler works.
        diagnostics: whether to write the diagnostics.
        predicts: what ``dynamics`` predicts, ``"change"`` or ``"next_observation"``; ``None``
            decides as :class:`~torchrl_l1.control.ActionJacobian` does.

    Raises:
        KeyError: at a call, if the observation, the action or the controller's state is missing.
        ValueError: if a width does not fit the state's. Data that are not finite raise nothing:
            L1 stands aside there and restarts, see :func:`~torchrl_l1.control.law.step`.

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule, TensorDictSequential
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_l1.dynamics import EnsembleDynamics
        >>> model = EnsembleDynamics(3, 1, hidden=(16,))
        >>> config = L1Config(0.05, action_low=-2.0, action_high=2.0)
        >>> l1 = L1Controller(model, config)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), l1.make_primer())
        >>> actor = TensorDictModule(torch.nn.Linear(3, 1), ["observation"], ["action"])
        >>> data = env.rollout(4, TensorDictSequential(actor, l1))
        >>> data["next", "l1", "u_exec"].shape, data["l1", "u_rl"].shape
        (torch.Size([4, 1]), torch.Size([4, 1]))
    """

    def __init__(
        self,
        dynamics: Dynamics,
        config: L1Config,
        *,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        key: str = L1_KEY,
        observation_dim: int | None = None,
        action_dim: int | None = None,
        compile: CompileMode = False,
        diagnostics: bool = True,
        predicts: Predicts | None = None,
    ) -> None:
        super().__init__()
        self.config = config
        self.model = as_action_jacobian(dynamics, observation_key, action_key, predicts)
        self.observation_key = observation_key
        self.action_key = action_key
        self.key = key
        self.compile_mode = compile
        self.diagnostics = diagnostics
        self._dims = (
            declared_dimension(self.model, "observation_dim", observation_dim),
            declared_dimension(self.model, "action_dim", action_dim),
        )
        self._state_names = state_names(config)
        self.in_keys = [observation_key, action_key, *((key, name) for name in self._state_names)]
        self.out_keys = [action_key, (key, "u_rl")]
        self.out_keys += [("next", key, name) for name in (*self._state_names, "u_exec")]
        self._step = make_step(config, self.model, compile, diagnostics)

    def make_primer(self) -> TensorDictPrimer:
        """Transform that gives the environment the controller's state, zero at every reset."""
        observation_dim, action_dim = self._dims
        if observation_dim is None or action_dim is None:
            raise ValueError(
                "the primer needs the widths of observation and action, and the model does not "
                "tell: give L1Controller observation_dim and action_dim"
            )
        self.config.check_dimensions(observation_dim, action_dim)
        dtype = self.model.dtype or torch.get_default_dtype()
        layout = Layout(torch.Size([]), observation_dim, action_dim, dtype, dtype)
        return TensorDictPrimer(
            Composite({self.key: layout.state_spec(self.config)}), expand_specs=True
        )

    # The name under which torchrl.modules.utils.get_primers_from_module looks for it.
    make_tensordict_primer = make_primer

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """One step of the controller, see the class."""
        u_rl, executed, following = advance(
            self._step,
            self._state_names,
            tensordict,
            self.observation_key,
            self.action_key,
            self.key,
            owner="L1Controller",
            remedy="append the primer to the environment, "
            "TransformedEnv(env, controller.make_primer())",
        )
        tensordict.set((self.key, "u_rl"), u_rl)
        tensordict.set(self.action_key, executed)
        tensordict.set(("next", self.key), following)
        return tensordict

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions do not travel between processes.
        return {name: value for name, value in self.__dict__.items() if name != "_step"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._step = make_step(self.config, self.model, self.compile_mode, self.diagnostics)
