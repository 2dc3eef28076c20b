"""An outer iteration of METRPO: this version against a commit from before it was made faster."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
from contextlib import ExitStack, closing
from io import BytesIO
from pathlib import Path
from typing import Any

import torch

from benchmarks.tables import Table
from benchmarks.timing import Row, ratio, spread
from torchrl_l1.planning import resolve_precision

THREADS = 1
PINNED = "db6b824"
"""The commit to compare with."""

SCALE = 0.25
"""Work of each phase, as a share of that in the recipe for HalfCheetah."""

_ROOT = Path(__file__).parents[1]
_WORKER = Path(__file__).with_name("metrpo_worker.py")


class PinnedUnavailableError(RuntimeError):
    """The pinned commit is not there."""


def pinned() -> Path:
    """A folder with package and recipes of the pinned commit, which is made if need be.

    Raises:
        PinnedUnavailableError: with the remedy.
    """
    folder = _ROOT / "build" / f"previous-{PINNED}"
    if folder.exists():
        return folder
    command = ["git", "-C", str(_ROOT), "archive", PINNED, "torchrl_l1", "recipes"]
    try:
        archive = subprocess.run(command, check=True, capture_output=True).stdout
    except (subprocess.CalledProcessError, OSError) as error:
        reason = getattr(error, "stderr", b"").decode().strip() or str(error)
        raise PinnedUnavailableError(
            f"no commit {PINNED}: {reason}. Fetch the whole history (`git fetch --unshallow`)"
        ) from error
    with tarfile.open(fileobj=BytesIO(archive)) as files:
        files.extractall(folder, filter="data")
    return folder


class Run:
    """METRPO in a process of its own, which takes an outer iteration when asked to.

    Args:
        source: folder of the package.
        precision: of fit and imagination; ``None`` for a version that knows none.
        iterations: that there may be.
    """

    def __init__(self, source: Path, precision: str | None, iterations: int) -> None:
        threads = torch.get_num_threads()
        self._process = subprocess.Popen(
            [sys.executable, "-W", "ignore", str(_WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": str(threads)},
        )
        self._send(threads=threads, precision=precision, scale=SCALE, iterations=iterations)

    def iterate(self) -> dict[str, float]:
        """Seconds by phase, on the wall, and those of the ``process`` in all."""
        assert self._process.stdout is not None
        self._send()
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError("METRPO failed in its process, see above")
        return json.loads(answer)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()

    def _send(self, **arguments: Any) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(arguments) + "\n")
        self._process.stdin.flush()


def run(repetitions: int) -> list[Row]:
    """Take outer iterations in turns.

    Args:
        repetitions: iterations measured of each version, after one that is not.

    Returns:
        One row per version and phase: ``seconds``, and of this version ``speedup``. The phase
        ``all`` is on the wall, ``processor`` the processor's time in all.
    """
    sources: dict[str, tuple[Path, str | None]] = {"float32": (_ROOT, "float32")}
    if resolve_precision("auto") == "bfloat16":
        sources["bfloat16"] = _ROOT, "bfloat16"
    try:
        sources = {PINNED: (pinned(), None), **sources}
    except PinnedUnavailableError as error:
        print(f"without the commit before: {error}", file=sys.stderr)
    measured: dict[str, list[dict[str, float]]] = {name: [] for name in sources}
    with ExitStack() as stack:
        runs = {
            name: stack.enter_context(closing(Run(*source, repetitions + 1)))
            for name, source in sources.items()
        }
        for repetition in range(repetitions + 1):
            for name, running in runs.items():
                seconds = running.iterate()
                processor = seconds.pop("process")
                everything = sum(seconds.values())
                if repetition:
                    measured[name].append({**seconds, "all": everything, "processor": processor})
    rows: list[Row] = []
    for name, iterations in measured.items():
        for phase in iterations[0]:
            values = [seconds[phase] for seconds in iterations]
            row: Row = {"version": name, "phase": phase, **spread("seconds", values)}
            if PINNED in measured and name != PINNED and min(values) > 0:
                row |= ratio("speedup", [old[phase] for old in measured[PINNED]], values)
            if max(values) > 1e-3:
                rows.append(row)
    return rows


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "metrpo_iteration",
        "An outer iteration of METRPO",
        f"Seconds of an outer iteration on HalfCheetah with {SCALE:.0%} of the recipe's real "
        "steps, gradient steps and TRPO steps, without L1, median (range): the commit "
        f"{PINNED} and this version with fits and imagination in float32, and in bfloat16 where "
        "`auto` takes that. The versions run in processes of their own and take turns. Phases and "
        "their sum are on the wall, `processor` is the time of all threads.",
        run(repetitions),
        {
            "version": "version",
            "phase": "phase",
            "seconds": "seconds",
            "speedup": f"times as fast as {PINNED}",
        },
        {},
    )
