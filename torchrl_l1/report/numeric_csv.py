"""CSV files of numbers, checked cell by cell."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def numeric_rows(
    file: Path,
    numbers: Sequence[str],
    words: Sequence[str] = (),
    optional: Sequence[str] = (),
    optional_words: Sequence[str] = (),
) -> list[dict[str, Any]]:
    """Some columns of a CSV file.

    Args:
        file: the file.
        numbers: columns of finite numbers.
        words: columns of text that must not be empty.
        optional: columns of numbers that may be absent, empty or not finite: NaN then.
        optional_words: columns of text that may be absent or empty.

    Raises:
        ValueError: if the file cannot be read, a column is missing, or a cell holds something
            else; the message names file and line.
    """
    try:
        with file.open(newline="", encoding="utf-8") as handle:
            reader = csv.DictReader(handle, strict=True)
            missing = [k for k in (*words, *numbers) if k not in (reader.fieldnames or ())]
            if missing:
                raise ValueError(f"{file} has no column {', '.join(missing)}")
            rows = list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"cannot read {file}: {error}") from error
    return [
        {
            **{key: _word(file, line, key, row[key]) for key in words},
            **{key: _number(file, line, key, row[key]) for key in numbers},
            **{key: _value(row.get(key)) for key in optional},
            **{key: row.get(key) or "" for key in optional_words},
        }
        for line, row in enumerate(rows, start=2)
    ]


def _word(file: Path, line: int, key: str, text: str | None) -> str:
    if not text:
        raise ValueError(f"{file}, line {line}: {key} is empty")
    return text


def _number(file: Path, line: int, key: str, text: str | None) -> float:
    value = _value(text)
    if math.isnan(value):
        raise ValueError(f"{file}, line {line}: {key} is {text!r}, not a finite number")
    return value


def _value(text: str | None) -> float:
    try:
        value = float(text or "nan")
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan
