"""Recorded data from other sources, as tensordicts like those of TorchRL's collectors."""

from __future__ import annotations

import csv
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_l1.dynamics.episode_ends import (
    check_ends,
    check_follows,
    check_no_end_within,
    tells_of_ends,
    tells_what_follows,
    told_ends,
)

if TYPE_CHECKING:
    from minari import MinariDataset

_Path = str | os.PathLike[str]

# Name of the whole observation in error messages, whatever its parts.
_ALL_OF_IT = ("observation", "obs", "state")

# Time steps that differ from the usual one by more than this are gaps.
_JITTER = 0.1


def read_csv(
    path: _Path,
    *,
    observation: Sequence[str],
    action: Sequence[str],
    episode: str | None = None,
    time: str | None = None,
    delimiter: str = ",",
) -> TensorDict:
    r"""Transitions of a real system from a table with one line per sampling instant.

    A line holds what was measured and the action that was sent to the actuators from then until the
    next line. Two consecutive lines of an episode make one transition, so the action in the last
    line of an episode is not used. Empty cells become NaN; how to treat them is up to the reader of
    the transitions, such as :func:`~torchrl_l1.dynamics.fit_dynamics`.

    Args:
        path: path of the file, whose first line holds the names of the columns.
        observation: columns of the observation, n of them.
        action: columns of the action, m of them.
        episode: column that numbers or names the episodes; one episode if ``None``. Rows of several
            episodes may alternate. If a name comes back after longer blocks of others, as in files
            that were joined, a new episode begins with a warning, unless there is a time.
        time: column of the time, s. A new episode begins where the time goes back and, with a
            warning, at a gap: where a step differs from the usual one by more than a tenth.
        delimiter: separator of the cells.

    Returns:
        ``observation`` ``(N, n)``, ``action`` ``(N, m)``, flags, the next observation under
        ``"next"``, ``("collector", "traj_ids")`` and, with a time column, ``dt`` ``(N, 1)``, the
        usual step; batch size ``[N]``, float64.

    Raises:
        FileNotFoundError: if there is no such file.
        KeyError: if there is no such column.
        ValueError: for a cell that is not a number, a line with more cells than columns or without
            its episode; if no two lines are consecutive; if a column you did not name, such as
            ``done``, ``is_first``, ``run`` or ``time``, indicates an episode end between lines read
            as consecutive; or if one like ``next_angle`` contradicts their order.

    Examples:
        >>> from pathlib import Path
        >>> from tempfile import mkdtemp
        >>> file = Path(mkdtemp()) / "drive.csv"
        >>> rows = ["time,angle,rate,torque", "0,0,0,1", "0.1,0,0.5,1", "0.2,0.05,1,0"]
        >>> _ = file.write_text("\n".join(rows))
        >>> data = read_csv(file, observation=["angle", "rate"], action=["torque"], time="time")
        >>> data["next", "observation"]
        tensor([[0.0000, 0.5000],
                [0.0500, 1.0000]], dtype=torch.float64)
        >>> data["dt"][0].item()
        0.1
    """
    observation, action = _listed(observation), _listed(action)
    if not observation or not action:
        raise ValueError("observation and action need the name of at least one column each")
    numbers = [*observation, *action, *([] if time is None else [time])]
    wanted = [*numbers, *([] if episode is None else [episode])]
    try:
        columns = _columns(path, wanted, numbers, observation, delimiter)
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not text in UTF-8 ({error.reason}): save it as such") from None
    except csv.Error as error:
        raise ValueError(f"{path} is not a table of text: {error}") from None
    told = {
        name: np.array(cells)
        for name, cells in columns.items()
        if cells and name not in wanted and tells_of_ends(name)
    }

    def side_by_side(*names: str) -> Tensor:
        return torch.tensor([columns[name] for name in names], dtype=torch.float64).T

    following = {
        other: (side_by_side(name), side_by_side(other))
        for name in observation
        for other in columns
        if other not in wanted and tells_what_follows(other, name)
    }
    clock = None if time is None else side_by_side(time)[:, 0]
    labels = None if episode is None else np.array(columns[episode])
    x, u = side_by_side(*observation), side_by_side(*action)
    return _rows(str(path), x, u, labels, clock, told, following)


