"""Reading the files of runs, cell by cell; every error names the file."""

from __future__ import annotations

import csv
import io
import json
import lzma
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_l1.algorithms.facts import AlgorithmFacts
from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.experiment.evaluate import episodes_file
from torchrl_l1.experiment.files import read_text
from torchrl_l1.experiment.matrix import TUNING, Condition, axes

SWITCH_RATE = "l1/switch_rate"
"""Column of the switches per step."""

L1_COLUMNS = {
    "switches_per_1000": (SWITCH_RATE, 1000),
    "u_a": ("l1/u_a", 1),
    "saturation": ("l1/saturation", 1),
}
"""Columns of a report's tables, with the signal that each shows and a factor."""

SIGNALS = tuple(signal for signal, _ in L1_COLUMNS.values())
"""Columns that only metrics tables of runs with L1 have."""

AGAIN = "Move the run directory away, or run it again"
"""What to do about a run whose files are damaged."""

_EVALUATE_AGAIN = "Delete it and start its campaign again"

# No table of a run comes near this; larger files would fill memory.
_MOST_BYTES = 200_000_000

_METRICS = ("iteration", "real_steps", "return_mean", "return_deterministic")


def read_metrics(file: Path, stages: int = 0, remedy: str = AGAIN) -> dict[str, np.ndarray]:
    """Columns of a metrics table; empty for a run that has only just begun.

    Those of :data:`SIGNALS` are NaN if the run lacks them.

    Args:
        file: the table.
        stages: number of the algorithm's stages; if there are any, there is a column ``stage``.
        remedy: the remedy in error messages.
    """
    numbers = (*_METRICS, "stage") if stages else _METRICS
    rows = checked_rows(file, numbers, optional=SIGNALS, remedy=remedy) if file.exists() else []
    columns = {name: np.array([row[name] for row in rows]) for name in (*numbers, *SIGNALS)}
    if not np.array_equal(columns["iteration"], np.arange(len(rows))):
        raise RunDirectoryError(f"{file}: the iterations are not 0, 1, 2, ... without gaps")
    if stages and not _in_turn(columns["stage"], stages):
        raise RunDirectoryError(f"{file}: the stages are not 1 to {stages} in turn")
    return columns


def _in_turn(stage: np.ndarray, stages: int) -> bool:
    found = list(dict.fromkeys(stage.tolist()))
    return found == list(range(1, stages + 1))[: len(found)] and bool((np.diff(stage) >= 0).all())


def read_seconds(file: Path, iterations: int, phases: Sequence[str]) -> dict[str, np.ndarray]:
    """Seconds of each phase in each iteration; NaN if unknown."""
    rows = checked_rows(file, ("iteration",), optional=phases) if file.exists() else []
    found = {int(row["iteration"]): row for row in rows}
    return {
        phase: np.array([found.get(i, {}).get(phase, np.nan) for i in range(iterations)])
        for phase in phases
    }


# Every table has columns for these; those of other disturbances may be absent.
_FIRST_DISTURBANCES = ("bias", "gain")


@dataclass(frozen=True, kw_only=True)
class Evaluation(Condition):
    """A condition with the returns of a run's frozen policy under it.

    Attributes:
        return_mean: mean return over the episodes; not finite if theirs are not.
        episodes: number of episodes.
        own_l1: whether the controller was that of the training; ``None`` in tables older than this
            column.
        switch_rate: switches per step; NaN if unknown or without L1.
        steps_mean: mean length of the episodes; NaN if unknown.
        returns: returns of the single episodes; empty if unknown.
        seed: seed of the evaluation; ``None`` if unknown.
    """

    return_mean: float
    episodes: int
    own_l1: bool | None = None
    switch_rate: float = math.nan
    steps_mean: float = math.nan
    returns: tuple[float, ...] = ()
    seed: int | None = None

    @property
    def condition(self) -> tuple[Any, ...]:
        """The tested condition, equal for repetitions. See :func:`condition_columns`."""
        columns = {**self.columns(), "l1": self.controller, "stage": self.stage or ""}
        return tuple(columns[name] for name in condition_columns())

    @property
    def tuned(self) -> bool:
        """Whether the test has set values of the controller."""
        return any(value is not None for value in self.tuning.values())


MEASURED: Mapping[str, str] = {"steps_mean": "steps_mean", "switch_rate": SWITCH_RATE}
"""Optional fields of an :class:`Evaluation`, with the columns that they come from."""


def condition_columns() -> tuple[str, ...]:
    """Names of the values of :attr:`Evaluation.condition`; the controller's own are in ``l1``.

    Examples:
        >>> [name for name in condition_columns() if name not in DISTURBANCES]
        ['l1', 'noise', 'policy', 'stage']
    """
    return tuple(axis.name for axis in axes() if axis.name not in TUNING)


