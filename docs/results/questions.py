"""The three questions of the studies: what the paper's table holds, what is recovered, what to use.

    python docs/results/questions.py

Reads `baselines/`, `table1_first/`, `table1/`, `mbmf/`, `mbmf_rest/`, `robust/` and
`trained_twice.csv` beside this file, which the commands of their pages write, and the paper's
tables. Robust runs are paired with the training on the same machine. Writes to `questions/`:
`table1.md` and `table4.md` with a `.png` of each, `ahead.md`, and `recovered.md` and `.png`.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import robust
from matplotlib.axes import Axes
from scipy.stats import binomtest

from torchrl_l1.report.page import interval_text, markdown, number
from torchrl_l1.report.published import PublishedCell, published_cells
from torchrl_l1.report.statistics import difference_summary
from torchrl_l1.report.style import color as color_of

HERE = Path(__file__).with_name("questions")
NOISES = ("none", "action", "observation")
# Differences are drawn as shares of these returns: of the pendulum that of a pole that hangs.
SCALES = {
    "inverted_pendulum": 100.0,
    "swimmer": 340.0,
    "hopper": 1300.0,
    "walker": 800.0,
    "half_cheetah": 3270.0,
}
# Whose returns are compared.
ACTIONS = {"stochastic": "sampled", "deterministic": "mean"}
RETURNS = {"stochastic": "return", "deterministic": "return_deterministic"}
ENDS = ("difference_low", "difference_high")
Row = dict[str, str]


class Table(NamedTuple):
    """A table of the paper.

    Attributes:
        number: the paper's.
        algorithm: the one that its rows are about.
        editions: reports of our runs, the earliest first.
        arms: controllers in training, and the place of each beside the line of a cell.
    """

    number: str
    algorithm: str
    editions: tuple[str, ...]
    arms: dict[str, float]


METRPO = Table(
    "1", "METRPO", ("baselines", "table1_first", "table1"), {"paper": -0.16, "robust": 0.16}
)
MBMF = Table("4", "MBMF", ("mbmf", "mbmf_rest"), {"paper": 0.0})


class Found(NamedTuple):
    """What an edition's runs have returned in a cell of the table, with a controller and without.

    Attributes:
        edition: the folder that they are from.
        off: mean return without L1, of the seeds in pairs where there are pairs; empty if there
            are no runs.
        on: mean return with the controller in training, likewise.
        pair: paired differences between the two, if there are any.
    """

    edition: str
    off: str
    on: str
    pair: Row | None

    @property
    def pairs(self) -> int:
        """How many seeds have been trained both ways."""
        return int(self.pair["pairs"]) if self.pair else 0


@cache
def rows(folder: str, name: str) -> list[Row]:
    """Those of a report's file; none where it has not been written."""
    file = Path(__file__).parent / folder / name
    if not file.exists():
        return []
    with file.open(newline="") as handle:
        return list(csv.DictReader(handle))


def ours(table: Table, task: str, noise: str, l1: str, policy: str = "stochastic") -> Found | None:
    """Of a table's editions that have the cell the one with most pairs, or the latest of these."""
    best = None
    single: dict[str, list[float]] = {}
    for edition in table.editions:
        returns = {
            row["l1"]: row["return_mean"]
            for row in rows(edition, "training.csv")
            if (row["task"], row["noise"]) == (task, noise) and not row["variant"]
        }
        pair = paired(edition, (task, noise, l1), policy)
        for arm in ("off", l1) if pair else ():
            of_seeds = seed_returns(edition, (task, noise, arm), pair[0], l1)
            returns[arm] = str(np.mean(of_seeds))
            single[arm] = of_seeds
        if l1 == "robust" and pair:
            differences = np.subtract(single[l1], single["off"]).tolist()
            summary = {name: str(value) for name, value in difference_summary(differences).items()}
            pair = [pair[0] | summary]
        on = returns.get(l1, "")
        found = Found(edition, returns.get("off", ""), on, pair[0] if pair else None)
        if found.off and (best is None or found.pairs >= best.pairs):
            best = found
    return best


def paired(edition: str, cell: tuple[str, str, str], policy: str) -> list[Row]:
    """Rows of an edition's paired differences in a cell: one, or none."""
    return [
        row
        for row in rows(edition, "pairs.csv")
        if (row["task"], row["noise"], row["l1"]) == cell
        and row["policy"] == policy
        and not row["variant"]
        and int(row["pairs"])
    ]


def first_training(task: str, noise: str, l1: str) -> dict[str, Row]:
    """The runs of a cell that have been trained a second time, by seed."""
    cell = {"task": task, "noise": noise, "l1": l1}
    return {
        row["seed"]: row for row in rows("", "trained_twice.csv") if row.items() >= cell.items()
    }


