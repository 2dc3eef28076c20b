from __future__ import annotations

import gc
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

import pytest
from omegaconf import DictConfig

from tests.forked import asked_for

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
SEARCH_PATH = [part for part in sys.path if part]
# All that commands load, now or later, W&B too.
PRELOADED = (
    "torchrl_l1.campaign.command",
    "torchrl_l1.campaign.evaluation",
    "torchrl_l1.experiment.launch",
    "torchrl_l1.algorithms",
    "torchrl_l1.cli.evaluate",
    "torchrl_l1.cli.export",
    "torchrl_l1.cli.play",
    "torchrl_l1.cli.robustify",
    "torchrl_l1.report",
    "wandb.sdk.launch.inputs.internal",
)

# As in a terminal, also in the background or under nohup: the tests send these, and what is ignored
# stays so.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)

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
    """A process of the command line, forked from one that has loaded the package.

    Args:
        arguments: of the command line, or of another module.
        output: file for all that it writes.
        path: what Python searches; by default what it does here.
        worker: whether it is of a campaign in this process, which gives it a session of its own.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        output: Path,
        path: Sequence[str] | None = None,
        module: str = "torchrl_l1.cli",
        worker: bool = False,
    ) -> None:
        place = (os.getcwd(), list(sys.path if path is None else path), worker)
        request = (module, list(arguments), str(output), place)
        super().__init__(
            multiprocessing.get_context("forkserver").Process(
                target=runpy.run_path,
                args=(str(FORKED),),
                kwargs={"init_globals": {"REQUEST": request}, "run_name": "__main__"},
            )
        )


def forked_worker(command: Sequence[str], **options: Any) -> Forked:
    """As much of ``subprocess.Popen`` as a campaign in this process needs for its workers."""
    module, arguments, stdout, _ = asked_for(command, **options)
    path = [os.getcwd(), *SEARCH_PATH]
    return Forked(arguments, Path(stdout.name), path, module, worker=True)


def started_anew(arguments: Sequence[str], output: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "torchrl_l1.cli", *arguments]
    with output.open("ab") as log:
        return subprocess.Popen(
            command, stdout=log, stderr=log, env={**os.environ, "OMP_NUM_THREADS": "1"}
        )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest first, so that no worker waits for them in the end: those of processes.

    One worker gets them, and has the process that all are forked from.
    """
    forked = {"start_cli", "forked_workers", "forked_processes"}

    def has_none(item: pytest.Item) -> bool:
        fixtures = forked.intersection(getattr(item, "fixturenames", ()))
        return not fixtures and item.path.stem != "test_attack"

    items.sort(key=has_none)


def pytest_collectstart() -> None:
    gc.disable()  # until all is loaded


def pytest_collection_finish() -> None:
    """Let the garbage collector leave alone what has been loaded, since it stays to the end."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 10, 10)
    gc.enable()


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
def forked_processes() -> Iterator[None]:
    """Lets other libraries fork their processes from one that has loaded the package.

    A process that is spawned loads everything anew, which takes seconds of CPU; what it is sent is
    pickled in both cases.
    """
    before = multiprocessing.get_start_method(allow_none=True)
    if HAS_FORKS:
        multiprocessing.set_start_method("forkserver", force=True)
    yield
    multiprocessing.set_start_method(before, force=True)


@pytest.fixture
def forked_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forks the workers of campaigns in this process from one that has loaded the package."""
    from torchrl_l1.campaign import workers

    if HAS_FORKS:
        names = {name: getattr(subprocess, name) for name in ("DEVNULL", "STDOUT")}
        given = SimpleNamespace(
            Popen=forked_worker, TimeoutExpired=subprocess.TimeoutExpired, **names
        )
        monkeypatch.setattr(workers, "subprocess", given)


@pytest.fixture
def tiny_overrides() -> list[str]:
    """Overrides that make a run last about a second."""
    return list(TINY)


@pytest.fixture
def tiny_recipe(tmp_path: Path) -> Callable[..., DictConfig]:
    """A composed recipe of the pendulum that runs in about a second into ``tmp_path / 'run'``."""
    from torchrl_l1.experiment.launch import compose

    def make(*overrides: str, recipe: str = "metrpo/inverted_pendulum") -> DictConfig:
        return compose(recipe, [*TINY, f"run_dir={tmp_path / 'run'}", *overrides])

    return make
