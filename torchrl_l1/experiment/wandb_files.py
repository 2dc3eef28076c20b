"""W&B's own files of a run: reading them, and repairing those truncated by a kill.

``wandb sync`` reads the files of a run one after the other. It stops at the first that it cannot
read to the end, skips files that do not name their run, and renumbers a step that does not follow
the one before. So files left by a kill are cut to their last complete record, and a run that
continues logs exactly what the files together lack.

The format is that of LevelDB's log, with W&B's own header: blocks of 32 KiB, in which each part of
a record follows its checksum, length and kind; records are protocol buffers.
"""

from __future__ import annotations

import json
import math
import re
import secrets
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl_l1.experiment.files import read_text, refuse_link, write_atomically

ID_FILE = "wandb_id.txt"
"""File in a run directory with the run's id at W&B."""

_BLOCK, _HEAD = 32_768, 7
_WHOLE, _FIRST, _MIDDLE, _LAST = 1, 2, 3, 4
_FOLDER = re.compile(r"(?:offline-)?run-\d{8}_\d{6}-(\w+)(?:-\w+)?")


def known_id(run_dir: Path) -> str | None:
    """The id of a run at W&B, or ``None`` if it has none yet.

    A run older than the file keeps the id in the names of its W&B folders.
    """
    try:
        text = read_text(run_dir / ID_FILE, 1000).strip()
        if re.fullmatch(r"\w{1,64}", text):
            return text
    except (OSError, ValueError):
        pass
    for file in _files(run_dir, "*"):
        named = _FOLDER.fullmatch(file.parent.name)
        if named and file.stem == f"run-{named[1]}":
            return named[1]
    return None


def draw_id(run_dir: Path) -> str:
    """Give a run a unique id and store it in the run directory."""
    drawn = secrets.token_hex(6)
    write_atomically(run_dir / ID_FILE, drawn + "\n")
    return drawn


def whole_records(content: bytes) -> Iterator[tuple[bytes, int]]:
    """The records of a file and where each ends, up to the first damaged one."""
    if content[:4] != b":W&B":
        return
    position = _HEAD
    parts: list[bytes] = []
    while position < len(content):
        left = _BLOCK - position % _BLOCK
        if left < _HEAD:
            position += left
            continue
        head = content[position : position + _HEAD]
        length, kind = int.from_bytes(head[4:6], "little"), head[-1]
        data = content[position + _HEAD : position + _HEAD + length]
        begins = kind in (_WHOLE, _FIRST)
        if (
            len(head) < _HEAD
            or len(data) < length
            or not _WHOLE <= kind <= _LAST
            or begins == bool(parts)
            or zlib.crc32(bytes([kind]) + data) != int.from_bytes(head[:4], "little")
        ):
            return
        parts.append(data)
        position += _HEAD + length
        if kind in (_WHOLE, _LAST):
            yield b"".join(parts), position
            parts = []


@dataclass
class WandbFile:
    """One of the files that W&B has written for a run.

    Attributes:
        path: its path.
        start: time at which it was begun, in seconds; ``None`` if it does not name its run.
        ended: whether it was ended properly.
        end: number of bytes up to the end of the last complete record.
        history: the logged entries, each with its ``_step``.
    """

    path: Path
    start: float | None = None
    ended: bool = False
    end: int = 0
    history: list[dict[str, Any]] = field(default_factory=list)


def _read(path: Path) -> WandbFile:
    from wandb.proto import wandb_internal_pb2

    found = WandbFile(path)
    for raw, end in whole_records(path.read_bytes()):
        record = wandb_internal_pb2.Record.FromString(raw)  # type: ignore[attr-defined]
        kind = record.WhichOneof("record_type")
        if kind == "run" and found.start is None:
            time = record.run.start_time
            found.start = time.seconds + 1e-9 * time.nanos
        elif kind == "exit":
            found.ended = True
        elif kind == "history":
            items = {
                "/".join(item.nested_key) or item.key: json.loads(item.value_json)
                for item in record.history.item
            }
            found.history.append({"_step": record.history.step.num, **items})
        found.end = end
    return found