def read_npz(
    path: _Path,
    *,
    observation: str | Sequence[str],
    action: str | Sequence[str],
    episode: str | None = None,
    time: str | None = None,
) -> TensorDict:
    """As :func:`read_csv`, from arrays saved by :func:`numpy.savez`.

    Arrays are ``(T,)`` or ``(T, k)``, one row per sampling instant; several are concatenated. The
    observations may have one row more than the actions: the last one of a single episode.

    Args:
        path: path of the file.
        observation: names of the arrays that make up the observation.
        action: names of the arrays that make up the action.
        episode: name of the array that numbers the episodes ``(T,)``; one episode if ``None``.
        time: name of the array of times ``(T,)``, s.

    Raises:
        FileNotFoundError: if there is no such file.
        KeyError: if there is no such array.
        ValueError: if the arrays are not numbers of one length, if the file is not one of NumPy's,
            or as in :func:`read_csv` for several episodes.
    """
    try:
        file = np.load(path, allow_pickle=False)
        if isinstance(file, np.ndarray):
            raise ValueError("a single array; save several by name with numpy.savez")
        with file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except Exception as error:
        why: object = error
        if "Object arrays" in str(error):
            why = (
                "it has arrays of objects, which are pickles: save arrays of numbers, episodes one "
                "after the other, and an array that numbers them"
            )
        elif "pickle" in str(error):  # as which NumPy treats everything else
            why = "numpy.savez did not write it"
        raise ValueError(f"{path} is not a readable .npz file: {why}") from None

    def array(name: str) -> np.ndarray:
        if name not in arrays:
            raise KeyError(f"{path} has no array {name!r}, only {', '.join(arrays)}")
        return arrays[name]

    def side_by_side(names: str | Sequence[str]) -> Tensor:
        parts = []
        for name in _listed(names):
            values = array(name)
            if values.dtype.kind not in "fiub" or values.ndim not in (1, 2):
                raise ValueError(
                    f"{path}: {name!r} has shape {list(values.shape)} and type {values.dtype}, "
                    "expected numbers of shape [T] or [T, k]"
                )
            column = torch.from_numpy(values.astype(np.float64))
            parts.append(column if column.ndim == 2 else column[:, None])
        lengths = {len(part) for part in parts}
        if len(lengths) != 1:
            raise ValueError(f"{path}: {names} have lengths {sorted(lengths)}, expected one length")
        return torch.cat(parts, -1)

    x, u = side_by_side(observation), side_by_side(action)
    names = [one for given in (observation, action, episode, time) for one in _listed(given)]
    told = {
        key: values
        for key, values in arrays.items()
        if tells_of_ends(key) and key not in names
        if values.ndim and values.size and values.dtype.kind in "fiubU"
    }
    following = {
        key: (now, side_by_side(key))
        for name, now in (
            *((name, x) for name in _ALL_OF_IT),
            *((name, side_by_side(name)) for name in _listed(observation)),
        )
        for key in arrays
        if key not in names and tells_what_follows(key, name)
        if arrays[key].size * len(now) == now.numel() * len(arrays[key])
    }
    if len(x) == len(u) + 1:
        u = torch.cat([u, u.new_zeros(1, u.shape[-1])])
    clock = None if time is None else side_by_side(time)
    if clock is not None and clock.shape[-1] != 1:
        raise ValueError(f"{path}: {time!r} has {clock.shape[-1]} columns, expected times (T,)")
    clock = None if clock is None else clock[:, 0]
    labels = None if episode is None else array(episode).reshape(-1)
    for name, values in (("action", u), (time, clock), (episode, labels)):
        if values is not None and len(values) != len(x):
            raise ValueError(f"{path}: {name} has {len(values)} rows, the observation {len(x)}")
    return _rows(str(path), x, u, labels, clock, told, following)


def read_minari(dataset: str | MinariDataset, download: bool = False) -> TensorDict:
    """Transitions of a Minari dataset; needs the extra ``minari``.

    Args:
        dataset: name of a dataset, such as ``"mujoco/inverteddoublependulum/medium-v0"``, or the
            dataset itself, perhaps reduced by :meth:`~minari.MinariDataset.filter_episodes`.
        download: whether to download it if it is not on this machine.

    Returns:
        ``observation``, ``action``, ``reward``, flags and what followed under ``"next"``,
        ``("collector", "traj_ids")``; batch size ``[N]``. The entries of dictionary observations
        have their own keys, as in TorchRL's ``GymEnv``.

    Raises:
        FileNotFoundError: if the dataset is not on this machine.
        ModuleNotFoundError: without Minari.
        TypeError: if actions are not vectors, or observations neither vectors nor dictionaries.
        ValueError: if there are no episodes.
    """
    try:
        import minari
        from gymnasium.spaces import Box
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "reading a Minari dataset needs Minari: pip install 'torchrl-l1[minari]'"
        ) from None
    if isinstance(dataset, str):
        dataset = minari.load_dataset(dataset, download=download)
    if not isinstance(dataset.action_space, Box):
        raise TypeError(
            f"the dataset has actions of {dataset.action_space}: L1 needs vectors of numbers, a Box"
        )
    episodes = []
    for number, episode in enumerate(dataset.iterate_episodes()):
        flags = {
            "terminated": torch.from_numpy(np.array(episode.terminations, dtype=bool))[:, None],
            "truncated": torch.from_numpy(np.array(episode.truncations, dtype=bool))[:, None],
        }
        reward = torch.from_numpy(np.array(episode.rewards))[:, None]
        actions = torch.from_numpy(np.array(episode.actions)).flatten(1)
        seen = TensorDict(_nested(episode.observations), batch_size=[len(actions) + 1])
        ids = torch.full((len(actions),), number)
        episodes.append(_step(seen[:-1], seen[1:], actions, ids, flags, reward))
    if not episodes:
        raise ValueError(f"the dataset {dataset.spec.dataset_id} has no episodes")
    return _named(torch.cat(episodes))


