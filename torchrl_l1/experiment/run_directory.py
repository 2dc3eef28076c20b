"""The directory of a run: what is written, how, and how a run is found again."""

from __future__ import annotations

import csv
import io
import json
import os
import platform
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
import yaml  # type: ignore[import-untyped]
from filelock import lock_descriptor, unlock_descriptor
from omegaconf import OmegaConf

import torchrl_l1
from torchrl_l1.experiment.settings import VOLATILE_KEYS, flatten, schema_defaults

PACKAGES = ("torch", "tensordict", "torchrl", "gymnasium", "mujoco", "numpy")


def versions() -> dict[str, str]:
    """Versions of Python, the platform and the packages that a result depends on.

    In a git checkout of this package the commit joins them, see :func:`commit`.
    """
    found = {
        "python": platform.python_version(),
        "platform": platform.platform(),
        # Not from the metadata of an installation: it may be that of another copy.
        "torchrl-l1": torchrl_l1.__version__,
    }
    package = Path(torchrl_l1.__file__).parent
    at = commit(package)
    if at is not None:
        found["torchrl-l1 commit"] = at
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def commit(package: Path) -> str | None:
    """The commit of the git checkout that a package's folder lies at the top of.

    Args:
        package: the folder.

    Returns:
        its hash, followed by ``with changes`` where files of the package differ from it;
        ``None`` where there is no checkout or no git.
    """
    if not (package.parent / ".git").exists():
        return None
    # Without locks: many runs may ask at once, and beside somebody's own git.
    git = ["git", "--no-optional-locks", "-C", str(package.parent)]
    try:
        head = _output([*git, "rev-parse", "HEAD"])
        changes = _output([*git, "status", "--porcelain", "--", package.name])
    except (OSError, subprocess.CalledProcessError):
        return None
    return f"{head} with changes" if changes else head


def _output(command: list[str]) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


# What a run killed in its first moments may leave behind; its directory is still free.
_BEFORE_CONFIG = (".lock", "versions.json", "versions.json.tmp", "config.yaml.tmp")

# A run that is asked for more iterations than it had continues; no other setting may change.
_MAY_GROW = "outer_iterations"


class RunDirectoryError(Exception):
    """The run directory cannot be used as asked; the message says why and what to do."""


class RunDirectoryInUse(RunDirectoryError):
    """Another process is running in the run directory."""


@contextmanager
def locked(file: Path, mode: str = "a") -> Iterator[bool]:
    """Lock a file for as long as the block lasts, or say that another process has.

    The lock is this process's, not its children's, and the system frees it when the process ends,
    however it does.

    Args:
        file: the file; what is in it does not matter.
        mode: how it is opened; by default it is made where there is none.

    Yields:
        whether the lock is ours.
    """
    with file.open(mode, encoding="utf-8") as handle:
        ours = lock_descriptor(handle.fileno(), blocking=False)
        try:
            yield ours
        finally:
            if ours:
                unlock_descriptor(handle.fileno())


