"""What W&B's own files of a run hold, read without the package: whether nothing is lost.

``problems(run_dir)`` compares them with ``metrics.csv`` and ``timing.csv``; by hand:
``python -m tests.wandb_files RUN_DIR ...``.
"""

from __future__ import annotations

import csv
import json
import math
import sys
import zlib
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from wandb.proto import wandb_internal_pb2

BLOCK, HEAD = 32_768, 7
WHOLE, FIRST, MIDDLE, LAST = 1, 2, 3, 4


@dataclass
class WandbFile:
    """A ``.wandb`` file as ``wandb sync`` would read it.

    Attributes:
        path: where it is.
        runs: the records that describe the run.
        history: what was logged, with ``_step``, in its order.
        ended: whether the run ended in order.
        torn: what keeps ``wandb sync`` from reading it to its end; empty if nothing does.
    """

    path: Path
    runs: list[Any] = field(default_factory=list)
    history: list[dict[str, Any]] = field(default_factory=list)
    ended: bool = False
    torn: str = ""

    @property
    def start(self) -> float:
        """Seconds, by which ``wandb sync`` orders files."""
        time = self.runs[0].start_time
        return float(time.seconds + 1e-9 * time.nanos)


def records(content: bytes) -> tuple[list[bytes], str]:
    """The records of a LevelDB log after W&B's header, and what is wrong behind the last one."""
    if content[:4] != b":W&B" or len(content) < HEAD:
        return [], "no header"
    found: list[bytes] = []
    parts: list[bytes] = []
    position = HEAD
    while position < len(content):
        left = BLOCK - position % BLOCK
        if left < HEAD:
            if any(content[position : position + left]):
                return found, f"trailer at {position}"
            position += left
            continue
        head = content[position : position + HEAD]
        if len(head) < HEAD:
            return found, f"cut at {position}"
        length, kind = int.from_bytes(head[4:6], "little"), head[6]
        data = content[position + HEAD : position + HEAD + length]
        if len(data) < length or kind not in (WHOLE, FIRST, MIDDLE, LAST):
            return found, f"cut at {position}"
        if zlib.crc32(bytes([kind]) + data) != int.from_bytes(head[:4], "little"):
            return found, f"checksum at {position}"
        if (kind in (WHOLE, FIRST)) == bool(parts):
            return found, f"order at {position}"
        parts.append(data)
        if kind in (WHOLE, LAST):
            found.append(b"".join(parts))
            parts = []
        position += HEAD + length
    return found, "the last record is not whole" if parts else ""


def read_wandb_file(path: Path) -> WandbFile:
    """All that is in a file, up to what cannot be read."""
    raw, torn = records(path.read_bytes())
    found = WandbFile(path, torn=torn)
    for one in raw:
        record = wandb_internal_pb2.Record.FromString(one)
        kind = record.WhichOneof("record_type")
        if kind == "run":
            found.runs.append(record.run)
        elif kind == "exit":
            found.ended = True
        elif kind == "history":
            items = {
                "/".join(item.nested_key) or item.key: json.loads(item.value_json)
                for item in record.history.item
            }
            found.history.append({"_step": record.history.step.num, **items})
    return found


def wandb_files(run_dir: Path) -> list[WandbFile]:
    """Those of a run, in the order in which ``wandb sync`` takes them."""
    found = [read_wandb_file(path) for path in run_dir.glob("wandb/*run-*/*.wandb")]
    return sorted(found, key=lambda file: file.start if file.runs else math.inf)


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as handle:
        return list(csv.DictReader(handle))


def same(logged: Any, written: str) -> bool:
    """Whether a logged value is the one of a table, to the bit."""
    try:
        one, other = float(logged), float(written)
    except (TypeError, ValueError):
        return str(logged) == written
    return one == other or (math.isnan(one) and math.isnan(other))


def problems(run_dir: Path, most: int = 10) -> list[str]:
    """What is missing in W&B's files of a run that has ended, doubled, or not as in its tables.

    Args:
        run_dir: the run directory.
        most: problems that are told.

    Returns:
        a line for each; empty where the files together hold every step of ``metrics.csv`` once,
        in order, with its values and its times, and each file can be read to its end.
    """
    found: list[str] = []
    metrics, timing = table(run_dir / "metrics.csv"), table(run_dir / "timing.csv")
    files = wandb_files(run_dir)
    ids = {run.run_id for file in files for run in file.runs}
    named = (run_dir / "wandb_id.txt").read_text().strip() if files else ""
    if not files:
        found.append("there are no files of W&B")
    elif ids != {named}:
        found.append(f"ids {sorted(ids)}, but wandb_id.txt says {named}")
    for file in files:
        if file.torn:
            found.append(f"{file.path.name} in {file.path.parent.name}: {file.torn}")
        if not file.runs:
            found.append(f"{file.path.parent.name} says nothing of the run, and wandb sync fails")
    if files and not files[-1].ended:
        found.append(f"{files[-1].path.parent.name} has no end")
    rows = [row for file in files for row in file.history]
    steps = [row["_step"] for row in rows]
    if any(later <= earlier for earlier, later in pairwise(steps)):
        found.append(f"steps do not rise: {steps}")
    rows = [row for row in rows if "iteration" in row]
    iterations = [row["iteration"] for row in rows]
    if iterations != list(range(len(metrics))):
        found.append(f"iterations {iterations}, but metrics.csv has {len(metrics)}")
    for row in rows:
        number = int(row["iteration"])
        if number >= len(metrics):
            continue
        seconds = {f"seconds/{key}": value for key, value in timing[number].items()}
        del seconds["seconds/iteration"]
        for key, written in {**metrics[number], **seconds}.items():
            if written != "" and not same(row.get(key), written):
                found.append(f"iteration {number}: {key} is {row.get(key)}, in the table {written}")
    return found[:most]


if __name__ == "__main__":
    status = 0
    for name in sys.argv[1:]:
        for line in problems(Path(name)):
            print(f"{name}: {line}")
            status = 1
    sys.exit(status)
