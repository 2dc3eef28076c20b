"""Offline learning from data of three qualities, deployed under actuator biases: table and figure.

    torchrl-l1 dataset RUN_DIR datasets/TASK/QUALITY.npz --quality QUALITY    # for each
    torchrl-l1 campaign offline --output runs/offline
    python docs/results/offline.py [runs/offline]

Writes `cells.csv` (returns of the episodes of each run, controller and bias), `summary.csv`,
`returns.md`, `recovered.md`, `imagination.md` and `returns.png` to the folder `offline` beside this
file; without a campaign's runs, all but the first again from it. Below three learning seeds there
are the values of each and no intervals or shares; from three on, intervals over seeds.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from torchrl_l1.envs import get_task
from torchrl_l1.experiment.files import write_table
from torchrl_l1.experiment.run_directory import read_config
from torchrl_l1.report.page import interval_text, markdown, number
from torchrl_l1.report.statistics import MIN_SAMPLES, mean_interval, recovered
from torchrl_l1.report.style import color, title

HERE = Path(__file__).parent / "offline"
TASKS = ("inverted_pendulum", "half_cheetah", "hopper")
QUALITIES = ("random", "medium", "expert")
CONTROLLERS = {l1: color(0, l1) for l1 in ("off", "paper", "robust", "oracle")}
Row = dict[str, Any]


# What is the same for all episodes of a row of `cells.csv`.
CELL = ("task", "quality", "seed", "l1", "bias", "data_reward", "clone")


def measured(folder: Path) -> list[Row]:
    """Rows of single episodes of all evaluated runs."""
    rows = []
    for file in sorted(folder.rglob("evaluations/episodes/disturbances.csv")):
        run = file.parents[2]
        config = read_config(run / "config.yaml")
        with (run / "metrics.csv").open() as handle:
            last = list(csv.DictReader(handle))[-1]
        with file.open() as handle:
            for row in csv.DictReader(handle):
                rows.append(
                    {
                        "task": config["task"],
                        "quality": Path(config["dataset"]).stem,
                        "seed": config["seed"],
                        "l1": row["l1"],
                        "bias": float(row["bias"]),
                        "episode": int(row["episode"]),
                        "return": round(float(row["return"]), 5),
                        "data_reward": round(float(last["data/reward"]), 6),
                        "clone": round(float(last.get("clone/return", "nan")), 5),
                    }
                )
    return rows


def keep(rows: Sequence[Row], file: Path) -> None:
    """One row for all episodes of a run, a controller and a bias, in place of that run's."""
    run_of = itemgetter("task", "quality", "seed")
    new = {run_of(row) for row in rows}
    old = [row for row in kept(file) if run_of(row) not in new] if file.exists() else []
    cells: dict[tuple[Any, ...], list[Row]] = {}
    for row in sorted([*old, *rows], key=run_of):
        cells.setdefault(tuple(row[name] for name in CELL), []).append(row)
    write_table(
        file,
        [
            {**dict(zip(CELL, key, strict=True)), "returns": " ".join(str(e["return"]) for e in of)}
            for key, of in cells.items()
        ],
    )


def kept(file: Path) -> list[Row]:
    """Rows of single episodes, as they were measured."""
    rows = []
    with file.open(newline="") as handle:
        for cell in csv.DictReader(handle):
            numbers = {name: float(cell[name]) for name in ("bias", "data_reward", "clone")}
            common = {"task": cell["task"], "quality": cell["quality"], "l1": cell["l1"], **numbers}
            rows += [
                {**common, "seed": int(cell["seed"]), "episode": episode, "return": float(value)}
                for episode, value in enumerate(cell["returns"].split())
            ]
    return rows


def select(rows: Sequence[Row], **where: Any) -> list[Row]:
    """Rows with these values."""
    return [row for row in rows if all(row[key] == value for key, value in where.items())]


