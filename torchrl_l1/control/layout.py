"""The tensordict side of L1: specs of its state and signals, and code that both forms share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from torchrl_l1.control.affine import StepFunction
from torchrl_l1.control.config import L1Config, Scalars, with_open_bounds
from torchrl_l1.control.jacobian import ActionJacobian, ChangeFunction, DynamicsModel
from torchrl_l1.control.module_model import Predicts
from torchrl_l1.control.seal import SEAL, Emitted, seal_width, verify
from torchrl_l1.control.signals import saturate
from torchrl_l1.control.state import L1Diagnostics, L1State, init

L1_KEY = "l1"
"""Default key of the nested tensordict that holds the controller's state and signals."""


def entry_name(key: str, owner: str) -> str:
    """The name of the nested tensordict, checked to be a single name.

    Raises:
        TypeError: if it is a key of several parts.
    """
    if not isinstance(key, str):
        raise TypeError(f"{owner} keeps its entries under one name: key must be a str, got {key!r}")
    return key


_FLAGS = ("switch", "ill_conditioned", "non_finite")


@dataclass(frozen=True)
class Layout:
    """Shapes and types of the controller's entries for one environment.

    Attributes:
        batch_size: the environment's batch size.
        observation_dim: width of the observation, n.
        action_dim: width of the action, m.
        dtype: type in which the controller computes.
        action_dtype: type of the action.
        device: the environment's device.
        low: lower action bound of the action spec; ``None`` if it has none.
        high: upper action bound.
    """

    batch_size: torch.Size
    observation_dim: int
    action_dim: int
    dtype: torch.dtype
    action_dtype: torch.dtype
    device: torch.device | None = None
    low: Scalars | None = None
    high: Scalars | None = None

    @classmethod
    def of(
        cls,
        env: EnvBase,
        observation_key: NestedKey,
        action_key: NestedKey,
        dtype: torch.dtype | None = None,
    ) -> Layout:
        """Layout for an environment; ``dtype`` is the observation's if ``None``.

        Raises:
            KeyError: if the environment has no such observation or action.
            ValueError: if they are not vectors of floating-point numbers.
        """
        observation = vector_spec(env, "observation", observation_key)
        action = vector_spec(env, "action", action_key)
        low, high = action_bounds(action)
        return cls(
            batch_size=env.batch_size,
            observation_dim=observation.shape[-1],
            action_dim=action.shape[-1],
            dtype=observation.dtype if dtype is None else dtype,
            action_dtype=action.dtype,
            device=env.device,
            low=low,
            high=high,
        )

    def bounded(self, config: L1Config) -> L1Config:
        """The configuration with open action bounds filled in from the action spec."""
        return with_open_bounds(config, self.low, self.high)

    def state_spec(self, config: L1Config) -> Composite:
        """Spec of an :class:`~torchrl_l1.control.L1State` with these settings, and of its seal."""
        state = init([], self.observation_dim, self.action_dim, config, dtype=self.dtype)
        entries = {name: (value.shape[-1], value.dtype) for name, value in state.entries().items()}
        width = seal_width(self.observation_dim, self.action_dim, bool(state.memory()))
        entries[SEAL] = (width, state.q.dtype)
        return self._composite(entries)

    def signal_spec(self, diagnostics: bool = True) -> Composite:
        """Spec of the executed input ``u_exec`` and, if wanted, the diagnostics."""
        entries = {"u_exec": (self.action_dim, self.action_dtype)}
        if diagnostics:
            for name in L1Diagnostics._fields:
                entries[name] = (1, torch.bool if name in _FLAGS else self.dtype)
        return self._composite(entries)

    def spec(self, config: L1Config, diagnostics: bool = True) -> Composite:
        """Spec of the state, the executed input ``u_exec`` and, if wanted, the diagnostics."""
        spec = self.state_spec(config)
        spec.update(self.signal_spec(diagnostics))
        return spec

    def zero(
        self, batch_size: torch.Size, config: L1Config, diagnostics: bool = True
    ) -> TensorDictBase:
        """Entries of a controller that has not started."""
        # An environment that is not batch-locked may add dimensions at reset.
        extra = batch_size[: len(batch_size) - len(self.batch_size)]
        return self.spec(config, diagnostics).zero(extra)

    def _composite(self, entries: dict[str, tuple[int, torch.dtype]]) -> Composite:
        specs: dict[str, TensorSpec] = {}
        for name, (width, dtype) in entries.items():
            shape = torch.Size([*self.batch_size, width])
            kind = Binary if dtype == torch.bool else Unbounded
            specs[name] = kind(shape=shape, dtype=dtype, device=self.device)
        return Composite(specs, shape=self.batch_size, device=self.device)


