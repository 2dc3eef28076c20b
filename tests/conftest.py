from __future__ import annotations

import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import pytest
from omegaconf import DictConfig

from torchrl_l1.experiment.launch import compose

TINY = [
    "outer_iterations=2",
    "episodes_per_iteration=2",
    "horizon=15",
    "trpo_iterations=2",
    "imagined_steps=100",
    "imagined_horizon=10",
    "model.members=2",
    "model.hidden=[8]",
    "policy.hidden=[8]",
    "fit.batch_size=16",
    "fit.max_epochs=2",
    "fit.validation_fraction=0.3",
    "trpo.fisher_fraction=1.0",
    "wandb.mode=disabled",
]

HAS_FORKS = sys.platform.startswith("linux")
FORKED = Path(__file__).with_name("forked.py")
# All that a run and an evaluation load.
PRELOADED = (
    "torchrl_l1.campaign.command",
    "torchrl_l1.campaign.evaluation",
    "torchrl_l1.experiment.launch",
    "torchrl_l1.algorithms",
)

if HAS_FORKS:
    # It starts with the first process that is asked of it, and ends with this one.
    multiprocessing.get_context("forkserver").set_forkserver_preload(list(PRELOADED))


class Process(Protocol):
    """What :class:`subprocess.Popen` and :class:`Forked` have in common."""

    @property
    def pid(self) -> int: ...

    def poll(self) -> int | None: ...

    def wait(self, timeout: float | None = None) -> int: ...

    def kill(self) -> None: ...


class Started:
    """A process of Python's own kind, started."""

    def __init__(self, process: multiprocessing.process.BaseProcess) -> None:
        self._process = process
        process.start()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired("torchrl-l1", timeout or 0.0)
        return self._process.exitcode

    def kill(self) -> None:
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)


class Forked(Started):
    """A process of the command line, forked from one that has loaded the package."""

    def __init__(self, arguments: Sequence[str], output: Path) -> None:
        request = ("torchrl_l1.cli", list(arguments), str(output))
        super().__init__(
            multiprocessing.get_context("forkserver").Process(
                target=runpy.run_path,
                args=(str(FORKED),),
                kwargs={"init_globals": {"REQUEST": request}, "run_name": "__main__"},
            )
        )


def started_anew(arguments: Sequence[str], output: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "torchrl_l1.cli", *arguments]
    with output.open("ab") as log:
        return subprocess.Popen(
            command, stdout=log, stderr=log, env={**os.environ, "OMP_NUM_THREADS": "1"}
        )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest first, so that no worker waits for them in the end: those of processes."""
    items.sort(key=lambda item: "start_cli" not in getattr(item, "fixturenames", ()))


@pytest.fixture
def start_cli(tmp_path: Path) -> Callable[..., Process]:
    """Starts ``torchrl-l1`` with arguments, in a process of its own.

    It writes to ``tmp_path / "output"`` unless told otherwise. The process is forked from one that
    has loaded the package, where the system does that well; ``anew=True`` starts an interpreter.
    """

    def start(arguments: Sequence[str], output: Path | None = None, anew: bool = False) -> Process:
        starter = Forked if HAS_FORKS and not anew else started_anew
        return starter(arguments, output or tmp_path / "output")

    return start


@pytest.fixture
def tiny_overrides() -> list[str]:
    """Overrides that make a run last about a second."""
    return list(TINY)


@pytest.fixture
def tiny_recipe(tmp_path: Path) -> Callable[..., DictConfig]:
    """A composed recipe of the pendulum that runs in about a second into ``tmp_path / 'run'``."""

    def make(*overrides: str, recipe: str = "metrpo/inverted_pendulum") -> DictConfig:
        return compose(recipe, [*TINY, f"run_dir={tmp_path / 'run'}", *overrides])

    return make