def table(rows: Sequence[Row], l1: str, biases: Sequence[float]) -> np.ndarray:
    """Returns ``(seeds, biases, episodes)`` of a controller."""
    seeds = sorted({row["seed"] for row in rows})
    return np.array(
        [
            [
                [row["return"] for row in select(rows, l1=l1, bias=bias, seed=seed)]
                for bias in biases
            ]
            for seed in seeds
        ]
    )


def summarize(rows: Sequence[Row]) -> list[Row]:
    """A row for each task, quality, bias (all but 0 together too) and controller."""
    found = []
    for task in TASKS:
        for quality in QUALITIES:
            cell = select(rows, task=task, quality=quality)
            if not cell:
                continue
            every = sorted({row["bias"] for row in cell})
            groups: dict[str, list[float]] = {f"{bias:g}": [bias] for bias in every}
            groups["biased"] = [bias for bias in every if bias]
            for name, biases in groups.items():
                tables = {l1: table(cell, l1, biases) for l1 in CONTROLLERS}
                off, oracle = tables["off"], tables["oracle"]
                for l1, values in tables.items():
                    row = {"task": task, "quality": quality, "bias": name, "l1": l1}
                    row |= {"seeds": values.shape[0], "episodes_per_seed": values.shape[2]}
                    row |= over_seeds("return", values) | over_seeds("change", values - off)
                    row["share"] = ""
                    if len(values) >= MIN_SAMPLES and name == "biased":
                        of = ([one.ravel() for one in arm] for arm in (off, values, oracle))
                        share = recovered(*of)
                        if share.share is not None and share.gap > 0:
                            row["share"] = f"{share.share:.2f} {share.interval:.2f}"
                    found.append(row)
    return found


def over_seeds(name: str, values: np.ndarray) -> Row:
    """Mean, and its interval if there are three or more seeds; and the value of each seed."""
    single = values.mean((1, 2))
    interval = mean_interval(single.tolist())
    return {
        f"{name}_mean": float(single.mean()),
        f"{name}_low": interval.low if interval else "",
        f"{name}_high": interval.high if interval else "",
        f"{name}_by_seed": " ".join(f"{one:.5g}" for one in single),
    }


def cell_text(row: Row, name: str) -> str:
    """A mean with its interval, or of few seeds the values."""
    if row[f"{name}_low"] == "":
        return ", ".join(number(float(one)) for one in row[f"{name}_by_seed"].split())
    return f"{number(row[f'{name}_mean'])} {interval_text(row, name)}"


def returns_page(summary: Sequence[Row], rows: Sequence[Row], horizon: dict[str, int]) -> str:
    """Returns by controller, without bias and with."""
    lines = []
    for task in TASKS:
        for quality in QUALITIES:
            cell = select(summary, task=task, quality=quality)
            if not cell:
                continue
            data = select(rows, task=task, quality=quality)[0]["data_reward"] * horizon[task]
            for bias in ("0", "biased"):
                of_bias = {row["l1"]: row for row in select(cell, bias=bias)}
                line = {
                    "task": task,
                    "data": quality,
                    "return of the data": number(data),
                    "bias": "none" if bias == "0" else "all others",
                }
                lines.append(line | {l1: cell_text(of_bias[l1], "return") for l1 in CONTROLLERS})
    return markdown(lines)


def recovered_page(summary: Sequence[Row]) -> str:
    """What each controller changes, without bias and with, against none."""
    lines = []
    for row in summary:
        if row["l1"] == "off" or row["bias"] not in ("0", "biased"):
            continue
        if row["l1"] == "paper":
            bias = "none" if row["bias"] == "0" else "all others"
            lines.append({"task": row["task"], "data": row["quality"], "bias": bias})
        lines[-1][row["l1"]] = cell_text(row, "change")
        if row["l1"] != "oracle":
            lines[-1][f"{row['l1']} recovers"] = row["share"]
    return markdown(lines)


