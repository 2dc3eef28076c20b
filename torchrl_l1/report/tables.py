"""Tables as Markdown and CSV."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence


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
