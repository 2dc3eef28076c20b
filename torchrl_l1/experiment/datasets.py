"""Reading the datasets that offline recipes name."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Container, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase, lazy_stack

from torchrl_l1.algorithms import DatasetColumns
from torchrl_l1.dynamics import read_csv, read_minari, read_npz
from torchrl_l1.experiment.checkpoints import read_checkpoint
from torchrl_l1.experiment.errors import RunDirectoryError

# Minari's pattern, except that a version is required.
_MINARI_NAME = re.compile(r"([-\w][-\w/]*[-\w]+/)?[-\w]+-v\d+")
_CHECKPOINTS = ("checkpoint.pt", "checkpoint_previous.pt")
_PICKLES = ("*.pkl", "*.pickle")


def read_dataset(source: str, columns: DatasetColumns | None = None) -> TensorDictBase:
    """Read transitions from a file, a folder or a Minari dataset.

    Args:
        source: a ``.npz``, ``.csv``, ``.pt`` or ``.safetensors`` file; the folder of a run, of a
            memory-mapped tensordict, of a replay buffer's ``dumps`` or of a Minari dataset; or the
            name of a Minari dataset on this machine, such as ``hopper/medium-v0``. From a run, the
            real transitions in its checkpoint are taken.
        columns: names of the observation, the action and so on in the source.

    Returns:
        at least ``observation``, ``action`` and ``("next", "observation")``, of any batch size.

    Raises:
        FileNotFoundError: if there is no such dataset.
        KeyError: if it lacks a required entry, or one that ``columns`` names.
        ValueError: if it cannot be read, is of an unknown kind, or cannot use some ``columns``.

    Warns:
        UserWarning: if a tensordict ends in zeros, as a storage does that is not full.
    """
    check_dataset(source)
    columns = columns or DatasetColumns()
    path = Path(source)
    try:
        if path.is_file():
            return _file(path, columns)
        data = _folder(path) if path.is_dir() else read_minari(source)
    except (ModuleNotFoundError, TypeError) as error:
        raise ValueError(str(error)) from error
    return _named(source, data, columns)


def check_dataset(source: str) -> None:
    """Raise the error of :func:`read_dataset` for a missing source; Minari names pass."""
    if not source:
        raise ValueError("offline learning needs a dataset: set dataset=...")
    if not (Path(source).is_dir() or Path(source).is_file() or is_minari_name(source)):
        raise FileNotFoundError(
            f"{source}: no such dataset; torchrl-l1 dataset RUN_DIR {source} makes one"
        )


def is_minari_name(text: str) -> bool:
    """Whether a text is the name of a Minari dataset, such as ``hopper/medium-v0``."""
    return _MINARI_NAME.fullmatch(text) is not None


def _file(path: Path, columns: DatasetColumns) -> TensorDictBase:
    if path.suffix not in _FILES:
        raise ValueError(
            f"{path} is not a dataset: use a folder or a file that ends in {', '.join(_FILES)}"
        )
    return _FILES[path.suffix](path, columns)


def _csv(path: Path, columns: DatasetColumns) -> TensorDict:
    if not (columns.observation and columns.action):
        raise ValueError(
            f"{path}: name its columns, as in columns.observation=[x,v] columns.action=[u]"
        )
    # A recipe has no setting for it. read_csv reports what is not text.
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        header = next((line for line in file if line.strip()), "")
    delimiter = next((mark for mark in (",", ";", "\t") if mark in header), ",")
    names = [name.strip(' "\n') for name in header.split(delimiter)]
    episode = columns.episode or ("episode" if "episode" in names else None)
    return read_csv(path, **vars(columns) | {"episode": episode}, delimiter=delimiter)


def _npz(path: Path, columns: DatasetColumns) -> TensorDict:
    episode = columns.episode
    if episode is None:
        try:
            with np.load(path, allow_pickle=False) as arrays:
                episode = "episode" if "episode" in arrays else None
        # read_npz reports what is wrong with it.
        except Exception:
            episode = None
    return read_npz(
        path,
        observation=columns.observation or "observation",
        action=columns.action or "action",
        episode=episode,
        time=columns.time,
    )


def _saved(path: Path, columns: DatasetColumns) -> TensorDictBase:
    try:
        data = torch.load(path, weights_only=True, map_location="cpu")
    # Damage takes any form, as do files that torch did not write.
    except Exception as error:
        raise ValueError(
            f"{path} cannot be read as plain tensors; write it with "
            "torch.save(data.clone().to_dict(), file) or data.memmap(folder)"
        ) from error
    return _named(str(path), _tensordict(path, data, columns), columns)


def _safetensors(path: Path, columns: DatasetColumns) -> TensorDictBase:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        flat = load_file(path)
    except SafetensorError as error:
        raise ValueError(f"{path} is damaged or not a safetensors file: {error}") from error
    data: dict[str, Any] = {}
    for name, value in flat.items():
        *places, last = re.split(r"[./]", name)
        inner = data
        for place in places:
            inner = inner.setdefault(place, {})
            if not isinstance(inner, dict):
                raise ValueError(f"{path} holds both {place!r} and {name!r}: leave one of them out")
        inner[last] = value
    return _named(str(path), _tensordict(path, data, columns), columns)


_FILES: dict[str, Callable[[Path, DatasetColumns], TensorDictBase]] = {
    ".csv": _csv,
    ".npz": _npz,
    ".pt": _saved,
    ".safetensors": _safetensors,
}


def _tensordict(path: Path, data: Any, columns: DatasetColumns) -> TensorDictBase:
    if isinstance(data, TensorDictBase):
        return data
    key = columns.observation[0] if columns.observation else "observation"
    found = _inside(data, _key(key, data)) if isinstance(data, dict) else None
    if not isinstance(data, dict) or not isinstance(found, torch.Tensor) or found.ndim < 2:
        raise ValueError(
            f"{path} holds no dictionary of tensors that includes {key!r} of shape [N, n]"
        )
    try:
        return TensorDict(data, batch_size=found.shape[:-1])
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"{path}: not one row for each of {key!r}: {error}") from error


def _key(name: str, keys: Container[str]) -> tuple[str, ...]:
    """A key by its name, in which dots separate nested keys."""
    return (name,) if name in keys else tuple(name.split("."))


def _inside(data: Any, key: Sequence[str]) -> Any:
    """The value under a key; ``None`` if there is none, or its parent is a tensor."""
    for part in key:
        data = data.get(part, None) if isinstance(data, dict | TensorDictBase) else None
    return data


def _folder(path: Path) -> TensorDictBase:
    if (path / "config.yaml").is_file():
        return _of_run(path)
    for inside in (path, path / "data"):
        if (inside / "metadata.json").is_file():
            return _of_minari(inside)
    if (path / "buffer_metadata.json").is_file():
        path = path / "storage"
    if (path / "meta.json").is_file():
        for pattern in _PICKLES:
            for found in path.rglob(pattern):
                raise ValueError(f"{found} is a pickle, which is not read; remove it")
        try:
            data, filled = TensorDict.load_memmap(path), _filled(path)
        # Errors of damaged files have no common class.
        except Exception as error:
            raise ValueError(f"{path} is not a readable tensordict: {error}") from error
        return _written_rows(path, data, filled)
    raise ValueError(
        f"{path} holds no dataset: no run (config.yaml), no tensordict (meta.json), no replay "
        "buffer (buffer_metadata.json), no Minari dataset (metadata.json)"
    )


def _filled(path: Path) -> int | None:
    """The length of a replay buffer, which its ``dumps`` writes beside the storage."""
    file = path / "storage_metadata.json"
    return int(json.loads(file.read_text(encoding="utf-8"))["len"]) if file.is_file() else None


def _written_rows(path: Path, data: TensorDictBase, filled: int | None) -> TensorDictBase:
    """The data without the unused rows of a replay buffer."""
    if filled is not None:
        # A storage of batches may count rows or single steps, and nothing tells which.
        if data.ndim > 1 and filled != data.numel():
            raise ValueError(
                f"{path} comes from a replay buffer of batches and does not tell which are filled: "
                "write them with buffer[:].memmap(folder)"
            )
        return data[:filled]
    if isinstance(data, TensorDict) and data.ndim and (empty := _zeros_at_the_end(data)):
        warnings.warn(
            f"the last {empty} of {len(data)} rows of {path} are zeros, as in the storage of a "
            "replay buffer that is not full: write its contents with buffer.dumps(folder)",
            stacklevel=4,
        )
    return data


def _zeros_at_the_end(data: TensorDict) -> int:
    """Number of rows after the last one that holds anything."""
    written = torch.zeros(len(data), dtype=torch.bool)
    for value in data.values(True, True):
        if isinstance(value, torch.Tensor):
            written |= (value.unsqueeze(-1) != 0).flatten(1).any(-1)
    return int(written.flip(0).cumsum(0).eq(0).sum())


def _of_run(path: Path) -> TensorDictBase:
    """The replay buffer of a run's last readable checkpoint."""
    problems = []
    for name in _CHECKPOINTS:
        try:
            buffer = read_checkpoint(path / name)["algorithm"].get("buffer")
        except RunDirectoryError as error:
            problems.append(str(error))
            continue
        if not buffer:
            raise ValueError(f"{path} is a run that has no real transitions")
        return TensorDict(buffer).auto_batch_size_(1)
    raise ValueError(f"{path} is a run without data: {problems[0]}")


