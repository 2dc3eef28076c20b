"""What an attack is made of: rows of the table, and commands in processes of their own."""

from __future__ import annotations

import multiprocessing
import os
import random
import re
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests import forked
from tests.conftest import HAS_FORKS, PRELOADED, Process, Started, started_anew

SECONDS = 300
"""After which a command counts as hanging."""


@dataclass
class Row:
    """A line of the table: how often something was tried, and what came of it.

    Attributes:
        kind: what was tried.
        tried: how often.
        failures: by what was tried, what went wrong: it was not survived.
        lost: by what was tried, what was lost.
        skipped: what this machine does not allow, with the reason.
    """

    kind: str
    tried: int = 0
    failures: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    def add(self, what: str, failure: str | None = None, lost: str | None = None) -> None:
        """Note what came of one attempt; ``None`` where all is well."""
        self.tried += 1
        if failure or lost:
            self.failures.append(f"{self.kind}: {what}: {failure or lost}")
        if lost:
            self.lost.append(what)


def table(rows: Sequence[Row]) -> str:
    """The rows as Markdown, and below them what went wrong and what was not tried."""
    lines = ["| kind | tried | survived | nothing lost |", "|---|---|---|---|"]
    for row in rows:
        survived, kept = row.tried - len(row.failures), row.tried - len(row.lost)
        lines.append(f"| {row.kind} | {row.tried} | {survived} | {kept} |")
    total = sum(row.tried for row in rows)
    bad, lost = (sum(len(part) for part in parts) for parts in (
        [row.failures for row in rows], [row.lost for row in rows],
    ))  # fmt: skip
    lines.append(f"| **all** | {total} | {total - bad} | {total - lost} |")
    failures = [failure for row in rows for failure in row.failures]
    skipped = [f"not tried: {row.kind}: {why}" for row in rows for why in row.skipped]
    return "\n".join([*lines, *([""] if failures or skipped else []), *failures, *skipped])


@dataclass
class Attack:
    """Where and how much.

    Attributes:
        folder: of the group, empty at first.
        quick: whether a few of each kind will do.
        seed: of what is random.
        match: part of the names of what is tried.
    """

    folder: Path
    quick: bool
    seed: int
    match: str = ""

    def random(self, name: str) -> random.Random:
        """A stream of random numbers of its own."""
        return random.Random(f"{self.seed} {name}")

    def some(self, full: int, quick: int) -> int:
        return quick if self.quick else full


class Command(Process):
    """``torchrl-l1`` in a process that was forked from one with the package loaded."""

    def __init__(
        self, arguments: Sequence[str], output: Path, prepare: Callable[[], object] | None = None
    ) -> None:
        self.arguments, self.output = list(arguments), output
        output.touch()
        # Whoever the process becomes.
        output.chmod(0o666)
        self._process: Process
        if HAS_FORKS:
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload([*PRELOADED, "tests.attack.outcome"])
            self._process = Started(
                context.Process(target=_run, args=(self.arguments, str(output), prepare))
            )
        else:
            assert prepare is None
            self._process = started_anew(arguments, output)

    def poll(self) -> int | None:
        return self._process.poll()

    def wait(self, timeout: float | None = None) -> int:
        return self._process.wait(timeout)

    def kill(self) -> None:
        self._process.kill()

    @property
    def pid(self) -> int:
        return self._process.pid

    def end(self) -> Said:
        """Wait for the end, and no longer than is reasonable."""
        try:
            status: int | None = self.wait(SECONDS)
        except subprocess.TimeoutExpired:
            self.kill()
            self.wait()
            status = None
        return Said(self.arguments, status, self.output.read_text(errors="replace"))


def _run(arguments: list[str], output: str, prepare: Callable[[], object] | None) -> None:
    if prepare is not None:
        prepare()
    forked.main("torchrl_l1.cli", arguments, output)


@dataclass
class Said:
    """How a command ended, and what it wrote."""

    arguments: list[str]
    status: int | None
    text: str

    def problem(self, statuses: Sequence[int] = (0,)) -> str | None:
        """What is wrong with it, whatever was asked: ``None`` if nothing is."""
        if self.status is None:
            return f"still running after {SECONDS} s"
        if "Traceback" in self.text or "Exception ignored" in self.text:
            last = [line for line in self.text.splitlines() if line.strip()]
            return f"a traceback: {last[-1][:200] if last else ''}"
        if self.status not in statuses:
            return f"status {self.status}: {self.text.strip()[-200:]}"
        return None

    def refusal(self, *words: str, statuses: Sequence[int] = (1,)) -> str | None:
        """What is wrong with it if it had to refuse in one line that has these words."""
        if problem := self.problem(statuses):
            return problem
        (command, *_) = self.arguments
        told = [part for part in self.text.splitlines() if part.startswith(f"torchrl-l1 {command}")]
        if len(told) != 1:
            return f"{len(told)} lines in place of one: {self.text.strip()[-200:]}"
        missing = [word for word in words if not re.search(word, told[0])]
        return f"{missing[0]!r} is not in: {told[0][:300]}" if missing else None


def command(
    arguments: Sequence[str], output: Path, prepare: Callable[[], object] | None = None
) -> Said:
    """Run ``torchrl-l1`` to its end."""
    output.unlink(missing_ok=True)
    return Command(arguments, output, prepare).end()


def contents(folder: Path, but: Sequence[str] = ()) -> dict[str, bytes]:
    """All files below a folder; links by where they lead."""
    found = {}
    for file in sorted(folder.rglob("*")):
        if file.name in but:
            continue
        if file.is_symlink():
            found[str(file.relative_to(folder))] = b"-> " + os.readlink(file).encode()
        elif file.is_file():
            found[str(file.relative_to(folder))] = file.read_bytes()
    return found


def changes(before: dict[str, bytes], after: dict[str, bytes]) -> str | None:
    """Files that were there and are not as they were."""
    changed = [name for name, content in before.items() if after.get(name) != content]
    return f"changed: {', '.join(changed[:5])}" if changed else None
