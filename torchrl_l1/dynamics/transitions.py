"""Transitions for fitting a model, taken from data as TorchRL makes them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ReplayBuffer

Data: TypeAlias = TensorDictBase | ReplayBuffer | Sequence[TensorDictBase]

# Shorter pieces of a long trajectory could not hold an open loop of 50 steps.
_PIECE = 100

_TRAJECTORY_IDS: tuple[NestedKey, ...] = (("collector", "traj_ids"), "traj_ids")
_PADDING: tuple[NestedKey, ...] = (("collector", "mask"), "mask")
_ENDS = ("done", "terminated", "truncated")
_STEPS: tuple[NestedKey, ...] = ("steps_to_next_obs", ("next", "steps_to_next_obs"))


@dataclass
class Transitions:
    """Transitions to train and to validate on.

    Attributes:
        data: ``observation``, ``action``, ``("next", "observation")``, batch size ``[N]``, in the
            order in which they were stored.
        validation: transitions kept out of training, ``(N,)``, bool.
        joined: transitions that the next row continues, ``(N,)``, bool.
        dropped: rows left out because they are not transitions of the system: values that are not
            finite, steps across a reset.
    """

    data: TensorDict
    validation: Tensor
    joined: Tensor
    dropped: int

    def warn_of_gaps(
        self,
        observation_key: NestedKey = "observation",
        action_key: NestedKey = "action",
        std_floor: float = 1e-4,
    ) -> None:
        """Warn about what no model can learn from the data.

        Args:
            observation_key: name of the observation at its source.
            action_key: name of the action there.
            std_floor: the model's smallest standard deviation.

        Warns:
            UserWarning: naming entries of the action that never vary, entries whose values or
                changes vary by less than a tenth of ``std_floor``, as in units that are too large,
                and entries of the observation whose changes vary by less than 20 steps of their
                type. The last kind excludes entries that vary by less than ``std_floor``.
        """
        action = self.data["action"]
        for entry in (action == action[:1]).all(0).nonzero().squeeze(-1).tolist():
            warnings.warn(
                f"{_name(action_key)}[{entry}] never varies, so its effect is not in the data: "
                "the model ignores it and L1 does not use it; record data that vary it",
                stacklevel=3,
            )
        before, after = self.data["observation"], self.data["next", "observation"]
        spread = (after - before).std(0, correction=0)
        self._warn_of_units(_name(observation_key), _name(action_key), spread, std_floor)
        step = before.abs().amax(0) * torch.finfo(before.dtype).eps
        for entry in ((spread > std_floor) & (spread < 20 * step)).nonzero().squeeze(-1).tolist():
            kind = str(before.dtype).removeprefix("torch.")
            warnings.warn(
                f"{_name(observation_key)}[{entry}] changes by {spread[entry]:.2g} per step, and "
                f"numbers of {kind} as large as its values are {step[entry]:.2g} apart: subtract "
                "an offset first",
                stacklevel=3,
            )

    def _warn_of_units(self, observation: str, action: str, change: Tensor, floor: float) -> None:
        x, u = self.data["observation"].double(), self.data["action"].double()
        told = set()
        for name, what, values, size in (
            (observation, "changes by {} per step", change, x.abs().amax(0)),
            (observation, "varies by {}", x.std(0, correction=0), x.abs().amax(0)),
            (action, "varies by {}", u.std(0, correction=0), u.abs().amax(0)),
        ):
            # Anything less is noise of the numbers, or of a simulation.
            noise = (20 * torch.finfo(change.dtype).eps * size).clamp_min(1e-9)
            small = (values > noise) & (values < 0.1 * floor)
            for entry in small.nonzero().squeeze(-1).tolist():
                if (name, entry) in told:
                    continue
                told.add((name, entry))
                warnings.warn(
                    f"{name}[{entry}] {what.format(f'{values[entry]:.2g}')}, very little for a "
                    f"model with std_floor={floor:g}: give it in smaller units, or a std_floor of "
                    f"{values[entry] / 10:.0e}",
                    stacklevel=4,
                )


def read_transitions(
    data: Data,
    observation_key: NestedKey = "observation",
    action_key: NestedKey = "action",
    validation_fraction: float = 0.1,
    seed: int = 0,
    dtype: torch.dtype | None = None,
    device: torch.device | None = None,
) -> Transitions:
    """Read transitions of a tensordict or buffer, drop other rows, and split off validation data.

    Two rows belong to one trajectory if the second starts with the observation with which the first
    ended, no flag says that an episode ended between them, and their ``traj_ids``, if any, are
    equal. The following rows are left out:

    - padding, marked by the mask that TorchRL's ``split_trajectories`` writes, and steps of an
      environment that was already done;
    - rows with an entry that is not finite, with a warning that counts them;
    - steps across a reset, with a warning: an environment that resets itself may report the first
      observation of the new episode as the last one of the old. The row after it is left out too,
      since some such environments spend a step on the reset.

    Rows with a true flag ``validation`` are kept out of training. Without the flag, whole
    trajectories are, drawn by ``seed`` until they hold ``validation_fraction`` of all rows;
    trajectories longer than that are cut into pieces first.

    Args:
        data: a tensordict with any batch size, time last (or called ``"time"``), which may be a
            lazy stack of different lengths; several tensordicts; or a replay buffer.
        observation_key: key of the observation ``(..., n)``; ``("next", observation_key)`` is the
            next one.
        action_key: key of the action ``(..., m)``.
        validation_fraction: share of rows kept out of training, in (0, 1).
        seed: seed of the draw.
        dtype: dtype of the result; torch's default if ``None``.
        device: device of the result; that of the data if ``None``.

    Raises:
        KeyError: if the data lack one of the keys.
        TypeError: for data of another kind.
        ValueError: if shapes do not fit, or widths differ between the parts.
    """
    read: list[TensorDict] = []
    trajectories = 0
    for part in _parts(data):
        one = _read(_time_last(part), observation_key, action_key, dtype, device)
        one["trajectory"] += trajectories
        trajectories += len(one)
        read.append(one)
    if not read:
        return _nothing()
    for key in ("observation", "action"):
        widths = sorted({one[key].shape[-1] for one in read})
        if len(widths) > 1:
            raise ValueError(
                f"the data have {key}s of widths {', '.join(map(str, widths))} in their parts: "
                "leave out the parts of another system"
            )
    rows: TensorDictBase = TensorDict.cat(read)
    keep = rows["real"] & _is_transition(rows, (observation_key, action_key))
    kept = keep.nonzero().squeeze(-1)
    joined = rows["joined"][kept]
    joined[:-1] &= kept.diff() == 1
    joined[-1:] = False
    rows, dropped = rows[kept], int(rows["real"].sum()) - len(kept)
    held_out = rows["validation"]
    if not held_out.any():
        held_out = _hold_out(rows["trajectory"], validation_fraction, seed)
    return Transitions(rows.select("observation", "action", "next"), held_out, joined, dropped)


def check_time_step(data: Data, dt: float, whose: str) -> None:
    """Reject data with steps of another length, if they hold it (``dt``, s).

    Args:
        data: as :func:`read_transitions` takes them.
        dt: time of a step in seconds; that of the data may differ by 2 %, as clocks do.
        whose: what takes such steps.

    Raises:
        ValueError: naming both.
    """
    for part in _parts(data):
        step = part.get("dt", None)
        taken = dt if step is None or not step.numel() else float(step.double().median())
        if not abs(taken - dt) <= 0.02 * dt:
            raise ValueError(
                f"the data were recorded with steps of {taken:.4g} s, and {whose} takes {dt:.4g} "
                "s: resample them, or let its steps be as long"
            )


def split_validation(
    buffer: ReplayBuffer, purpose: str, items: str, setting: str
) -> tuple[TensorDictBase, TensorDictBase]:
    """Items to train on and items to validate on, as the flag ``validation`` ``(N,)`` says.

    Args:
        buffer: the items.
        purpose: what they are for, for the error message.
        items: what to call them there.
        setting: the setting that decides how many are kept out.

    Raises:
        ValueError: if there is nothing to train or to validate on.
    """
    empty = TensorDict({"validation": torch.zeros(0, dtype=torch.bool)}, batch_size=[0])
    data = buffer[:] if len(buffer) else empty
    held_out = data["validation"].reshape(-1)
    return two_parts(data, held_out, purpose, items, setting)


def two_parts(
    data: TensorDictBase, held_out: Tensor, purpose: str, items: str, setting: str
) -> tuple[TensorDictBase, TensorDictBase]:
    """As :func:`split_validation`, for items ``[N]`` and a mask ``(N,)`` of those kept out."""
    train, validation = data[~held_out], data[held_out]
    if train.shape[0] == 0 or validation.shape[0] == 0:
        raise ValueError(
            f"cannot {purpose}: {train.shape[0]} training and {validation.shape[0]} validation "
            f"{items}; collect more data or change {setting}"
        )
    return train, validation


def _parts(data: Data) -> list[TensorDictBase]:
    if isinstance(data, ReplayBuffer):
        data = data[:] if len(data) else []
        if not len(data):
            return []
    parts = [data] if isinstance(data, TensorDictBase) else list(data)
    for part in parts:
        if not isinstance(part, TensorDictBase):
            raise TypeError(
                "data must be a tensordict, several of them or a ReplayBuffer of tensordicts, got "
                f"{type(part if isinstance(data, list | tuple) else data).__name__}: "
                "TensorDict(..., batch_size=[N]) makes one of tensors, read_csv and read_npz of "
                "tables"
            )
        if not part.ndim:
            raise ValueError("data have batch size []: give transitions with a batch size [N]")
    return [one for part in parts for one in _even(part)]


def _even(data: TensorDictBase) -> list[TensorDictBase]:
    """The tensordict itself, or the trajectories of a lazy stack one by one."""
    if -1 not in data.shape:
        return [data]
    return [one for part in data.unbind(data.shape.index(-1) - 1) for one in _even(part)]


def _time_last(data: TensorDictBase) -> TensorDictBase:
    """Move the dimension that collectors call time to the end, if it is not there."""
    names = data.names if data._has_names() else []
    if "time" in names[:-1]:
        data = data.transpose(names.index("time"), data.ndim - 1)
    return data


def _read(
    data: TensorDictBase,
    observation_key: NestedKey,
    action_key: NestedKey,
    dtype: torch.dtype | None,
    device: torch.device | None,
) -> TensorDict:
    """The needed entries of a tensordict, flattened, and what is known of each row."""
    shape, next_key = data.shape, _after(observation_key)

    def vectors(key: NestedKey, option: str) -> Tensor:
        values = _entry(data, key, option).detach()
        if values.ndim != data.ndim + 1 or not values.shape[-1]:
            raise ValueError(
                f"{_name(key)} has shape {list(values.shape)} for a batch size of {list(shape)}, "
                f"expected {[*shape, 'n']}: one vector per transition"
            )
        return values.reshape(-1, values.shape[-1]).to(
            device=device, dtype=dtype or torch.get_default_dtype()
        )

    _check_single_steps(data, next_key)
    observation = vectors(observation_key, "observation_key")
    following = vectors(next_key, "observation_key")
    action = vectors(action_key, "action_key")
    if observation.shape != following.shape:
        raise ValueError(
            f"{_name(observation_key)} has {observation.shape[-1]} entries, {_name(next_key)} "
            f"{following.shape[-1]}: they must be observations of one kind"
        )
    return TensorDict(
        {
            "observation": observation,
            "action": action,
            "next": {"observation": following},
            **_known_of_rows(data, observation, following),
        },
        batch_size=[len(observation)],
    )


def _known_of_rows(
    data: TensorDictBase, observation: Tensor, following: Tensor
) -> dict[str, Tensor]:
    """Rows that the next one continues, rows to learn from, and the episode of each."""
    here = observation.device

    def flag(*keys: NestedKey) -> Tensor | None:
        found = [value for key in keys if (value := data.get(key, None)) is not None]
        if not found:
            return None
        flat = [value.reshape(data.numel(), -1).bool().any(-1).to(here) for value in found]
        return torch.stack(flat).any(0)

    none = torch.zeros(len(observation), dtype=torch.bool, device=here)
    ends = flag(*(("next", name) for name in _ENDS))
    before = flag(*_ENDS)
    if ends is None:
        ends, before = before if before is not None else none, none
    mask, first, held_out = flag(*_PADDING), flag("is_init"), flag("validation")
    ids = _trajectory_ids(data, here)
    # In a batch no row follows another, and nothing follows the last row.
    meets = none.clone()
    meets[:-1] = (following[:-1] == observation[1:]).all(-1)
    meets &= (torch.arange(len(meets), device=here) + 1) % max(data.shape[-1], 1) != 0
    told = ids is not None or first is not None
    goes_on = ~none if told else none.clone()
    if ids is not None:
        goes_on[:-1] &= ids[:-1] == ids[1:]
    if first is not None:
        goes_on[:-1] &= ~first[1:]
    real = ~none if mask is None else mask
    if before is not None:
        real = real & ~before
    # An episode ended, and the next one starts where it did: no plant does that.
    across = meets & ends & ~goes_on & real
    spent = none.clone()
    spent[1:] = across[:-1]
    joined = meets & ~ends
    if told:
        joined &= goes_on
    starts = ~none
    starts[1:] = ~joined[:-1]
    trajectory = starts.cumsum(0) - 1
    if ids is not None:
        trajectory = ids.unique(return_inverse=True)[1]
    return {
        "joined": joined,
        "real": real,
        "reset": (across | spent) & real,
        "trajectory": trajectory,
        "validation": none if held_out is None else held_out,
    }


def _entry(data: TensorDictBase, key: NestedKey, option: str) -> Tensor:
    """The numbers under a key."""
    value = data.get(key, None)
    if value is None:
        there = ", ".join(sorted(_name(one) for one in data.keys(True, True)))
        raise KeyError(
            f"the data have no {_name(key)}, only {there}: name it by {option}, or rename it"
            + "; it is what followed each step, the observation one row later" * (key[0] == "next")
        )
    if not isinstance(value, Tensor) or value.is_complex():
        kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(f"{_name(key)} is {kind}, expected a tensor of real numbers")
    return value


def _check_single_steps(data: TensorDictBase, next_key: NestedKey) -> None:
    """Reject data of TorchRL's MultiStep, whose next observation is several steps away."""
    for key in _STEPS:
        if (steps := data.get(key, None)) is not None and bool((steps > 1).any()):
            raise ValueError(
                f"{_name(next_key)} is up to {int(steps.max())} steps later, as {_name(key)} says, "
                "which MultiStep wrote: a model predicts one step, so give data that it has not "
                "changed"
            )


