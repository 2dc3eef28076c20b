"""Environments of any library in terms of vectors, and access to the objects inside them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import gymnasium
import mujoco
import torch
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import (
    CatTensors,
    Compose,
    DTypeCastTransform,
    EnvBase,
    RewardSum,
    Transform,
    TransformedEnv,
    UnsqueezeTransform,
)

from torchrl_l1.control.pipeline import transforms_of
from torchrl_l1.envs.mujoco_env import BatchedMujocoEnv

AnyEnv: TypeAlias = EnvBase | gymnasium.Env[Any, Any]
"""An environment of TorchRL, or one of Gymnasium as it is."""


def vector_environment(env: EnvBase, keys: Sequence[str] = ()) -> EnvBase:
    """An environment with a vector ``observation`` and a vector ``action``, both float32.

    If the observation has several parts, as dm_control's has, they are joined in the order of their
    names. Actions are clipped to their bounds, as an actuator would, except in our own tasks.

    Args:
        env: the environment.
        keys: the parts that make up the observation, in this order; by default ``observation`` or,
            if there is no such part, all.

    Raises:
        TypeError: for an environment of Gymnasium.
        ValueError: if it has no such observation or action.
    """
    if isinstance(env, gymnasium.Env):
        name = type(env).__name__
        raise TypeError(f"{name} is an environment of Gymnasium: torchrl.envs.GymWrapper wraps it")
    actions = list(env.full_action_spec.keys(True, True))
    action = env.full_action_spec["action"] if actions == ["action"] else None
    continuous = isinstance(action, (Bounded, Unbounded)) and action.dtype.is_floating_point
    if action is None or not continuous or action.ndim != len(env.batch_size) + 1:
        raise ValueError(
            f"L1 needs one vector of continuous actions under 'action'; {type(env).__name__} has "
            f"{_in_words(env.full_action_spec)}"
        )
    transforms: list[Transform] = []
    found = vectors(env)
    check_keys(keys, found, type(env).__name__)
    if keys:
        found = {key: found[key] for key in keys}
    elif "observation" in found:
        found = {"observation": found["observation"]}
    if list(found) != ["observation"]:
        if not found:
            raise ValueError(
                f"{type(env).__name__} has no vector of floating-point observations, only "
                f"{sorted(map(str, env.full_observation_spec.keys(True, True)))}"
            )
        if not keys and (left_out := parts_left_out(env, found)):
            raise ValueError(unclear(left_out, found))
        transforms += _joined(env, list(keys) or sorted(found), found)
    kinds = {spec.dtype for spec in found.values()}
    kind = kinds.pop() if len(kinds) == 1 else torch.float32
    is_own = isinstance(_base(env), BatchedMujocoEnv)
    is_done = is_own or any(isinstance(one, _Executed) for one in transforms_of(env))
    if not is_done or kind != torch.float32:
        transforms.append(_Observed(kind))
    if not is_done or action.dtype != torch.float32:
        transforms.append(_Executed(action, isinstance(action, Bounded) and not is_own))
    return TransformedEnv(env, Compose(*transforms), auto_unwrap=True) if transforms else env


class _Observed(DTypeCastTransform):
    """Convert to single precision in a copy: some environments reuse one array for all outputs."""

    def __init__(self, dtype: torch.dtype) -> None:
        super().__init__(dtype, torch.float32, in_keys=["observation"])

    def _apply_transform(self, obs: Tensor) -> Tensor:
        return obs.to(self.dtype_out, copy=True)


class _Executed(DTypeCastTransform):
    """Convert to the environment's type, within its bounds despite rounding."""

    def __init__(self, spec: TensorSpec, is_clipped: bool) -> None:
        super().__init__(spec.dtype, torch.float32, in_keys=[], in_keys_inv=["action"])
        self._space = spec.space if is_clipped else None

    def _inv_apply_transform(self, state: Tensor) -> Tensor:
        action = state.to(self.dtype_in)
        return action if self._space is None else action.clamp(self._space.low, self._space.high)


