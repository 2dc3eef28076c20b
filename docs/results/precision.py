"""Trainings with the products of the ensemble in bfloat16 against those in float32, seed by seed.

    python docs/results/precision.py [FOLDER]

Reads `metrics.csv` of the runs in FOLDER/RECIPE/PRECISION_SEED, such as `metrpo/bfloat16_0`, if a
FOLDER is given, and keeps returns and losses in `precision/runs.csv` beside this file, in place of
those of the same runs. Writes from those `precision/table.md` and `precision/runs.png`.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from scipy.stats import t as student

from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.page import markdown

HERE = Path(__file__).with_name("precision")
PRECISIONS = ("float32", "bfloat16")
KEPT = ("recipe", "precision", "seed", "real_steps", "return_mean", "model/validation_loss")
LAST = 5
Row = dict[str, str]
Runs = dict[tuple[str, str, str], list[Row]]


def gather(folder: Path) -> None:
    """Keep the curves of all runs in one file."""
    rows: list[Row] = []
    for file in sorted(folder.glob("*/*_*/metrics.csv")):
        precision, _, seed = file.parent.name.rpartition("_")
        if precision not in PRECISIONS:
            continue
        own = {"recipe": file.parts[-3], "precision": precision, "seed": seed}
        with file.open(newline="") as handle:
            rows += [{**{n: row.get(n, "") for n in KEPT}, **own} for row in csv.DictReader(handle)]
    new = {run_of(row) for row in rows}
    old = [row for row in read() if run_of(row) not in new] if (HERE / "runs.csv").exists() else []
    HERE.mkdir(exist_ok=True)
    write_table(HERE / "runs.csv", sorted(old + rows, key=run_of))


def run_of(row: Row) -> tuple[str, str, str]:
    """Recipe, seed and precision."""
    return row["recipe"], row["seed"], row["precision"]


def read() -> list[Row]:
    """The rows that are kept."""
    with (HERE / "runs.csv").open(newline="") as handle:
        return list(csv.DictReader(handle))


def values(rows: list[Row], column: str) -> np.ndarray:
    """A column as numbers."""
    return np.array([float(row[column] or "nan") for row in rows])


def table(runs: Runs) -> list[dict[str, str]]:
    """A line per pair, and one per recipe with the interval of the mean difference."""
    lines = []
    for recipe in dict.fromkeys(key[0] for key in runs):
        differences, ratios, final = [], [], {name: [] for name in PRECISIONS}
        seeds = [s for r, s, p in runs if (r, p) == (recipe, "bfloat16")]
        for seed in (s for s in seeds if (recipe, s, "float32") in runs):
            pair = [runs[recipe, seed, precision] for precision in PRECISIONS]
            ends = [values(rows, "return_mean")[-LAST:].mean() for rows in pair]
            losses = [np.nanmean(values(rows, "model/validation_loss")) for rows in pair]
            for name, end in zip(PRECISIONS, ends, strict=True):
                final[name].append(end)
            differences.append(ends[1] - ends[0])
            ratios.append(losses[1] - losses[0] if min(losses) <= 0 else losses[1] / losses[0] - 1)
            lines.append(_line(recipe, seed, ends, differences[-1], ratios[-1], min(losses) <= 0))
        if len(differences) > 1:
            count, mean = len(differences), np.mean(differences)
            half = student.ppf(0.975, count - 1) * np.std(differences, ddof=1) / count**0.5
            ends = [float(np.mean(final[name])) for name in PRECISIONS]
            line = _line(recipe, f"all {count}", ends, float(mean), float(np.mean(ratios)), False)
            line["difference"] += f" [{mean - half:.3g}, {mean + half:.3g}]"
            line["validation loss"] = ""
            lines.append(line)
    return lines


def _line(
    recipe: str, seed: str, ends: list[float], difference: float, loss: float, absolute: bool
) -> dict[str, str]:
    return {
        "recipe": recipe,
        "seed": seed,
        **{name: f"{end:.4g}" for name, end in zip(PRECISIONS, ends, strict=True)},
        "difference": f"{difference:+.3g}",
        "validation loss": f"{loss:+.3f} nats" if absolute else f"{loss:+.1%}",
    }


def _some(value: float, _: int) -> str:
    """Labels of ticks between powers of ten, of those that have room."""
    return f"{value:g}" if f"{value:e}"[0] in "235" else ""


def draw(runs: Runs) -> None:
    """Returns and validation losses over real steps, a column per recipe."""
    recipes = list(dict.fromkeys(key[0] for key in runs))
    figure = Figure((5 * len(recipes), 5.5), layout="constrained")
    axes = figure.subplots(2, len(recipes), squeeze=False, sharex="col")
    colours = dict(zip(PRECISIONS, ("tab:blue", "tab:orange"), strict=True))
    for (recipe, seed, precision), rows in runs.items():
        column = axes[:, recipes.index(recipe)]
        steps = values(rows, "real_steps") / 1000
        label = precision if seed == "0" else None
        column[0].plot(steps, values(rows, "return_mean"), color=colours[precision], label=label)
        column[1].plot(steps, values(rows, "model/validation_loss"), color=colours[precision])
        column[0].set_title(recipe)
        column[1].set_xlabel("real steps, thousands")
    for upper, lower in axes.T:
        if all(line.get_ydata().min() > 0 for line in lower.lines):
            lower.set_yscale("log")
            lower.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            lower.yaxis.set_minor_formatter(FuncFormatter(_some))
        upper.legend()
    axes[0, 0].set_ylabel("return")
    axes[1, 0].set_ylabel("validation loss")
    figure.savefig(HERE / "runs.png", dpi=110)


def main() -> None:
    """Read what is new, then write table and figure."""
    if len(sys.argv) > 1:
        gather(Path(sys.argv[1]))
    runs: Runs = {}
    for row in read():
        runs.setdefault(run_of(row), []).append(row)
    (HERE / "table.md").write_text(markdown(table(runs)) + "\n")
    draw(runs)
    print(f"Table: {HERE / 'table.md'}, figure: {HERE / 'runs.png'}")


if __name__ == "__main__":
    main()