def read_evaluations(file: Path) -> list[Evaluation]:
    """The rows of an evaluation, with the returns of single episodes if these are beside it.

    Disturbances without a column are neutral.

    Raises:
        RunDirectoryError: if a file cannot be read or contradicts itself.
    """
    optional = ("own_l1", *MEASURED.values())
    rows = _each_once(file, _condition_rows(file, ("episodes",), optional, ("return_mean",)))
    singly: dict[tuple[Any, ...], list[float]] = {}
    episodes = episodes_file(file)
    if episodes.exists():
        # The episodes of older tables may have no numbers.
        for row in _each_once(episodes, _condition_rows(episodes, (), ("episode",), ("return",))):
            singly.setdefault(_condition_key(row), []).append(row["return"])
    for row in rows:
        found = singly.get(_condition_key(row), [])
        if found and math.isfinite(row["return_mean"]) and not _is_mean(row, found):
            raise RunDirectoryError(
                f"{episodes} does not belong to {file}: its episodes of L1 {row['l1']} differ in "
                f"mean or number from the table. {_EVALUATE_AGAIN}"
            )
    return [
        Evaluation(
            **_condition_fields(row),
            return_mean=row["return_mean"],
            episodes=int(row["episodes"]),
            own_l1=None if math.isnan(row["own_l1"]) else bool(row["own_l1"]),
            **{field: row[column] for field, column in MEASURED.items()},
            returns=tuple(singly.get(_condition_key(row), ())),
        )
        for row in rows
    ]


