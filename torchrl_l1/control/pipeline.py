"""What L1 requires of the pipeline around it: the order of transforms, and settings left open."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv
from torchrl.envs.transforms import (
    ActionScaling,
    ClipTransform,
    Compose,
    ConditionalPolicySwitch,
    DeviceCastTransform,
    DTypeCastTransform,
    ExcludeTransform,
    FrameSkipTransform,
    NextObservationDelta,
    SelectTransform,
    Transform,
    VecNorm,
    VecNormV2,
)

from torchrl_l1.control.config import L1Config, Scalars, with_open_bounds
from torchrl_l1.control.probe import describe
from torchrl_l1.control.step_time import time_step

_TOLERANCE = 1e-4

# Actions of a policy that ignores the bounds may lie a little beyond them; where an action is
# scaled, other units are likelier.
_FAR, _FAR_WHERE_SCALED = 1.5, 1.05

# Stands for a time step not known yet: so short that no setting is too fast for it.
_SHORT = 1e-6


def chain_of(transform: Transform) -> list[Transform]:
    """All transforms beside this one, in order, including those of nested ``Compose``."""
    top = transform
    while True:
        reference = top.__dict__.get("_container")
        above = None if reference is None else reference()
        if not isinstance(above, Compose):
            return list(_flatten(top))
        top = above


def _flatten(transform: Transform) -> Iterator[Transform]:
    if isinstance(transform, Compose):
        for member in transform:
            yield from _flatten(member)
    else:
        yield transform


def transforms_of(environment: EnvBase) -> list[nn.Module]:
    """All transforms of an environment, in order, those of environments inside it first."""
    chains = []
    while isinstance(environment, TransformedEnv):
        chains.append(environment.transform)
        environment = environment.base_env
    return [member for chain in reversed(chains) for member in chain.modules()]


def action_keys(transforms: Sequence[nn.Module], key: NestedKey) -> list[NestedKey]:
    """Keys of an action on its way through transforms, which may rename it.

    Args:
        transforms: in the order of ``Compose``; an action meets the last one first.
        key: under which the last one receives it.

    Returns:
        the key after the first one, then the keys under which each receives it.
    """
    keys = [key := unravel_key(key)]
    for transform in reversed(transforms):
        if not isinstance(transform, (DTypeCastTransform, DeviceCastTransform)):
            names = (getattr(transform, f"{side}_keys_inv", None) or () for side in ("out", "in"))
            key = dict(zip(*names, strict=False)).get(key, key)
        keys.append(key)
    return keys[::-1]


def check_resets(owner: str, env: EnvBase) -> None:
    """Reject an environment that would not signal its resets to L1, with its state at the root.

    Raises:
        ValueError: naming the reset masks there are.
    """
    if "_reset" not in env.reset_keys:
        raise ValueError(
            f"{owner} restarts on a root '_reset', but this environment resets by "
            f"{env.reset_keys} only: give it a 'done' at its root with the shape of its batch"
        )


def check_alone(
    own: Transform, env: EnvBase, is_twin: Callable[[nn.Module], bool] = lambda other: False
) -> None:
    """Reject another controller of the same action: transforms with an attribute ``controls``.

    Args:
        own: the controller that asks, with an ``action_key``.
        env: the environment around it.
        is_twin: whether a transform belongs to the same controller.

    Raises:
        ValueError: naming both.
    """
    for other in transforms_of(env):
        is_other = getattr(other, "controls", False) and other is not own and not is_twin(other)
        if is_other and other.action_key == own.action_key:
            raise ValueError(
                f"{type(other).__name__} is there beside {type(own).__name__}, and both would act "
                f"against the same disturbance of {own.action_key!r}: leave one of them out"
            )


def check_order(
    l1: Transform,
    observation_key: NestedKey,
    action_key: NestedKey,
    key: str,
    names: Sequence[str],
) -> None:
    """Reject transforms after L1 that must come before it, or that remove its state.

    A transform that disturbs actuators or sensors declares so with an attribute ``disturbs``,
    ``"action"`` or ``"observation"``, or has a method ``compensate``.

    Raises:
        ValueError: naming the transform and the right order.
    """
    owner = type(l1).__name__
    chain = chain_of(l1)
    position = next(index for index, member in enumerate(chain) if member is l1)
    if any(isinstance(member, ConditionalPolicySwitch) for member in chain):
        raise ValueError(
            f"ConditionalPolicySwitch beside {owner} lets its policy bypass it: make the choice "
            "within the policy"
        )
    for index, later in enumerate(chain[position + 1 :], position + 1):
        name = type(later).__name__
        order = f"write Compose(..., {name}(...), {owner}(...))"
        disturbs = getattr(later, "disturbs", None)
        if disturbs is None and callable(getattr(later, "compensate", None)):
            disturbs = "action"
        if isinstance(later, FrameSkipTransform) and later.frame_skip > 1:
            raise ValueError(
                f"{name} comes after {owner} and would apply it again to its own output: {order}, "
                f"with the dt of {later.frame_skip} frames"
            )
        acts_on, *_ = action_keys(chain[position + 1 : index], getattr(later, "key", action_key))
        if disturbs == "action" and acts_on == action_key:
            raise ValueError(
                f"{name} comes after {owner} and so disturbs the policy's action, not what "
                f"{owner} sends to the actuators: {order}"
            )
        overwrites = observation_key in _written(later) or (
            disturbs == "observation" and getattr(later, "key", None) == observation_key
        )
        if overwrites:
            raise ValueError(
                f"{name} comes after {owner} and overwrites {observation_key!r}, which L1 reads: "
                f"put it before {owner}, {order}, give it separate out_keys, or give {owner} the "
                "observation_key of the raw observation"
            )
        lost = _excluded(later, key, names)
        if lost:
            raise ValueError(
                f"{name} comes after {owner} and removes {lost} under {key!r}, which the next "
                f"step needs: exclude them from the data instead, such as in the replay buffer"
            )


def _written(transform: Transform) -> list[NestedKey]:
    # A change of type or device does not change the observation, and what NextObservationDelta
    # drops has been passed on.
    if isinstance(transform, (DTypeCastTransform, DeviceCastTransform, NextObservationDelta)):
        return []
    try:
        return list(transform.out_keys)
    except (AttributeError, NotImplementedError):
        return []  # keys of its own, such as "is_init", which need the environment


def _excluded(transform: Transform, key: str, names: Sequence[str]) -> list[str]:
    if not isinstance(transform, ExcludeTransform):
        return []
    excluded = [unravel_key(one) for one in transform.excluded_keys]
    return [name for name in names if key in excluded or (key, name) in excluded]


def widen_selection(l1: Transform, key: str, names: Sequence[str]) -> None:
    """Let ``key`` in a later ``SelectTransform`` stand for all its entries, leaf by leaf."""
    chain = chain_of(l1)
    for later in chain[chain.index(l1) + 1 :]:
        if isinstance(later, SelectTransform) and key in later.selected_keys:
            leaves = [(key, name) for name in names]
            later.selected_keys += [leaf for leaf in leaves if leaf not in later.selected_keys]


def unspecified(l1: Transform, key: str, names: Sequence[str]) -> list[str]:
    """Entries of the state that the environment's specs lack, so it does not carry them along."""
    specified = l1.container.full_observation_spec.keys(True, True)
    return [name for name in names if (key, name) not in specified]


def carry(
    lacking: Sequence[str],
    owner: str,
    key: str,
    tensordict: TensorDictBase,
    following: TensorDictBase,
) -> None:
    """Carry entries missing from the specs from the end of a step to the start of the next.

    ``SelectTransform`` keeps them, since a step reads them, but removes them from the specs.

    Raises:
        KeyError: naming them, if they are gone.
    """
    for name in lacking:
        value = tensordict.get(("next", key, name), None)
        if value is None:
            raise KeyError(
                f"{owner} found no {lacking} under {('next', key)} after the step: a later "
                f"transform removes them; keep {key!r} and everything in it"
            )
        following.set((key, name), value)


class Settings:
    """Settings given to a form of L1, to which an environment may add the time step.

    Args:
        owner: name of the class.
        config: the settings, or ``None``.
        dt: time of one environment step in seconds; the environment's if ``None``.
        others: further fields of :class:`L1Config`.

    Raises:
        TypeError: for unknown fields, or a config of another type.
        ValueError: if both config and fields are given, or a setting does not fit.
    """

    def __init__(
        self, owner: str, config: L1Config | None, dt: float | None, others: dict[str, Any]
    ) -> None:
        self.owner = owner
        if config is not None and not isinstance(config, L1Config):
            raise TypeError(
                f"{owner} takes an L1Config as its second argument, got {type(config).__name__}: "
                "give settings by name, as dt=0.05, or as L1Config(...)"
            )
        if config is not None:
            given = [name for name, value in {"dt": dt, **others}.items() if value is not None]
            if given:
                raise ValueError(f"give config or {given}, not both; see dataclasses.replace")
        known = {field.name for field in fields(L1Config)}
        unknown = sorted(set(others) - known)
        if unknown:
            raise TypeError(f"{owner} got unknown settings {unknown}; L1Config has {sorted(known)}")
        self._others = dict(others)
        self.has_dt = self.is_complete = config is not None or dt is not None
        # Without a time step, everything that does not depend on it is checked now.
        self.config = config or L1Config(_SHORT if dt is None else dt, **others)

    def complete(self, env: EnvBase, *, is_shared: bool = False) -> L1Config:
        """The configuration, with the environment's time step if none was given.

        Args:
            env: the environment.
            is_shared: whether the time step of an environment before it stays.

        Raises:
            ValueError: if the environment does not declare it.
        """
        if not self.has_dt and not (is_shared and self.is_complete):
            dt = time_step(env)
            if dt is None:
                raise ValueError(
                    f"{self.owner} needs dt, the time of one environment step in seconds: the "
                    "environment does not declare it"
                )
            self.config = L1Config(dt, **self._others)
            self.is_complete = True
        return self.config

    def bound(self, low: Scalars | None, high: Scalars | None) -> None:
        """Fill in open action bounds."""
        config = self.config = with_open_bounds(self.config, low, high)
        self._others |= {"action_low": config.action_low, "action_high": config.action_high}


