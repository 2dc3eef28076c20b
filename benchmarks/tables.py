"""Tables of measurements as Markdown and CSV."""

from __future__ import annotations

import csv
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.timing import Row
from torchrl_l1.report.page import markdown


@dataclass(frozen=True)
class Table:
    """Rows of a benchmark and how to show them.

    Attributes:
        name: stem of the files.
        title: heading.
        caption: what is measured, with its unit.
        rows: measurements; a column ``x`` may come with ``x_low`` and ``x_high``, and may be
            missing from some rows.
        columns: columns to show, with their headings; ``rows`` may hold more.
        formats: format specification by column, ``.2f`` unless given.
    """

    name: str
    title: str
    caption: str
    rows: Sequence[Row]
    columns: Mapping[str, str]
    formats: Mapping[str, str]

    def markdown(self) -> str:
        """The table with its heading, each cell as median and range."""
        cells = [
            {heading: self._cell(row, column) for column, heading in self.columns.items()}
            for row in self.rows
        ]
        return f"## {self.title}\n\n{self.caption}\n\n{markdown(cells)}\n"

    def _cell(self, row: Row, column: str) -> str:
        if column not in row:
            return ""
        value, form = row[column], self.formats.get(column, ".2f")
        if isinstance(value, str | int):
            return str(value)
        if f"{column}_low" not in row:
            return f"{value:{form}}"
        return f"{value:{form}} ({row[f'{column}_low']:{form}} to {row[f'{column}_high']:{form}})"

    def write(self, folder: Path) -> None:
        """Write ``name.md`` and ``name.csv``."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{self.name}.md").write_text(f"{self.markdown()}\n*{machine()}*\n")
        with (folder / f"{self.name}.csv").open("w", newline="") as file:
            names = dict.fromkeys(name for row in self.rows for name in row)
            writer = csv.DictWriter(file, list(names))
            writer.writeheader()
            writer.writerows(self.rows)


def machine() -> str:
    """Processor, threads and versions, in a line."""
    return (
        f"{_processor()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads in use; "
        f"Python {platform.python_version()}, torch {torch.__version__}"
    )


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    known: dict[str, str] = {}
    for line in cpuinfo.read_text().splitlines() if cpuinfo.exists() else ():
        key, _, value = line.partition(":")
        known.setdefault(key.strip(), value.strip())
    name = known.get("model name") or platform.processor() or platform.machine()
    # Virtual machines call many processors the same; what decides is how they multiply bfloat16.
    flags = known.get("flags", "").split()
    notes = [f"model {known['model']}"] if "model" in known else []
    notes += [flag for flag in ("avx512_bf16", "amx_bf16") if flag in flags]
    return f"{name} ({', '.join(notes)})" if notes else name
