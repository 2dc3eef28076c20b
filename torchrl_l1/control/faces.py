"""What the environment-side and the policy-side controller share."""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType
from typing import TypeAlias, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_l1.control import specs
from torchrl_l1.control.augmentation import augment
from torchrl_l1.control.compilation import CompileMode, compiled
from torchrl_l1.control.jacobian import ActionJacobian, ChangeFunction, DynamicsModel, Predicts
from torchrl_l1.control.law import L1Config, L1Diagnostics, L1State

Dynamics: TypeAlias = ActionJacobian | DynamicsModel | TensorDictModuleBase | ChangeFunction
Step = tuple[Tensor, L1State, L1Diagnostics]
StepFunction = Callable[[L1State, Tensor, Tensor], Step]


def as_action_jacobian(
    dynamics: Dynamics,
    observation_key: NestedKey,
    action_key: NestedKey,
    predicts: Predicts | None = None,
) -> ActionJacobian:
    """The dynamics as an :class:`ActionJacobian`, which is returned as it is."""
    if isinstance(dynamics, ActionJacobian):
        if predicts not in (None, dynamics.predicts):
            raise ValueError(
                f"predicts={predicts!r} was given, but the ActionJacobian has "
                f"predicts={dynamics.predicts!r}: give it there"
            )
        return dynamics
    return ActionJacobian(
        dynamics, observation_key=observation_key, action_key=action_key, predicts=predicts
    )


def make_step(config: L1Config, model: ActionJacobian, mode: CompileMode) -> StepFunction:
    """The step of L1 as a function of state, observation and action, compiled or not."""

    def step(state: L1State, observation: Tensor, u_rl: Tensor) -> Step:
        return augment(config, model, state, observation, u_rl)

    # Environments keep their batch size, so graphs with free sizes would only cost: and torch
    # cannot make dual tensors of them, which forward-mode Jacobians need.
    return compiled(cast(FunctionType, step), mode, dynamic=False)


def advance(
    step: StepFunction,
    tensordict: TensorDictBase,
    observation_key: NestedKey,
    action_key: NestedKey,
    key: str,
    *,
    owner: str,
    remedy: str,
    diagnostics: bool,
) -> tuple[Tensor, Tensor, TensorDict]:
    """Read a step's inputs from a tensordict and take the step.

    Returns:
        the policy's action, the executed input (both in the action's type) and the nested
        tensordict of what follows.
    """
    observation = required_entry(tensordict, observation_key, owner)
    action = required_entry(tensordict, action_key, owner)
    nested = tensordict.get(key, None)
    if nested is None or not isinstance(nested, TensorDictBase):
        raise KeyError(f"{owner} found no state under {key!r}: {remedy}")
    values = [nested.get(name, None) for name in L1State._fields]
    missing = [name for name, value in zip(L1State._fields, values, strict=True) if value is None]
    if missing:
        raise KeyError(f"{owner} found no {missing} under {key!r}: {remedy}")
    state = L1State(*values)
    for name, value, like in (
        (observation_key, observation, state.x_hat),
        (action_key, action, state.q),
    ):
        if value.shape != like.shape:
            raise ValueError(
                f"{owner}: {name!r} has shape {tuple(value.shape)}, expected {tuple(like.shape)} "
                f"as the state under {key!r}"
            )
    dtype = state.x_hat.dtype
    with torch.no_grad():
        executed, state, signals = step(state, observation.to(dtype), action.to(dtype))
    executed = executed.to(action.dtype)
    following = specs.pack(
        executed,
        state,
        signals if diagnostics else None,
        tensordict.batch_size,
        tensordict.device,
    )
    return action, executed, following


def required_entry(tensordict: TensorDictBase, key: NestedKey, owner: str) -> Tensor:
    """The entry, or a ``KeyError`` that says what there is instead."""
    value = tensordict.get(key, None)
    if value is None:
        found = sorted(map(str, tensordict.keys(include_nested=isinstance(key, tuple))))
        raise KeyError(f"{owner} found no {key!r} in the tensordict, only {found}")
    return value


def declared_dimension(model: ActionJacobian, name: str, given: int | None) -> int | None:
    """The width given, or else the one that the model declares."""
    declared = getattr(model.dynamics, name, None)
    declared = declared if isinstance(declared, int) else None
    if given is not None and declared is not None and given != declared:
        raise ValueError(f"{name}={given} was given, but the model has {name}={declared}")
    return declared if given is None else given
