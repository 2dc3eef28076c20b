"""What columns of a file that nobody named tell of where its rows do not follow each other."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from torch import Tensor

# What flags of an episode's end are called, by D4RL, Minari, Gymnasium and TorchRL among others,
# those of its start, and what numbers it.
_ENDS = re.compile(r"(is_)?(done|terminal|terminated|termination|timeout|truncated|truncation)s*")
_STARTS = re.compile(r"(is_)?(reset|new_episode|episode_start)s?|is_(first|init)")
_NUMBERS = re.compile(
    r"(episode|run|trial|rollout)(_?(id|idx|index|number))?|traj(ectory)?_?(ids?|idx|index|number)"
)
_TIMES = re.compile(r"time(stamp)?s?")

_FALSE = ("", "false", "f", "no", "n", "none")

# Observations that differ by less than this share of their spread are one, rounded twice.
_ROUNDING = 1e-5

# A step of time that is so many times the usual one is no jitter.
_GAP = 10


def tells_of_ends(name: str) -> bool:
    """Whether a column of this name tells where episodes end."""
    kinds = (_ENDS, _STARTS, _NUMBERS, _TIMES)
    return any(kind.fullmatch(name.lower()) for kind in kinds)


def tells_what_follows(name: str, observation: str) -> bool:
    """Whether a column of this name holds what an observation was one step later.

    Examples:
        >>> tells_what_follows("next_observations", "observation"), tells_what_follows("x", "x")
        (True, False)
    """
    one = re.escape(observation.lower())
    one += "?" if one.endswith("s") else "s?"
    return bool(re.fullmatch(rf"next[_./ ]?{one}|{one}[_./ ]next", name.lower()))


def told_ends(
    columns: Mapping[str, np.ndarray], count: int, numbered: bool
) -> dict[str, np.ndarray]:
    """Rows that are the last of an episode, by the column that tells so.

    Args:
        columns: numbers or text, none of them empty.
        count: rows of the file.
        numbered: whether what numbers the episodes is named, so that other numbers do not count.
    """
    found = {}
    for name, values in columns.items():
        rows = values.reshape(count if values.size == count else len(values), -1)
        if _ENDS.fullmatch(name.lower()):
            found[name] = _is_set(rows)
        elif _STARTS.fullmatch(name.lower()):
            found[name] = np.append(_is_set(rows)[1:], False)
        elif numbered or len(rows) < count - 1:
            continue
        elif _NUMBERS.fullmatch(name.lower()):
            found[name] = np.append((rows[1:] != rows[:-1]).any(-1), False)
        else:
            found[name] = np.append(_breaks(rows[:, 0]), False)
    return found


def _is_set(flags: np.ndarray) -> np.ndarray:
    """In which rows a flag is, however it is written."""
    if flags.dtype.kind == "U":
        return np.array([any(map(_is_true, row)) for row in flags.tolist()], dtype=bool)
    return ((flags != 0) & (flags == flags)).any(-1)


def _is_true(cell: str) -> bool:
    try:
        number = float(cell)
    except ValueError:
        return cell.lower() not in _FALSE
    return number != 0 and number == number


def _breaks(clock: np.ndarray) -> np.ndarray:
    """Where a time goes back, or on by much more than usual; nowhere if it is no number."""
    try:
        steps = np.diff(clock.astype(np.float64))
    except ValueError:
        return np.zeros(len(clock) - 1, dtype=bool)
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else np.inf
    return (steps < 0) | (steps > _GAP * usual)


def check_ends(path: str, name: str, ends: np.ndarray) -> None:
    """Refuse a file that tells of several episodes where it is to be read as one."""
    count = int(ends[:-1].sum())
    if count:
        raise ValueError(
            f"{path} tells by {name!r} of {count} episodes that end before the last row, and would "
            "be read as one: name what numbers them as episode, such as the running count of their "
            "starts, or the time; or rename the column if it is of something else"
        )


def check_no_end_within(path: str, name: str, ends: Tensor, joined: Tensor) -> None:
    """Refuse a file that tells of ends after which an episode would go on.

    A flag may stand in the row whose action ended the episode, with the last observation behind
    it, so that only a second row behind it is one too many.
    """
    count = int((ends[:-2] & joined[:-1] & joined[1:]).sum())
    if count:
        raise ValueError(
            f"{path} tells by {name!r} of {count} ends within what episode and time say are single "
            "episodes, and steps across them would be taken for the plant's: name what numbers "
            "all episodes as episode, such as the running count of their starts; leave out rows "
            "behind an end; or rename the column if it is of something else"
        )


def check_follows(path: str, name: str, now: Tensor, told: Tensor, joined: Tensor) -> None:
    """Refuse a file that tells of rows that are not what followed the row before.

    Args:
        path: of the file.
        name: of the column that tells.
        now: the observation ``(T, k)``.
        told: what the file says that it was one step later, ``(T, k)``.
        joined: whether a row is taken for what followed the one before, ``(T - 1,)``.

    Raises:
        ValueError: if it is another in any row; values that are no numbers tell nothing.
    """
    spread = (now - now.nanmean(0)).square().nanmean(0).sqrt()
    apart = (now[1:] - told[:-1]).abs() > _ROUNDING * (spread + now[1:].abs())
    count = int((apart.any(-1) & joined).sum())
    if count:
        raise ValueError(
            f"{path} has {name!r}, which is not what stands in the next row {count} times of "
            f"{int(joined.sum())}: rows that do not follow each other are no steps of the plant; "
            "name what numbers the episodes as episode, or, of rows in any order, make a "
            "tensordict of observation, action and ('next', 'observation') and hand that over"
        )