def _columns(
    path: _Path,
    wanted: Sequence[str],
    numbers: Sequence[str],
    observation: Sequence[str],
    delimiter: str,
) -> dict[str, list[Any]]:
    """Columns of a table by name; those in ``numbers`` as numbers, with empty cells as NaN.

    Also columns that indicate the ends of episodes, or what followed an observation.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file{', but a folder' * Path(path).is_dir()}")
    if len(delimiter) != 1:
        raise ValueError(f"{path}: the delimiter is one character, like '\\t', got {delimiter!r}")
    # A byte order mark is not part of the first column's name.
    with open(path, newline="", encoding="utf-8-sig") as file:
        # Spaces after a delimiter would hide quotes; they may be delimiters themselves.
        lines = csv.reader(file, delimiter=delimiter, skipinitialspace=True)
        header = [name.strip() for name in next(filter(None, lines), [])]
        if any("\0" in name for name in header):
            raise ValueError(f"{path} is not text: save the table as CSV")
        if header:
            header[0] = header[0].removeprefix("#").strip()
        for name in wanted:
            if name not in header:
                there = ", ".join(header) or "no first line"
                hint = "" if len(header) > 1 else f", with cells separated by {delimiter!r}"
                other = next((mark for mark in (";", "\t", ",") if hint and mark in there), None)
                hint += f"; give delimiter={other!r}" if other else ""
                raise KeyError(f"{path} has no column {name!r}, only {there}{hint}")
            if header.count(name) > 1:
                raise ValueError(f"{path} has {header.count(name)} columns {name!r}: rename them")
        ends = [name for name in header if tells_of_ends(name) and name not in wanted]
        following = [
            name
            for name in header
            if name not in wanted and any(tells_what_follows(name, one) for one in observation)
        ]
        numbers = [*numbers, *following]
        places = {name: header.index(name) for name in [*wanted, *ends, *following]}
        columns: dict[str, list[Any]] = {name: [] for name in places}
        for line in lines:
            if not any(cell.strip() for cell in line):
                continue
            if any(cell.strip() for cell in line[len(header) :]):
                raise ValueError(
                    f"{path}, line {lines.line_num} has {len(line)} cells for {len(header)} "
                    f"columns: there is a column without a name, or a {delimiter!r} within numbers"
                )
            for name, place in places.items():
                cell = line[place].strip() if place < len(line) else ""
                if name in numbers:
                    try:
                        columns[name].append(_number(cell))
                    except ValueError:
                        remedy = "leave the cell empty if there is no value"
                        if re.fullmatch(r"[-+]?\d*,\d+", cell):
                            remedy = "use a point before the decimals"
                        elif re.search(r"\d:\d", cell):
                            remedy = "give times in seconds"
                        raise ValueError(
                            f"{path}, line {lines.line_num}, column {name!r}: {cell!r} is not a "
                            f"number; {remedy}"
                        ) from None
                else:
                    columns[name].append(cell)
    return columns


def _number(cell: str) -> float:
    if "_" in cell:  # which Python accepts between digits
        raise ValueError
    return float(cell or "nan")


def _listed(names: str | Sequence[str] | None) -> list[str]:
    return [names] if isinstance(names, str) else list(names or ())


def _episodes(path: str, labels: np.ndarray) -> Tensor:
    """Numbers of the episodes by which the rows are labelled."""
    missing = np.array([str(label).lower() in ("", "nan") for label in labels.tolist()], dtype=bool)
    if missing.any():
        raise ValueError(
            f"{path}: {int(missing.sum())} of {len(labels)} rows name no episode, first row "
            f"{int(missing.argmax()) + 1}: fill that in, or leave them out"
        )
    return torch.from_numpy(np.unique(labels, return_inverse=True)[1].reshape(-1))


def _rows(
    path: str,
    x: Tensor,
    u: Tensor,
    labels: np.ndarray | None,
    clock: Tensor | None,
    told: Mapping[str, np.ndarray],
    following: Mapping[str, tuple[Tensor, Tensor]],
) -> TensorDict:
    """Transitions between consecutive rows."""
    ends = told_ends(told, len(x), labels is not None)
    ids = torch.zeros(len(x), dtype=torch.long)
    blocks, order = ids, torch.arange(len(x))
    if labels is None and clock is None:
        for name, flags in ends.items():
            check_ends(path, name, flags)
    if labels is not None and len(labels):
        ids = _episodes(path, labels)
        blocks[1:] = (ids[1:] != ids[:-1]).cumsum(0)
        again = int(blocks[-1]) + 1 - len(ids.unique())
        # Rows of episodes recorded at the same time alternate; joined files have long blocks.
        if clock is not None or 4 * int(blocks[-1] + 1) > len(ids):
            blocks = torch.zeros_like(ids)
        elif again:
            warnings.warn(
                f"{path}: names of episodes come back {again} times after others: a new episode "
                "begins at each; give every episode its own name",
                stacklevel=3,
            )
        order = ids.argsort(stable=True)
        x, u, ids, blocks = x[order], u[order], ids[order], blocks[order]
        clock = None if clock is None else clock[order]
    joined = (ids[1:] == ids[:-1]) & (blocks[1:] == blocks[:-1])
    extras = {}
    if clock is not None and len(clock) > 1:
        dt, joined = _steps(path, clock, joined)
        extras["dt"] = torch.full((len(x) - 1, 1), dt, dtype=x.dtype)
    for name, flags in ends.items():
        ended = torch.zeros(len(x), dtype=torch.bool)
        ended[: len(flags)] = torch.from_numpy(flags[: len(x)])
        check_no_end_within(path, name, ended[order], joined)
    for name, (now, then) in following.items():
        after = torch.full_like(now, torch.nan)
        after[: len(then)] = then[: len(now)]
        check_follows(path, name, now[order], after[order], joined)
    if not joined.any():
        raise ValueError(f"{path} has {len(x)} rows, none of which follows another in its episode")
    trajectory = torch.cat([torch.zeros(1, dtype=torch.long), (~joined).cumsum(0)])
    last = torch.ones_like(joined)
    last[:-1] = ~joined[1:]
    data = _step(
        TensorDict({"observation": x[:-1]}, batch_size=[len(joined)]),
        TensorDict({"observation": x[1:]}, batch_size=[len(joined)]),
        u[:-1],
        trajectory[:-1],
        {"terminated": torch.zeros_like(last)[:, None], "truncated": last[:, None]},
    )
    return _named(data.update(extras)[joined])


def _steps(path: str, clock: Tensor, joined: Tensor) -> tuple[float, Tensor]:
    """The usual time step, s, and which rows are followed by the next one after that step."""
    steps = clock.diff()
    # Rows with equal times are a step of zero length, and so a gap.
    onward = joined & (steps >= 0)
    taken = steps[onward & (steps > 0)]
    if not len(taken):
        raise ValueError(
            f"{path}: the time never increases from one row to the next: sort the rows by it, or "
            "check what numbers the episodes"
        )
    dt = float(taken.median())
    even = (steps - dt).abs() <= _JITTER * dt
    gaps = int((joined & ~even & ~(steps < 0)).sum())
    if gaps > int(onward.sum()) / 2:
        low, high = float(steps[onward].min()), float(steps[onward].max())
        back = int((joined & (steps < 0)).sum())
        remedy = "resample to one sampling time"
        if 4 * back > int(onward.sum()):
            remedy = f"the time goes back {back} times, sort the rows by it"
        raise ValueError(f"{path}: time steps from {low:.4g} to {high:.4g} s: {remedy}")
    if gaps:
        warnings.warn(
            f"{path}: {gaps} time steps differ from {dt:.4g} s by more than a tenth: a new "
            "episode begins after each",
            stacklevel=4,
        )
    return dt, joined & even


def _nested(values: Any) -> dict[str, Any]:
    """Observations of an episode as GymEnv names them."""
    if isinstance(values, Mapping):
        return {
            key: _nested(value) if isinstance(value, Mapping) else torch.from_numpy(np.array(value))
            for key, value in values.items()
        }
    if not isinstance(values, np.ndarray):
        raise TypeError(
            f"the dataset has observations of type {type(values).__name__}: arrays or "
            "dictionaries of them can be read"
        )
    return {"observation": torch.from_numpy(np.array(values))}


def _step(
    seen: TensorDict,
    following: TensorDict,
    action: Tensor,
    trajectory: Tensor,
    flags: Mapping[str, Tensor],
    reward: Tensor | None = None,
) -> TensorDict:
    """One tensordict of an environment's outputs before and after a step."""
    after = {**flags, "done": flags["terminated"] | flags["truncated"]}
    following.update(after if reward is None else {**after, "reward": reward})
    before = {name: torch.zeros_like(value) for name, value in after.items()}
    collector = {"traj_ids": trajectory}
    return seen.update({"action": action, **before, "next": following, "collector": collector})


def _named(data: TensorDict) -> TensorDict:
    """Name the last dimension ``"time"``, as collectors do."""
    data.names = ["time"]
    return data
