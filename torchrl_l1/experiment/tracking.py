"""Logging of a run's metrics beside its tables: W&B and TensorBoard, complete after any kill.

Rows of ``metrics.csv`` that they lack are logged when a run continues, and nothing twice.
"""

from __future__ import annotations

import csv
import os
import secrets
import shlex
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import wandb

from torchrl_l1.checks import check_choice
from torchrl_l1.experiment.errors import RunDirectoryError, message
from torchrl_l1.experiment.files import locked, refuse_link
from torchrl_l1.experiment.run_directory import read_config
from torchrl_l1.experiment.settings import RunSettings, WandbSettings
from torchrl_l1.experiment.wandb_files import has_ended, known_id, take_over

MODES = ("auto", "online", "offline", "disabled")

# The modes that W&B accepts from the environment, including older names.
_WANDB_MODES = ("online", "offline", "disabled", "shared", "run", "dryrun")
_ONLINE = ("online", "shared", "run")

LOGGERS = ("wandb", "tensorboard")
"""Loggers that a recipe may name."""

Row = Mapping[str, Any]

_PATIENCE = 10.0

# Seconds for what has not been uploaded when a run ends; W&B's own default is to wait for ever.
_UPLOAD = 60.0


def check_wandb_mode(mode: str) -> None:
    """Make sure that W&B can be used in a mode.

    Raises:
        ValueError: for an unknown mode, or one that needs a missing API key or home folder.
    """
    if mode not in MODES:
        raise ValueError(f"wandb.mode must be one of {', '.join(MODES)}, got {mode!r}")
    here = os.environ.get("WANDB_MODE")
    if mode == "auto" and here and here not in _WANDB_MODES:
        raise ValueError(
            f"WANDB_MODE={here}: it must be one of {', '.join(_WANDB_MODES)}; or set wandb.mode"
        )
    setting, asked = ("WANDB_MODE", here) if mode == "auto" else ("wandb.mode", mode)
    if asked != "disabled":
        try:
            Path.home()  # as in containers with the number of a user that they do not know
        except RuntimeError as error:
            raise ValueError("W&B needs a home folder: set HOME, or wandb.mode=disabled") from error
    if asked in _ONLINE and not _has_key():
        raise ValueError(
            f"{setting}={asked} needs an API key; log in with wandb login or set WANDB_API_KEY, or "
            "choose wandb.mode=offline"
        )


def check_loggers(recipe: RunSettings) -> None:
    """Make sure that all loggers of a recipe can be used.

    Raises:
        ValueError: naming the setting and the remedy.
    """
    for name in recipe.loggers:
        check_choice("loggers", name, LOGGERS)
    if "wandb" in recipe.loggers:
        check_wandb_mode(recipe.wandb.mode)
        _check_words(recipe.wandb)
    if "tensorboard" in recipe.loggers and find_spec("tensorboard") is None:
        raise ValueError(
            "loggers: tensorboard is not installed; pip install 'torchrl-l1[tensorboard]'"
        )


def _check_words(settings: WandbSettings) -> None:
    """Refuse names that W&B would refuse only after the run has begun."""
    for key, field in (("project", "project"), ("tags", "run_tags")):
        given: dict[str, Any] = {field: getattr(settings, key)}
        try:
            wandb.Settings(**given)
        except (ValueError, wandb.errors.Error) as error:
            # Pydantic's message has several lines and a URL.
            why = error.errors()[0]["msg"] if hasattr(error, "errors") else error
            raise ValueError(f"wandb.{key}: {why}") from error


def chosen_mode(mode: str) -> str:
    """The mode that ``auto`` stands for: ``online`` with a working key, else ``offline``."""
    if mode != "auto":
        return mode
    # An explicit WANDB_MODE, as set on clusters, takes precedence.
    return os.environ.get("WANDB_MODE") or ("online" if _logged_in() else "offline")


def _has_key() -> bool:
    try:
        return bool(wandb.login(prompt=False, verify=False))
    except wandb.errors.Error as error:  # there is a key, but it is malformed
        raise ValueError(f"W&B: {message(error)}") from error


