"""Tables as Markdown and CSV."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]


def number(value: float | None) -> str:
    """Three significant digits, and no fewer than the units.

    Examples:
        >>> number(2367.31), number(-51.26), number(-0.00312), number(None)
        ('2367', '-51.3', '-0.00312', '–')
    """
    if value is None or math.isnan(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def interval_text(low: float | None, high: float | None) -> str:
    """An interval in brackets, or a dash.

    Examples:
        >>> interval_text(-1.0, 2.5), interval_text(None, None)
        ('[-1, 2.5]', '–')
    """
    return "–" if low is None else f"[{number(low)}, {number(high)}]"


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """A Markdown table; the keys of the rows are its header. Columns without content go.

    Without rows it is empty.
    """
    if not rows:
        return ""
    columns = [key for key in rows[0] if any(row[key] not in ("", "–") for row in rows)]
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    lines += [f"| {' | '.join(row[key] for key in columns)} |" for row in rows]
    return "\n".join(lines)


class Footnotes:
    """Numbered notes below a table; equal ones share their number."""

    def __init__(self) -> None:
        self._notes: dict[str, int] = {}

    def mark(self, note: str) -> str:
        """The mark of a note, such as ``†1``; nothing for an empty one."""
        return f" †{self._notes.setdefault(note, len(self._notes) + 1)}" if note else ""

    def text(self) -> str:
        """The notes, a line each."""
        return "\n".join(f"- †{index}: {note}." for note, index in self._notes.items())


def grouped(
    rows: Sequence[Row], keys: Sequence[str], inner: str
) -> list[tuple[tuple[Any, ...], dict[str, Row]]]:
    """Rows by their values of some keys, and each group by its values of another one."""
    groups: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row.get(key, "") for key in keys), {})[row[inner]] = row
    return list(groups.items())


def with_interval(row: Row | None) -> str:
    """A mean with its standard deviation and 95 % interval, as far as there are enough seeds."""
    if row is None:
        return "–"
    seeds = row["seeds"] if "seeds" in row else row["training_seeds"]
    spread = spread_text(row["return_mean"], row["std"] if seeds > 1 else None)
    return f"{spread} {interval_of(row, 'return')}".removesuffix(" –")


def less_off(row: Row) -> str:
    """The mean difference to the baseline with its interval; single ones where there are few."""
    values = str(row.get("differences", "")).split()
    if row.get("difference_low") is None:
        return ", ".join(number(float(value)) for value in values) or "–"
    return f"{number(row['difference_mean'])} {interval_of(row, 'difference')}"


def interval_of(row: Row, name: str) -> str:
    """The interval of a value of a row, or a dash."""
    return interval_text(row.get(f"{name}_low"), row.get(f"{name}_high"))


def spread_text(mean: float | None, spread: float | None) -> str:
    """A mean, with its spread if that is known."""
    return number(mean) if spread is None else f"{number(mean)} ± {number(spread)}"


def paper_text(row: Row, notes: Footnotes) -> str:
    """The published value, its erratum among the notes."""
    if row.get("paper_mean") is None:
        return "–"
    return f"{row['paper_mean']} ± {row['paper_std']}{notes.mark(row['paper_erratum'])}"


def with_notes(table: str, notes: Footnotes) -> str:
    """A table with its notes below."""
    return f"{table}\n\n{notes.text()}".rstrip()
