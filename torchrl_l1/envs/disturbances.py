"""Code common to disturbances of actuators and sensors: values, state, and delay lines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import (
    EnvBase,
    FrameSkipTransform,
    MultiAction,
    NoopResetEnv,
    SerialEnv,
    Transform,
    TransformedEnv,
)

from torchrl_l1.control import L1Transform, OracleTransform
from torchrl_l1.control.pipeline import action_keys

Draw = Callable[[torch.Size], Tensor]
"""Draws values of a shape, or one value for all entries; again whenever an environment resets."""

Value = float | Sequence[float] | Tensor | Draw
"""A number, one for each entry, one for each environment ``(*batch, 1 or entries)``, or drawn."""


@dataclass(frozen=True)
class RandomSigns:
    """A magnitude with a random sign for each environment and entry, drawn at every reset.

    Attributes:
        magnitude: a number, one for each entry, one row for each environment, or itself drawn.

    Examples:
        >>> RandomSigns(0.3)(torch.Size([4, 6])).abs().unique()
        tensor([0.3000])
    """

    magnitude: Value

    def __call__(self, shape: torch.Size) -> Tensor:
        """Draw from torch's global generator.

        Raises:
            ValueError: for magnitudes that do not fit the shape.
        """
        given = self.magnitude(shape) if callable(self.magnitude) else self.magnitude
        magnitude = torch.as_tensor(given)
        try:
            magnitude = magnitude.expand(shape)
        except RuntimeError:
            raise ValueError(
                f"RandomSigns has magnitudes of shape {tuple(magnitude.shape)}, expected one "
                f"number, one for each entry, or one row for each environment of {tuple(shape)}"
            ) from None
        return magnitude * (1 - 2 * torch.randint(2, shape, device=magnitude.device).float())


@dataclass(frozen=True)
class Uniform:
    """Uniform in ``[low, high)``, drawn for each environment at every reset.

    Attributes:
        low: lower bound.
        high: upper bound.
        shared: whether all entries of an environment have the same value.

    Examples:
        >>> Uniform(0.5, 1.0, shared=True)(torch.Size([4, 6])).shape
        torch.Size([4, 1])
    """

    low: float
    high: float
    shared: bool = False

    def __call__(self, shape: torch.Size) -> Tensor:
        """Draw from torch's global generator."""
        if self.shared:
            shape = torch.Size((*shape[:-1], 1))
        return self.low + (self.high - self.low) * torch.rand(shape)


def where_stepped(tensordict: TensorDictBase, key: NestedKey, seen: Tensor) -> Tensor:
    """The value after a step, or from before it if a ``"_step"`` mask leaves an environment out."""
    stepped, before = tensordict.get("_step", None), tensordict.get(key, None)
    if stepped is None or before is None:
        return seen
    return torch.where(stepped.reshape(*seen.shape[:-1], -1).any(-1, keepdim=True), seen, before)


