"""A seal on observation and controller's state: does L1 read what its environment gave?

A step or reset writes the seal beside the state; the next step recomputes it from what it reads. It
travels in the tensordict, so batches, partial resets, processes, collectors and several concurrent
rollouts need no special treatment.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_l1.control.state import COMMON, L1State

SEAL = "seal"
"""Name of the entry beside those of the state, see :func:`seal_width`."""

# Relative to entries of the same size: a change between float64 and float32 stays below it.
_TOLERANCE = 1e-6

_LARGEST = 3.3e38  # within the range of float32, which float64 values may be converted to


def seal_width(observation_dim: int, action_dim: int, has_memory: bool) -> int:
    """Number of entries of a seal: the observation, the state, and a sum of a law's memory."""
    return 2 * observation_dim + 3 * action_dim + 2 + has_memory


def sealed(observation: Tensor, state: L1State) -> Tensor:
    """A copy of observation and state in one type, which the caller may modify in place.

    Wide entries that only some laws remember are represented by their sum.
    """
    # Every operation counts here: at a batch size of one each costs as much as a thousand
    # additions, and joining several types costs as much as three.
    x_hat, u_bar, q, sigma_m, n_switch, started, *_ = state
    dtype = q.dtype
    flags = n_switch.to(dtype), started.to(dtype)
    parts = [observation.to(dtype), x_hat, u_bar, q, sigma_m, *flags]
    if memory := state.memory():
        parts.append(torch.cat(memory, -1).sum(-1, keepdim=True))
    # Anything non-finite becomes a fixed number here; inspecting the entries will find it.
    largest = min(torch.finfo(dtype).max, _LARGEST)
    seal = torch.cat(parts, -1).nan_to_num(0.9 * largest, largest, -largest)
    return seal.detach() if seal.requires_grad else seal


class Emitted(NamedTuple):
    """What was sealed last, to distinguish a lost state from a changed observation.

    Attributes:
        observation: the tensor itself, as given.
        state: its entries.
        seal: the seal of the two.
        versions: the version counters of observation and entries at that time, which in-place
            writes increase; ``None`` for tensors without one.
    """

    observation: Tensor
    state: L1State
    seal: Tensor
    versions: tuple[int, ...] | None

    @classmethod
    def of(cls, observation: Tensor, state: L1State, seal: Tensor) -> Emitted:
        """Remember these, without a copy."""
        return cls(observation, state, seal, _versions(observation, state))

    def is_what_is_read(self, observation: Tensor, state: L1State, seal: Tensor) -> bool:
        """Whether these are the very tensors emitted, not written to since.

        On a CPU the observation's values are compared too, since writes through ``numpy()`` or
        ``data`` do not count; elsewhere that would wait for the device.
        """
        return (
            observation is self.observation
            and seal is self.seal
            and all(a is b for a, b in zip(state, self.state, strict=True))
            and self.versions is not None
            and self.versions == _versions(observation, state)
            and (not observation.is_cpu or _holds(seal, observation))
        )


def verify(
    observation: Tensor,
    state: L1State,
    seal: Tensor,
    *,
    owner: str,
    observation_key: NestedKey,
    key: str,
    emitted: Emitted | None = None,
    zero_is_none: bool = False,
) -> Tensor:
    """The observation, if it and the state match the seal up to rounding.

    Args:
        observation: ``(..., n)`` as read.
        state: as read.
        seal: as read, see :func:`seal_width`.
        owner: name of the reading class.
        observation_key: where it reads the observation.
        key: where it reads state and seal.
        emitted: what it sealed last, if it remembers.
        zero_is_none: whether a row of zeros counts as no seal, unless its observation is the one
            that was sealed last.

    Raises:
        ValueError: naming the observation's key or the state's entries.
    """
    if torch.compiler.is_compiling():
        names = [owner, str(observation_key), key]
        return _verified(observation, sealed(observation, state), seal, names, zero_is_none)
    if emitted is not None and emitted.is_what_is_read(observation, state, seal):
        return observation
    found = sealed(observation, state)
    if found.shape != seal.shape:
        raise ValueError(
            f"{owner}: the state under {key!r} is that of an L1 with other settings or widths, "
            "from another controller's primer: give each its own key"
        )
    if not torch.equal(found, seal):
        n = observation.shape[-1]
        _compare(found, seal, n, owner, repr(observation_key), key, state, emitted, zero_is_none)
    return observation