def _of_minari(path: Path) -> TensorDictBase:
    try:
        from minari import MinariDataset
    except ModuleNotFoundError:
        raise ValueError(
            f"{path} is a Minari dataset, which needs Minari: pip install 'torchrl-l1[minari]'"
        ) from None
    try:
        dataset = MinariDataset(path)
    # Minari's errors for a damaged folder have no common class.
    except Exception as error:
        raise ValueError(f"{path} is not a readable Minari dataset: {error}") from error
    return read_minari(dataset)


def _named(source: str, data: TensorDictBase, columns: DatasetColumns) -> TensorDictBase:
    """The data with the usual names; columns that are named take precedence."""
    for name in ("episode", "time"):
        if getattr(columns, name) is not None:
            raise ValueError(
                f"{source}: columns.{name} is only for .csv and .npz files; here trajectories are "
                "found by TorchRL's own keys: leave it out"
            )
    if -1 in data.shape:  # trajectories of different lengths
        axis = data.shape.index(-1) - 1
        return lazy_stack([_named(source, part, columns) for part in data.unbind(axis)], axis)
    data = data.copy()  # memory-mapped data are locked
    for name, given in (("observation", columns.observation), ("action", columns.action)):
        if len(given) > 1:
            raise ValueError(
                f"{source}: a tensordict has one {name}, not {', '.join(given)}: name one"
            )
        key = _key(given[0], set(data.keys())) if given else (name,)
        values, wanted = _inside(data, key), ".".join(key)
        if not isinstance(values, torch.Tensor):
            keys = (key if isinstance(key, tuple) else (key,) for key in data.keys(True, True))
            there = ", ".join(sorted(map(".".join, keys)))
            raise KeyError(
                f"{source} has no {wanted}, only {there}: name it with columns.{name}=[...]"
            )
        if key != (name,):
            data = data.set(name, values)
            following = _inside(data, ("next", *key))
            if name == "observation":
                if following is None:
                    raise KeyError(f"{source} has no next.{wanted}, which followed each step")
                data = data.set(("next", name), following)
        if name == "action" and given:
            data = data.exclude("executed")  # that of a run would take precedence
    return data