def _condition_fields(row: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a condition."""
    words = {axis.name: row[axis.name] or None for axis in axes() if axis.kind is str}
    tuned = {name: _known(row[name]) for name in TUNING}
    return {
        **words,
        **tuned,
        "disturbances": {name: row[name] for name in DISTURBANCES if name in row},
    }


def _is_mean(row: Mapping[str, Any], returns: Sequence[float]) -> bool:
    """Whether a row of a table matches these episodes; means were taken in single precision."""
    size = max(map(abs, returns))
    same = abs(float(np.mean(returns)) - row["return_mean"]) <= 1e-4 * size + 1e-9
    return same and len(returns) == int(row["episodes"])


def _each_once(file: Path, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows without duplicates: a repetition is not another training seed."""
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for index, row in enumerate(rows):
        number = row.get("episode", 0.0)
        key = (*_condition_key(row), index if math.isnan(number) else (number,))
        if str(found.setdefault(key, row)) != str(row):  # NaN is equal to itself here
            raise RunDirectoryError(
                f"{file}, line {index + 2}: its values for L1 {row['l1']} under these conditions "
                f"contradict an earlier line. {_EVALUATE_AGAIN}"
            )
    return list(found.values())


def _condition_rows(
    file: Path, numbers: Sequence[str], optional: Sequence[str], results: Sequence[str]
) -> list[dict[str, Any]]:
    """Rows with the columns of conditions and others; missing disturbances are allowed."""
    later = tuple(name for name in DISTURBANCES if name not in _FIRST_DISTURBANCES)
    return checked_rows(
        file,
        (*_FIRST_DISTURBANCES, *numbers),
        ("l1", "noise", "policy"),
        (*TUNING, *optional),
        ("stage",),
        later,
        results,
        _EVALUATE_AGAIN,
    )


def _condition_key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    tuning = {name: _known(row[name]) for name in TUNING}
    return tuple({**row, **tuning}.get(axis.name) for axis in axes())


def one_policy(tests: Sequence[Evaluation]) -> list[Evaluation]:
    """The tests of policies with one way to act: each once, as ``stochastic``, however named."""
    first = sorted(tests, key=lambda test: test.policy != "stochastic")
    found = [replace(test, policy="stochastic") for test in first]
    chosen: dict[Any, Evaluation] = {}
    for test in found:
        chosen.setdefault((test.condition, test.own_l1), test)
    return list(chosen.values())


def distinct_policies(tests: Sequence[Evaluation], algorithm: AlgorithmFacts) -> list[Evaluation]:
    """The tests, each once in stages where the algorithm has only one way to act."""
    single = [test for test in tests if algorithm.acts_in_one_way(test.stage or "")]
    both = [test for test in tests if not algorithm.acts_in_one_way(test.stage or "")]
    return [*one_policy(single), *both]


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def checked_rows(
    file: Path,
    numbers: Sequence[str],
    words: Sequence[str] = (),
    optional: Sequence[str] = (),
    optional_words: Sequence[str] = (),
    if_any: Sequence[str] = (),
    results: Sequence[str] = (),
    remedy: str = AGAIN,
) -> list[dict[str, Any]]:
    """As :func:`numeric_rows`, for a file of a run directory.

    Raises:
        RunDirectoryError: instead of ``ValueError``, with the ``remedy``.
    """
    try:
        return numeric_rows(file, numbers, words, optional, optional_words, if_any, results)
    except ValueError as error:
        raise RunDirectoryError(f"{error}. {remedy}") from error


def read_versions(file: Path) -> dict[str, str]:
    """Versions by package; empty if there is no such file."""
    if not file.exists():
        return {}
    try:
        versions = json.loads(read_text(file, _MOST_BYTES))
        if not isinstance(versions, dict):
            raise ValueError("it holds no names and versions")
    except (OSError, ValueError, RecursionError) as error:
        raise RunDirectoryError(f"cannot read {file}: {error}") from error
    return {str(key): str(value) for key, value in versions.items()}


def numeric_rows(
    file: Path,
    numbers: Sequence[str],
    words: Sequence[str] = (),
    optional: Sequence[str] = (),
    optional_words: Sequence[str] = (),
    if_any: Sequence[str] = (),
    results: Sequence[str] = (),
) -> list[dict[str, Any]]:
    """Some columns of a CSV file.

    Args:
        file: the file, compressed if its name ends in ``.xz``.
        numbers: columns of finite numbers.
        words: columns of text that must not be empty.
        optional: columns of numbers that may be absent, empty or not finite, which gives NaN.
        optional_words: columns of text that may be absent or empty.
        if_any: columns of finite numbers that are left out if absent or empty.
        results: columns of numbers that may be infinite or NaN.

    Raises:
        ValueError: if the file cannot be read, a column is missing, a line has more values than
            there are columns, or a cell is invalid; the message names file and line.
    """
    try:
        reader = csv.reader(io.StringIO(_table_text(file), newline=""), strict=True)
        header = next(reader, [])
        columns = len(header)
        place = {name: index for index, name in enumerate(header)}
        every = (*words, *numbers, *results, *optional, *if_any)
        twice = [k for k in every if header.count(k) > 1]
        if twice:
            raise ValueError(f"{file} has the column {', '.join(twice)} twice")
        missing = [k for k in (*words, *numbers, *results) if k not in place]
        if missing:
            raise ValueError(f"{file} has no column {', '.join(missing)}")
        rows = [row for row in reader if row]
        most = max(map(len, rows), default=0)
        for line, row in enumerate(rows, start=2) if most > columns else ():
            # For example because of a decimal comma, which shifts the rest of the line.
            if any(row[columns:]):
                raise ValueError(f"{file}, line {line}: more values than the {columns} columns")
    except (OSError, EOFError, UnicodeDecodeError, lzma.LZMAError, csv.Error) as error:
        raise ValueError(f"cannot read {file}: {error}") from error

    def column(key: str) -> list[str | None]:
        at = place.get(key, most)
        return [row[at] if at < len(row) else None for row in rows]

    found: dict[str, list[Any]] = {}
    for key in words:
        found[key] = [_word(file, i, key, text) for i, text in enumerate(column(key), start=2)]
    for key in (*numbers, *(key for key in if_any if any(column(key)))):
        found[key] = [_number(file, i, key, text) for i, text in enumerate(column(key), start=2)]
    for key in results:
        found[key] = [_result(file, i, key, text) for i, text in enumerate(column(key), start=2)]
    for key in optional:
        found[key] = [_value(text) for text in column(key)]
    for key in optional_words:
        texts = enumerate(column(key), start=2)
        found[key] = [_word(file, i, key, text) if text else "" for i, text in texts]
    return [dict(zip(found, row, strict=True)) for row in zip(*found.values(), strict=True)]


def _word(file: Path, line: int, key: str, text: str | None) -> str:
    if not text:
        raise ValueError(f"{file}, line {line}: {key} is empty")
    if not _is_word(text):
        raise ValueError(f"{file}, line {line}: {key} is {text[:40]!r}, which is not a word")
    return text


@lru_cache(1000)
def _is_word(text: str) -> bool:
    return re.fullmatch(r"[^\x00-\x1f<>|`\\\[\]]{1,100}", text) is not None


def _number(file: Path, line: int, key: str, text: str | None) -> float:
    value = _value(text)
    if math.isnan(value):
        raise ValueError(f"{file}, line {line}: {key} is {text!r}, not a finite number")
    return value


def _result(file: Path, line: int, key: str, text: str | None) -> float:
    try:
        return float(text or "")
    except ValueError:
        raise ValueError(f"{file}, line {line}: {key} is {text!r}, not a number") from None


def _value(text: str | None) -> float:
    try:
        value = float(text or "nan")
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def _table_text(file: Path) -> str:
    """The text of a table."""
    if file.suffix != ".xz" or not file.is_file():
        return read_text(file, _MOST_BYTES)
    with lzma.open(file) as compressed:
        content = compressed.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise ValueError(f"{file} holds more than {_MOST_BYTES} bytes")
    return content.decode()
