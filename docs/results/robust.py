"""Frozen policies with L1 off, the paper's, the robust controller and the oracle, joined.

    python docs/results/robust.py [FOLDER]

Reads the tables that `torchrl-l1 evaluate` wrote into FOLDER/TASK/seed_N/bias and .../noise, if a
FOLDER is given, and keeps their episodes in `robust/TASK.csv` beside this file, in place of those
of the same policy. More episodes without a disturbance, of tasks whose returns scatter much, are in
.../undisturbed and are kept in `robust/undisturbed_TASK.csv`. Writes from those `robust/TASK.md`,
`robust/TASK.png`, `robust/policies.md`, `robust/overall.md` and `robust/harm.md`.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_l1.algorithms import METRPO
from torchrl_l1.experiment.files import write_table
from torchrl_l1.experiment.matrix import disturbance_words
from torchrl_l1.report.evaluation_summary import summarize, summary_lines
from torchrl_l1.report.page import markdown, number
from torchrl_l1.report.recovery import MEDIANS, plot_heat_map
from torchrl_l1.report.statistics import ratio, student_interval

HERE = Path(__file__).with_name("robust")
TASKS = ("inverted_pendulum", "swimmer", "hopper", "walker", "half_cheetah")
KEPT = ("run", "l1", "noise", "bias", "signs", "policy", "episode", "return", "steps")
NUMBERS = ("bias", "signs", "episode", "return", "steps")
CONTROLLERS = ("off", "paper", "robust", "oracle")
Row = dict[str, Any]
Disturbance = tuple[float, float]  # bias and signs
NONE = (0.0, 0.0)
LEAST = 0.02  # of the undisturbed return, from which on a loss is spoken of
# Policies on which settings of the robust controller were found or chosen.
TUNED = {"swimmer": ("seed_0",), "hopper": ("seed_0",), "walker": ("seed_0",)}


def read(file: Path) -> list[Row]:
    """Episodes of a table, with numbers as numbers."""
    with file.open(newline="") as handle:
        return [
            {name: float(row[name]) if name in NUMBERS else row[name] for name in KEPT}
            for row in csv.DictReader(handle)
        ]


def gather(folder: Path, task: str, parts: Sequence[str], kept: Path) -> None:
    """Keep the episodes of all seeds and controllers of a task in one file, the new in place."""
    rows = []
    for file in sorted(folder.glob(f"{task}/seed_*/*/episodes.csv")):
        if file.parent.name in parts:
            rows += [{**row, "run": file.parts[-3]} for row in read(file)]
    if not rows:
        return
    HERE.mkdir(exist_ok=True)
    new = {(row["run"], row["l1"]) for row in rows}
    before = read(kept) if kept.exists() else []
    old = [row for row in before if (row["run"], row["l1"]) not in new]
    write_table(kept, sorted(old + rows, key=lambda row: row["run"]))


def conditions(episodes: Sequence[Row]) -> list[Row]:
    """One row per run and condition, as `summarize` takes them."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in episodes:
        groups.setdefault(tuple(row[name] for name in KEPT[:6]), []).append(row)
    return [
        {
            **{name: value for name, value in zip(KEPT[:6], key, strict=True)},
            "return_mean": float(np.mean([row["return"] for row in members])),
            "episodes": len(members),
        }
        for key, members in groups.items()
    ]


def returns(
    episodes: Sequence[Row], run: str, l1: str, disturbances: Sequence[Disturbance], noise: str
) -> np.ndarray:
    """Returns of a policy, reset by reset, in the mean over the disturbances."""
    of: dict[float, list[float]] = {}
    for row in episodes:
        is_of = (row["run"], row["l1"], row["noise"]) == (run, l1, noise)
        if is_of and (row["bias"], row["signs"]) in disturbances:
            of.setdefault(row["episode"], []).append(row["return"])
    return np.array([np.mean(of[episode]) for episode in sorted(of)])


def policy_rows(episodes: Sequence[Row]) -> list[Row]:
    """What each policy loses under the biases that cost it something, and what it gets back.

    Those are the ones at which the oracle is better than no controller, by more than 2 % of the
    magnitude of what the policy returns undisturbed, and with its 95 % interval over the resets.
    Their returns are means of equal weight, the intervals Student's t and Fieller's over resets.
    """
    rows = []
    for run in sorted({row["run"] for row in episodes}):
        mine = [row for row in episodes if row["run"] == run]
        every = sorted({(row["bias"], row["signs"]) for row in mine} - {NONE})
        of = partial(returns, mine, run, noise="none")
        undisturbed = of("off", [NONE])
        least = LEAST * abs(undisturbed.mean())
        costly = []
        for one in every:
            gap = of("oracle", [one]) - of("off", [one])
            if gap.mean() > least and student_interval(gap.tolist()).low > 0:
                costly.append(one)
        row: Row = {"run": run, "undisturbed": undisturbed.mean(), "tested": len(every)}
        row["costly"] = costly
        for l1 in CONTROLLERS:
            row[f"all {l1}"] = of(l1, every).mean()
            row[l1] = of(l1, costly).mean() if costly else None
        for l1 in ("paper", "robust") if costly else ():
            off = of("off", costly)
            row[f"share {l1}"] = ratio(of(l1, costly) - off, of("oracle", costly) - off)
        rows.append(row)
    return rows


