"""Training with L1 off, the paper's and the robust controller in the loop, seed by seed.

    python docs/results/in_the_loop.py [FOLDER]

Reads `metrics.csv` of the runs in FOLDER/TASK/L1_SEED, such as `half_cheetah/robust_0`, if a FOLDER
is given, and keeps their returns in `in_the_loop/runs.csv` beside this file, in place of those of
the same runs. Writes from those `in_the_loop/table.md`.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np

from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.page import markdown
from torchrl_l1.report.statistics import final_return

HERE = Path(__file__).with_name("in_the_loop")
KEPT = ("task", "seed", "l1", "real_steps", "return_mean", "return_deterministic")
Row = dict[str, str]


def gather(folder: Path) -> None:
    """Keep the returns of all runs in one file."""
    rows: list[Row] = []
    for file in sorted(folder.glob("*/*_*/metrics.csv")):
        l1, _, seed = file.parent.name.rpartition("_")
        own = {"task": file.parts[-3], "seed": seed, "l1": l1}
        with file.open(newline="") as handle:
            rows += [{**{n: row.get(n, "") for n in KEPT}, **own} for row in csv.DictReader(handle)]
    kept, new = HERE / "runs.csv", {run_of(row) for row in rows}
    old = [row for row in read() if run_of(row) not in new] if kept.exists() else []
    HERE.mkdir(exist_ok=True)
    write_table(kept, sorted(old + rows, key=run_of))


def run_of(row: Row) -> tuple[str, str, str]:
    """Task, seed and controller."""
    return row["task"], row["seed"], row["l1"]


def read() -> list[Row]:
    """The rows that are kept."""
    with (HERE / "runs.csv").open(newline="") as handle:
        return list(csv.DictReader(handle))


def main() -> None:
    """Read what is new, then write the table."""
    if len(sys.argv) > 1:
        gather(Path(sys.argv[1]))
    runs: dict[tuple[str, str, str], list[Row]] = {}
    for row in read():
        runs.setdefault(run_of(row), []).append(row)
    lines = []
    for task, seed in dict.fromkeys(key[:2] for key in runs):
        line = {"task": task, "seed": seed}
        for l1 in ("off", "paper", "robust"):
            if rows := runs.get((task, seed, l1)):
                returns = np.array([float(row["return_mean"]) for row in rows])
                line[f"{l1}: last three"] = f"{final_return(returns):.4g}"
                line[f"{l1}: lowest after the first"] = f"{returns[1:].min():.4g}"
        lines.append({**line, "real steps": rows[-1]["real_steps"]})
    (HERE / "table.md").write_text(markdown(lines) + "\n")
    print(f"Table: {HERE / 'table.md'}")


if __name__ == "__main__":
    main()
