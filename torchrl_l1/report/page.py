"""The page of a report and its tables."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_l1.experiment.files import bounded, write_table
from torchrl_l1.report.style import named

Row = Mapping[str, Any]
"""A line of a table by column."""


class Page:
    """A Markdown page with its CSVs and figures in one folder.

    Args:
        folder: the folder for everything; must exist.

    Attributes:
        name: name of this part, see :meth:`part`; empty for the page itself.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.name = ""
        self._blocks: list[str] = ["# Report"]
        self._taken: set[str] = set()

    def part(self, name: str) -> Page:
        """The same page, continued under a name.

        Args:
            name: prefix of headings, captions and file names; none if empty.
        """
        part = Page(self.folder)
        part.name, part._blocks, part._taken = name, self._blocks, self._taken
        return part

    def file(self, *words: str) -> Path:
        """The file for another figure of this part; a long name is cut and ends in its digest.

        Words that differ only in signs, such as -0.5 and 0.5, get names with a number.
        """
        return self._free(slug((self.name, *words)), ".png")

    def _free(self, name: str, suffix: str) -> Path:
        """A unique name among the files of the page, even if case is ignored."""
        number, file = 1, f"{bounded(name)}{suffix}"
        while file.lower() in self._taken:
            number += 1
            file = f"{bounded(name)}_{number}{suffix}"
        self._taken.add(file.lower())
        return self.folder / file

    def heading(self, text: str, how_to_read: str) -> None:
        """Begin a section with an explanation of how to read it."""
        self.text(f"## {named(self.name, ' '.join(text.split()))}")
        self.text(how_to_read)

    def text(self, *blocks: str) -> None:
        """Add paragraphs or tables."""
        self._blocks += [block for block in blocks if block]

    def csv(self, name: str, rows: Sequence[Row]) -> None:
        """Write a table in full precision and mention it; names that are taken get a number.

        An evaluation may thus be called ``training``.
        """
        prefix = f"{slug((self.name,))}_" if self.name else ""
        file = self._free(prefix + name, ".csv")
        write_table(file, [{key: _cell(value) for key, value in row.items()} for row in rows])
        self.text(f"All columns: [{file.name}](./{file.name}).")

    def figure(self, file: Path | None, caption: str) -> None:
        """Show a figure, if there was something to draw."""
        if file is not None:
            self.text(f"![{plain(named(self.name, caption))}]({file.name})")

    def render(self) -> str:
        """The Markdown."""
        return _writable("\n\n".join(self._blocks) + "\n")