def leaf_spec(spec: TensorSpec) -> TensorSpec:
    """The spec itself, or the single leaf of a composite one.

    Raises:
        ValueError: if it has several.
    """
    if not isinstance(spec, Composite):
        return spec
    leaves = list(spec.keys(include_nested=True, leaves_only=True))
    if len(leaves) != 1:
        raise ValueError(f"action_spec has several entries {leaves}: give that of the action")
    return spec[leaves[0]]


def warn_of_surroundings(
    owner: str,
    env: EnvBase,
    observation_key: NestedKey,
    action_key: NestedKey,
    bounds: tuple[Scalars | None, Scalars | None],
    spec: tuple[Scalars | None, Scalars | None],
) -> None:
    """Warn about setups that L1 can work with but hardly anybody wants.

    Args:
        owner: name of the class.
        env: the environment up to L1.
        observation_key: of the observation.
        action_key: of the action.
        bounds: lower and upper action bound in the settings.
        spec: those of the action's spec.

    Warns:
        UserWarning: about bounds beyond the spec's or a ``ClipTransform``'s, and about a normaliser
            whose statistics change.
    """
    for name, sign, given, told in zip(
        ("action_low", "action_high"), (-1, 1), bounds, spec, strict=True
    ):
        if _is_beyond(given, told, sign):
            warnings.warn(
                f"{owner} has {name}={given}, but the environment's action ends at {told}: "
                "anything L1 sends beyond that is cut off without its knowledge; leave the "
                "bounds out, or give infinite ones if the spec is wrong",
                UserWarning,
                stacklevel=3,
            )
    assumed = [told if given is None else given for given, told in zip(bounds, spec, strict=True)]
    for clip in () if scales_actions(env) else transforms_of(env):
        if not isinstance(clip, ClipTransform) or action_key not in clip.in_keys_inv:
            continue
        for name, sign, known, end in zip(
            ("action_low", "action_high"), (-1, 1), assumed, (clip.low, clip.high), strict=True
        ):
            if end is not None and (known is None or _is_beyond(known, float(end), sign)):
                warnings.warn(
                    f"ClipTransform cuts off at {float(end):.6g} what {owner} sends, without its "
                    f"knowledge: give {owner} {name}={float(end):.6g}",
                    UserWarning,
                    stacklevel=3,
                )
    normaliser = _running_normaliser(env, observation_key)
    if normaliser is not None:
        warnings.warn(
            f"{normaliser} stands between the plant and {owner} and keeps changing its statistics, "
            f"and with them what {observation_key!r} means to the model: freeze it, or put it "
            "behind L1 with separate out_keys",
            UserWarning,
            stacklevel=3,
        )


