"""Kills and signals at random moments: what is resumed ends as if nothing had happened."""

from __future__ import annotations

import csv
import io
import os
import random
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.attack.outcome import Attack, Command, Row, Said, command
from tests.conftest import TINY
from tests.kills import MBMF
from torchrl_l1.campaign.description import dump_yaml
from torchrl_l1.experiment.run_directory import RunDirectory, run_directories

# Each lasts a second or two, with some of its time in every phase.
METRPO_TINY = [*TINY, "outer_iterations=4", "fit.max_epochs=40", "fit.patience=40"]
PETS_TINY = [
    *("outer_iterations=4", "random_episodes=2", "episodes_per_iteration=2", "horizon=15"),
    *("particles=3", "cem.horizon=4", "cem.candidates=8", "cem.elites=2", "cem.iterations=2"),
    *("model.members=2", "model.hidden=[8]", "fit.batch_size=16", "fit.max_epochs=20"),
    "wandb.mode=disabled",
]
MBMF_TINY = [*MBMF, "wandb.mode=disabled"]
RUNS = {
    "METRPO": ("metrpo/inverted_pendulum", METRPO_TINY),
    "PETS": ("pets/inverted_pendulum", PETS_TINY),
    "MBMF": ("mbmf/inverted_pendulum", MBMF_TINY),
}


@dataclass
class Subject:
    """A command that is killed: a run, or a campaign.

    Attributes:
        name: for the table.
        arguments: without the place.
        place: the option that says where it writes.
    """

    name: str
    arguments: Sequence[str]
    place: str

    def at(self, folder: Path) -> list[str]:
        if self.place.endswith("="):
            return [*self.arguments, f"{self.place}{folder}"]
        return [*self.arguments, self.place, str(folder)]


def subjects(folder: Path, names: Sequence[str]) -> list[Subject]:
    """Those of some names; a campaign's file is written."""
    evaluation = {"name": "noisy", "l1": ["off"], "noise": ["action"], "episodes": 2}
    matrices = [
        {"recipe": recipe, "overrides": overrides, "matrix": {"seed": [0]}}
        for recipe, overrides in (RUNS["METRPO"], RUNS["PETS"])
    ]
    file = folder / "both.yaml"
    file.write_text(dump_yaml({"runs": matrices, "evaluations": [evaluation]}))
    found = []
    for name in names:
        if name in RUNS:
            recipe, overrides = RUNS[name]
            found.append(Subject(name, ["run", recipe, *overrides, "--resume"], "run_dir="))
        else:
            workers = "1" if "one" in name else "2"
            arguments = ["campaign", str(file), "--workers", workers]
            found.append(Subject(name, arguments, "--output"))
    return found


@dataclass
class Unbroken:
    """What a subject leaves when nobody disturbs it."""

    results: dict[str, bytes]
    seconds: float


def results(folder: Path) -> dict[str, bytes]:
    """All that a run has computed, of each run below a folder; times and places are left out."""
    found: dict[str, bytes] = {}
    for path, _ in run_directories(folder):
        for name in ("metrics.csv", "model.pt", "policy.pt"):
            if (path / name).exists():
                found[str((path / name).relative_to(folder))] = (path / name).read_bytes()
        for table in sorted(path.glob("evaluations/**/*.csv")):
            with table.open(newline="") as file:
                rows = [
                    {k: v for k, v in row.items() if k != "run"} for row in csv.DictReader(file)
                ]
            found[str(table.relative_to(folder))] = repr(rows).encode()
    return found


def timings(folder: Path) -> dict[str, list[str]]:
    """The seconds of every iteration, which differ each time that it is done."""
    return {
        str(path.relative_to(folder)): (path / "timing.csv").read_text().splitlines()
        for path, _ in run_directories(folder)
        if (path / "timing.csv").exists()
    }


def wait_for_the_end(folder: Path) -> None:
    """Until the processes of a campaign that was killed have ended, too: the system ends them."""
    deadline = time.monotonic() + 20
    while any(RunDirectory(path).held() for path, _ in run_directories(folder)):
        if time.monotonic() > deadline:
            raise TimeoutError(f"a run below {folder} lives on")
        time.sleep(0.01)


def torn(folder: Path, whole: Unbroken) -> str | None:
    """What is there after a kill and is no beginning of what there should be."""
    for path, _ in run_directories(folder):
        name = str((path / "metrics.csv").relative_to(folder))
        if (path / "metrics.csv").exists():
            found, complete = (
                list(csv.DictReader(io.StringIO(text.decode(), newline="")))
                for text in ((path / "metrics.csv").read_bytes(), whole.results[name])
            )
            # Columns of later stages are not there yet.
            begun = [{key: row[key] for key in found[0]} for row in complete if found]
            if found != begun[: len(found)]:
                return f"{name} is no part of the unbroken one"
    return None