def _logged_in() -> bool:
    try:
        return bool(wandb.login(prompt=False))
    except wandb.errors.Error:
        # A key but no network to verify it: nothing is lost offline.
        return False


def own_run() -> wandb.Settings:
    """W&B's settings for a run that says nothing, ends in any case, and leaves other runs alone."""
    return wandb.Settings(
        silent=True,
        console="off",
        # Without it, a run that the calling program has open would be logged to and ended.
        reinit="create_new",
        finish_timeout=_UPLOAD,
        finish_timeout_raises=True,
        # Without the suffix, two within a second would share a folder.
        x_sync_dir_suffix=secrets.token_hex(3),
    )


@dataclass
class Evaluated:
    """The results of an evaluation.

    Attributes:
        name: name of the evaluation, such as ``evaluation``.
        rows: rows of its table.
        pictures: charts, filmstrips (``.png``) and films (``.gif``, ``.mp4``).
    """

    name: str
    rows: Sequence[Row]
    pictures: Sequence[Path] = ()

    @property
    def columns(self) -> list[str]:
        """Names of the table's columns."""
        return list(dict.fromkeys(key for row in self.rows for key in row))


class Tracker(ABC):
    """A logger of one run."""

    @abstractmethod
    def log(self, metrics: Row, timing: Row) -> None:
        """Log one outer iteration as one dictionary."""

    @abstractmethod
    def evaluation(self, evaluated: Evaluated) -> None:
        """Log the table and pictures of an evaluation."""

    @abstractmethod
    def close(self, status: int = 0) -> None:
        """Flush and close; ``status`` is the exit status of the process, 0 for success."""


def _values(metrics: Row, timing: Row) -> dict[str, Any]:
    seconds = {f"seconds/{phase}": value for phase, value in timing.items()}
    del seconds["seconds/iteration"]
    return {**metrics, **seconds}


