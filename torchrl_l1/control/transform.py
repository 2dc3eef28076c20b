"""The environment-side face of L1: a transform between the policy and the environment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, Transform

from torchrl_l1.compilation import CompileMode
from torchrl_l1.control.affine import StepFunction, make_step
from torchrl_l1.control.config import L1Config
from torchrl_l1.control.jacobian import Predicts
from torchrl_l1.control.layout import L1_KEY, Dynamics, Layout, advance, as_action_jacobian
from torchrl_l1.control.state import state_names

# Where a step's outcome waits, inside the tensordict, for the base environment to return.
_PENDING = "_l1_pending"


class L1Transform(Transform):
    """L1 adaptive control inside an environment (arXiv 2403.14860, Algorithm 2).

    The policy's action stays in ``action``, so that replay data hold what the paper stores;
    the environment receives the executed input. Under ``key`` the tensordict carries the
    controller's state (:class:`~torchrl_l1.control.L1State`) from step to step, and
    ``("next", key)`` also holds the executed input ``u_exec`` and the diagnostics
    (:class:`~torchrl_l1.control.L1Diagnostics`). A reset starts the controller afresh in the
    environments that it resets and in no others.

    Order matters. Transforms that disturb the executed input (noise, bias) must come before
    this one in ``Compose``, as the last transform meets the action first. L1 reads the
    observation that the policy reads: transforms that change it must come before as well, and
    the model must have been fitted to that observation.

    Action bounds that the configuration leaves open are taken from the action spec where it
    is bounded; infinite bounds in the configuration turn clipping off.

    The model is referred to, not registered: it keeps its train mode and device, its weights
    are not in the environment's ``state_dict``, and updating them in place is seen at the next
    step. Processes of a ``ParallelEnv`` of transformed environments hold copies; keep L1 outside
    of it while the model is being trained.

    Args:
        dynamics: the learned model, see :class:`~torchrl_l1.control.ActionJacobian`; an
            ``ActionJacobian`` is used as it is.
        config: the settings; or give ``dt`` and others of :class:`L1Config`'s here.
        dt: time of one environment step in seconds.
        observation_key: key of the observation.
        action_key: key of the action.
        key: name of the nested tensordict with the controller's entries.
        compile: ``True`` compiles the step, which takes some tens of seconds at the first;
            ``"auto"`` does so where a compiler works.
        diagnostics: whether to write the diagnostics.
        dtype: type in which the controller computes; that of the model's parameters if
            ``None``, or the observation's for a model without any.
        predicts: what ``dynamics`` predicts, ``"change"`` or ``"next_observation"``; ``None``
            decides as :class:`~torchrl_l1.control.ActionJacobian` does.
        **settings: further fields of :class:`L1Config` (``epsilon``, ``cutoff``, ...).

    Raises:
        ValueError: if a setting or width does not fit, at a reset to an observation that is not
            finite, or if a later transform overwrites the observation.
        KeyError: at a step, if the observation, the action or the controller's state is missing.
        RuntimeError: if used in a replay buffer.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_l1.dynamics import EnsembleDynamics
        >>> model = EnsembleDynamics(3, 1, hidden=(16,))
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), L1Transform(model, dt=0.05, epsilon=0.3))
        >>> data = env.rollout(4)
        >>> data["action"].shape, data["next", "l1", "u_exec"].shape
        (torch.Size([4, 1]), torch.Size([4, 1]))
    """

    def __init__(
        self,
        dynamics: Dynamics,
        config: L1Config | None = None,
        *,
        dt: float | None = None,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        key: str = L1_KEY,
        compile: CompileMode = False,
        diagnostics: bool = True,
        dtype: torch.dtype | None = None,
        predicts: Predicts | None = None,
        **settings: Any,
    ) -> None:
        super().__init__()
        self.config = _configuration(config, dt, settings)
        self.model = as_action_jacobian(dynamics, observation_key, action_key, predicts)
        self.observation_key = unravel_key(observation_key)
        self.action_key = unravel_key(action_key)
        self.key = key
        self._state_names = state_names(self.config)
        self.compile_mode = compile
        self.diagnostics = diagnostics
        self.dtype = self.model.dtype if dtype is None else dtype
        self._layout: Layout | None = None
        self._step_config: L1Config | None = None
        self._step_function: StepFunction | None = None

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attach to an environment, whose specs then decide widths and bounds."""
        self._layout = None
        super().set_container(container)

    def empty_cache(self) -> None:
        """Forget what the specs decided: a transform before this one may have changed them."""
        self._layout = None
        super().empty_cache()

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the controller's state and signals."""
        self._check_order()
        observation_spec[self.key] = self._resolve().spec(self.config, self.diagnostics)
        return observation_spec

    def transform_state_spec(self, state_spec: TensorSpec) -> TensorSpec:
        """Add the controller's state, which a step reads."""
        state_spec[self.key] = self._resolve().state_spec(self.config)
        return state_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refused: L1 acts at the steps of an environment, not on stored data."""
        raise RuntimeError(
            "L1Transform acts inside an environment: append it to a TransformedEnv, not to a "
            "replay buffer. Stored data already hold the executed input, under "
            f"{('next', self.key, 'u_exec')}"
        )

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._layout is None or self._step_function is None:
            # After copying, or when a transform before this one came or went without a reset.
            if not self._is_in_environment():
                return self.forward(tensordict)
            self._resolve()
        assert self._step_function is not None
        _, executed, following = advance(
            self._step_function,
            self._state_names,
            tensordict,
            self.observation_key,
            self.action_key,
            self.key,
            owner="L1Transform",
            remedy="reset the environment first and pass on what reset or step_mdp returned",
        )
        # The caller's tensordict keeps the policy's action: this one is a shallow copy.
        tensordict.set(self.action_key, executed)
        return tensordict.set(_PENDING, following)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        following = tensordict.get(_PENDING)
        stepped = tensordict.get("_step", None)
        if stepped is not None:
            previous = tensordict.get(self.key).select(*following.keys(), strict=False)
            following = following.where(stepped.reshape(following.batch_size), previous, pad=0)
        return next_tensordict.set(self.key, following)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Partial resets are merged by the environment, which discards the rows not reset.
        layout = self._resolve()
        self._check_finite(
            tensordict_reset.get(self.observation_key), tensordict.get("_reset", None)
        )
        return tensordict_reset.set(
            self.key, layout.zero(tensordict_reset.batch_size, self.config, self.diagnostics)
        )

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Here nothing is merged afterwards, and the mask says which rows are new.
        nested = tensordict_reset.get(self.key)
        reset = tensordict.get("_reset").reshape(nested.batch_size)
        fresh = self._resolve().zero(nested.batch_size, self.config, self.diagnostics)
        return tensordict_reset.set(self.key, fresh.where(reset, nested))

    def _resolve(self) -> Layout:
        if self._layout is None or self._step_function is None:
            parent = self.parent
            if parent is None:
                raise RuntimeError("L1Transform belongs to no environment yet")
            layout = Layout.of(parent, self.observation_key, self.action_key, self.dtype)
            config = layout.bounded(self.config)
            config.check_dimensions(layout.observation_dim, layout.action_dim)
            self.model.check_dimensions(layout.observation_dim, layout.action_dim)
            if self._step_function is None or config != self._step_config:
                self._step_function = make_step(
                    config, self.model, self.compile_mode, self.diagnostics
                )
                self._step_config = config
            self._layout = layout
        return self._layout

    def _is_in_environment(self) -> bool:
        try:
            return self.container is not None
        except ValueError:  # TorchRL's answer where the container is a replay buffer
            return False

    def _check_order(self) -> None:
        chain = list(_flatten(self.container.transform))
        position = chain.index(self) if self in chain else len(chain)
        for later in chain[position + 1 :]:
            if self.observation_key in later.out_keys:
                raise ValueError(
                    f"{type(later).__name__} comes after L1Transform and overwrites "
                    f"{self.observation_key!r}, which L1 reads: put it before L1Transform, or "
                    "give it separate out_keys"
                )

    def _check_finite(self, observation: Tensor, reset: Tensor | None) -> None:
        bad = ~observation.isfinite().all(-1)
        if reset is not None and reset.numel() == bad.numel():
            bad = bad & reset.reshape(bad.shape)
        if bad.any():
            where = bad.nonzero().tolist()
            raise ValueError(
                f"the environment was reset to a {self.observation_key!r} that is not finite"
                + (f" (environments {where})" if bad.ndim else "")
            )

    def __repr__(self) -> str:
        return f"{type(self).__name__}(config={self.config}, key={self.key!r})"

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions do not travel between processes.
        return super().__getstate__() | {"_layout": None, "_step_function": None}


def _configuration(config: L1Config | None, dt: float | None, settings: dict[str, Any]) -> L1Config:
    if config is not None:
        given = [name for name, value in {"dt": dt, **settings}.items() if value is not None]
        if given:
            raise ValueError(f"give config or {given}, not both; see dataclasses.replace")
        return config
    if dt is None:
        raise ValueError("L1Transform needs dt, the time of one environment step, or a config")
    known = {field.name for field in fields(L1Config)}
    unknown = sorted(set(settings) - known)
    if unknown:
        raise TypeError(f"L1Transform got unknown settings {unknown}; L1Config has {sorted(known)}")
    return L1Config(dt, **settings)


def _flatten(transform: Transform) -> Iterator[Transform]:
    if isinstance(transform, Compose):
        for member in transform:
            yield from _flatten(member)
    else:
        yield transform