def _joined(
    env: EnvBase, keys: Sequence[str], found: Mapping[str, TensorSpec]
) -> Iterator[Transform]:
    """Join parts to one observation, without writing to them: a step may read them again."""
    place = {key: key for key in keys}
    long = [key for key in keys if found[key].dtype == torch.float64]
    if 0 < len(long) < len(keys):
        place |= {key: f"{key}_float32" for key in long}
        types, there = (torch.float64, torch.float32), [place[key] for key in long]
        yield DTypeCastTransform(*types, in_keys=long, out_keys=there, in_keys_inv=[])
    scalars = [key for key in keys if found[key].ndim == len(env.batch_size)]
    if scalars:
        before = [place[key] for key in scalars]
        place |= {key: f"{key}_vector" for key in scalars}
        yield UnsqueezeTransform(-1, in_keys=before, out_keys=[place[key] for key in scalars])
    yield CatTensors(list(place.values()), "observation", del_keys=False, sort=False)


def _in_words(spec: Composite) -> str:
    leaves = spec.items(True, True)
    return ", ".join(f"{key!r}: {type(s).__name__} {list(s.shape)} {s.dtype}" for key, s in leaves)


def check_keys(keys: Sequence[str], there: Sequence[str] | Mapping[str, Any], name: str) -> None:
    """Reject parts of an observation that an environment lacks, or that occur twice.

    Raises:
        ValueError: naming them and the existing ones.
    """
    for key in keys:
        if key not in there:
            raise ValueError(
                f"observation_keys: {name} has no vector {key!r} in its observations; there are "
                f"{', '.join(sorted(there)) or 'none'}"
            )
    if len(set(keys)) < len(keys):
        raise ValueError(f"observation_keys names a part twice: {', '.join(keys)}")


def vectors(env: EnvBase) -> dict[str, TensorSpec]:
    """Floating-point observations that are vectors, or numbers, and not nested.

    Rewards summed by a transform do not count.
    """
    dims = len(env.batch_size)
    sums = {
        key
        for transform in transforms_of(env)
        if isinstance(transform, RewardSum)
        for key in transform.out_keys
    }
    return {
        key: spec
        for key, spec in env.full_observation_spec.items(True, True)
        if isinstance(key, str)
        and spec.dtype.is_floating_point
        and spec.ndim - dims <= 1
        and key not in sums
    }


def parts_left_out(env: EnvBase, found: Mapping[str, TensorSpec]) -> list[str]:
    """Parts of Gymnasium's dictionary that are not among the vectors found."""
    space = getattr(wrapped(env), "observation_space", None)
    there = env.full_observation_spec.keys()
    parts = space if isinstance(space, gymnasium.spaces.Dict) else ()
    return [key for key in parts if key in there and key not in found]


def unclear(left_out: Sequence[str], found: Iterable[str]) -> str:
    """The error that the vector parts may not contain everything there is to know."""
    return (
        f"the observations {', '.join(left_out)} are not vectors of floating-point numbers: say "
        f"which others make the state, such as observation_keys=[{','.join(sorted(found))}], or "
        "leave them out with gymnasium.wrappers.FilterObservation"
    )


def innermost(env: AnyEnv) -> Any:
    """An environment without transforms and wrappers, as its library provides it."""
    inner = wrapped(env)
    return _base(env) if inner is None else getattr(inner, "unwrapped", inner)


def wrapped(env: AnyEnv) -> Any:
    """The environment that TorchRL wraps, or Gymnasium's itself; ``None`` if nothing is wrapped."""
    # Not getattr, with which a batch asks its members.
    return env if isinstance(env, gymnasium.Env) else _base(env).__dict__.get("_env")


def _base(env: AnyEnv) -> AnyEnv:
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def simulation_of(env: AnyEnv) -> Any:
    """Gymnasium's environment with MuJoCo's ``model`` and ``data``, if it is one; else ``None``."""
    inner = getattr(wrapped(env), "unwrapped", None)
    return inner if isinstance(getattr(inner, "model", None), mujoco.MjModel) else None