def _after(key: NestedKey) -> NestedKey:
    return unravel_key(("next", key))


def _name(key: NestedKey) -> str:
    return repr(unravel_key(key))


def _trajectory_ids(data: TensorDictBase, device: torch.device) -> Tensor | None:
    for key in _TRAJECTORY_IDS:
        if (value := data.get(key, None)) is None:
            continue
        if isinstance(value, Tensor):
            ids = value.reshape(-1).to(device).unique(return_inverse=True)[1]
        else:  # names
            names = np.array(value.tolist() if data.ndim else [], dtype=str).reshape(-1)
            ids = torch.from_numpy(np.unique(names, return_inverse=True)[1]).to(device)
        if len(ids) != data.numel():
            raise ValueError(
                f"{_name(key)} holds {len(ids)} numbers for {data.numel()} transitions: expected "
                "one for each"
            )
        return ids
    return None


def _is_transition(rows: TensorDictBase, keys: tuple[NestedKey, NestedKey]) -> Tensor:
    """Rows that are transitions of the system; warnings count the others."""
    real, count = rows["real"], int(rows["real"].sum())
    names = {"observation": keys[0], "action": keys[1], ("next", "observation"): _after(keys[0])}
    finite = torch.ones_like(real)
    culprits = []
    for key, name in names.items():
        good = rows[key].isfinite().all(-1)
        finite &= good
        if broken := int((real & ~good).sum()):
            culprits.append(f"{broken} in {_name(name)}")
    if culprits:
        warnings.warn(
            f"dropped {int((real & ~finite).sum())} of {count} transitions with values that are "
            f"not finite: {', '.join(culprits)}",
            stacklevel=4,
        )
    across = real & finite & rows["reset"]
    if across.any():
        warnings.warn(
            f"dropped {int(across.sum())} of {count} transitions at resets: "
            f"{_name(_after(keys[0]))} of an ended episode is the observation that the next one "
            "starts from, as reported by an environment that resets itself",
            stacklevel=4,
        )
    return finite & ~rows["reset"]