class WandbTracker(Tracker):
    """Weights & Biases, continuing from the files that it has written so far.

    Each row is written at once, with a step after all others; ``iteration`` is the axis of the
    charts.

    Args:
        mode: as returned by :func:`chosen_mode`; not ``disabled``.
        recipe: the run's settings.
        run_dir: the run directory, which contains W&B's files.
        config: the full resolved configuration, with versions.
        metrics: rows so far.
        timings: their times.
        say: receives lines for the user.

    Raises:
        RunDirectoryError: if W&B refuses the run.
    """

    def __init__(
        self,
        mode: str,
        recipe: RunSettings,
        run_dir: Path,
        config: Row,
        metrics: Sequence[Row],
        timings: Sequence[Row],
        say: Callable[[str], object] = print,
    ) -> None:
        held, settings = take_over(run_dir, metrics, say), recipe.wandb
        self._say, self._failed = say, False
        self._held: Mapping[int, Row] = held.rows
        self._next_step = held.next_step
        try:
            self._run = wandb.init(
                mode=mode,  # type: ignore[arg-type]
                entity=settings.entity,
                project=settings.project,
                group=settings.group,
                name=settings.name or f"{recipe.recipe} seed={recipe.seed}",
                tags=list(settings.tags),
                notes=settings.notes,
                config=dict(config),
                dir=str(run_dir),
                id=held.run,
                resume="allow",
                settings=own_run(),
            )
        # The errors of a W&B process that has died have no common class.
        except Exception as error:
            raise RunDirectoryError(
                f"W&B: {message(error)}; use wandb.mode=offline to run without it"
            ) from error
        if mode == "online":
            self._follow_server(len(metrics))
        self._run.define_metric("iteration")
        self._run.define_metric("*", step_metric="iteration", step_sync=False)
        for row, timing in zip(metrics, timings, strict=True):
            self.log(row, timing)

    def _follow_server(self, rows: int) -> None:
        """For a run logged online, the server knows what has arrived."""
        self._held = {}
        if self._run.resumed:
            self._next_step = max(self._next_step, int(self._run.step))
            last = self._run.summary.get("iteration")
            known = int(last) + 1 if isinstance(last, int | float) else rows
            self._held = {number: {} for number in range(known)}

    def log(self, metrics: Row, timing: Row) -> None:
        """Log one outer iteration as one dictionary, unless W&B already has it."""
        number = int(metrics["iteration"])
        if number in self._held:
            return
        step = max(self._next_step, number)
        try:
            # Uncommitted data wait in memory for the next step and are lost in a kill.
            self._run.log(_values(metrics, timing), step=step, commit=True)
        except Exception as error:
            self._fail(error)
        self._next_step = step + 1

    def _fail(self, error: Exception) -> None:
        if not self._failed:
            self._say(f"W&B: {message(error)}; --resume logs what it lacks of the training")
        self._failed = True

    def evaluation(self, evaluated: Evaluated) -> None:
        """Log a table, charts and films under the evaluation's name."""
        columns: list[str | int] = list(evaluated.columns)
        cells = [[row.get(str(key)) for key in columns] for row in evaluated.rows]
        shown: dict[str, Any] = {evaluated.name: wandb.Table(columns, cells)} if cells else {}
        for picture in evaluated.pictures:
            film = picture.suffix in (".gif", ".mp4")
            media = wandb.Video(str(picture)) if film else wandb.Image(str(picture))
            shown[f"{evaluated.name}/{picture.stem}"] = media
        self._run.log(shown, step=self._next_step, commit=True)
        self._next_step += 1

    def close(self, status: int = 0) -> None:
        """Flush and close."""
        file = Path(self._run.settings.sync_file)
        try:
            if not self._failed:
                self._run.finish(exit_code=status)
        except TimeoutError:
            self._say(
                f"W&B: not everything has arrived within {_UPLOAD:g} s; send the rest with "
                f"wandb sync {shlex.quote(str(file.parent))}"
            )
            return
        except Exception as error:
            self._fail(error)
        if self._failed:
            with suppress(Exception):
                wandb.teardown()  # or the next run of this process would ask the same dead one
            return
        # W&B's own process may write the last records slightly later.
        deadline = time.monotonic() + _PATIENCE
        while file.is_file() and not has_ended(file) and time.monotonic() < deadline:
            time.sleep(0.05)


class TensorboardTracker(Tracker):
    """TensorBoard, through TorchRL's logger, in the folder ``tensorboard`` of the run directory.

    Args:
        run_dir: the run directory.
        metrics: rows so far.
        timings: their times.
    """

    def __init__(self, run_dir: Path, metrics: Sequence[Row], timings: Sequence[Row]) -> None:
        from torchrl.record.loggers.tensorboard import TensorboardLogger

        folder = run_dir / "tensorboard"
        refuse_link(folder)
        held = in_tensorboard(folder)
        self._logger = TensorboardLogger(folder.name, log_dir=str(run_dir))
        for row, timing in zip(metrics, timings, strict=True):
            if row["iteration"] not in held:
                self.log(row, timing)

    def log(self, metrics: Row, timing: Row) -> None:
        """Log one outer iteration; its number comes last and marks it as complete."""
        number = int(metrics["iteration"])
        values = _values(metrics, timing)
        for name in (*(values.keys() - {"iteration"}), "iteration"):
            self._logger.log_scalar(name, values[name], step=number)
        self._logger.experiment.flush()

    def evaluation(self, evaluated: Evaluated) -> None:
        """Log the table as text and charts as images; TensorBoard does not show films."""
        from matplotlib.image import imread

        writer, columns = self._logger.experiment, evaluated.columns
        lines = [columns, ["---"] * len(columns)]
        lines += [[str(row.get(key, "")) for key in columns] for row in evaluated.rows]
        writer.add_text(evaluated.name, "\n".join(f"|{'|'.join(line)}|" for line in lines))
        for picture in evaluated.pictures:
            if picture.suffix == ".png":
                pixels = imread(picture)[..., :3]
                writer.add_image(f"{evaluated.name}/{picture.stem}", pixels, dataformats="HWC")

    def close(self, status: int = 0) -> None:
        """Flush and close."""
        self._logger.experiment.close()