def compared(folder: Path, whole: Unbroken, before: dict[str, list[str]]) -> tuple[str, str]:
    """What differs from the unbroken one, and what was done again, after the last resume."""
    now = results(folder)
    different = [name for name in whole.results | now if now.get(name) != whole.results.get(name)]
    after = timings(folder)
    again = [name for name, rows in before.items() if after.get(name, [])[: len(rows)] != rows]
    return (
        f"differ from the unbroken run: {', '.join(different)}" if different else "",
        f"iterations were lost: {', '.join(again)}" if again else "",
    )


def rows(attack: Attack) -> list[Row]:
    """Kills of runs and campaigns, and the signals that end a process in order."""
    every = ("METRPO", "PETS", "MBMF", "a campaign, one worker", "a campaign, two workers")
    chosen = every[:1] + every[-1:] if attack.quick else every
    chosen = tuple(name for name in chosen if attack.match in name)
    found = []
    signals = Row("signals: SIGTERM, SIGINT, SIGHUP, SIGUSR1, one or two")
    for subject in subjects(attack.folder, chosen):
        rng = attack.random(subject.name)
        place = attack.folder / subject.name.replace(",", "").replace(" ", "_")
        place.mkdir()
        start = time.monotonic()
        said = command(subject.at(place / "whole"), place / "whole.log")
        seconds = time.monotonic() - start
        row = Row(f"kill -9: {subject.name}")
        found.append(row)
        if problem := said.problem():
            row.add("unbroken", problem)
            continue
        whole = Unbroken(results(place / "whole"), seconds)
        for number in range(attack.some(8, 1)):
            kill(row, subject, place / f"kill_{number}", whole, rng)
        for number in range(attack.some(3, 1)):
            end_in_order(signals, subject, place / f"signal_{number}", whole, rng)
        report = command(["report", str(place)], place / "report.log")
        row.add("report of all", report.problem())
    return [*found, signals]


def kill(row: Row, subject: Subject, folder: Path, whole: Unbroken, rng: random.Random) -> None:
    """Kill once or twice, resume, compare."""
    log = folder.with_suffix(".log")
    before: dict[str, list[str]] = {}
    moments = [rng.uniform(0, whole.seconds) for _ in range(rng.choice((1, 1, 2)))]
    what = f"after {', '.join(f'{moment:.2f}' for moment in moments)} s"
    for moment in moments:
        process = Command(subject.at(folder), log)
        time.sleep(moment)
        process.kill()
        process.wait()
        wait_for_the_end(folder)
        if problem := torn(folder, whole):
            row.add(what, problem, problem)
            return
        before |= timings(folder)
    said = command(subject.at(folder), log)
    different, again = compared(folder, whole, before)
    row.add(what, said.problem() or different or None, different or again or None)


def end_in_order(
    row: Row, subject: Subject, folder: Path, whole: Unbroken, rng: random.Random
) -> None:
    """Send a signal, or two, once the process is at work; look at its words; resume; compare."""
    log = folder.with_suffix(".log")
    number = rng.choice((signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1))
    twice = rng.random() < 0.3
    what = f"{subject.name}, {number.name}{' twice' * twice}"
    process = Command(subject.at(folder), log)
    deadline = time.monotonic() + 60
    while not list(folder.rglob(".lock")) and process.poll() is None:
        if time.monotonic() > deadline:
            row.add(what, "it did not begin")
            return
        time.sleep(0.01)
    time.sleep(rng.uniform(0, whole.seconds))
    for _ in range(1 + twice):
        if process.poll() is None:
            os.kill(process.pid, number)
            time.sleep(0.05)
    ended = process.end()
    wait_for_the_end(folder)
    problem = _orderly(ended, subject, number, twice)
    before = timings(folder)
    torn_one = torn(folder, whole)
    said = command(subject.at(folder), log)
    different, again = compared(folder, whole, before)
    lost = torn_one or different or again or None
    row.add(what, problem or said.problem() or lost, lost)


def _orderly(said: Said, subject: Subject, number: signal.Signals, twice: bool) -> str | None:
    """What is wrong with the way in which it ended; it may have been done before the signal."""
    makes_room = number == signal.SIGUSR1 and subject.name in RUNS
    expected = {0, 75 if makes_room else 128 + number}
    if twice:
        expected.add(-number)
    if problem := said.problem(tuple(expected)):
        return problem
    lines = [line for line in said.text.splitlines() if "stopped by" in line or "room" in line]
    if said.status == 128 + number and len(lines) != 1:
        return f"{len(lines)} lines on the signal in place of one: {said.text[-300:]}"
    return None
