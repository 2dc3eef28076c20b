"""What commands cost before they do anything: this version against a commit from before."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

from benchmarks.metrpo_iteration import PINNED, pinned
from benchmarks.tables import Table
from benchmarks.timing import Row, ratio, spread

THREADS = 1
_FACE = "from torchrl_l1.control import L1Transform"
COMMANDS = ("--help", "run --help", "recipes", "import torchrl_l1", _FACE)
PEER = "import torchrl"

_ROOT = Path(__file__).parents[1]
_COMMAND = "import sys; from torchrl_l1.cli import main; sys.exit(main(sys.argv[1:]))"


def _is_code(words: str) -> bool:
    return "import" in words.split()


def _seconds(words: str, package: Path) -> float:
    """Processor time of a process of its own that runs a command of a version of the package."""
    code = [words] if _is_code(words) else [_COMMAND, *words.split()]
    environment = {**os.environ, "PYTHONPATH": str(package)}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", *code],
        check=True,
        stdout=subprocess.DEVNULL,
        cwd=package,
        env=environment,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def run(repetitions: int) -> list[Row]:
    """Measure every command in both versions in turn, and the import of TorchRL.

    Args:
        repetitions: interleaved measurements of each.

    Returns:
        One row per command: ``seconds`` now, ``before`` at the pinned commit, and ``speedup``.
    """
    cases = [(words, _ROOT) for words in COMMANDS]
    cases += [(words, pinned()) for words in COMMANDS] + [(PEER, _ROOT)]
    for case in cases:  # files into the page cache
        _seconds(*case)
    measured: dict[tuple[str, Path], list[float]] = {case: [] for case in cases}
    for _ in range(repetitions):
        for case in cases:
            measured[case].append(_seconds(*case))
    rows: list[Row] = []
    for words in COMMANDS:
        now, before = measured[words, _ROOT], measured[words, pinned()]
        row: Row = {"command": words if _is_code(words) else f"torchrl-l1 {words}"}
        row |= spread("seconds", now) | spread("before", before) | ratio("speedup", before, now)
        rows.append(row)
    rows.append({"command": PEER, **spread("seconds", measured[PEER, _ROOT])})
    return rows


def table(repetitions: int) -> Table:
    """The table, measured."""
    return Table(
        "startup",
        "Start-up",
        "Processor time of a process that runs a command and ends, median (range), in this version "
        f"and at commit {PINNED}; that of importing TorchRL, which most of the package needs, for "
        "scale.",
        run(repetitions),
        {
            "command": "command",
            "seconds": "seconds",
            "before": f"seconds at {PINNED}",
            "speedup": "times as fast",
        },
        {"seconds": ".2f", "before": ".2f", "speedup": ".0f"},
    )
