"""Kills at random moments: whether every run goes on, to the bit, and its loggers hold all of it.

``python -m tests.kills [KILLS] [SEED] [FOLDER] [KIND ...]`` kills METRPO, PETS, MBMF, offline
learning and a campaign in turn, each once at a moment that is drawn, and starts it again. In every
second round W&B's own process is killed as well, as by a power cut. It prints a table, and ends
with status 1 if anything is lost. Processes are forked from one that has loaded the package, where
that can be done.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from tests.conftest import HAS_FORKS, PRELOADED, Forked, Process, started_anew
from tests.wandb_files import problems

METRPO = [
    *("outer_iterations=5", "episodes_per_iteration=2", "horizon=15", "trpo_iterations=2"),
    *("imagined_steps=100", "imagined_horizon=10", "policy.hidden=[8]", "fit.batch_size=16"),
    *("model.members=2", "model.hidden=[8]", "fit.max_epochs=200", "fit.patience=200"),
    *("fit.validation_fraction=0.3", "trpo.fisher_fraction=1.0"),
]
PETS = [
    *("outer_iterations=4", "horizon=10", "random_episodes=2", "random_steps=8", "particles=2"),
    *("cem.horizon=3", "cem.candidates=8", "cem.elites=2", "cem.iterations=1"),
    *("model.members=2", "model.hidden=[8]", "fit.max_epochs=20", "fit.validation_fraction=0.3"),
]
MBMF = [
    *("outer_iterations=6", "shooting_iterations=2", "cloning.iterations=2", "horizon=10"),
    *("shooting_episodes=2", "fine_tuning.episodes=2", "fine_tuning.minibatches=2"),
    *("evaluation_episodes=2", "shooting.candidates=16", "shooting.horizon=4", "model.hidden=[8]"),
    *("fit.max_epochs=20", "cloning.max_epochs=20", "fine_tuning.epochs=20"),
]
OFFLINE = [
    *("outer_iterations=6", "horizon=15", "trpo_iterations=20", "evaluation_episodes=2"),
    *("imagined_steps=100", "imagined_horizon=10", "model.members=2", "model.hidden=[8]"),
    *("policy.hidden=[8]", "fit.batch_size=16", "fit.max_epochs=50", "cloning.max_epochs=20"),
    "trpo.fisher_fraction=1.0",
]
CAMPAIGN = {
    "runs": [
        {
            "recipe": "pets/inverted_pendulum",
            "overrides": [*PETS, "wandb.mode=offline"],
            "matrix": {"l1": ["off", "paper"], "seed": [0]},
        }
    ],
    "evaluations": [{"name": "biased", "l1": ["off"], "bias": [0.0, 1.0], "episodes": 2}],
}
RUNS = {
    "metrpo": ("metrpo/inverted_pendulum", METRPO),
    "pets": ("pets/inverted_pendulum", PETS),
    "mbmf": ("mbmf/inverted_pendulum", MBMF),
    "offline": ("offline/inverted_pendulum", OFFLINE),
}
KINDS = (*RUNS, "campaign")
PATIENCE = 600.0


def command(kind: str, folder: Path) -> list[str]:
    """The arguments of ``torchrl-l1`` for one of the kinds; all that it writes is in a folder."""
    if kind == "campaign":
        file = folder.parent / "kills.yaml"
        file.write_text(yaml.safe_dump(CAMPAIGN))
        return ["campaign", str(file), "--output", str(folder), "--workers", "2"]
    recipe, settings = RUNS[kind]
    if kind == "offline":
        file = folder.parent / "dataset.npz"
        if not file.exists():
            write_dataset(file)
        settings = [*settings, f"dataset={file}"]
    return ["run", recipe, *settings, "wandb.mode=offline", f"run_dir={folder}", "--resume"]


def write_dataset(file: Path) -> None:
    """Four episodes of a pendulum that does what it likes."""
    rng = np.random.default_rng(0)
    observation = rng.normal(scale=0.1, size=(80, 4)).cumsum(0)
    truncated = np.arange(80) % 20 == 19
    np.savez(
        file,
        observation=observation,
        action=rng.uniform(-3, 3, (80, 1)),
        reward=-(observation[:, 0] ** 2),
        truncated=truncated,
    )


def start(kind: str, folder: Path) -> Process:
    """Start it; what it says is beside its folder."""
    starter = Forked if HAS_FORKS else started_anew
    return starter(command(kind, folder), folder.with_suffix(".log"))


def run_directories(folder: Path) -> list[Path]:
    """Those in or below a folder."""
    return sorted(file.parent for file in folder.rglob("metrics.csv"))


def results(folder: Path) -> dict[str, bytes]:
    """What must be the same to the bit: metrics and evaluations."""
    files = [*folder.rglob("metrics.csv"), *folder.rglob("evaluations/episodes/*.csv")]
    # Evaluations name the run directory.
    here = str(folder).encode()
    return {str(file.relative_to(folder)): file.read_bytes().replace(here, b"") for file in files}


def rows(folder: Path) -> int:
    """Outer iterations that are complete in all runs; -1 where none has begun."""
    tables = [file.read_bytes().count(b"\n") - 1 for file in folder.rglob("metrics.csv")]
    return sum(tables) if any(folder.rglob("config.yaml")) else -1


def wait_for(process: Process, folder: Path, count: int) -> None:
    """Until so many outer iterations are complete, or the process has ended."""
    while process.poll() is None and rows(folder) < count:
        time.sleep(0.01)


def ended_well(process: Process) -> bool:
    """Wait for a process."""
    try:
        return process.wait(PATIENCE) == 0
    except subprocess.TimeoutExpired:
        kill(process, everything=True)
        return False


def descendants(pid: int) -> list[int]:
    """The processes that one has started, and those that these have, where Linux tells."""
    found = []
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                found += [int(child), *descendants(int(child))]
    return found


def kill(process: Process, everything: bool) -> None:
    """SIGKILL to a process, and to all that it has started if asked."""
    others = descendants(process.pid) if everything else []
    with suppress(ProcessLookupError):  # it has ended meanwhile
        process.kill()
    for pid in others:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.wait()


def lost(folder: Path, expected: dict[str, bytes]) -> list[str]:
    """What is not as in the unbroken run."""
    found = [name for name, content in expected.items() if results(folder).get(name) != content]
    lines = [f"{name} differs" for name in found]
    for run_dir in run_directories(folder):
        # W&B's own process may write the last records after the run has ended.
        deadline = time.monotonic() + 20
        while (missing := problems(run_dir)) and time.monotonic() < deadline:
            time.sleep(0.2)
        lines += [f"W&B: {line}" for line in missing]
    return lines


@dataclass
class Kills:
    """The outcome.

    Attributes:
        tried: kills, by kind.
        early: those that came before any outer iteration was complete.
        late: those that came when all were, in evaluations or while loggers were closed.
        resumed: runs that ended well after the kill.
        same: those with the results of the unbroken run.
        logged: those of which W&B's files hold every step once.
        lines: what was lost.
    """

    tried: Counter[str] = field(default_factory=Counter)
    early: Counter[str] = field(default_factory=Counter)
    late: Counter[str] = field(default_factory=Counter)
    resumed: Counter[str] = field(default_factory=Counter)
    same: Counter[str] = field(default_factory=Counter)
    logged: Counter[str] = field(default_factory=Counter)
    lines: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        """A table in Markdown."""
        columns = (self.tried, self.early, self.late, self.resumed, self.same, self.logged)
        lines = [
            "| | kills | before the first row | after the last | went on | same to the bit "
            "| W&B complete |",
            "|---|---|---|---|---|---|---|",
        ]
        for kind in KINDS:
            if self.tried[kind]:
                lines.append(f"| {kind} | " + " | ".join(str(c[kind]) for c in columns) + " |")
        total = " | ".join(str(c.total()) for c in columns)
        return "\n".join([*lines, f"| all | {total} |", *self.lines])


def attack(kills: int, seed: int, root: Path, kinds: tuple[str, ...] = KINDS) -> Kills:
    """Kill runs of each kind in turn, and look at what they have become.

    Args:
        kills: how many.
        seed: of the moments.
        root: folder of all that is written.
        kinds: that are killed.
    """
    if HAS_FORKS:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([*PRELOADED, "tests.conftest", "tests.wandb_files"])
    outcome, rng = Kills(), random.Random(seed)
    expected, iteration = {}, {}
    for kind in kinds[:kills]:
        folder = root / f"{kind}_unbroken"
        process = start(kind, folder)
        wait_for(process, folder, 0)
        first = time.monotonic()
        if not ended_well(process):
            raise RuntimeError(f"{kind} does not run at all, see {folder.with_suffix('.log')}")
        iteration[kind] = (time.monotonic() - first) / rows(folder)
        expected[kind] = results(folder)
    for number in range(kills):
        kind = kinds[number % len(kinds)]
        folder, every = root / f"{kind}_{number}", rows(root / f"{kind}_unbroken")
        # Counted in rows, since seconds are others when the machine is busy.
        count, moment = rng.randint(0, every), rng.uniform(0, iteration[kind])
        process = start(kind, folder)
        wait_for(process, folder, count)
        with suppress(subprocess.TimeoutExpired):
            process.wait(moment)
        kill(process, everything=number // len(kinds) % 2 == 1)
        outcome.tried[kind] += 1
        outcome.early[kind] += rows(folder) < 1
        outcome.late[kind] += rows(folder) == every
        outcome.resumed[kind] += (well := ended_well(start(kind, folder)))
        lines = lost(folder, expected[kind]) if well else ["did not go on"]
        outcome.same[kind] += not any("differs" in line for line in lines) and well
        outcome.logged[kind] += not any("W&B" in line for line in lines) and well
        outcome.lines += [f"{folder}, {moment:.2f} s after row {count}: {line}" for line in lines]
        print(f"{number + 1} of {kills}: {folder.name}, {'; '.join(lines) or 'nothing lost'}")
        sys.stdout.flush()
    return outcome


def main(arguments: list[str]) -> int:
    """Entry point: kills, seed, folder and kinds, each of which may be left out."""
    kills, seed, folder, *kinds = [*arguments, *("20", "0", "")[len(arguments) :]]
    root = Path(folder or tempfile.mkdtemp())
    root.mkdir(parents=True, exist_ok=True)
    outcome = attack(int(kills), int(seed), root, tuple(kinds) or KINDS)
    print(outcome)
    return 1 if outcome.lines else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
