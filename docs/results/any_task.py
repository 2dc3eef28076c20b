"""Environments of elsewhere, each by one line: what they return while they are learned.

    python docs/results/any_task.py [FOLDER]

Reads `metrics.csv` of the runs in FOLDER/NAME/seed_N, if a FOLDER is given, and keeps their returns
in `any_task/runs.csv` beside this file, in place of those of the same runs. Writes from those
`any_task/table.md` and `any_task/curves.png`. The commands are on the page on environments.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.page import markdown
from torchrl_l1.report.style import color, grid, save

HERE = Path(__file__).with_name("any_task")
KEPT = ("name", "seed", "real_steps", "return_mean")
Row = dict[str, str]


class Expected(NamedTuple):
    """What runs of a name are.

    Attributes:
        words: what was learned, with what.
        goal: a return that says that it was; ``None`` if there is none.
    """

    words: str
    goal: float | None


NAMES = {
    "pendulum": Expected("PETS on Pendulum-v1", -200.0),
    "reacher": Expected("PETS on Reacher-v5", -6.0),
    "half_cheetah": Expected("METRPO on HalfCheetah-v5", None),
    "swingup": Expected("PETS on dm_control's cartpole, swingup", 700.0),
}


def gather(folder: Path) -> None:
    """Keep the returns of all runs in one file."""
    rows: list[Row] = []
    for file in sorted(folder.glob("*/seed_*/metrics.csv")):
        own = {"name": file.parts[-3], "seed": file.parts[-2].removeprefix("seed_")}
        with file.open(newline="") as handle:
            rows += [own | {n: row[n] for n in KEPT[2:]} for row in csv.DictReader(handle)]
    kept, new = HERE / "runs.csv", {(row["name"], row["seed"]) for row in rows}
    old = [row for row in read() if (row["name"], row["seed"]) not in new] if kept.exists() else []
    HERE.mkdir(exist_ok=True)
    write_table(kept, sorted(old + rows, key=lambda row: (row["name"], row["seed"])))


def read() -> list[Row]:
    """The rows that are kept."""
    with (HERE / "runs.csv").open(newline="") as handle:
        return list(csv.DictReader(handle))


def line(name: str, seed: str, steps: Sequence[int], returns: Sequence[float]) -> Row:
    """One run in the table."""
    expected, reached = NAMES[name], ""
    if expected.goal is not None:
        at = next((s for s, r in zip(steps, returns, strict=True) if r >= expected.goal), None)
        reached = f"{expected.goal:g} " + ("not reached" if at is None else f"after {at} steps")
    return {
        "runs": expected.words,
        "seed": seed,
        "rounds": str(len(steps)),
        "real steps": str(steps[-1]),
        "goal": reached,
        "best": f"{max(returns):.4g}",
        "mean of the last five": f"{np.mean(returns[-5:]):.4g}",
    }


def main() -> None:
    """Read what is new, then write table and figure."""
    if len(sys.argv) > 1:
        gather(Path(sys.argv[1]))
    runs: dict[tuple[str, str], list[Row]] = {}
    for row in read():
        runs.setdefault((row["name"], row["seed"]), []).append(row)
    shown = [name for name in NAMES if name in {key[0] for key in runs}]
    figure, axes = grid(len(shown), 2, 4.8, 3.0)
    lines = []
    for axis, name in zip(axes, shown, strict=True):
        for index, (seed, rows) in enumerate(
            (k[1], rows) for k, rows in runs.items() if k[0] == name
        ):
            steps = [int(row["real_steps"]) for row in rows]
            returns = [float(row["return_mean"]) for row in rows]
            lines.append(line(name, seed, steps, returns))
            axis.plot(steps, returns, ".-", color=color(index), label=f"seed {seed}")
        if (goal := NAMES[name].goal) is not None:
            axis.axhline(goal, color="grey", linestyle=":", linewidth=1)
        axis.set(title=NAMES[name].words, xlabel="real steps", ylabel="return")
        axis.legend(frameon=False, fontsize=8, loc="lower right")
    (HERE / "table.md").write_text(markdown(lines) + "\n")
    save(figure, HERE / "curves.png")
    print(f"Table: {HERE / 'table.md'}\nFigure: {HERE / 'curves.png'}")


if __name__ == "__main__":
    main()