def in_tensorboard(folder: Path) -> set[int]:
    """Outer iterations that are complete in TensorBoard's files in a folder."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    if not folder.is_dir():
        return set()
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    whole = events.Scalars("iteration") if "iteration" in events.Tags()["scalars"] else []
    return {event.step for event in whole}


@contextmanager
def trackers(
    recipe: RunSettings,
    run_dir: Path,
    config: Row,
    metrics: Sequence[Row],
    timings: Sequence[Row],
    say: Callable[[str], object] = print,
) -> Iterator[list[Tracker]]:
    """The loggers of a run, brought up to date, and closed at the end.

    Args:
        recipe: its settings.
        run_dir: the run directory.
        config: the full resolved configuration, with versions.
        metrics: rows so far.
        timings: their times.
        say: receives lines for the user.
    """
    opened: list[Tracker] = []
    status = 1
    try:
        mode = chosen_mode(recipe.wandb.mode) if "wandb" in recipe.loggers else "disabled"
        if mode != "disabled":
            opened.append(WandbTracker(mode, recipe, run_dir, config, metrics, timings, say))
        if "tensorboard" in recipe.loggers:
            opened.append(TensorboardTracker(run_dir, metrics, timings))
        yield opened
        status = 0
    finally:
        with ExitStack() as closing:  # if one fails, none stays open
            for tracker in reversed(opened):
                closing.callback(tracker.close, status)


def _rows(file: Path) -> list[dict[str, Any]]:
    """A table of numbers with its values parsed."""
    with file.open(newline="", encoding="utf-8") as handle:
        table = list(csv.DictReader(handle))
    return [{key: _number(text) for key, text in row.items() if text} for row in table]


def _number(text: str) -> int | float:
    try:
        return int(text)
    except ValueError:
        return float(text)


def _used(recipe: RunSettings, run_dir: Path) -> list[str]:
    """The loggers that the training has logged to."""
    wandb_is_on = "wandb" in recipe.loggers and recipe.wandb.mode != "disabled"
    used = ["wandb"] if wandb_is_on and known_id(run_dir) else []
    if "tensorboard" in recipe.loggers and (run_dir / "tensorboard").is_dir():
        used.append("tensorboard")
    return used


def lacks(recipe: RunSettings, run_dir: Path, metrics: Sequence[Row]) -> bool:
    """Whether a logger that a run has used lacks rows, judging by the run directory."""
    used = _used(recipe, run_dir)
    if "wandb" in used:
        held = take_over(run_dir, metrics, lambda line: None)
        if len(held.rows) < len(metrics):
            return True
    return "tensorboard" in used and len(in_tensorboard(run_dir / "tensorboard")) < len(metrics)


def log_evaluation(
    recipe: RunSettings,
    run_dir: Path,
    evaluated: Evaluated,
    say: Callable[[str], object] = lambda line: print(line, file=sys.stderr),
) -> None:
    """Log an evaluation to the loggers that the training has used, in the same run.

    If it used none, nothing happens. Failures are reported in one line: the tables are written
    anyway.

    Args:
        recipe: the run's settings.
        run_dir: the run directory.
        evaluated: its table and pictures.
        say: receives a line if nothing is logged.
    """
    try:
        used = _used(recipe, run_dir)
        if not used:
            return
        now = replace(recipe, loggers=used)
        check_loggers(now)
        config = read_config(run_dir / "config.yaml")
        with locked(run_dir / ".lock") as ours:
            if not ours:
                say(f"{run_dir}: a process is running there, so {evaluated.name} is not logged")
                return
            # Missing rows of the training come first.
            metrics, timings = (_rows(run_dir / f"{name}.csv") for name in ("metrics", "timing"))
            timings = timings[: len(metrics)]  # written first: a kill may leave one more
            with trackers(now, run_dir, config, metrics, timings, say) as opened:
                for tracker in opened:
                    tracker.evaluation(evaluated)
    except Exception as error:
        say(f"{run_dir}: {evaluated.name} is not logged: {message(error)}")
