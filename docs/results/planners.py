"""PETS and MBMF on the pendulum with an actuator bias, under all controllers and the oracle.

    python docs/results/planners.py [FOLDER]

Reads the episodes that `torchrl-l1 evaluate` wrote into FOLDER/pets and FOLDER/mbmf, if a FOLDER is
given, and keeps their returns in `planners/episodes.csv` beside this file, in place of those of the
same algorithm. Writes from those `planners/table.md`.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np

from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.page import markdown

HERE = Path(__file__).with_name("planners")
ALGORITHMS = {"pets": "PETS, its planner", "mbmf": "MBMF, its tuned policy"}
CONTROLLERS = ("off", "paper", "robust", "oracle")
KEPT = ("l1", "bias", "episode", "return")
Row = dict[str, str]


def read(file: Path) -> list[Row]:
    """Rows of a table."""
    with file.open(newline="") as handle:
        return list(csv.DictReader(handle))


def gather(folder: Path) -> None:
    """Keep the returns of all algorithms in one file."""
    files = {name: folder / name / "episodes.csv" for name in ALGORITHMS}
    if not any(file.exists() for file in files.values()):
        sys.exit(f"no episodes in {' or '.join(map(str, files.values()))}")
    kept = HERE / "episodes.csv"
    before = read(kept) if kept.exists() else []
    rows: list[Row] = []
    for name, file in files.items():
        if file.exists():
            new = [{key: row[key] for key in KEPT} for row in read(file)]
            rows += [{"algorithm": name, **row} for row in new]
        else:
            rows += [row for row in before if row["algorithm"] == name]
    HERE.mkdir(exist_ok=True)
    write_table(kept, rows)


def main() -> None:
    """Read what is new, then write the table."""
    if len(sys.argv) > 1:
        gather(Path(sys.argv[1]))
    returns: dict[tuple[str, str, str], list[float]] = {}
    for row in read(HERE / "episodes.csv"):
        key = (row["algorithm"], row["bias"], row["l1"])
        returns.setdefault(key, []).append(float(row["return"]))
    lines = []
    for name, bias in dict.fromkeys(key[:2] for key in returns):
        line = {"what acts": ALGORITHMS[name], "bias": f"{float(bias):g}"}
        for l1 in CONTROLLERS:
            line[l1] = f"{np.mean(returns[name, bias, l1]):.3g}"
        line["episodes"] = str(len(returns[name, bias, "off"]))
        lines.append(line)
    (HERE / "table.md").write_text(markdown(lines) + "\n")
    print(f"Table: {HERE / 'table.md'}")


if __name__ == "__main__":
    main()