def seed_returns(edition: str, cell: tuple[str, str, str], pair: Row, l1: str) -> list[float]:
    """Returns of the runs of a cell that have the seeds of a pair, by its kind of action.

    The robust runs come from the machine of the first training. What they are compared with is
    that training where a second has replaced it.
    """
    first = first_training(*cell) if (edition, l1) == ("table1", "robust") else {}
    seeds, column = pair["seeds"].split(), RETURNS[pair["policy"]]
    found = {
        row["seed"]: float(first.get(row["seed"], row)[column])
        for row in rows(edition, "runs.csv")
        if (row["task"], row["noise"], row["l1"]) == cell and not row["variant"]
        if row["return"] and row["seed"] in seeds
    }
    assert len(found) == len(seeds), (edition, cell, seeds)
    return [found[seed] for seed in seeds]


def draw(ax: Axes, pair: Row, row: float, scale: float, color: str) -> None:
    """A controller's differences in a cell: each seed, mean (hollow of a single one), interval."""
    differences = np.array(pair["differences"].split(), dtype=np.float64) / scale
    if len(differences) > 1:
        ax.plot(differences, np.full_like(differences, row), "|", color=color, markersize=7)
    face = color if len(differences) > 1 else "white"
    mean = float(pair["difference_mean"]) / scale
    ax.plot(mean, row, "D", color=color, markersize=4, markerfacecolor=face)
    if pair.get("difference_low"):
        ends = np.array([float(pair[name]) for name in ENDS])
        ax.plot(ends / scale, [row, row], color=color, lw=1)


def line(table: Table, task: str, noise: str, l1: str, found: Found | None) -> Row:
    """A cell in a table."""
    words = {"task": task, "noise": noise, "L1": l1, "off": "not run", "on": "not run"}
    words |= {"difference": "", "95 % interval": "", "pairs": "0"}
    if found is not None:
        words |= {"off": number(float(found.off)), "pairs": str(found.pairs)}
        if found.on:
            words["on"] = number(float(found.on))
        if found.pair is not None:
            words["difference"] = number(float(found.pair["difference_mean"]))
            if found.pair.get("difference_low"):
                ends = {name: float(found.pair[name]) for name in ENDS}
                words["95 % interval"] = interval_text(ends, "difference")
    words |= dict.fromkeys(("published off", "published on", "its difference"), "")
    if l1 == "paper":
        off, on = published(table, task, noise)
        words |= {
            f"published {arm}": f"{of.mean} ± {of.std}" for arm, of in (("off", off), ("on", on))
        }
        words["its difference"] = f"{float(on.mean) - float(off.mean):.4g}"
    words["runs of"] = found.edition if found else ""
    if l1 == "robust" and found and found.pair and first_training(task, noise, "off"):
        words["runs of"] += ", first training"
    return words


def published(table: Table, task: str, noise: str) -> tuple[PublishedCell, PublishedCell]:
    """What the paper prints in a cell, without L1 and with it."""
    off, on = (published_cells()[table.number, task, noise, arm, arm] for arm in ("off", "on"))
    return off, on


def cells_of(table: Table) -> None:
    """All cells of a table: ours where there are runs, beside the paper's."""
    HERE.mkdir(exist_ok=True)
    lines, labels = [], []
    figure, ax = plt.subplots(figsize=(8, 6.4), layout="constrained")
    cells = [(task, noise) for task in SCALES for noise in NOISES]
    for place, (task, noise) in enumerate(cells):
        run, scale = False, SCALES[task]
        off, on = published(table, task, noise)
        theirs = (float(on.mean) - float(off.mean)) / scale
        spread = np.hypot(float(off.std), float(on.std)) / scale
        ax.errorbar(theirs, place, xerr=spread, fmt="o", color="0.6", elinewidth=1, zorder=1)
        for l1, offset in table.arms.items():
            found = ours(table, task, noise, l1)
            lines.append(line(table, task, noise, l1, found))
            if found is not None and found.pair is not None:
                draw(ax, found.pair, place + offset, scale, color_of(0, l1))
                run = True
        labels.append(f"{task.replace('_', ' ')}, {noise}" + ("" if run else " (not run)"))
    ax.axvline(0, color="0.8", zorder=0)
    ax.invert_yaxis()
    ax.set_yticks(range(len(cells)), labels)
    ax.set_xlabel("return with L1 in training less that without, as a share of the task's scale")
    ax.plot([], [], "o", color="0.6", label="published, ± its spreads over seeds")
    for l1 in table.arms:
        label = f"ours, {l1}: mean, 95 % interval, seeds"
        ax.plot([], [], "D-", color=color_of(0, l1), markersize=4, label=label)
    single = {"color": "0.3", "markersize": 4, "markerfacecolor": "white"}
    ax.plot([], [], "D", **single, label="hollow: a single seed")
    figure.legend(loc="outside lower center", ncols=2)
    figure.savefig(HERE / f"table{table.number}.png", dpi=110)
    plt.close(figure)
    (HERE / f"table{table.number}.md").write_text(markdown(lines) + "\n")


