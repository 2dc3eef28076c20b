"""The environment-side form of L1: a transform between the policy and the environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform

from torchrl_l1.compilation import CompileMode
from torchrl_l1.control.affine import StepFunction, make_step
from torchrl_l1.control.config import L1Config
from torchrl_l1.control.layout import (
    L1_KEY,
    Advanced,
    Dynamics,
    Layout,
    advance,
    as_action_jacobian,
    entry_name,
)
from torchrl_l1.control.module_model import Predicts
from torchrl_l1.control.pipeline import (
    Settings,
    carry,
    check_alone,
    check_order,
    check_resets,
    scales_actions,
    unspecified,
    warn_of_action_units,
    warn_of_surroundings,
    widen_selection,
)
from torchrl_l1.control.seal import SEAL, Emitted, sealed
from torchrl_l1.control.state import L1Diagnostics, L1State, state_names
from torchrl_l1.control.step_time import check_time_step


@dataclass
class _Last:
    """What one process remembers from one call to the next.

    These are not the module's own attributes, since setting one of those costs as much as a small
    kernel.

    Attributes:
        ahead: what the current step has found.
        emitted: what was sealed last.
        consumed: the seal from which the last step was taken.
        repeats: how often it was taken again.
    """

    ahead: Advanced | None = None
    emitted: Emitted | None = None
    consumed: Tensor | None = None
    repeats: int = 0


class L1Transform(Transform):
    """L1 adaptive control inside an environment (arXiv 2403.14860, Algorithm 2).

    The policy's action stays in ``action``, so replay data hold what the paper stores; the
    environment receives the executed input. Under ``key`` the tensordict carries the controller's
    state (:class:`~torchrl_l1.control.L1State`) from step to step, and ``("next", key)`` also holds
    the executed input ``u_exec`` and the diagnostics (:class:`~torchrl_l1.control.L1Diagnostics`).
    A reset restarts the controller in the environments being reset and in no others.

    Order matters, as the last transform of ``Compose`` meets the action first. Transforms that
    disturb the executed input (noise, bias), repeat it (``FrameSkipTransform``) or change the
    observation, to which the model must have been fitted, come before this one. Those that map the
    policy's action to the units of L1 (``ActionScaling``) come after it. L1 rejects a wrong order
    that it can see. What it cannot see in the chain it notices at the next step: the observation
    that it reads must be the one that it passed on, and its state that of the last step. A change
    of type or device is allowed.

    No gradient flows through L1: to autograd, what the environment receives does not depend on the
    policy's action.

    Action bounds that the configuration leaves open are taken from the action spec if it is
    bounded; infinite bounds in the configuration turn clipping off.

    The model is referenced, not registered: it keeps its train mode and device, its weights are not
    in the environment's ``state_dict``, and in-place updates take effect at the next step. Worker
    processes of a ``ParallelEnv`` of transformed environments hold copies; keep L1 outside it while
    the model is being trained.

    Args:
        dynamics: the learned model, see :class:`~torchrl_l1.control.ActionJacobian`; an
            ``ActionJacobian`` is used as it is.
        config: the settings; alternatively give ``dt`` and other fields of :class:`L1Config` here.
        dt: time of one environment step in seconds; the environment's own if ``None``, see
            :func:`~torchrl_l1.control.time_step`.
        observation_key: key of the observation.
        action_key: key of the action.
        key: name of the nested tensordict that holds the controller's entries.
        compile: ``True`` compiles the step, which makes the first step take some tens of seconds;
            ``"auto"`` does so if a compiler works.
        diagnostics: whether to write the diagnostics.
        dtype: type in which the controller computes; if ``None``, that of the model's parameters,
            or the observation's for a model without any.
        predicts: what ``dynamics`` predicts, ``"change"`` or ``"next_observation"``; ``None``
            decides as :class:`~torchrl_l1.control.ActionJacobian` does.
        out_key: key of the prediction, for a model with several output keys.
        ensemble_dim: output dimension over which the mean is taken, for a model that returns one
            prediction per ensemble member.
        check_dt: whether ``dt`` must match that of an environment that declares one.
        check: whether each step checks that the observation and the controller's state are those
            from the previous step; turn it off to edit them on purpose.
        **settings: further fields of :class:`L1Config` (``epsilon``, ``cutoff``, ...).

    Raises:
        ValueError: if a setting, a width, the time step or the order of transforms does not fit; at
            a reset to an observation that is not finite; or at a step whose observation or state is
            not that of the previous step.
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

    controls = True

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
        out_key: NestedKey | None = None,
        ensemble_dim: int | None = None,
        check_dt: bool = True,
        check: bool = True,
        **settings: Any,
    ) -> None:
        super().__init__()
        self._settings = Settings("L1Transform", config, dt, settings)
        self.model = as_action_jacobian(
            dynamics,
            observation_key,
            action_key,
            predicts,
            out_key=out_key,
            ensemble_dim=ensemble_dim,
        )
        self.observation_key = unravel_key(observation_key)
        self.action_key = unravel_key(action_key)
        self.key = entry_name(key, "L1Transform")
        self._pending = f"_{key}_pending"
        self._state_names = state_names(self._settings.config)
        self.check_dt, self.check = check_dt, check
        self.compile_mode = compile
        self.diagnostics = diagnostics
        self.dtype = dtype
        self._layout: Layout | None = None
        self._zero: tuple[Layout, L1Config, TensorDictBase] | None = None
        self._is_ready = self._is_stateful = False
        self._step_config: L1Config | None = None
        self._step_function: StepFunction | None = None
        self._last = _Last()
        self._lacking: list[str] | None = None

    @property
    def config(self) -> L1Config:
        """The settings.

        Raises:
            ValueError: if the time step is the environment's, and there is none yet.
        """
        if not self._settings.is_complete:
            raise ValueError(
                "L1Transform knows dt only once an environment that declares it is reset: give "
                "dt otherwise"
            )
        return self._settings.config

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attach to an environment, whose specs then determine widths and bounds."""
        self._forget()
        super().set_container(container)
        if self._is_in_environment():
            self._check_order()

    def empty_cache(self) -> None:
        """Forget what came from the specs: a transform before this one may have changed them."""
        self._forget()
        super().empty_cache()

    def _forget(self) -> None:
        self._layout = self._zero = None
        self._last = _Last()
        self._lacking = None

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the controller's state and signals."""
        self._check_order()
        if observation_spec.get(self.key, None) is not None:
            raise ValueError(
                f"the environment already has entries under {self.key!r}, of another controller? "
                "Leave one of them out or, if it controls another action, give L1Transform its own "
                "key"
            )
        layout = self._resolve()
        observation_spec[self.key] = layout.spec(self._settings.config, self.diagnostics)
        return observation_spec

    def transform_state_spec(self, state_spec: TensorSpec) -> TensorSpec:
        """Add the controller's state, which a step reads."""
        state_spec[self.key] = self._resolve().state_spec(self._settings.config)
        return state_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Rejected: L1 acts at the steps of an environment, not on stored data."""
        raise RuntimeError(
            "L1Transform acts inside an environment: append it to a TransformedEnv, not to a "
            "replay buffer. Stored data already hold the executed input, under "
            f"{('next', self.key, 'u_exec')}"
        )

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._layout is None or not self._is_ready:
            # After copying, or when a transform before this one was added or removed without a
            # reset.
            if not self._is_in_environment():
                return self.forward(tensordict)
            self._complete()
        if tensordict.get(self._pending, None) is not None:
            raise ValueError(
                "L1Transform is applied again to its own output: a transform after it repeats the "
                "step, as FrameSkipTransform does; it must come before L1Transform in Compose"
            )
        assert self._step_function is not None and self._step_config is not None
        ahead = advance(
            self._step_function,
            self._state_names,
            tensordict,
            self.observation_key,
            self.action_key,
            self.key,
            owner="L1Transform",
            remedy="reset the environment first and pass on what reset or step_mdp returned",
            config=self._step_config,
            check=self.check,
            emitted=self._last.emitted,
        )
        if self.check and not torch.compiler.is_compiling():
            self._check_repeated(ahead.seal)
        # Values already at hand need not be read again.
        self._last.ahead = None if torch.compiler.is_compiling() else ahead
        # The caller's tensordict keeps the policy's action: this one is a shallow copy.
        tensordict.set(self.action_key, ahead.executed)
        return tensordict.set(self._pending, ahead.following)

    def _check_repeated(self, seal: Tensor | None) -> None:
        """Reject a step taken twice each time, as by a FrameSkipTransform around."""
        last = self._last
        if seal is None or last.emitted is None or not self._is_stateful:
            return
        if seal is last.emitted.seal or _equal(seal, last.emitted.seal):
            if last.repeats:
                raise ValueError(
                    f"L1Transform stepped {last.repeats + 1} times from one state before it came "
                    "to the next: put what repeats the action, such as FrameSkipTransform, before "
                    "it in Compose"
                )
            last.consumed = seal if seal is last.emitted.seal else seal.clone()
        elif last.consumed is not None and _equal(seal, last.consumed):
            last.repeats += 1
        else:
            last.consumed, last.repeats = seal.clone(), 0

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        following = tensordict.get(self._pending)
        ahead, self._last.ahead = self._last.ahead, None
        state = ahead.state if ahead is not None and ahead.following is following else None
        stepped = tensordict.get("_step", None)
        if stepped is not None:
            previous = tensordict.get(self.key).select(*following.keys(), strict=False)
            following = following.where(stepped.reshape(following.batch_size), previous, pad=0)
            state = None
        # Environments may continue without asking: the seal is on what came out.
        self._seal(following, next_tensordict.get(self.observation_key), state)
        return next_tensordict.set(self.key, following)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Partial resets are merged by the environment, which discards the rows not reset.
        self._complete()
        self._check_dtype()
        self._last.repeats = 0
        observation = tensordict_reset.get(self.observation_key)
        self._check_finite(observation, tensordict.get("_reset", None))
        return tensordict_reset.set(self.key, self._fresh(tensordict_reset))

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Nothing is merged afterwards here, and the mask says which rows are new.
        nested = tensordict_reset.get(self.key)
        reset = tensordict.get("_reset").reshape(nested.batch_size)
        fresh = self._fresh(tensordict_reset)
        return tensordict_reset.set(self.key, fresh.where(reset, nested))

    def _post_step_mdp_hooks(
        self, tensordict: TensorDictBase, tensordict_: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        if self._lacking is None:
            self._lacking = unspecified(self, self.key, (*self._state_names, SEAL))
        carry(self._lacking, "L1Transform", self.key, tensordict, tensordict_)
        return tensordict, tensordict_

    def _check_batched_worker_compat(self) -> None:
        lacking = unspecified(self, self.key, (*self._state_names, SEAL))
        if lacking:
            raise ValueError(
                f"a batched environment would lose {lacking} of L1Transform, which a later "
                f"transform removes from the specs: let it keep {self.key!r} and all that is in it"
            )

    def _fresh(self, tensordict_reset: TensorDictBase) -> TensorDictBase:
        batch_size, kept = tensordict_reset.batch_size, self._zero
        layout, config = self._resolve(), self._settings.config
        # Kept, since some environment of a batch is reset every few steps.
        if kept is None or kept[:2] != (layout, config) or kept[2].batch_size != batch_size:
            kept = self._zero = layout, config, layout.zero(batch_size, config, self.diagnostics)
        fresh = kept[2].clone()
        self._seal(fresh, tensordict_reset.get(self.observation_key))
        return fresh

    def _seal(
        self, nested: TensorDictBase, observation: Tensor, state: L1State | None = None
    ) -> None:
        """Write the seal beside the state, reading the state there if not given."""
        if state is None:
            found = dict(nested.items())
            state = L1State(**{name: found[name] for name in self._state_names})
        seal = sealed(observation, state)
        nested.set(SEAL, seal)
        if not torch.compiler.is_compiling():
            self._last.emitted = Emitted.of(observation, state, seal)

    def _resolve(self) -> Layout:
        if self._layout is None:
            parent = self.parent
            if parent is None:
                raise RuntimeError("L1Transform belongs to no environment yet")
            dtype = self.model.dtype if self.dtype is None else self.dtype
            layout = Layout.of(parent, self.observation_key, self.action_key, dtype)
            dimensions = layout.observation_dim, layout.action_dim
            layout.bounded(self._settings.config).check_dimensions(*dimensions)
            self.model.check_dimensions(*dimensions)
            # An environment with its state in the tensordict may step from any state, even twice.
            self._is_stateful = not list(parent.base_env.full_state_spec.keys(True, True))
            self._layout, self._is_ready, self._zero = layout, False, None
        return self._layout

    def _complete(self) -> None:
        """Make the step function, now that the environment runs and its properties are known."""
        if self._layout is not None and self._is_ready:
            return
        layout, parent = self._resolve(), self.parent
        check_resets("L1Transform", parent)
        check_alone(self, self.container)
        config = self._settings.complete(parent)
        if self.check_dt:
            check_time_step("L1Transform", config.dt, parent)
        bounds = config.action_low, config.action_high
        spec = layout.low, layout.high
        keys = self.observation_key, self.action_key
        warn_of_surroundings("L1Transform", parent, *keys, bounds, spec)
        config = layout.bounded(config)
        limits, scaled = (config.action_low, config.action_high), scales_actions(parent)
        warn_of_action_units(self.model.dynamics, *limits, scaled)
        if self._step_function is None or config != self._step_config:
            self._step_function = make_step(config, self.model, self.compile_mode, self.diagnostics)
            self._step_config = config
        self._is_ready = True

    def _check_dtype(self) -> None:
        """Reject a model whose type is not the one in the specs."""
        now, layout = self.model.dtype, self._resolve()
        if self.dtype is None and now not in (None, layout.dtype):
            raise ValueError(
                f"the model is of {now} and was of {layout.dtype} when L1Transform came into the "
                "environment: convert it first, or create the environment again"
            )

    def _check_order(self) -> None:
        names = (*self._state_names, SEAL)
        check_order(self, self.observation_key, self.action_key, self.key, names)
        widen_selection(self, self.key, (*names, "u_exec", *L1Diagnostics._fields))

    def _is_in_environment(self) -> bool:
        try:
            return self.container is not None
        except ValueError:  # TorchRL's answer where the container is a replay buffer
            return False

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
        return f"{type(self).__name__}(config={self._settings.config}, key={self.key!r})"

    def __getstate__(self) -> dict[str, Any]:
        # Compiled functions cannot be sent to other processes.
        empty = {
            "_step_function": None,
            "_layout": None,
            "_zero": None,
            "_last": _Last(),
            "_lacking": None,
        }
        return super().__getstate__() | empty


def _equal(one: Tensor, other: Tensor) -> bool:
    return one.shape == other.shape and torch.equal(one, other)