def plain(text: object) -> str:
    r"""Text from a file, unchanged, as one line of Markdown.

    Examples:
        >>> print(plain("a | b <script> ![x](http://y)"))
        a \| b &lt;script&gt; !\[x\](http://y)
    """
    line = " ".join(re.sub(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+", " ", str(text)).split())
    line = line.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    line = re.sub(r"[\\`*|]", r"\\\g<0>", line)
    # Brackets have a meaning only before another one or an address.
    return re.sub(r"\[(?=[^\]]*\][(\[])|\](?=[(\[])", r"\\\g<0>", line)


def code(text: object) -> str:
    """Text from a file as code.

    Examples:
        >>> code("l1.epsilon=0.1")
        '`l1.epsilon=0.1`'
    """
    line = " ".join(re.sub(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+", " ", str(text)).split())
    return f"`{line.replace('`', chr(39)).replace('|', chr(166))}`"


def _writable(text: str) -> str:
    """A text in which bytes of paths that are not UTF-8 are escaped."""
    return text.encode(errors="backslashreplace").decode()


def _cell(value: object) -> object:
    """A value for a CSV: text that a spreadsheet would read as a formula is quoted."""
    value = _writable(value) if isinstance(value, str) else value
    if isinstance(value, str) and re.match(r"[=+@\t\r]|-(?![\d.])", value):
        return f"'{value}"
    return value


def slug(words: Sequence[str]) -> str:
    """Words as part of a file name.

    Examples:
        >>> slug(["half_cheetah", "", "l1.epsilon=0.1"])
        'half_cheetah_l1_epsilon_0_1'
    """
    return re.sub(r"[^A-Za-z0-9]+", "_", "_".join(filter(None, words))).strip("_").lower()


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """A Markdown table with the keys of the rows as its header. Empty columns are dropped.

    Without rows it is empty.
    """
    if not rows:
        return ""
    columns = [key for key in rows[0] if any(row[key] not in ("", "–") for row in rows)]
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    lines += [f"| {' | '.join(plain(row[key]) for key in columns)} |" for row in rows]
    return "\n".join(lines)


def values_text(values: Mapping[str, str]) -> str:
    """The common value of several, or if they differ, the value of each.

    Examples:
        >>> values_text({"PETS": "15", "DETS": "15"})
        '15'
        >>> values_text({"METRPO": "19", "PETS": "15", "DETS": "15"})
        '19 (METRPO), 15 (PETS, DETS)'
    """
    names: dict[str, list[str]] = {}
    for name, value in values.items():
        names.setdefault(value, []).append(name)
    if len(names) < 2:
        return "".join(names)
    return ", ".join(f"{value} ({', '.join(found)})" for value, found in names.items())


class Footnotes:
    """Numbered notes below a table; equal ones share a number."""

    def __init__(self) -> None:
        self._notes: dict[str, int] = {}

    def mark(self, note: str) -> str:
        """The mark of a note, such as ``†1``; nothing for an empty one."""
        return f" †{self._notes.setdefault(note, len(self._notes) + 1)}" if note else ""

    def below(self, table: str) -> str:
        """A table with the notes below it, a line each."""
        notes = "\n".join(f"- †{index}: {note}." for note, index in self._notes.items())
        return f"{table}\n\n{notes}".rstrip()


def number(value: float | None) -> str:
    """Three significant digits, but at least all digits before the point.

    Examples:
        >>> number(2367.31), number(-51.26), number(-0.00312), number(None)
        ('2367', '-51.3', '-0.00312', '–')
    """
    if value is None or math.isnan(value):
        return "–"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def interval_text(row: Row, name: str) -> str:
    """The interval of a value, or a dash.

    Examples:
        >>> interval_text({"return_low": -1.0, "return_high": 2.5}, "return")
        '[-1, 2.5]'
        >>> interval_text({"gap_low": -math.inf, "gap_high": math.inf}, "gap")
        'unbounded'
        >>> interval_text({}, "return")
        '–'
    """
    low, high = row.get(f"{name}_low"), row.get(f"{name}_high")
    if low == -math.inf and high == math.inf:
        return "unbounded"
    return "–" if low is None else f"[{number(low)}, {number(high)}]"


def spread_text(mean: float | None, spread: float | None) -> str:
    """A mean with its spread, if it has one.

    Examples:
        >>> spread_text(2367.31, 12.0), spread_text(2367.31, None), spread_text(None, None)
        ('2367 ± 12', '2367', '–')
    """
    return number(mean) if spread is None else f"{number(mean)} ± {number(spread)}"


def return_text(row: Row | None) -> str:
    """The return of some seeds: mean, standard deviation and interval, if known."""
    if row is None:
        return "–"
    seeds = row["seeds"] if "seeds" in row else row["training_seeds"]
    spread = spread_text(row["return_mean"], row["std"] if seeds > 1 else None)
    return f"{spread} {interval_text(row, 'return')}".removesuffix(" –")


def difference_text(row: Row) -> str:
    """A mean difference with its interval, or the single differences if there are few."""
    if row.get("difference_low") is None:
        return _differences(row) or "–"
    return f"{number(row['difference_mean'])} {interval_text(row, 'difference')}"


def difference_columns(row: Row) -> dict[str, str]:
    """The same with the interquartile mean, as columns."""
    few = row.get("difference_low") is None
    return {
        "mean difference": "–" if few else number(row["difference_mean"]),
        "95 % interval": interval_text(row, "difference"),
        "interquartile mean": number(row.get("iqm")),
        "95 % interval of it": interval_text(row, "iqm"),
        "differences": _differences(row) if few else "",
    }


def _differences(row: Row) -> str:
    return ", ".join(number(float(value)) for value in str(row.get("differences", "")).split())


def paper_text(row: Row, notes: Footnotes) -> str:
    """The paper's printed value, with a mark if it has an erratum."""
    if row.get("paper_mean") is None:
        return "–"
    return f"{row['paper_mean']} ± {row['paper_std']}{notes.mark(row['paper_erratum'])}"


def grouped(
    rows: Sequence[Row], keys: Sequence[str], inner: str
) -> list[tuple[tuple[Any, ...], dict[str, Row]]]:
    """Groups of rows that agree in some keys, each keyed by the value of another key.

    Args:
        rows: the rows.
        keys: keys in which a group agrees; empty if a row lacks one.
        inner: key that distinguishes its rows.
    """
    groups: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row.get(key, "") for key in keys), {})[row[inner]] = row
    return list(groups.items())