def _nothing() -> Transitions:
    none = torch.zeros(0, dtype=torch.bool)
    return Transitions(TensorDict(batch_size=[0]), none, none, 0)


def _hold_out(groups: Tensor, fraction: float, seed: int) -> Tensor:
    """Rows kept out of training, ``(N,)``, in whole groups."""
    count = len(groups)
    wanted = max(1, min(round(fraction * count), count - 1))
    groups, sizes = groups.unique(return_inverse=True, return_counts=True)[1:]
    if count and int(sizes.max()) > wanted:
        order = groups.argsort(stable=True)
        rank = torch.arange(count, device=groups.device)
        rank[order] = rank - (sizes.cumsum(0) - sizes)[groups[order]]
        piece = max(1, min(wanted, count - wanted, max(_PIECE, wanted // 5)))
        pieces = groups * (count // piece + 1) + rank // piece
        groups, sizes = pieces.unique(return_inverse=True, return_counts=True)[1:]
    generator = torch.Generator().manual_seed(int(seed))
    order = torch.randperm(len(sizes), generator=generator).to(groups.device)
    before = sizes[order].cumsum(0) - sizes[order]
    # Never all of them.
    drawn = order[before < wanted][: max(0, len(sizes) - 1)]
    return torch.isin(groups, drawn)
