"""What columns that nobody named reveal about rows that do not follow each other."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from torch import Tensor

# Names of flags of an episode's end, used by D4RL, Minari, Gymnasium and TorchRL among others, of
# flags of its start, and of columns that number episodes.
_ENDS = re.compile(r"(is_)?(done|terminal|terminated|termination|timeout|truncated|truncation)s*")
_STARTS = re.compile(r"(is_)?(reset|new_episode|episode_start)s?|is_(first|init)")
_NUMBERS = re.compile(
    r"(episode|run|trial|rollout)(_?(id|idx|index|number))?|traj(ectory)?_?(ids?|idx|index|number)"
)
_TIMES = re.compile(r"time(stamp)?s?")

_FALSE = ("", "false", "f", "no", "n", "none")

# Observations that differ by less than this share of their spread are equal up to rounding.
_ROUNDING = 1e-5

# A time step this many times the usual one is not jitter.
_GAP = 10


def tells_of_ends(name: str) -> bool:
    """Whether the name of a column means that it shows where episodes end."""
    kinds = (_ENDS, _STARTS, _NUMBERS, _TIMES)
    return any(kind.fullmatch(name.lower()) for kind in kinds)


def tells_what_follows(name: str, observation: str) -> bool:
    """Whether the name of a column means that it holds an observation one step later.

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
    """Rows that are the last of an episode, by the column that shows it.

    Args:
        columns: numbers or text, none of them empty.
        count: number of rows in the file.
        numbered: whether a column that numbers the episodes is named, so that others do not count.
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
    """Rows in which a flag is set, however it is written."""
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
    """Rows where a time goes back, or jumps by much more than usual; none if it is not numeric."""
    try:
        steps = np.diff(clock.astype(np.float64))
    except ValueError:
        return np.zeros(len(clock) - 1, dtype=bool)
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else np.inf
    return (steps < 0) | (steps > _GAP * usual)


def check_ends(path: str, name: str, ends: np.ndarray) -> None:
    """Reject a file that shows several episodes but would be read as one."""
    count = int(ends[:-1].sum())
    if count:
        raise ValueError(
            f"{path}: {name!r} shows {count} episodes that end before the last row, which would "
            "be read as one: name as episode the column that numbers them, such as a running count "
            "of their starts, or name the time; or rename the column if it holds something else"
        )


def check_no_end_within(path: str, name: str, ends: Tensor, joined: Tensor) -> None:
    """Reject a file that shows ends of episodes where an episode would continue.

    A flag may stand in the row whose action ended the episode, followed by the last observation, so
    only a second row after it is one too many.
    """
    count = int((ends[:-2] & joined[:-1] & joined[1:]).sum())
    if count:
        raise ValueError(
            f"{path}: {name!r} shows {count} ends within single episodes according to episode and "
            "time, and steps across them would be taken for the plant's: name as episode the "
            "column that numbers all episodes, such as a running count of their starts; leave out "
            "rows after an end; or rename the column if it holds something else"
        )


def check_follows(path: str, name: str, now: Tensor, told: Tensor, joined: Tensor) -> None:
    """Reject a file that shows that rows are not what followed the row before.

    Args:
        path: path of the file.
        name: name of the column that shows it.
        now: the observation ``(T, k)``.
        told: the observation one step later, according to the file, ``(T, k)``.
        joined: whether a row is read as following the one before, ``(T - 1,)``.

    Raises:
        ValueError: if they differ in any row; values that are not numbers are ignored.
    """
    spread = (now - now.nanmean(0)).square().nanmean(0).sqrt()
    apart = (now[1:] - told[:-1]).abs() > _ROUNDING * (spread + now[1:].abs())
    count = int((apart.any(-1) & joined).sum())
    if count:
        raise ValueError(
            f"{path} has {name!r}, which differs from the next row {count} times out of "
            f"{int(joined.sum())}: rows that do not follow each other are not steps of the plant; "
            "name as episode the column that numbers them or, for rows in any order, make a "
            "tensordict of observation, action and ('next', 'observation') and pass that"
        )