def pack(
    executed: Tensor,
    state: L1State,
    diagnostics: L1Diagnostics | None,
    batch_size: torch.Size,
    device: torch.device | None = None,
) -> TensorDict:
    """Nested tensordict of the next state, the executed input and the diagnostics."""
    entries = state.entries()
    entries["u_exec"] = executed
    if diagnostics is not None:
        entries.update(diagnostics._asdict())
    # Not TensorDict(...), whose checks of each entry would take most of the time.
    return TensorDict._new_unsafe(entries, batch_size=torch.Size(batch_size), device=device)


def vector_spec(env: EnvBase, kind: str, key: NestedKey) -> TensorSpec:
    """Spec of the observation or action, if it is a vector of floating-point numbers.

    Args:
        env: the environment.
        kind: ``"observation"`` or ``"action"``.
        key: of it.

    Raises:
        KeyError: if there is none under that key.
        ValueError: if it is something else.
    """
    specs = env.full_observation_spec if kind == "observation" else env.full_action_spec
    if key not in specs.keys(include_nested=True, leaves_only=True):
        found = sorted(map(str, specs.keys(include_nested=True, leaves_only=True)))
        raise KeyError(f"the environment has no {kind} {key!r}, only {found}: see {kind}_key")
    spec = specs[key]
    is_continuous = kind == "observation" or isinstance(spec, (Bounded, Unbounded))
    is_vector = spec.dtype.is_floating_point and spec.ndim == len(env.batch_size) + 1
    if not (is_continuous and is_vector and spec.shape[-1] > 0):
        raise ValueError(
            f"L1 needs a vector of floating-point numbers as {kind} {key!r}, but its spec is "
            f"{type(spec).__name__} of shape {tuple(spec.shape)} and type {spec.dtype}"
        )
    return spec


def action_bounds(action: TensorSpec) -> tuple[Scalars | None, Scalars | None]:
    """Bounds of an action spec; ``None`` if it has none.

    Raises:
        ValueError: if the environments of a batch have different bounds, or no room between them.
    """
    if not isinstance(action, Bounded):
        return None, None
    low, high = (
        bound.expand(action.shape).reshape(-1, action.shape[-1])
        for bound in (action.space.low, action.space.high)
    )
    if (low != low[0]).any() or (high != high[0]).any():
        raise ValueError(
            "the environments have different action bounds: give L1 the bounds to use as "
            "action_low and action_high"
        )
    locked = (low[0] >= high[0]).nonzero().flatten().tolist()
    if locked:
        raise ValueError(
            f"the action spec has low >= high in the entries {locked}, where L1 has nothing to "
            "choose: leave locked actuators out of the action"
        )
    return _scalars(low[0]), _scalars(high[0])


def _scalars(bound: Tensor) -> Scalars:
    # A number costs nothing per step; a tuple becomes a tensor each time.
    values = tuple(bound.tolist())
    return values[0] if values.count(values[0]) == len(values) else values


Dynamics: TypeAlias = ActionJacobian | DynamicsModel | TensorDictModuleBase | ChangeFunction


def as_action_jacobian(
    dynamics: Dynamics,
    observation_key: NestedKey,
    action_key: NestedKey,
    predicts: Predicts | None = None,
    *,
    out_key: NestedKey | None = None,
    ensemble_dim: int | None = None,
) -> ActionJacobian:
    """The dynamics as an :class:`ActionJacobian`; one given is returned as it is."""
    if isinstance(dynamics, ActionJacobian):
        if out_key is not None or ensemble_dim is not None:
            raise ValueError("give out_key and ensemble_dim to the ActionJacobian")
        if predicts not in (None, dynamics.predicts):
            raise ValueError(
                f"predicts={predicts!r} was given, but the ActionJacobian has "
                f"predicts={dynamics.predicts!r}: give it there"
            )
        return dynamics
    return ActionJacobian(
        dynamics,
        observation_key=observation_key,
        action_key=action_key,
        predicts=predicts,
        out_key=out_key,
        ensemble_dim=ensemble_dim,
    )