def _compare(
    found: Tensor,
    seal: Tensor,
    n: int,
    owner: str,
    observation_key: str,
    key: str,
    state: L1State | None,
    emitted: Emitted | None,
    zero_is_none: bool,
) -> None:
    seal = seal.to(found.dtype)
    differs = ~_close(found, seal)
    m, has_memory = divmod(found.shape[-1] - 2 * n - 2, 3)
    if has_memory:
        # A sum is only as exact as its terms, which may be larger than it.
        terms = found if state is None else torch.cat(state.memory(), -1)
        scale = terms.abs().sum(-1).nan_to_num()
        differs[..., -1] &= (found - seal)[..., -1].abs() > 10 * _TOLERANCE * scale
    # If the observation is right, the seal is old or lost, and the state with it.
    is_right = torch.zeros_like(differs[..., 0])
    if emitted is not None and emitted.seal.shape == found.shape:
        is_right = _close(found[..., :n], emitted.seal[..., :n].to(found.dtype)).all(-1)
    if zero_is_none:
        differs = differs & ((seal != 0).any(-1) | is_right).unsqueeze(-1)
    if not differs.any():
        return
    changed = differs[..., :n].any(-1) & ~is_right
    if changed.any():
        raise ValueError(_of_observation(found, seal, changed, owner, observation_key, n))
    widths = [n, n, m, m, m, 1, 1] + [1] * has_memory
    parts = [bool(part.any()) for part in differs.split(widths, -1)[1:]]
    raise ValueError(_of_state(owner, key, _lost(parts, state, emitted)))


def _holds(seal: Tensor, observation: Tensor) -> bool:
    return torch.equal(observation.to(seal.dtype), seal.narrow(-1, 0, observation.shape[-1]))


def _close(found: Tensor, seal: Tensor) -> Tensor:
    return torch.isclose(found, seal, rtol=_TOLERANCE, atol=1e-30, equal_nan=True)


def _of_observation(
    found: Tensor, seal: Tensor, changed: Tensor, owner: str, key: str, n: int
) -> str:
    row = changed.nonzero()[0].tolist()
    found, seal = found[tuple(row)][:n], seal[tuple(row)][:n]
    entry = int((found - seal).abs().nan_to_num(torch.inf).argmax())
    where = f"environment {row}, entry {entry}" if row else f"entry {entry}"
    return (
        f"{owner}: {key} is not what the environment gave: {where} was "
        f"{float(seal[entry]):.6g} and is {float(found[entry]):.6g} now; what changes it "
        "(a normaliser, a later transform, the policy) must have separate out_keys, or give "
        f"{owner} the observation_key of the raw observation"
    )


def _of_state(owner: str, key: str, names: list[str]) -> str:
    return (
        f"{owner}: the entries {names} under {key!r} are not those that followed from the last "
        "step: they were lost on the way (SelectTransform, ExcludeTransform, step_mdp, a "
        f"collector); keep {key!r} and all that is in it"
    )


def _lost(parts: list[bool], state: L1State | None, emitted: Emitted | None) -> list[str]:
    """Names of what differs, by parts of the seal or, if that is old itself, from before."""
    names = list(L1State._fields) if state is None else list(state.entries())
    read: Sequence[Tensor | None] = () if state is None else state
    given: Sequence[Tensor | None] = () if emitted is None else emitted.state
    before = [
        name
        for name, a, b in zip(L1State._fields, read, given, strict=False)
        if a is not None and b is not None and a.shape == b.shape and not torch.equal(a, b)
    ]
    differing = [name for name, part in zip(names[:COMMON], parts, strict=False) if part]
    memory = names[COMMON:] if any(parts[COMMON:]) else []
    return before or differing + memory or [SEAL]


def _versions(observation: Tensor, state: L1State) -> tuple[int, ...] | None:
    try:
        return observation._version, *[value._version for value in state if value is not None]
    except RuntimeError:  # tensors in inference mode do not count
        return None


# Opaque to the compiler, whose graph would break at a data-dependent question.
@torch.library.custom_op(
    "torchrl_l1::verified",
    mutates_args=(),
    schema="(Tensor observation, Tensor found, Tensor seal, str[] names, bool zero_is_none) "
    "-> Tensor",
)
def _verified(
    observation: Tensor, found: Tensor, seal: Tensor, names: list[str], zero_is_none: bool
) -> Tensor:
    if not torch.equal(found, seal):
        owner, observation_key, key = names
        n = observation.shape[-1]
        _compare(found, seal, n, owner, repr(observation_key), key, None, None, zero_is_none)
    return observation.clone()


@_verified.register_fake
def _(
    observation: Tensor, found: Tensor, seal: Tensor, names: list[str], zero_is_none: bool
) -> Tensor:
    return torch.empty_like(observation)