def ahead() -> None:
    """In how many pairs of seeds and cells the return is higher with L1 in training.

    Pairs without any difference count for neither. Those of a cell are not independent, so the
    interval is that of the share of cells, by their mean difference.
    """
    groups = [*(task.replace("_", " ") for task in SCALES), *map("noise {}".format, NOISES)]
    arms = [(METRPO, "paper"), (METRPO, "robust"), (MBMF, "paper")]
    lines = []
    for (table, l1), (policy, action) in product(arms, ACTIONS.items()):
        pairs: list[bool] = []
        cells: list[bool] = []
        signs: dict[str, list[bool]] = {group: [] for group in groups}
        for task, noise in product(SCALES, NOISES):
            found = ours(table, task, noise, l1, policy)
            if found is None or found.pair is None:
                continue
            differences = map(float, found.pair["differences"].split())
            higher = [difference > 0 for difference in differences if difference]
            cells.append(float(found.pair["difference_mean"]) > 0)
            for group in (pairs, signs[task.replace("_", " ")], signs[f"noise {noise}"]):
                group.extend(higher)
        ends = binomtest(sum(cells), len(cells)).proportion_ci()
        lines.append(
            {"algorithm": table.algorithm, "L1 in training": l1, "action": action}
            | {"pairs": count(pairs), "share": f"{np.mean(pairs):.2f}", "cells": count(cells)}
            | {"share of cells": f"{np.mean(cells):.2f} [{ends.low:.2f}, {ends.high:.2f}]"}
            | {group: count(of) for group, of in signs.items()}
        )
    (HERE / "ahead.md").write_text(markdown(lines) + "\n")


def count(signs: Sequence[bool]) -> str:
    """How many of them hold; empty if there are none."""
    return f"{sum(signs)} of {len(signs)}" if signs else ""


def recovered() -> None:
    """What the controllers recover of the oracle's gain, policy by policy."""
    HERE.mkdir(exist_ok=True)
    lines: dict[str, dict[str, str]] = {}
    figure, ax = plt.subplots(figsize=(7.5, 3.4), layout="constrained")
    for column, task in enumerate(robust.TASKS):
        rows = robust.policy_rows(robust.read(robust.HERE / f"{task}.csv"))
        lines[task] = robust.overall(task, rows)
        losing = [row for row in rows if row["costly"]]
        for (offset, l1), index in product(enumerate(("paper", "robust")), range(len(losing))):
            share, ends = losing[index][f"share {l1}"]
            place = column + 0.4 * (offset - 0.5) + 0.09 * (index - (len(losing) - 1) / 2)
            label = f"L1 {l1}" if column == index == 0 else None
            ax.plot([place, place], [ends.low, ends.high], color=color_of(0, l1), lw=1.2)
            ax.plot(place, share, "o", color=color_of(0, l1), markersize=5, label=label)
    table = [
        {"share of the oracle's gain": words}
        | {task.replace("_", " "): of[f"{l1} recovers"] for task, of in lines.items()}
        for l1, words in (("paper", "the paper's controller"), ("robust", "the robust controller"))
    ]
    (HERE / "recovered.md").write_text(markdown(table) + "\n")
    ax.axhline(0, color="0.5", lw=0.8)
    ax.axhline(1, color="0.5", lw=0.8, ls="--")
    labels = [f"{task.replace('_', ' ')} ({of['policies']})" for task, of in lines.items()]
    ax.set_xticks(range(len(lines)), labels)
    ax.set_xlabel("task (number of policies); a dot per policy, 95 % interval over its 24 resets")
    ax.set_ylabel("share of the oracle's gain")
    ax.set_ylim(-1.7, 2.2)
    ax.legend(loc="lower left")
    figure.savefig(HERE / "recovered.png", dpi=110)
    plt.close(figure)


def main() -> None:
    """Write all of it."""
    for table in (METRPO, MBMF):
        cells_of(table)
    ahead()
    recovered()
    print(f"Tables and figures: {HERE}")


if __name__ == "__main__":
    main()