def scales_actions(env: EnvBase) -> bool:
    """Whether an ``ActionScaling`` gives the environment's action other units."""
    found = [one for one in transforms_of(env) if isinstance(one, ActionScaling)]
    return any(bool((one.scale != 1).any() or (one.loc != 0).any()) for one in found)


def warn_of_action_units(
    dynamics: object, low: Scalars | None, high: Scalars | None, scaled: bool = False
) -> None:
    """Warn if a model has been fitted to actions far beyond the bounds of L1.

    The data's mean and deviation show it: whatever the actions within the bounds, their root mean
    square around the middle is at most half the range.

    Args:
        dynamics: the model.
        low: lower bound.
        high: upper bound.
        scaled: whether the action is scaled on its way to the plant, see :func:`scales_actions`.
    """
    normalizer = getattr(dynamics, "action_normalizer", None)
    mean, std = getattr(normalizer, "mean", None), getattr(normalizer, "std", None)
    limit = getattr(getattr(dynamics, "box", None), "high", None)
    if low is None or high is None or not isinstance(mean, Tensor) or not isinstance(std, Tensor):
        return
    if not (isinstance(limit, Tensor) and limit.isfinite().all()):
        return  # not fitted yet
    bottom, top = torch.as_tensor(low).to(mean), torch.as_tensor(high).to(mean)
    if not all(bound.ndim == 0 or bound.shape == mean.shape for bound in (bottom, top)):
        return
    size = (std.square() + (mean - (bottom + top) / 2).square()).sqrt()
    far = _FAR_WHERE_SCALED if scaled else _FAR
    beyond = (size > far * (top - bottom) / 2) & size.isfinite()
    if beyond.any():
        warnings.warn(
            f"{describe(dynamics)} was fitted to actions far beyond the bounds of L1, in the "
            f"entries {beyond.nonzero().flatten().tolist()}: other units? Put ActionScaling after "
            "L1, Compose(..., L1Transform(...), ActionScaling())",
            stacklevel=2,
        )


def _is_beyond(given: Scalars | None, told: Scalars | None, sign: int) -> bool:
    if given is None or told is None:
        return False
    width = max(len(one) if isinstance(one, tuple) else 1 for one in (given, told))
    mine, theirs = (one if isinstance(one, tuple) else (one,) * width for one in (given, told))
    return any(
        math.isfinite(a) and sign * (a - b) > _TOLERANCE * abs(b)
        for a, b in zip(mine, theirs, strict=True)
    )


def _running_normaliser(env: EnvBase, observation_key: NestedKey) -> str | None:
    """Name of a normaliser of the observation whose statistics keep changing."""
    while isinstance(env, TransformedEnv):
        for transform in _flatten(env.transform):
            if (
                isinstance(transform, (VecNorm, VecNormV2))
                and not transform.frozen
                and observation_key in transform.out_keys
            ):
                return type(transform).__name__
        env = env.base_env
    if isinstance(env, SerialEnv):
        members = env.__dict__.get("_envs", [])
        return _running_normaliser(members[0], observation_key) if members else None
    wrapped = env.__dict__.get("_env", None)
    while wrapped is not None:
        # Gymnasium's, of which there is also one for vectors.
        if type(wrapped).__name__ == "NormalizeObservation":
            return "NormalizeObservation" if wrapped.update_running_mean else None
        wrapped = getattr(wrapped, "__dict__", {}).get("env", None)
    return None