def policy_lines(task: str, rows: Sequence[Row]) -> list[Row]:
    """:func:`policy_rows` in words."""
    lines = []
    for row in rows:
        line = {"task": task, "policy": row["run"].replace("_", " ")}
        line |= {"undisturbed": number(row["undisturbed"])}
        line["costly biases"] = f"{len(row['costly'])} of {row['tested']}"
        for l1 in CONTROLLERS:
            line[l1] = "–" if row[l1] is None else number(row[l1])
        for l1 in ("paper", "robust"):
            share = row.get(f"share {l1}")
            line[f"{l1} recovers"] = f"{share[0]:.2f} {share[1]:.2f}" if share else "–"
        lines.append(line)
    return lines


def spread(values: Sequence[float], digits: str) -> str:
    """Median and range over policies."""
    if not values:
        return "–"
    ends = f"[{min(values):{digits}}, {max(values):{digits}}]"
    return f"{float(np.median(values)):{digits}} {ends}"


def overall(task: str, rows: Sequence[Row]) -> dict[str, str]:
    """The policies of a task together: shares, and means over all six biases.

    Shares are medians over the policies that lose something, with the lowest and the highest.
    """
    line = {"policies": str(len(rows))}
    losing = [row for row in rows if row["costly"]]
    line["of them with costly biases"] = str(len(losing))
    for l1 in ("paper", "robust"):
        line[f"{l1} recovers"] = spread([row[f"share {l1}"][0] for row in losing], ".2f")
    held_out = [row for row in losing if row["run"] not in TUNED.get(task, ())]
    line["robust, not tuned on"] = spread([row["share robust"][0] for row in held_out], ".2f")
    for l1 in CONTROLLERS:
        line[f"all six: {l1}"] = number(float(np.mean([row[f"all {l1}"] for row in rows])))
    gains = [row["all robust"] - row["all off"] for row in rows]
    line["robust less off"] = ", ".join(map(number, gains))
    return line


def harm(episodes: Sequence[Row], noise: str, l1: str) -> dict[str, str]:
    """Return less that without L1, in per cent of its magnitude: mean over policies, and the worst.

    That of the worst has its 95 % interval over episodes, by Student's t.
    """
    changes = {}
    for run in sorted({row["run"] for row in episodes}):
        on, off = (returns(episodes, run, one, [NONE], noise) for one in (l1, "off"))
        changes[run] = (on - off) / abs(off.mean()) * 100
    run, worst = min(changes.items(), key=lambda item: float(item[1].mean()))
    mean = np.mean([one.mean() for one in changes.values()])
    interval = student_interval(worst.tolist())
    return {
        f"{l1}, mean, %": f"{mean:+.1f}",
        f"{l1}, worst policy, %": f"{worst.mean():+.1f} {interval:+.1f} ({run.replace('_', ' ')})",
    }


def main() -> None:
    """Read what is new, then write all tables and figures."""
    lines: list[Row] = []
    totals: list[Row] = []
    policies: list[Row] = []
    for task in TASKS:
        file, more = HERE / f"{task}.csv", HERE / f"undisturbed_{task}.csv"
        if len(sys.argv) > 1:
            gather(Path(sys.argv[1]), task, ("bias", "noise"), file)
            gather(Path(sys.argv[1]), task, ("undisturbed",), more)
        if not file.exists():
            continue
        episodes = read(file)
        summary = summarize(conditions(episodes), episodes)
        biased = [row for row in summary if row["noise"] == "none"]
        (HERE / f"{task}.md").write_text(markdown(summary_lines(biased)) + "\n")
        plot_heat_map(biased, MEDIANS, task, HERE / f"{task}.png", METRPO.facts)
        rows = policy_rows(episodes)
        policies += policy_lines(task, rows)
        totals.append({"task": task, **overall(task, rows)})
        for noise in dict.fromkeys(row["noise"] for row in episodes):
            of = read(more) if more.exists() else episodes
            count = sum(
                (row["l1"], row["noise"]) == ("off", noise) and row["bias"] == 0 == row["signs"]
                for row in of
            )
            runs = len({row["run"] for row in of})
            line = {"task": task, "policies": str(runs), "noise": noise}
            line["episodes of each"] = str(count // runs)
            for l1 in ("paper", "robust"):
                line |= harm(of, noise, l1)
            lines.append(line)
        for row in biased:
            if row["l1"] == "robust" and "recovered" in row:
                print(task, disturbance_words(row), f"{row['recovered']:.2f}")
    (HERE / "overall.md").write_text(markdown(totals) + "\n")
    (HERE / "policies.md").write_text(markdown(policies) + "\n")
    (HERE / "harm.md").write_text(markdown(lines) + "\n")
    print(f"Tables and figures: {HERE}")


if __name__ == "__main__":
    main()
