"""Runs of Table 1 that were trained a second time: what equal seeds and settings return twice.

    python docs/results/trained_twice.py

Reads `trained_twice.csv` beside this file, the returns of the first training, and
`table1/runs.csv`, where the second has replaced it; writes `trained_twice.md`.
"""

from __future__ import annotations

import csv
from pathlib import Path

from torchrl_l1.report.page import markdown

HERE = Path(__file__).parent
CELL = ("task", "noise", "l1", "seed")
RETURNS = {"return": "sampled actions", "return_deterministic": "mean action"}


def read(file: Path) -> dict[tuple[str, ...], dict[str, str]]:
    """Rows of a table by their run."""
    with file.open(newline="") as handle:
        rows = list(csv.DictReader(handle))
    return {tuple(row[key] for key in CELL): row for row in rows if not row.get("variant")}


def main() -> None:
    """Put both trainings side by side."""
    first, second = (read(HERE / name) for name in ("trained_twice.csv", "table1/runs.csv"))
    lines = []
    for run, row in first.items():
        line = dict(zip(CELL, run, strict=True))
        for column, words in RETURNS.items():
            values = (float(found[column]) for found in (row, second[run]))
            line[words] = " / ".join(f"{value:.4g}" for value in values)
        lines.append(line)
    file = HERE / "trained_twice.md"
    file.write_text(markdown(lines) + "\n")
    print(f"Table: {file}")


if __name__ == "__main__":
    main()
