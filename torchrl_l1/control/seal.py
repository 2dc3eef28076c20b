"""Whether L1 reads what its environment gave: a seal on observation and controller's state.

A step or reset writes the seal beside the state; the next step computes it anew of what it reads.
It travels in the tensordict, so that batches, partial resets, processes, collectors and several
rollouts at a time need no care.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_l1.control.state import L1State

SEAL = "seal"
"""Name of the entry, ``(..., n + 4)``, beside those of the state."""

_EXTRA = 4  # started, n_switch, and two sums

# Of entries of the same size: a change of type between float64 and float32 stays below it.
_TOLERANCE = 1e-6

_LARGEST = 3.3e38  # in the range of float32, to which float64 may be changed

_IN_ACTION_UNITS = ("u_bar", "q", "sigma_m")


def seal_width(observation_dim: int) -> int:
    """Number of entries of a seal."""
    return observation_dim + _EXTRA


def sealed(observation: Tensor, state: L1State) -> Tensor:
    """Observation, flags and sums of the state ``(..., n + 4)``, in the state's type.

    The observation is copied, since the caller may write to it in place. Of the state, the sums of
    entries in action units and of all others are kept apart, so that large observations do not
    hide changes of small actions.
    """
    # Every operation counts here: at a batch of one each costs as much as a thousand sums.
    x_hat, u_bar, q, sigma_m, n_switch, started, *memory = state
    others = x_hat
    if memory[0] is not None:
        others = torch.cat([x_hat, *(value for value in memory if value is not None)], -1)
    others_sum = others.sum(-1, keepdim=True)
    actions_sum = torch.cat([u_bar, q, sigma_m], -1).sum(-1, keepdim=True)
    # What is not finite is a number of its own here: whoever looks at the entries finds none.
    dtype = x_hat.dtype
    largest = min(torch.finfo(dtype).max, _LARGEST)
    observation = observation.to(dtype).nan_to_num(0.9 * largest, largest, -largest)
    return torch.cat([observation, started, n_switch, actions_sum, others_sum], -1).detach()


class Emitted(NamedTuple):
    """What was sealed last, to tell a lost state from a changed observation.

    Attributes:
        observation: the tensor itself, as given.
        state: its entries.
        seal: of the two.
        versions: of observation and entries then, which writing in place counts up; ``None`` for
            tensors that do not count.
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
        """Whether these are the very tensors that were emitted, unwritten since; no kernel."""
        return (
            observation is self.observation
            and seal is self.seal
            and all(a is b for a, b in zip(state, self.state, strict=True))
            and self.versions is not None
            and self.versions == _versions(observation, state)
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
    """The observation, if it and the state are those of the seal; to within rounding.

    Args:
        observation: ``(..., n)`` as read.
        state: as read.
        seal: as read ``(..., n + 4)``.
        owner: name of the class that reads.
        observation_key: where it reads the observation.
        key: where it reads state and seal.
        emitted: what it sealed last, if it remembers.
        zero_is_none: whether a row of zeros is no seal.

    Raises:
        ValueError: naming the observation's key or the state's entries.
    """
    if torch.compiler.is_compiling():
        names = [owner, str(observation_key), key]
        return _verified(observation, sealed(observation, state), seal, names, zero_is_none)
    if emitted is not None and emitted.is_what_is_read(observation, state, seal):
        return observation
    found = sealed(observation, state)
    if not torch.equal(found, seal):
        _compare(found, seal, owner, repr(observation_key), key, state, emitted, zero_is_none)
    return observation


def _compare(
    found: Tensor,
    seal: Tensor,
    owner: str,
    observation_key: str,
    key: str,
    state: L1State | None,
    emitted: Emitted | None,
    zero_is_none: bool,
) -> None:
    n = found.shape[-1] - _EXTRA
    seal = seal.to(found.dtype)
    differs = ~torch.isclose(found, seal, rtol=_TOLERANCE, atol=1e-30, equal_nan=True)
    # A sum is as exact as its terms, which may be larger than it.
    scale = found.abs().amax(-1, keepdim=True).nan_to_num()
    if state is not None:
        actions = torch.cat([getattr(state, name).abs() for name in _IN_ACTION_UNITS], -1)
        rest = [state.x_hat, *(value for value in state[6:] if value is not None)]
        others = torch.cat([value.abs() for value in rest], -1)
        scale = torch.cat([actions.sum(-1, keepdim=True), others.sum(-1, keepdim=True)], -1)
    off = (found[..., -2:] - seal[..., -2:]).abs() > 10 * _TOLERANCE * (1e-30 + scale)
    differs = torch.cat([differs[..., :-2], differs[..., -2:] & off], -1)
    if zero_is_none:
        differs = differs & (seal != 0).any(-1, keepdim=True)
    if not differs.any():
        return
    changed = differs[..., :n].any(-1)
    if emitted is not None and emitted.seal.shape == found.shape and changed.any():
        # With an observation that is right, it is the seal that is old, and the state with it.
        last = emitted.seal[..., :n].to(found.dtype)
        same = torch.isclose(found[..., :n], last, rtol=_TOLERANCE, atol=1e-30, equal_nan=True)
        changed = changed & ~same.all(-1)
    if changed.any():
        raise ValueError(_of_observation(found, seal, changed, owner, observation_key, n))
    raise ValueError(_of_state(owner, key, _lost(state, emitted)))


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


def _lost(state: L1State | None, emitted: Emitted | None) -> list[str]:
    if state is None:
        return [*L1State._fields[:6], SEAL]
    names = list(state.entries())
    if emitted is None or emitted.state.x_hat.shape != state.x_hat.shape:
        return names
    read, given = state.entries(), emitted.state.entries()
    return [name for name in names if not torch.equal(read[name], given[name])] or [SEAL]


def _versions(observation: Tensor, state: L1State) -> tuple[int, ...] | None:
    try:
        return observation._version, *[value._version for value in state if value is not None]
    except RuntimeError:  # tensors of inference mode do not count
        return None


# Opaque to the compiler, which would break its graph at a question that depends on data.
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
        _compare(found, seal, owner, repr(observation_key), key, None, None, zero_is_none)
    return observation.clone()


@_verified.register_fake
def _(
    observation: Tensor, found: Tensor, seal: Tensor, names: list[str], zero_is_none: bool
) -> Tensor:
    return torch.empty_like(observation)
