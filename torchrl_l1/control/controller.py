"""The policy-side form of L1: a module that turns the actor's action into the executed input."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.transforms import TensorDictPrimer, Transform

from torchrl_l1.compilation import CompileMode
from torchrl_l1.control.affine import StepFunction, make_step
from torchrl_l1.control.config import L1Config, Scalars, with_open_bounds
from torchrl_l1.control.layout import (
    L1_KEY,
    Dynamics,
    Layout,
    action_bounds,
    advance,
    as_action_jacobian,
    declared_dimension,
    entry_name,
    required_entry,
    vector_spec,
)
from torchrl_l1.control.module_model import Predicts
from torchrl_l1.control.pipeline import (
    Settings,
    carry,
    chain_of,
    check_alone,
    check_resets,
    leaf_spec,
    unspecified,
    warn_of_action_units,
    warn_of_surroundings,
    widen_selection,
)
from torchrl_l1.control.seal import SEAL, Emitted, sealed
from torchrl_l1.control.state import L1Diagnostics, L1State, state_names
from torchrl_l1.control.step_time import check_time_step


class _Environment:
    """What a controller knows of its environment, as reported by its primers."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.is_known = False
        self.low: Scalars | None = None
        self.high: Scalars | None = None
        self.emitted: Emitted | None = None
        self.sent: Tensor | None = None
        self._filled: tuple[L1Config, L1Config] | None = None

    @property
    def config(self) -> L1Config:
        """The settings, with open bounds filled in."""
        config = self.settings.config
        if self._filled is None or self._filled[0] is not config:
            self._filled = config, with_open_bounds(config, self.low, self.high)
        return self._filled[1]

    def learn(self, low: Scalars | None, high: Scalars | None) -> None:
        """Take over the action bounds of an environment.

        Raises:
            ValueError: if another environment reported different bounds.
        """
        if self.is_known and (low, high) != (self.low, self.high):
            raise ValueError(
                "the primers of one L1Controller are in environments with different action bounds: "
                "give it action_spec, or action_low and action_high"
            )
        self.low, self.high, self.is_known = low, high, True
        self._filled = None

    def __deepcopy__(self, memo: dict[int, Any]) -> _Environment:
        # Copies of a policy, as collectors make them, act in the same environment.
        return self

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"emitted": None, "sent": None}


