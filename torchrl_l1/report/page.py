"""The report itself: sections of text, tables and figures."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_l1.experiment.run_directory import write_table
from torchrl_l1.report.campaigns import CampaignState
from torchrl_l1.report.runs import Run
from torchrl_l1.report.style import named

Row = Mapping[str, Any]


class Page:
    """A Markdown page with its CSVs and figures in one folder.

    Args:
        folder: where everything goes; must exist.

    Attributes:
        name: of the part that this is, see :meth:`part`; empty for the page itself.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.name = ""
        self._blocks: list[str] = ["# Report"]

    def part(self, name: str) -> Page:
        """The same page, to be continued under a name.

        Args:
            name: comes first in headings, captions and names of files; nothing does if empty.
        """
        part = Page(self.folder)
        part.name, part._blocks = name, self._blocks
        return part

    def file(self, *words: str, suffix: str = ".png") -> Path:
        """Where a file of this part goes."""
        return self.folder / f"{slug((self.name, *words))}{suffix}"

    def heading(self, text: str, how_to_read: str) -> None:
        """Begin a section with a sentence on how to read it."""
        self.text(f"## {named(self.name, text)}")
        self.text(how_to_read)

    def text(self, *blocks: str) -> None:
        """Add paragraphs or tables."""
        self._blocks += [block for block in blocks if block]

    def csv(self, name: str, rows: Sequence[Row]) -> None:
        """Write a table in full precision and name it."""
        prefix = f"{slug((self.name,))}_" if self.name else ""
        file = self.folder / f"{prefix}{name}.csv"
        write_table(file, rows)
        self.text(f"All columns: [{file.name}](./{file.name}).")

    def figure(self, file: Path | None, caption: str) -> None:
        """Show a figure; nothing if there was nothing to draw."""
        if file is not None:
            self.text(f"![{named(self.name, caption)}]({file.name})")

    def campaigns(self, campaigns: Sequence[CampaignState]) -> None:
        """How far each campaign is, and the command behind it."""
        for campaign in campaigns:
            left = campaign.expected - campaign.finished - campaign.begun
            state = f"{campaign.finished} of {campaign.expected} runs finished"
            state += f", {campaign.begun} unfinished" * (campaign.begun > 0)
            state += f", {left} not begun" * (left > 0)
            self.text(
                f"Campaign **{campaign.name}** ({state}). {campaign.description}".strip(),
                f"```console\n$ {campaign.command}\n```",
            )

    def versions(self, runs: Sequence[Run]) -> None:
        """What the runs ran with, a line per package and version."""
        seen: dict[tuple[str, str], int] = {}
        for run in runs:
            for package, version in run.versions.items():
                seen[package, version] = seen.get((package, version), 0) + 1
        rows = [
            {"package": package, "version": version, "runs": str(count)}
            for (package, version), count in sorted(seen.items())
        ]
        without = sum(not run.versions for run in runs)
        if rows:
            self.text(markdown(rows))
            self.csv("versions", rows)
        if without:
            self.text(f"{without} of {len(runs)} runs have no versions.json.")

    def render(self) -> str:
        """The Markdown."""
        return "\n\n".join(self._blocks) + "\n"


def slug(words: Sequence[str]) -> str:
    """Words as part of a file name.

    Examples:
        >>> slug(["half_cheetah", "", "l1.epsilon=0.1"])
        'half_cheetah_l1_epsilon_0_1'
    """
    return re.sub(r"[^A-Za-z0-9]+", "_", "_".join(filter(None, words))).strip("_").lower()


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