class Advanced(NamedTuple):
    """The result of :func:`advance`.

    Attributes:
        u_rl: the policy's action, in its own type.
        executed: the executed input, in the same type.
        following: nested tensordict of the next state and signals.
        state: the state in it.
        seal: the seal that was read, if any.
    """

    u_rl: Tensor
    executed: Tensor
    following: TensorDict
    state: L1State
    seal: Tensor | None


def advance(
    step: StepFunction,
    names: Sequence[str],
    tensordict: TensorDictBase,
    observation_key: NestedKey,
    action_key: NestedKey,
    key: str,
    *,
    owner: str,
    remedy: str,
    config: L1Config,
    check: bool = True,
    emitted: Emitted | None = None,
    seal_is_required: bool = True,
) -> Advanced:
    """Read a step's inputs and the named state entries, and take the step.

    Args:
        step: the controller's step.
        names: names of the state's entries.
        tensordict: the tensordict to read.
        observation_key: key of the observation.
        action_key: key of the action.
        key: key of the nested tensordict with the state.
        owner: name of the reading class, for errors.
        remedy: what to do if there is no state.
        config: the settings of the step.
        check: whether observation and state must be those that were sealed.
        emitted: what was sealed last.
        seal_is_required: whether a seal must be present.

    Returns:
        what was read, and the next state and signals.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if one has the wrong shape, or is not what was sealed.
    """
    observation = required_entry(tensordict, observation_key, owner)
    action = required_entry(tensordict, action_key, owner)
    nested = tensordict.get(key, None)
    if nested is None or not isinstance(nested, TensorDictBase):
        raise KeyError(
            f"{owner} found no state under {key!r}: {remedy}, and let no transform rename or "
            "remove it"
        )
    found = dict(nested.items())  # looking each one up would cost as much as a small kernel
    entries: dict[str, Any] = {name: found.get(name) for name in names}
    seal = found.get(SEAL) if check else None
    missing = [name for name, value in entries.items() if value is None]
    if check and seal_is_required and seal is None:
        missing.append(SEAL)
    if missing:
        lost = "a transform, a module or a collector removed it on the way; keep everything there"
        raise KeyError(f"{owner} found no {missing} under {key!r}: {lost}")
    state = L1State(**entries)
    for name, value, like in (
        (observation_key, observation, state.x_hat),
        (action_key, action, state.q),
    ):
        if value.shape != like.shape:
            hint = (
                "; what changes it (a normaliser, a later transform, the policy) needs separate "
                f"out_keys, or give {owner} the observation_key of the raw observation"
            )
            raise ValueError(
                f"{owner}: {name!r} has shape {tuple(value.shape)}, expected {tuple(like.shape)} "
                f"as the state under {key!r}" + (hint if name == observation_key else "")
            )
    dtype = state.x_hat.dtype
    if seal is not None:
        observation = verify(
            observation,
            state,
            seal,
            owner=owner,
            observation_key=observation_key,
            key=key,
            emitted=emitted,
            zero_is_none=not seal_is_required,
        )
    with torch.no_grad():
        executed, state, signals = step(state, observation.to(dtype), action.to(dtype))
    if executed.dtype != action.dtype:  # in which the bounds may be other numbers
        executed = saturate(config, executed.to(action.dtype))
    following = pack(executed, state, signals, tensordict.batch_size, tensordict.device)
    return Advanced(action, executed, following, state, seal)


def required_entry(tensordict: TensorDictBase, key: NestedKey, owner: str) -> Tensor:
    """The entry, or a ``KeyError`` that lists the entries there are instead."""
    value = tensordict.get(key, None)
    if value is None:
        found = sorted(map(str, tensordict.keys(include_nested=isinstance(key, tuple))))
        raise KeyError(
            f"{owner} found no {key!r} in the tensordict, only {found}: if a transform has "
            "renamed or removed it, keep it there or give its new key"
        )
    return value


def declared_dimension(model: ActionJacobian, name: str, given: int | None) -> int | None:
    """The width given, or else the one the model declares."""
    declared = getattr(model.dynamics, name, None)
    declared = declared if isinstance(declared, int) else None
    if given is not None and declared is not None and given != declared:
        raise ValueError(f"{name}={given} was given, but the model has {name}={declared}")
    return declared if given is None else given