class RunDirectory:
    """Files of one run.

    ``config.yaml`` (resolved), ``versions.json``, ``metrics.csv`` (one row per outer iteration,
    the source of truth), ``timing.csv`` (wall-clock seconds by phase), ``checkpoint.pt``,
    ``model.pt``, ``policy.pt``, and W&B's own files. All are replaced atomically, the checkpoint
    first and the metrics last, so that a row of the metrics says that its iteration is complete.
    Where a row is missing, all are made again from the checkpoint when the run resumes.

    Args:
        path: the directory.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config_file = self.path / "config.yaml"
        self.checkpoint_file = self.path / "checkpoint.pt"
        self.metrics_file = self.path / "metrics.csv"
        self.timing_file = self.path / "timing.csv"

    @contextmanager
    def open(self, config: dict[str, Any], resume: bool) -> Iterator[None]:
        """Prepare the directory for a run of ``config`` and hold it for as long as that lasts.

        Raises:
            RunDirectoryError: if it holds a run and ``resume`` is not set, if that run has
                another configuration, or (:class:`RunDirectoryInUse`) if another process is
                running in it. Nothing is changed in these cases.
        """
        if self.config_file.exists():
            if not resume:
                raise RunDirectoryError(
                    f"{self.path} already holds a run. Continue it with --resume, or choose "
                    "another directory with run_dir=..."
                )
            self.check_same(config)
        elif not self.free():
            raise RunDirectoryError(
                f"{self.path} is not empty and holds no run; choose another run_dir"
            )
        self.path.mkdir(parents=True, exist_ok=True)
        with locked(self.path / ".lock") as ours:
            if not ours:
                raise RunDirectoryInUse(f"another process is running in {self.path}")
            if not self.config_file.exists():
                write_atomically(self.path / "versions.json", json.dumps(versions(), indent=2))
            if self._stored().get(_MAY_GROW) != config.get(_MAY_GROW) or not resume:
                write_atomically(self.config_file, OmegaConf.to_yaml(OmegaConf.create(config)))
            yield

    def _stored(self) -> dict[str, Any]:
        if not self.config_file.exists():
            return {}
        stored = OmegaConf.to_container(OmegaConf.load(self.config_file))
        assert isinstance(stored, dict)
        return {str(key): value for key, value in stored.items()}

    def free(self) -> bool:
        """Whether a run may begin here: there is nothing but what one killed at once has left."""
        if not self.path.exists():
            return True
        return self.path.is_dir() and all(f.name in _BEFORE_CONFIG for f in self.path.iterdir())

    def held(self) -> bool:
        """Whether a process is running in this directory."""
        lock = self.path / ".lock"
        if not lock.exists():
            return False
        # Nothing is made or changed; a directory may be somebody else's, to be read only.
        with locked(lock, "r+" if os.access(lock, os.W_OK) else "r") as free:
            return not free

    def check_same(self, config: dict[str, Any]) -> None:
        """Compare ``config`` with that of the run that the directory holds.

        Raises:
            RunDirectoryError: if a setting differs that touches the result, see
                :func:`differences`.
        """
        different = differences(self._stored(), config, may_grow=True)
        if different:
            raise RunDirectoryError(
                f"{self.path} holds a run of another configuration:\n  "
                + "\n  ".join(different)
                + "\nGive the same settings, or another run_dir."
            )

    def iterations_done(self) -> int:
        """Outer iterations that are complete: the rows of the metrics."""
        if not self.checkpoint_file.exists():
            return 0
        try:
            text = self.metrics_file.read_text(encoding="utf-8")
        except FileNotFoundError:
            return 0
        return max(len(text.splitlines()) - 1, 0)

    def save_checkpoint(self, state: dict[str, Any]) -> None:
        """Replace the checkpoint; a kill at any moment leaves the old or the new one."""
        save_atomically(self.checkpoint_file, state)

    def load_checkpoint(self) -> dict[str, Any] | None:
        """The last checkpoint, or ``None`` if there is none yet."""
        if not self.checkpoint_file.exists():
            return None
        state: dict[str, Any] = torch.load(
            self.checkpoint_file, weights_only=True, map_location="cpu"
        )
        return state


def differences(
    before: Mapping[str, Any], now: Mapping[str, Any], may_grow: bool = False
) -> list[str]:
    """The settings that differ between two runs and touch the result, a text for each.

    Settings that the first run does not mention, since it is older than they are, have the
    schema's defaults.

    Args:
        before: configuration of the first run.
        now: configuration of the second.
        may_grow: whether the second may have more outer iterations.

    Examples:
        >>> before = {"seed": 0, "outer_iterations": 2, "run_dir": "here"}
        >>> now = {"seed": 1, "outer_iterations": 3, "run_dir": "there"}
        >>> differences(before, now)
        ['outer_iterations: 2 there, 3 now', 'seed: 0 there, 1 now']
        >>> differences(before, now, may_grow=True)
        ['seed: 0 there, 1 now']
    """
    defaults = schema_defaults(now)
    before, now = flatten(before), flatten(now)
    before = {k: v for k, v in defaults.items() if k in now} | before
    if may_grow and before.get(_MAY_GROW, 0) < now.get(_MAY_GROW, 0):
        before[_MAY_GROW] = now[_MAY_GROW]
    return [
        f"{key}: {before.get(key, '(absent)')} there, {now.get(key, '(absent)')} now"
        for key in sorted(before.keys() | now.keys())
        if before.get(key) != now.get(key) and key.split(".")[0] not in VOLATILE_KEYS
    ]


def write_table(file: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a whole CSV atomically; columns in order of first appearance."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(file, text.getvalue())


def write_atomically(file: Path, text: str) -> None:
    """Replace a text file in one step."""
    temporary = file.with_name(file.name + ".tmp")
    with temporary.open("w", encoding="utf-8") as handle:
        handle.write(text)
        handle.flush()
        os.fsync(handle.fileno())
    os.replace(temporary, file)


def save_atomically(file: Path, state: object) -> None:
    """Replace a ``torch.save`` file in one step."""
    temporary = file.with_name(file.name + ".tmp")
    with temporary.open("wb") as handle:
        torch.save(state, handle)
        handle.flush()
        os.fsync(handle.fileno())
    os.replace(temporary, file)


def run_directories(folder: Path) -> Iterator[tuple[Path, dict[str, Any] | RunDirectoryError]]:
    """Every run directory in or below a folder, with its configuration or why that is unreadable.

    Folders come in alphabetical order; hidden ones, and those that are links, are left out.
    """
    for path, below, files in os.walk(folder):
        below[:] = sorted(name for name in below if not name.startswith("."))
        if "config.yaml" not in files:
            continue
        config: dict[str, Any] | RunDirectoryError
        try:
            config = read_config(Path(path) / "config.yaml")
        except RunDirectoryError as error:
            config = error
        # Any tool may keep a config.yaml; a run's says which task and which seed.
        if isinstance(config, RunDirectoryError) or ("task" in config and "seed" in config):
            below.clear()
            yield Path(path), config


def read_config(file: Path) -> dict[str, Any]:
    """A configuration; empty if the file holds something else than keys and values.

    Raises:
        RunDirectoryError: if the file cannot be read.
    """
    try:
        config = OmegaConf.to_container(OmegaConf.load(file))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise RunDirectoryError(f"cannot read {file}: {error}") from error
    return {str(k): v for k, v in config.items()} if isinstance(config, dict) else {}
