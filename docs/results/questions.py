"""The three questions of the studies: what the paper's table holds, what is recovered, what to use.

    python docs/results/questions.py

Reads `baselines/`, `table1_first/` and `robust/` beside this file, which the commands of their
pages write, and the paper's table. Writes `questions/table1.md` and `.png`, and
`questions/recovered.md` and `.png`.
"""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import robust

from torchrl_l1.report.page import markdown
from torchrl_l1.report.published import published_cells

HERE = Path(__file__).with_name("questions")
RUNS = Path(__file__).with_name("table1_first")
NOISES = ("none", "action", "observation")
# Differences are drawn as shares of these returns: of the pendulum that of a pole that hangs.
SCALES = {
    "inverted_pendulum": 100.0,
    "swimmer": 340.0,
    "hopper": 1300.0,
    "walker": 800.0,
    "half_cheetah": 3270.0,
}
Key = tuple[str, str]


def ours() -> tuple[dict[tuple[str, str, str], str], dict[Key, dict[str, str]]]:
    """Mean returns by task, noise and controller, and the paired differences."""
    returns = {}
    for folder in (RUNS.with_name("baselines"), RUNS):
        with (folder / "training.csv").open(newline="") as handle:
            for row in csv.DictReader(handle):
                returns[row["task"], row["noise"], row["l1"]] = row["return_mean"]
    with (RUNS / "pairs.csv").open(newline="") as handle:
        pairs = {
            (row["task"], row["noise"]): row
            for row in csv.DictReader(handle)
            if row["policy"] == "stochastic"
        }
    return returns, pairs


def table1() -> None:
    """All cells of Table 1: ours where there are runs, beside the paper's."""
    HERE.mkdir(exist_ok=True)
    returns, pairs = ours()
    lines = []
    figure, ax = plt.subplots(figsize=(8, 5), layout="constrained")
    cells = [(task, noise) for task in SCALES for noise in NOISES]
    for row, (task, noise) in enumerate(reversed(cells)):
        off, on = (published_cells()["1", task, noise, l1, l1] for l1 in ("off", "on"))
        theirs = float(on.mean) - float(off.mean)
        pair = pairs.get((task, noise))
        ax.plot(theirs / SCALES[task], row, "o", color="0.6", label="paper" if not row else None)
        line = {"task": task, "noise": noise, "L1 off": "not run", "L1 paper": "not run"}
        line |= {"difference": "", "95 % interval": "", "seeds": "0"}
        for l1 in ("off", "paper"):
            if found := returns.get((task, noise, l1)):
                line[f"L1 {l1}"] = f"{float(found):.4g}"
        if pair is not None:
            line |= {"difference": f"{float(pair['difference_mean']):.3g}", "seeds": pair["pairs"]}
            seeds = np.array(pair["differences"].split(), dtype=np.float64) / SCALES[task]
            ax.plot(seeds, np.full_like(seeds, row), "|", color="tab:blue", markersize=9)
            mean = float(pair["difference_mean"]) / SCALES[task]
            ax.plot(mean, row, "D", color="tab:blue", markersize=5)
            if pair["difference_low"]:
                ends = [float(pair[f"difference_{end}"]) for end in ("low", "high")]
                line["95 % interval"] = f"[{ends[0]:.3g}, {ends[1]:.3g}]"
                ax.plot(np.array(ends) / SCALES[task], [row, row], color="tab:blue", lw=1)
        line |= {"paper off": off.mean, "paper L1": on.mean, "paper difference": f"{theirs:.4g}"}
        lines.append(line)
    ax.axvline(0, color="0.8", zorder=0)
    words = [
        f"{task.replace('_', ' ')}, {noise}" + ("" if (task, noise) in pairs else " (not run)")
        for task, noise in reversed(cells)
    ]
    ax.set_yticks(range(len(cells)), words)
    ax.set_xlabel("return with L1 in training less that without, as a share of the task's scale")
    ax.plot([], [], "D-", color="tab:blue", markersize=5, label="ours: mean, interval, seeds")
    ax.legend(loc="lower right")
    figure.savefig(HERE / "table1.png", dpi=110)
    plt.close(figure)
    (HERE / "table1.md").write_text(markdown(lines[::-1]) + "\n")


def recovered() -> None:
    """What the controllers recover of the oracle's gain, by task."""
    HERE.mkdir(exist_ok=True)
    lines = {}
    for task in robust.TASKS:
        found = robust.overall(robust.read(robust.HERE / f"{task}.csv"))
        lines[task] = {l1: found[f"{l1} recovered"] for l1 in ("paper", "robust")}
    table = [
        {"share of the oracle's gain": words}
        | {task.replace("_", " "): of[l1] for task, of in lines.items()}
        for l1, words in (("paper", "the paper's controller"), ("robust", "the robust controller"))
    ]
    (HERE / "recovered.md").write_text(markdown(table) + "\n")
    figure, ax = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
    for offset, (l1, color) in enumerate((("paper", "tab:orange"), ("robust", "tab:blue"))):
        for column, of in enumerate(lines.values()):
            mean, ends = of[l1].split(" ", 1)
            low, high = (float(end) for end in ends.strip("[]").split(", "))
            place = column + 0.36 * (offset - 0.5)
            label = f"L1 {l1}" if not column else None
            ax.bar(place, float(mean), 0.34, color=color, alpha=0.75, label=label)
            ax.plot([place, place], [low, high], color="0.2", lw=1.2)
    ax.axhline(0, color="0.5", lw=0.8)
    ax.axhline(1, color="0.5", lw=0.8, ls="--")
    ax.set_xticks(range(len(lines)), [task.replace("_", " ") for task in lines])
    ax.set_ylabel("share of the oracle's gain")
    ax.legend(loc="lower left")
    figure.savefig(HERE / "recovered.png", dpi=110)
    plt.close(figure)


def main() -> None:
    """Write all of it."""
    table1()
    recovered()
    print(f"Tables and figures: {HERE}")


if __name__ == "__main__":
    main()
