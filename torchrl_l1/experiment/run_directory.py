"""The directory of a run: its files, how they are written, and how runs are found again."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import yaml  # type: ignore[import-untyped]
from omegaconf import OmegaConf

from torchrl_l1.atomic import TEMPORARY
from torchrl_l1.experiment.checkpoints import read_checkpoint
from torchrl_l1.experiment.errors import RunDirectoryError, RunDirectoryInUse, message
from torchrl_l1.experiment.files import (
    digest,
    locked,
    problem,
    read_text,
    saved,
    settings_content,
    table_text,
    write_atomically,
)
from torchrl_l1.experiment.provenance import (
    MAY_GROW,
    code_versions,
    data_version,
    differences,
    versions,
)

# Files that a run killed in its first moments, a file manager and NFS may leave; the directory is
# still free.
_BEFORE_CONFIG = (
    *(".lock", "versions.json", "versions.json.tmp", "config.yaml.tmp", TEMPORARY),
    *(".DS_Store", ".nfs*"),
)

# Settings that may change when a run continues and that matter to its later use.
_RENEWED = (MAY_GROW, "search_path")

# Files whose checksums are kept; the tables' by their number of rows.
_TABLES, _WEIGHTS = ("metrics.csv", "timing.csv"), ("model.pt", "policy.pt")


class RunDirectory:
    """Files of one run.

    ``config.yaml`` (resolved), ``versions.json``, ``metrics.csv`` (one row per outer iteration,
    the source of truth), ``timing.csv`` (wall-clock seconds by phase), ``checkpoint.pt``, the one
    before it and kept ones, ``model.pt``, ``policy.pt``, ``checksums.json`` of these,
    ``diverged.txt`` if a row is marked, and W&B's own files.
    All are replaced atomically, the checkpoint first and the metrics last, so that a row of the
    metrics means that its iteration is complete. A file that does not match the checkpoint is
    rewritten when the run resumes.

    Args:
        path: the directory.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.config_file = self.path / "config.yaml"
        self.versions_file = self.path / "versions.json"
        self.checkpoint_file = self.path / "checkpoint.pt"
        self.previous_file = self.path / "checkpoint_previous.pt"
        self.metrics_file = self.path / "metrics.csv"
        self.timing_file = self.path / "timing.csv"
        self.checksums_file = self.path / "checksums.json"
        self.diverged_file = self.path / "diverged.txt"
        # Whether the last checkpoint may replace the one before it.
        self.last_is_good = True

    def check_open(self, config: dict[str, Any], resume: bool) -> None:
        """Refuse a directory in which a run of ``config`` cannot begin or continue.

        Raises:
            RunDirectoryError: if it holds a run and ``resume`` is not set, if that run has
                another configuration, or if it holds something else.
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

    @contextmanager
    def open(self, config: dict[str, Any], resume: bool) -> Iterator[None]:
        """Prepare the directory for a run of ``config`` and lock it for the duration of the block.

        Raises:
            RunDirectoryError: as :meth:`check_open`, or (:class:`RunDirectoryInUse`) if another
                process is running in it. Nothing is changed in these cases.
        """
        self.check_open(config, resume)
        self.path.mkdir(parents=True, exist_ok=True)
        with locked(self.path / ".lock") as ours:
            if not ours:
                raise RunDirectoryInUse(f"another process is running in {self.path}")
            for left in self.path.glob(TEMPORARY):  # by a kill
                left.unlink()
            if not self.config_file.exists():
                found = {**versions(), **code_versions(config), **data_version(config)}
                write_atomically(self.versions_file, json.dumps(found, indent=2))
            stored = self._stored()
            # Folders of the user's code may have moved; evaluations of the run look there too.
            if not resume or any((stored.get(k) or []) != (config.get(k) or []) for k in _RENEWED):
                write_atomically(self.config_file, OmegaConf.to_yaml(OmegaConf.create(config)))
            yield

    def _stored(self) -> dict[str, Any]:
        return read_config(self.config_file) if self.config_file.exists() else {}

    def free(self) -> bool:
        """Whether a run may begin here: there is nothing but remains of one killed at once."""
        if not self.path.exists():
            return True
        return self.path.is_dir() and all(
            any(map(file.match, _BEFORE_CONFIG)) for file in self.path.iterdir()
        )

    def held(self) -> bool:
        """Whether a process is running in this directory."""
        lock = self.path / ".lock"
        if not lock.exists():
            return False
        # Nothing is created or changed: the directory may be somebody else's and read-only.
        with locked(lock, "r+" if os.access(lock, os.W_OK) else "r") as free:
            return not free

    def check_same(self, config: dict[str, Any]) -> None:
        """Compare ``config`` with that of the run in the directory.

        Raises:
            RunDirectoryError: if a setting differs that affects the result, see
                :func:`differences`.
        """
        different = differences(self._stored(), config, may_grow=True)
        if different:
            raise RunDirectoryError(
                f"{self.path} holds a run of another configuration: {_shortened(different)}; give "
                "the same settings, or another run_dir"
            )

    def iterations_done(self) -> int:
        """Number of complete outer iterations: the rows of the metrics.

        Zero for a table that is not as it was written: it is rewritten when the run resumes.
        """
        if not self.checkpoint_file.exists():
            return 0
        try:
            text = read_text(self.metrics_file)
        except (OSError, ValueError):
            return 0
        rows = max(len(text.splitlines()) - 1, 0)
        return 0 if rows and self._table_problem(self.metrics_file, text) else rows

    def metrics_problem(self) -> str | None:
        """What is wrong with the metrics; ``None`` if nothing, or if it cannot be known."""
        try:
            return self._table_problem(self.metrics_file, read_text(self.metrics_file))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            return f"cannot read {self.metrics_file}: {error}"

    def intact(self) -> bool:
        """Whether tables and weights are as they were written, as far as that is known."""
        known = self._checksums()
        try:
            for file in (self.metrics_file, self.timing_file):
                if self._table_problem(file, read_text(file)):
                    return False
            for name in _WEIGHTS:
                if name in known and digest((self.path / name).read_bytes()) != known[name]:
                    return False
            size = known.get(self.checkpoint_file.name)
            return size is None or self.checkpoint_file.stat().st_size == size
        except (OSError, ValueError):
            return False

    def _checksums(self) -> dict[str, Any]:
        """Stored checksums; empty for a run older than they are."""
        try:
            known = json.loads(read_text(self.checksums_file))
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except (OSError, ValueError, RecursionError):
            known = None
        # Unreadable checksums match nothing.
        return known if isinstance(known, dict) else dict.fromkeys((*_TABLES, *_WEIGHTS), "?")

    def _table_problem(self, file: Path, text: str) -> str | None:
        known = self._checksums().get(file.name)
        if known is None:
            return None
        rows = str(max(len(text.splitlines()) - 1, 0))
        if isinstance(known, dict) and known.get(rows) == digest(text):
            return None
        return (
            f"{file} is not as it was written (see {self.checksums_file.name}); --resume rewrites "
            "it from the checkpoint"
        )

    def save_checkpoint(self, state: dict[str, Any]) -> None:
        """Replace the checkpoint, and keep the one before it.

        A kill at any moment leaves the old or the new one.
        """
        keep = self.previous_file if self.last_is_good else None
        write_atomically(self.checkpoint_file, saved(state), keep)
        self.last_is_good = True

    def load_checkpoint(
        self,
        config: Mapping[str, Any] | None = None,
        say: Callable[[str], object] = lambda line: print(line, file=sys.stderr),
    ) -> dict[str, Any] | None:
        """The last readable checkpoint, or ``None`` if there is none yet.

        Args:
            config: configuration of the run; that of the directory by default.
            say: receives a line if it is not the last one, or of another version of torch.

        Raises:
            RunDirectoryError: if none can be read although there are results, or if it is of
                another configuration.
        """
        problems = []
        state: dict[str, Any] | None = None
        for file in (self.checkpoint_file, self.previous_file):
            if not (file.exists() or file.is_symlink()):
                problems.append(f"{file} is missing")
                continue
            try:
                state = read_checkpoint(file)
            except RunDirectoryError as error:
                problems.append(str(error))
                continue
            self._check_checkpoint(file, state, self._stored() if config is None else config, say)
            break
        self.last_is_good = state is not None and not problems
        if state is not None and problems:
            done = len(state["metrics"])
            say(f"{problems[0]}; {self.previous_file.name} of {done} iterations is used instead")
        for name in self.changed_files(config or self._stored()) if state is not None else ():
            say(f"{name} has changed since the run in {self.path} began; it is used as it is")
        if state is None and self._has_results():
            raise RunDirectoryError(
                f"{'; '.join(problems)}; but there are results, which are left untouched: choose "
                "another run_dir to start over"
            )
        if state is None and self.checkpoint_file.exists():
            say(f"{problems[0]}; the run starts over")
        return state

    def changed_files(self, config: Mapping[str, Any], data: bool = False) -> list[str]:
        """The user's files named in ``config`` that have changed since the run began.

        Args:
            config: configuration of the run.
            data: whether to include the dataset; a run that continues already has its data.
        """
        try:
            began = json.loads(read_text(self.versions_file))
        except (OSError, ValueError, RecursionError):
            return []
        known = began if isinstance(began, dict) else {}
        found = {**code_versions(config), **(data_version(config) if data else {})}
        return [name for name, version in found.items() if known.get(name, version) != version]

    def load_kept(self, file: Path) -> dict[str, Any]:
        """Load a kept checkpoint of the run.

        Raises:
            RunDirectoryError: if it cannot be read, or is of another configuration.
        """
        state = read_checkpoint(file)
        self._check_checkpoint(file, state, self._stored(), lambda line: None)
        return state

    def _has_results(self) -> bool:
        names = (*_TABLES, *_WEIGHTS)
        return any((self.path / n).exists() and (self.path / n).stat().st_size for n in names)

    def _check_checkpoint(
        self,
        file: Path,
        state: Mapping[str, Any],
        config: Mapping[str, Any],
        say: Callable[[str], object],
    ) -> None:
        """Refuse a checkpoint of another configuration; older ones do not tell theirs."""
        settings = state.get("settings")
        if isinstance(settings, dict) and config:
            different = differences(settings, config, may_grow=True)
            if different:
                raise RunDirectoryError(
                    f"{file} is of another configuration: {_shortened(different)}; put the run's "
                    "own back, or choose another run_dir"
                )
        other = state.get("torch")
        if other is not None and other != str(torch.__version__):
            say(f"{file} was written with torch {other}, this is torch {torch.__version__}")

    def write_results(
        self,
        weights: Mapping[str, object],
        rows: Sequence[Mapping[str, Any]],
        timings: Sequence[Mapping[str, Any]],
    ) -> None:
        """Write all files derived from a checkpoint.

        The metrics come last: whoever finds the last row takes the run for finished and never
        returns to it.
        """
        for file, content in self._results(weights, rows, timings).items():
            write_atomically(file, content)

    def restore_results(
        self,
        weights: Mapping[str, object],
        rows: Sequence[Mapping[str, Any]],
        timings: Sequence[Mapping[str, Any]],
    ) -> list[str]:
        """Rewrite files that do not match the checkpoint; returns their names."""
        restored = []
        for file, content in self._results(weights, rows, timings).items():
            try:
                as_it_was = file.is_file() and file.read_bytes() == content
            except OSError:
                as_it_was = False
            if not as_it_was:
                write_atomically(file, content)
                restored.append(file.name)
        return restored

    def tell_divergence(self, rows: Sequence[Mapping[str, Any]], line: str = "") -> None:
        """Keep ``diverged.txt`` exactly as long as a row is marked.

        Args:
            rows: the rows so far.
            line: its text; if empty, the existing text, or else the iteration.
        """
        marked = [row for row in rows if "diverged" in row]
        if not marked:
            self.diverged_file.unlink(missing_ok=True)
        elif line or not self.diverged_file.exists():
            line = line or f"training diverged in iteration {marked[-1]['iteration']}"
            write_atomically(self.diverged_file, f"{line}\n")

    def mark_diverged(self, line: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """Record that the run has stopped after these rows, and mark the last one."""
        write_atomically(self.diverged_file, line + "\n")
        if not rows:
            return
        text = table_text([*rows[:-1], {**rows[-1], "diverged": 1}])
        checksums = self._checksums()
        known = checksums.get(self.metrics_file.name)
        known = known if isinstance(known, dict) else {}
        checksums[self.metrics_file.name] = {**known, str(len(rows)): digest(text)}
        write_atomically(self.checksums_file, json.dumps(checksums, indent=2))
        write_atomically(self.metrics_file, text)

    def _results(
        self,
        weights: Mapping[str, object],
        rows: Sequence[Mapping[str, Any]],
        timings: Sequence[Mapping[str, Any]],
    ) -> dict[Path, bytes]:
        """Contents of files in the order in which to write them."""
        files = {self.path / f"{name}.pt": saved(state) for name, state in weights.items()}
        checksums: dict[str, Any] = {file.name: digest(content) for file, content in files.items()}
        checksums[self.checkpoint_file.name] = self.checkpoint_file.stat().st_size
        tables = {self.timing_file: timings, self.metrics_file: rows}
        texts = {file: table_text(table) for file, table in tables.items()}
        for file, table in tables.items():
            # The previous table stays valid until this one is written.
            before = {str(len(table) - 1): digest(table_text(table[:-1]))} if table[1:] else {}
            checksums[file.name] = {**before, str(len(table)): digest(texts[file])}
        return {
            **files,
            self.timing_file: texts[self.timing_file].encode(),
            self.checksums_file: json.dumps(checksums, indent=2).encode(),
            self.metrics_file: texts[self.metrics_file].encode(),
        }


def _shortened(items: Sequence[str], most: int = 8) -> str:
    """A list as one line."""
    rest = f"; and {len(items) - most} more" if len(items) > most else ""
    return "; ".join(items[:most]) + rest


def run_directories(folder: Path) -> Iterator[tuple[Path, dict[str, Any] | RunDirectoryError]]:
    """Every run directory in or below a folder, with its configuration or the error on reading it.

    Folders come in alphabetical order; hidden ones and links are left out. A folder that cannot
    be listed counts as an unreadable run directory.
    """
    closed: list[OSError] = []
    for path, below, files in os.walk(folder, onerror=closed.append):
        below[:] = sorted(name for name in below if not name.startswith("."))
        if "config.yaml" not in files:
            continue
        config: dict[str, Any] | RunDirectoryError
        try:
            config = read_config(Path(path) / "config.yaml")
        except RunDirectoryError as error:
            config = error
        # Any tool may keep a config.yaml; that of a run has a task and a seed.
        if isinstance(config, RunDirectoryError) or ("task" in config and "seed" in config):
            below.clear()
            yield Path(path), config
    for refusal in closed:
        yield Path(refusal.filename), RunDirectoryError(f"cannot look into {message(refusal)}")


def read_config(file: Path) -> dict[str, Any]:
    """Read a configuration; empty if the file holds anything but keys and values.

    Raises:
        RunDirectoryError: if the file cannot be read.
    """
    try:
        config = settings_content(file)
    except (yaml.YAMLError, RecursionError) as error:
        raise RunDirectoryError(f"cannot read {file}: {problem(error)}") from error
    # OmegaConf's own errors are of many kinds.
    except Exception as error:
        raise RunDirectoryError(f"cannot read {file}: {message(error)}") from error
    return {str(k): v for k, v in config.items()} if isinstance(config, dict) else {}