class L1Primer(TensorDictPrimer):
    """Starts the state of an :class:`L1Controller` at each reset and carries it from step to step.

    Made by :meth:`L1Controller.make_primer`. It seals each observation and state for the controller
    to check, and reports the environment's action bounds and time step to the controller.

    Raises:
        ValueError: at a reset, if the controller's ``dt`` differs from the environment's.
        KeyError: at a step, if the observation or what the controller wrote is missing.
    """

    controls = True

    def __init__(
        self,
        environment: _Environment,
        layout: Layout,
        observation_key: NestedKey,
        action_key: NestedKey,
        key: str,
        diagnostics: bool,
        check_dt: bool,
        has_dtype: bool,
    ) -> None:
        config = environment.settings.config
        super().__init__(Composite({key: layout.state_spec(config)}), expand_specs=True)
        self._shared = environment
        self._layout, self._diagnostics, self._has_dtype = layout, diagnostics, has_dtype
        self._signals = layout.signal_spec(diagnostics)
        self.observation_key = unravel_key(observation_key)
        self.action_key = unravel_key(action_key)
        self.key = key
        self.check_dt = check_dt
        self._state_names = state_names(config)
        self._is_checked = False
        self._lacking: list[str] | None = None

    def empty_cache(self) -> None:
        """Forget what the environment reported: a transform may have been added or removed."""
        self._is_checked = False
        self._lacking = None
        super().empty_cache()

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attach to an environment."""
        super().set_container(container)
        names = (*self._state_names, SEAL, "u_exec", *L1Diagnostics._fields)
        widen_selection(self, self.key, names)

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Add the controller's state."""
        self._adopt_types()
        return super().transform_input_spec(input_spec)

    def _adopt_types(self) -> None:
        """Take the action's dtype from the environment, and the model's if the model has none."""
        parent, layout = self.parent, self._layout
        if parent is None:
            return
        types = {"action_dtype": parent.full_action_spec.get(self.action_key, None)}
        if not self._has_dtype:
            types["dtype"] = parent.full_observation_spec.get(self.observation_key, None)
        found = {name: spec.dtype for name, spec in types.items() if spec is not None}
        floating = {name: dtype for name, dtype in found.items() if dtype.is_floating_point}
        self._layout = replace(layout, **floating)
        if self._layout != layout:
            primers = Composite({self.key: self._layout.state_spec(self._shared.settings.config)})
            device: torch.device | None = self.device
            self.primers: Composite = primers if device is None else primers.to(device)
            self._signals = self._layout.signal_spec(self._diagnostics)

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Add the controller's state and signals."""
        self._adopt_types()
        is_there = output_spec["full_observation_spec"].get(self.key, None) is not None
        if is_there and not self._has_a_twin():
            raise ValueError(
                f"the environment already has entries under {self.key!r}, of another controller or "
                "primer: leave one of them out or, if it controls another action, give "
                "L1Controller its own key"
            )
        output_spec = super().transform_output_spec(output_spec)
        observation_spec = output_spec["full_observation_spec"]
        signals = self._signals.expand(observation_spec.shape).to(observation_spec.device)
        observation_spec[self.key].update(signals)
        return output_spec

    def _has_a_twin(self) -> bool:
        """Whether another primer of this controller comes first, such as one a collector added."""
        chain = chain_of(self)
        before = chain[: next(index for index, member in enumerate(chain) if member is self)]
        return any(map(self._is_twin, before))

    def _is_twin(self, other: nn.Module) -> bool:
        return isinstance(other, L1Primer) and other._shared is self._shared

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        nested = next_tensordict.get(self.key, None)
        if nested is None or nested.get(self._state_names[0], None) is None:
            nested = self._without_controller(tensordict)
        stepped = tensordict.get("_step", None)
        if stepped is not None:
            previous = tensordict.get(self.key).select(*nested.keys(), strict=False)
            nested = nested.where(stepped.reshape(nested.batch_size), previous, pad=0)
        # The controller could not know the observation to come.
        nested = nested.clone(False)
        self._seal(nested, next_tensordict)
        return next_tensordict.set(self.key, nested)

    def _post_step_mdp_hooks(
        self, tensordict: TensorDictBase, tensordict_: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        if self._lacking is None:
            self._lacking = unspecified(self, self.key, (*self._state_names, SEAL))
        carry(self._lacking, "L1Controller's primer", self.key, tensordict, tensordict_)
        return tensordict, tensordict_

    def _without_controller(self, tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict.get((self.key, "u_rl"), None) is not None:
            raise KeyError(
                f"L1Controller's primer found nothing under {('next', self.key)}: what the "
                "controller wrote was lost between the policy and the environment"
            )
        # A step of another policy, as with random frames: L1 starts after it.
        nested = tensordict.get(self.key)
        return nested.apply(torch.zeros_like)

    def _reset_func(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._ask()
        tensordict_reset = super()._reset_func(tensordict, tensordict_reset)
        nested = tensordict_reset.get(self.key, None)
        if nested is not None:
            nested.update(self._signals.expand(nested.batch_size).to(nested.device).zero())
            self._seal(nested, tensordict_reset)
        return tensordict_reset

    def _seal(self, nested: TensorDictBase, around: TensorDictBase) -> None:
        observation = required_entry(around, self.observation_key, "L1Controller's primer")
        state = L1State(**{name: nested.get(name) for name in self._state_names})
        seal = sealed(observation, state)
        nested.set(SEAL, seal)
        if not torch.compiler.is_compiling():
            self._shared.emitted = Emitted.of(observation, state, seal)

    def _ask(self) -> None:
        environment = self.container
        if self._is_checked or environment is None:
            return
        check_resets("L1Controller", environment)
        check_alone(self, environment, self._is_twin)
        action = vector_spec(environment, "action", self.action_key)
        observation = vector_spec(self.parent, "observation", self.observation_key)
        layout = self._layout
        for name, width, spec in (
            ("observation_dim", layout.observation_dim, observation),
            ("action_dim", layout.action_dim, action),
        ):
            if spec.shape[-1] != width:
                raise ValueError(
                    f"L1Controller has {name}={width}, but the environment's has width "
                    f"{spec.shape[-1]}"
                )
        settings = self._shared.settings
        config = settings.complete(environment, is_shared=True)
        if self.check_dt:
            check_time_step("L1Controller", config.dt, environment, was_given=settings.has_dt)
        try:
            told = action_bounds(action)
        except ValueError:  # of environments with different ones
            if config.action_low is None or config.action_high is None:
                raise
            told = None, None
        bounds = config.action_low, config.action_high
        keys = self.observation_key, self.action_key
        warn_of_surroundings("L1Controller", environment, *keys, bounds, told)
        if None in bounds:
            self._shared.learn(*told)
        self._is_checked = True


class L1Controller(TensorDictModuleBase):
    """L1 adaptive control after an actor (arXiv 2403.14860, Algorithm 2).

    It reads the observation, the actor's action and the controller's state. It replaces the action
    by the executed input, keeps the actor's action under ``(key, "u_rl")``, and writes the next
    state, the executed input ``u_exec`` and the diagnostics
    (:class:`~torchrl_l1.control.L1Diagnostics`) under ``("next", key)``. The environment needs the
    primer of :meth:`make_primer`, which starts the state at each reset and carries it from step to
    step. No gradient flows through the controller: log-probabilities belong to ``(key, "u_rl")``.

    :class:`~torchrl_l1.control.L1Transform` does the same inside the environment and leaves
    ``action`` as the policy's; prefer it unless the environment cannot be wrapped.

    The model is referenced, not registered: its weights are not among this module's parameters, and
    in-place updates take effect at the next step.

    Args:
        dynamics: the learned model, see :class:`~torchrl_l1.control.ActionJacobian`; an
            ``ActionJacobian`` is used as it is.
        config: the settings; alternatively give ``dt`` and other fields of :class:`L1Config` here.
            Action bounds that they leave open come from ``action_spec`` or else, once it is reset,
            from the environment that has the primer; infinite bounds turn clipping off.
        dt: time of one environment step in seconds; if ``None``, that of the environment with the
            primer.
        action_spec: spec of the action that leaves the controller, such as ``env.action_spec``. It
            may be needed where policy and environment are copied into another process.
        observation_key: key of the observation.
        action_key: key of the action, replaced by the executed input.
        key: name of the nested tensordict that holds the controller's entries.
        observation_dim: width of the observation; :meth:`make_primer` needs it if the model has no
            attribute of that name.
        action_dim: width of the action, likewise.
        compile: ``True`` compiles the step, ``"auto"`` does so if a compiler works.
        diagnostics: whether to write the diagnostics.
        predicts: what ``dynamics`` predicts, ``"change"`` or ``"next_observation"``; ``None``
            decides as :class:`~torchrl_l1.control.ActionJacobian` does.
        out_key: key of the prediction, for a model with several output keys.
        ensemble_dim: output dimension over which the mean is taken, for a model that returns one
            prediction per ensemble member.
        check_dt: whether ``dt`` must match that of an environment that declares one.
        check: whether each step checks that the observation and the controller's state are those
            that the primer passed on.
        **settings: further fields of :class:`L1Config` (``epsilon``, ``cutoff``, ...).

    Raises:
        KeyError: on a call, if the observation, the action or the controller's state is missing.
        ValueError: if a setting, a width or the time step does not fit, or if the observation or
            the state is not what the primer passed on. Non-finite data raise nothing: L1 then
            stands aside and restarts, see :func:`~torchrl_l1.control.law.step`.

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule, TensorDictSequential
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_l1.dynamics import EnsembleDynamics
        >>> model = EnsembleDynamics(3, 1, hidden=(16,))
        >>> l1 = L1Controller(model, dt=0.05)
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), l1.make_primer())
        >>> actor = TensorDictModule(torch.nn.Linear(3, 1), ["observation"], ["action"])
        >>> data = env.rollout(4, TensorDictSequential(actor, l1))
        >>> data["next", "l1", "u_exec"].shape, data["l1", "u_rl"].shape
        (torch.Size([4, 1]), torch.Size([4, 1]))
    """

    def __init__(
        self,
        dynamics: Dynamics,
        config: L1Config | None = None,
        *,
        dt: float | None = None,
        action_spec: TensorSpec | None = None,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        key: str = L1_KEY,
        observation_dim: int | None = None,
        action_dim: int | None = None,
        compile: CompileMode = False,
        diagnostics: bool = True,
        predicts: Predicts | None = None,
        out_key: NestedKey | None = None,
        ensemble_dim: int | None = None,
        check_dt: bool = True,
        check: bool = True,
        **settings: Any,
    ) -> None:
        super().__init__()
        self._environment = _Environment(Settings("L1Controller", config, dt, settings))
        self.model = as_action_jacobian(
            dynamics,
            observation_key,
            action_key,
            predicts,
            out_key=out_key,
            ensemble_dim=ensemble_dim,
        )
        self.observation_key = observation_key
        self.action_key = action_key
        self.key = entry_name(key, "L1Controller")
        self.compile_mode = compile
        self.diagnostics = diagnostics
        self.check_dt, self.check = check_dt, check
        if action_spec is not None:
            action_spec = leaf_spec(action_spec)
            self._environment.settings.bound(*action_bounds(action_spec))
            if action_dim is None:
                action_dim = action_spec.shape[-1]
        self._dims = (
            declared_dimension(self.model, "observation_dim", observation_dim),
            declared_dimension(self.model, "action_dim", action_dim),
        )
        self._state_names = state_names(self._environment.settings.config)
        self.in_keys = [observation_key, action_key, *((key, name) for name in self._state_names)]
        self.out_keys = [action_key, (key, "u_rl")]
        self.out_keys += [("next", key, name) for name in (*self._state_names, "u_exec")]
        self._step: StepFunction | None = None
        self._step_config: L1Config | None = None

    @property
    def config(self) -> L1Config:
        """The settings, completed by the environment's action bounds and time step.

        Raises:
            ValueError: if the time step is the environment's, and no environment has declared it
                yet.
        """
        if not self._environment.settings.is_complete:
            raise ValueError(
                "L1Controller knows dt only once an environment with its primer declares it and is "
                "reset: give dt otherwise"
            )
        return self._environment.config

    @property
    def policy_action_key(self) -> tuple[str, str]:
        """Key of the policy's action, to which its log-probabilities belong.

        A loss on collected data reads it as ``loss.set_keys(action=controller.policy_action_key)``.
        """
        return self.key, "u_rl"

    def make_primer(self) -> L1Primer:
        """Transform that adds the controller's state to the environment, zero at every reset."""
        observation_dim, action_dim = self._dims
        if observation_dim is None or action_dim is None:
            raise ValueError(
                "the primer needs the widths of observation and action, and the model does not "
                "declare them: give L1Controller observation_dim and action_dim"
            )
        self._environment.config.check_dimensions(observation_dim, action_dim)
        known = self.model.dtype
        dtype = known or torch.get_default_dtype()
        layout = Layout(torch.Size([]), observation_dim, action_dim, dtype, dtype)
        keys = self.observation_key, self.action_key, self.key
        settings = self.diagnostics, self.check_dt, known is not None
        return L1Primer(self._environment, layout, *keys, *settings)

    # The name under which torchrl.modules.utils.get_primers_from_module looks for it.
    make_tensordict_primer = make_primer

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Take one step of the controller, see the class."""
        environment, is_eager = self._environment, not torch.compiler.is_compiling()
        action = tensordict.get(self.action_key, None)
        if is_eager and action is not None and action is environment.sent:
            raise ValueError(
                f"L1Controller is applied again to {self.action_key!r}, its own output: the policy "
                "contains it twice, or wrote no action before it"
            )
        ahead = advance(
            self._prepared(),
            self._state_names,
            tensordict,
            self.observation_key,
            self.action_key,
            self.key,
            owner="L1Controller",
            remedy="append the primer to the environment, "
            "TransformedEnv(env, controller.make_primer())",
            config=self.config,
            check=self.check,
            emitted=self._environment.emitted,
            seal_is_required=False,
        )
        is_rollout = ahead.seal is not None or tensordict.get((self.key, SEAL), None) is not None
        if is_eager and not is_rollout and ahead.u_rl.requires_grad and torch.is_grad_enabled():
            raise ValueError(
                "no gradient flows through L1Controller, and here is none of its primer's data: "
                "give a loss the actor alone, or act under torch.no_grad()"
            )
        if is_eager:
            environment.sent = ahead.executed
        tensordict.set((self.key, "u_rl"), ahead.u_rl)
        tensordict.set(self.action_key, ahead.executed)
        tensordict.set(("next", self.key), ahead.following)
        return tensordict

    def _prepared(self) -> StepFunction:
        config = self.config
        if self._step is None or config != self._step_config:
            if not self._environment.is_known and None in (config.action_low, config.action_high):
                warnings.warn(
                    "L1Controller has no action bounds, so its output is not clipped: give it "
                    "action_spec=env.action_spec, or infinite action_low and action_high if that "
                    "is meant",
                    UserWarning,
                    stacklevel=3,
                )
            warn_of_action_units(self.model.dynamics, config.action_low, config.action_high)
            self._step = make_step(config, self.model, self.compile_mode, self.diagnostics)
            self._step_config = config
        return self._step

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions cannot be sent to other processes.
        return self.__dict__ | {"_step": None}