def imagination_page(rows: Sequence[Row], horizon: dict[str, int]) -> str:
    """What imagination makes of the cloned policies, without bias and L1, seed by seed."""
    lines = []
    for task in TASKS:
        for quality in QUALITIES:
            cell = select(rows, task=task, quality=quality, l1="off", bias=0.0)
            if not cell:
                continue
            seeds = sorted({row["seed"] for row in cell})
            of_seed = [select(cell, seed=seed) for seed in seeds]
            after = [float(np.mean([row["return"] for row in found])) for found in of_seed]
            lines.append(
                {
                    "task": task,
                    "data": quality,
                    "return of the data": number(cell[0]["data_reward"] * horizon[task]),
                    "cloned policies": ", ".join(number(found[0]["clone"]) for found in of_seed),
                    "after imagination": ", ".join(map(number, after)),
                }
            )
    return markdown(lines)


def draw(summary: Sequence[Row]) -> None:
    """Returns against the bias, a panel for each task and quality.

    Lines are means over seeds, with their intervals or, of few seeds, a dash for each.
    """
    tasks = [task for task in TASKS if select(summary, task=task)]
    figure, axes = plt.subplots(
        len(tasks), len(QUALITIES), figsize=(9.5, 2.7 * len(tasks)), squeeze=False
    )
    for line, task in zip(axes, tasks, strict=True):
        for axis, quality in zip(line, QUALITIES, strict=True):
            for l1, colour in CONTROLLERS.items():
                cell = [
                    row
                    for row in select(summary, task=task, quality=quality, l1=l1)
                    if row["bias"] != "biased"
                ]
                biases = [float(row["bias"]) for row in cell]
                low, mean, high = (
                    [row[f"return_{name}"] for row in cell] for name in ("low", "mean", "high")
                )
                style = "--" if l1 == "oracle" else "-"
                axis.plot(biases, mean, style, marker="o", ms=3, color=colour, label=l1)
                if "" not in low:
                    axis.fill_between(biases, low, high, color=colour, alpha=0.12, linewidth=0)
                    continue
                for bias, row in zip(biases, cell, strict=True):
                    single = list(map(float, row["return_by_seed"].split()))
                    axis.plot([bias] * len(single), single, "_", color=colour, alpha=0.6)
            tested = select(summary, task=task, quality=quality)
            seeds = f", n = {tested[0]['seeds']}" if tested else ""
            axis.set_title(f"{title(task)}, {quality} data{seeds}", fontsize=9)
            if not tested:
                axis.text(0.5, 0.5, "not run", ha="center", transform=axis.transAxes)
                axis.set_axis_off()
                continue
            axis.spines[["top", "right"]].set_visible(False)
            axis.grid(alpha=0.3)
        line[0].set_ylabel("return")
    for axis in axes[-1]:
        axis.set_xlabel("actuator bias (action units)")
    axes[0][0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(HERE / "returns.png", dpi=110)


def main(folder: Path | None = None) -> None:
    """All of it, or of the episodes that are there."""
    HERE.mkdir(exist_ok=True)
    if folder is not None:
        if not (found := measured(folder)):
            sys.exit(f"no evaluated runs below {folder}")
        keep(found, HERE / "cells.csv")
    rows = kept(HERE / "cells.csv")
    summary = summarize(rows)
    shown = [{k: f"{v:.5g}" if isinstance(v, float) else v for k, v in r.items()} for r in summary]
    write_table(HERE / "summary.csv", shown)
    horizon = {task: get_task(task).horizon for task in TASKS}
    (HERE / "returns.md").write_text(returns_page(summary, rows, horizon) + "\n")
    (HERE / "recovered.md").write_text(recovered_page(summary) + "\n")
    (HERE / "imagination.md").write_text(imagination_page(rows, horizon) + "\n")
    draw(summary)
    print((HERE / "returns.md").read_text(), (HERE / "recovered.md").read_text(), sep="\n")


if __name__ == "__main__":
    if len(sys.argv) > 2:
        sys.exit(__doc__)
    main(*map(Path, sys.argv[1:]))