class EnvironmentTransform(Transform):
    """A transform of environments, with the reason why stored data must not pass through it."""

    reason: ClassVar[str]
    disturbs: ClassVar[str]

    def check_order(self, remembers: bool) -> None:
        """Reject transforms before or after this one that would make it act incorrectly.

        A controller before it, or in a transformed environment inside, would take a disturbed
        action for the policy's. Some transforms after it step the environment through copies of it;
        a frame skip also passes these an action that is already disturbed.

        Args:
            remembers: whether this one has a state, which the copies would not share.

        Raises:
            ValueError: naming the transform and the right order.
        """
        environment = self._environment()
        if environment is None:
            return
        mine, chain = type(self).__name__, list(environment.transform.modules())
        place = next(index for index, member in enumerate(chain) if member is self)
        before, inside = chain[:place], environment.base_env
        while isinstance(inside, (TransformedEnv, SerialEnv)):
            if isinstance(inside, SerialEnv):
                inside = next(iter(inside.__dict__.get("_envs", [])), None)
            else:
                before = [*inside.transform.modules(), *before]
                inside = inside.base_env
        keys = action_keys(before, self.key)[1:] if self.disturbs == "action" else ()
        for earlier, key in zip(before, keys, strict=False):
            is_controller = isinstance(earlier, (L1Transform, OracleTransform))
            if is_controller and earlier.action_key == key:
                other = type(earlier).__name__
                raise ValueError(
                    f"{mine} comes after {other} and so disturbs the policy's action, not what "
                    f"{other} sends to the actuators: put {mine} before {other}"
                )
        for later in chain[place + 1 :]:
            skips = isinstance(later, FrameSkipTransform) and later.frame_skip > 1
            steps = skips or isinstance(later, (MultiAction, NoopResetEnv))
            if steps and (remembers or (skips and self.disturbs == "action")):
                other = type(later).__name__
                raise ValueError(
                    f"{other} comes after {mine} and steps the environment through copies of what "
                    f"is before it, which would disturb it differently: put {other} before "
                    f"{mine}, or around it, TransformedEnv(env, {other}(...), auto_unwrap=False)"
                )

    def _environment(self) -> EnvBase | None:
        """The environment.

        Raises:
            RuntimeError: in a replay buffer.
        """
        try:
            return self.container
        except ValueError:  # TorchRL's answer where the container is a replay buffer
            raise RuntimeError(self._refusal()) from None

    def resets(self, tensordict: TensorDictBase) -> Tensor | None:
        """Environments being reset.

        Returns:
            mask ``(*batch, 1)``, bool, true where any part of an environment is reset; ``None`` if
            all are.
        """
        environment = self._environment()
        keys = ["_reset"] if environment is None else environment.reset_keys
        return _any_of([tensordict.get(key, None) for key in keys], tensordict.batch_size)

    def begun(self, next_tensordict: TensorDictBase) -> Tensor | None:
        """Environments that reset themselves within the step and have begun an episode.

        Returns:
            mask ``(*batch, 1)``, bool: what is observed there is the first of that episode;
            ``None`` for environments that are reset from outside.
        """
        environment = self._environment()
        is_native = "_torchrl_native_autoreset"
        if environment is None or not environment.__dict__.get(is_native, False):
            return None
        flags = [next_tensordict.get(key, None) for key in environment.done_keys]
        return _any_of(flags, next_tensordict.batch_size)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Reject stored data.

        Raises:
            RuntimeError: always.
        """
        raise RuntimeError(self._refusal())

    def _refusal(self) -> str:
        return (
            f"{type(self).__name__} belongs to an environment (TransformedEnv), not to a replay "
            f"buffer or a policy: {self.reason}"
        )


def _any_of(flags: Sequence[Tensor | None], batch: torch.Size) -> Tensor | None:
    """Where any of them is set ``(*batch, 1)``; ``None`` if there are none."""
    found = [flag.reshape(*batch, -1).any(-1, True) for flag in flags if flag is not None]
    return torch.stack(found).any(0) if found else None


class HeldDisturbance(EnvironmentTransform):
    """Holds the value of a disturbance and its state: tensors whose leading axes are the batch.

    Subclasses define how an episode begins. The state is replaced, never written to, so copies of a
    transform do not share it.
    """

    what: ClassVar[str] = "entry"

    def __init__(self, value: Value, key: NestedKey) -> None:
        super().__init__()
        self.key = key
        self.draw: Draw | None = value if callable(value) else None
        tensor = None if callable(value) else torch.as_tensor(value, dtype=torch.float64)
        if tensor is not None and not tensor.isfinite().all():
            raise ValueError(
                f"{type(self).__name__} needs a finite number, or one for each {self.what} entry, "
                f"got {value!r}"
            )
        if tensor is not None:
            self._check(tensor)
        # It is a setting: loading another environment's weights must not overwrite it.
        self.register_buffer("value", tensor, persistent=False)
        self._state: Mapping[str, Tensor] = {}
        self._following: Mapping[str, Tensor] = {}

    def _check(self, value: Tensor) -> None:
        """Reject values that the disturbance cannot have."""

    def _admitted(self, drawn: Tensor) -> Tensor:
        """The drawn value as one that the disturbance can have."""
        return drawn

    def _require(self, sound: bool, rule: str, value: Tensor) -> None:
        if not sound:
            raise ValueError(f"{type(self).__name__}: {rule}, got {value.tolist()}")

    def _begin(self, entry: Tensor) -> dict[str, Tensor]:
        """The state at the start of an episode."""
        return {}

    def _drawn(self, entry: Tensor) -> dict[str, Tensor]:
        if self.draw is None:
            return {}
        value = self._admitted(self.draw(entry.shape).to(entry.device))
        if value.shape not in (entry.shape, (*entry.shape[:-1], 1)) or not value.isfinite().all():
            raise ValueError(
                f"{type(self).__name__} drew values of shape {tuple(value.shape)}, expected finite "
                f"ones of shape {tuple(entry.shape)}, or {(*entry.shape[:-1], 1)}"
            )
        self._check(value)
        return {"value": value}

    def _restart(self, entry: Tensor, reset: Tensor | None) -> None:
        self._check_shape(entry)
        if reset is None:
            self._state = {}  # may have been for another number of environments
        self._check_batch(self._state, entry.shape[:-1])
        state = self._drawn(entry)
        self._keep(state, reset, entry.shape[:-1])
        self._keep(self._begin(entry), reset, entry.shape[:-1])

    def _started(self, entry: Tensor) -> None:
        if not self._state:  # used without an environment that was reset
            self._restart(entry, None)
        self._check_batch(self._state, entry.shape[:-1])

    def _check_batch(self, state: Mapping[str, Tensor], batch: torch.Size) -> None:
        """Reject a state for environments other than those that step or are reset.

        Raises:
            ValueError: naming both batch sizes.
        """
        sizes = {tuple(value.shape[: len(batch)]) for value in state.values()} - {tuple(batch)}
        if sizes:
            raise ValueError(
                f"{type(self).__name__} has a state of batch {sizes.pop()}, but {tuple(batch)} "
                "steps, of an environment that is not batch-locked: steps cannot be left out there "
                "(ConditionalSkip, or rollouts that continue without environments that are done)"
            )

    def _keep(self, state: Mapping[str, Tensor], where: Tensor | None, batch: torch.Size) -> None:
        """Make a state the current one, in some environments or in all."""
        if where is not None:
            chosen = where.reshape(*batch, -1).any(-1)
            state = {
                name: torch.where(_with_axes_of(new, chosen), new, self._state[name])
                if name in self._state and self._state[name].shape == new.shape
                else new
                for name, new in state.items()
            }
        self._state = {**self._state, **state}

    def _current(self, entry: Tensor) -> Tensor:
        """The current value by which an entry is disturbed."""
        value = self._state["value"] if self.draw is not None else self.value
        assert isinstance(value, Tensor)
        return value.to(entry)

    def _check_shape(self, entry: Tensor) -> None:
        value, shape = self.value, entry.shape
        if value is None or not value.ndim:
            return
        if value.ndim == 1 and value.shape != shape[-1:]:
            raise ValueError(
                f"{type(self).__name__} has {value.shape[-1]} values, but the {self.what} "
                f"{self.key!r} has {shape[-1]} entries"
            )
        fits = value.shape[:-1] == shape[:-1] and value.shape[-1] in (1, shape[-1])
        if value.ndim > 1 and not fits:
            raise ValueError(
                f"{type(self).__name__} has values of shape {tuple(value.shape)}, but the "
                f"{self.what} {self.key!r} has shape {tuple(shape)}: one row for each environment"
            )

    def __repr__(self) -> str:
        value = self.draw if self.value is None else self.value.tolist()
        return f"{type(self).__name__}({value}, key={self.key!r})"


def _with_axes_of(entry: Tensor, mask: Tensor) -> Tensor:
    """A mask of the batch with trailing axes added, to be broadcast to an entry."""
    return mask.reshape(*mask.shape, *(1,) * (entry.ndim - mask.ndim))


class DelayLine(HeldDisturbance):
    """Delivers the value from a number of steps ago."""

    def _admitted(self, drawn: Tensor) -> Tensor:
        return drawn.floor()

    def _check(self, value: Tensor) -> None:
        whole = (value >= 0) & (value == value.round())
        self._require(bool(whole.all()), "steps must be whole and not negative", value)

    def _line(self, entry: Tensor) -> Tensor:
        """The last entries, oldest first ``(*batch, entries, length)``, as if all were this one."""
        length = int(self._current(entry).max()) + 1
        present = self._state.get("line")
        # A draw for some environments must not shorten the memory of the others.
        length = length if present is None else max(length, present.shape[-1])
        return entry.unsqueeze(-1).expand(*entry.shape, length)

    def _keep(self, state: Mapping[str, Tensor], where: Tensor | None, batch: torch.Size) -> None:
        old, new = self._state.get("line"), state.get("line")
        if old is not None and new is not None and (missing := new.shape[-1] - old.shape[-1]) > 0:
            oldest = old[..., :1].expand(*old.shape[:-1], missing)
            self._state = {**self._state, "line": torch.cat([oldest, old], -1)}
        super()._keep(state, where, batch)

    def _pass(self, entry: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        line = torch.cat([self._state["line"][..., 1:].to(entry), entry.unsqueeze(-1)], -1)
        steps = self._current(entry).long().expand(entry.shape).unsqueeze(-1)
        delivered = line.gather(-1, line.shape[-1] - 1 - steps).squeeze(-1)
        return delivered, {"line": line}