def has_ended(path: Path) -> bool:
    """Whether W&B has finished writing a file."""
    return _read(path).ended


def _files(run_dir: Path, run: str) -> list[Path]:
    patterns = (f"run-*/run-{run}.wandb", f"offline-run-*/run-{run}.wandb")
    return sorted(
        file
        for pattern in patterns
        for file in (run_dir / "wandb").glob(pattern)
        if not file.parent.is_symlink()
    )


@dataclass
class Held:
    """The joint contents of W&B's files of a run.

    Attributes:
        run: the id under which the run continues.
        rows: rows of the metrics by outer iteration.
        next_step: the first step after all of theirs.
    """

    run: str
    rows: dict[int, Mapping[str, Any]] = field(default_factory=dict)
    next_step: int = 0


def take_over(
    run_dir: Path, metrics: Sequence[Mapping[str, Any]], say: Callable[[str], object]
) -> Held:
    """Repair the files of a run and return their contents.

    A file without a proper end is cut to its last complete record and replaced, so that a W&B
    process that has outlived a kill no longer writes to it. One that does not name its run is
    removed. Files that contradict the metrics or have gaps are set aside, and the run gets another
    id.

    Args:
        run_dir: the run directory, held by this process.
        metrics: its rows so far.
        say: receives a line if files are set aside.
    """
    refuse_link(run_dir / "wandb")
    run = known_id(run_dir)
    if run is None:
        return Held(draw_id(run_dir))
    files = []
    for path in _files(run_dir, run):
        file = _read(path)
        if file.start is None:
            shutil.rmtree(path.parent, ignore_errors=True)
        else:
            files.append(file)
    files.sort(key=_order)
    held = Held(run)
    if not _collect(files, metrics, held):
        for file in files:
            folder = file.path.parent
            folder.rename(folder.with_name(f"set-aside-{folder.name}"))
        say(
            f"{run_dir / 'wandb'}: its files do not match the run's metrics.csv; they are set "
            "aside, and the run is logged to W&B again"
        )
        return Held(draw_id(run_dir))
    if not (run_dir / ID_FILE).exists():
        write_atomically(run_dir / ID_FILE, run + "\n")
    for file in files:
        content = file.path.read_bytes()
        if not file.ended or file.end < len(content):
            # An end written meanwhile is cut off: no history follows it.
            write_atomically(file.path, content[: file.end])
    return held


def _order(file: WandbFile) -> tuple[float, float]:
    """By their steps, which never decrease; clocks of two machines may differ."""
    first = file.history[0]["_step"] if file.history else math.inf
    return first, file.start or 0.0


def _collect(files: Sequence[WandbFile], metrics: Sequence[Mapping[str, Any]], held: Held) -> bool:
    """Join the contents of files in their order; false if they contradict the metrics."""
    for row in (row for file in files for row in file.history):
        held.next_step = max(held.next_step, int(row["_step"]) + 1)
        if "iteration" not in row:
            continue
        number = row["iteration"]
        if number == len(held.rows) - 1 and _same(row, held.rows[number]):
            continue  # older versions logged it again when a run continued
        if number != len(held.rows):
            return False
        if number < len(metrics) and not _same(metrics[number], row):
            return False
        held.rows[number] = row
    return True


def _same(row: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two rows have the same metrics; times differ if an iteration is repeated."""
    return all(
        key in other and _equal(value, other[key])
        for key, value in row.items()
        if not key.startswith(("_", "seconds/"))
    )


def _equal(value: Any, other: Any) -> bool:
    try:
        one, two = float(value), float(other)
    except (TypeError, ValueError):
        return bool(value == other)
    return one == two or (math.isnan(one) and math.isnan(two))
