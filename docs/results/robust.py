"""Frozen policies with L1 off, the paper's, the robust controller and the oracle, joined.

    python docs/results/robust.py [FOLDER]

Reads the tables that `torchrl-l1 evaluate` wrote into FOLDER/TASK/seed_N/bias and .../noise, if a
FOLDER is given, and keeps their episodes in `robust/TASK.csv` beside this file, in place of those
of the same policy. More episodes without a disturbance, of tasks whose returns scatter much, are in
.../undisturbed and are kept in `robust/undisturbed_TASK.csv`. Writes from those `robust/TASK.md`,
`robust/TASK.png`, `robust/overall.md` and `robust/harm.md`.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_l1.algorithms import METRPO
from torchrl_l1.experiment.files import write_table
from torchrl_l1.experiment.matrix import disturbance_words
from torchrl_l1.report.evaluation_summary import summarize, summary_lines
from torchrl_l1.report.page import markdown
from torchrl_l1.report.recovery import MEDIANS, plot_heat_map
from torchrl_l1.report.statistics import Recovery, recovered, student_interval

HERE = Path(__file__).with_name("robust")
TASKS = ("inverted_pendulum", "swimmer", "hopper", "walker", "half_cheetah")
KEPT = ("run", "l1", "noise", "bias", "signs", "policy", "episode", "return", "steps")
NUMBERS = ("bias", "signs", "episode", "return", "steps")
CONTROLLERS = ("off", "paper", "robust", "oracle")
Row = dict[str, Any]
Disturbance = tuple[float, float]  # bias and signs
NONE = (0.0, 0.0)
# Instead of a share, where nothing can be told from chance.
UNTOLD = "not told"
# What a pole that hangs returns.
IDLE = {"inverted_pendulum": -100.0}
# Policies on which settings of the robust controller were found or chosen.
TUNED = {
    "swimmer": ("seed_0",),
    "hopper": ("seed_0",),
    "walker": ("seed_0", "seed_1", "seed_2"),
    "half_cheetah": ("seed_0", "seed_1"),
}


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


def of_policies(
    episodes: Sequence[Row], l1: str, disturbances: Sequence[Disturbance], noise: str = "none"
) -> dict[str, np.ndarray]:
    """Returns of a controller under some disturbances, by run."""
    chosen = set(disturbances)
    found: dict[str, list[float]] = {}
    for row in episodes:
        if (row["l1"], row["noise"]) == (l1, noise) and (row["bias"], row["signs"]) in chosen:
            found.setdefault(row["run"], []).append(row["return"])
    return {run: np.array(found[run]) for run in sorted(found)}


def difference(
    episodes: Sequence[Row], l1: str, disturbances: Sequence[Disturbance], noise: str = "none"
) -> np.ndarray:
    """Mean return of each policy with a controller less that without."""
    on, off = (of_policies(episodes, one, disturbances, noise) for one in (l1, "off"))
    return np.array([on[run].mean() - off[run].mean() for run in off])


def with_interval(values: np.ndarray, digits: str) -> str:
    """Mean over policies, and its 95 % interval by Student's t if there are two or more."""
    mean = format(values.mean(), digits)
    if len(values) < 2:
        return f"{mean} (one policy)"
    return f"{mean} {student_interval(values.tolist()):{digits}}"


def harm(episodes: Sequence[Row], noise: str, l1: str) -> str:
    """Return less that without L1: mean over policies, and 95 % interval by Student's t.

    Both in per cent of the mean magnitude of what the policies return without L1: of returns
    about zero, and of either sign, the mean is no scale.
    """
    off = of_policies(episodes, "off", [NONE], noise)
    scale = np.mean([abs(one.mean()) for one in off.values()]) / 100
    return with_interval(difference(episodes, l1, [NONE], noise) / scale, "+.1f")


def idle(task: str, episodes: Sequence[Row]) -> set[str]:
    """Policies that have learned nothing.

    Their undisturbed return without L1 is less than a tenth of the way from that of doing nothing,
    which is 0 and the pendulum's -100, to the best policy's.
    """
    returns = {run: one.mean() for run, one in of_policies(episodes, "off", [NONE]).items()}
    nothing = IDLE.get(task, 0.0)
    least = nothing + 0.1 * (max(returns.values()) - nothing)
    return {run for run, value in returns.items() if value < least}


def overall(task: str, episodes: Sequence[Row]) -> dict[str, str]:
    """What the controllers recover of the disturbances that cost something, and of all.

    The costly ones are those whose oracle is better than no controller, with its 95 % interval;
    all have equal weight. Shares of single policies are starred where these have learned nothing,
    and empty where the oracle gains nothing.
    """
    disturbances = sorted({(row["bias"], row["signs"]) for row in episodes} - {NONE})

    def shares(l1: str, chosen: Sequence[Disturbance], runs: Iterable[str]) -> Recovery:
        of = [of_policies(episodes, one, chosen) for one in ("off", l1, "oracle")]
        return recovered(*([one[run] for run in runs] for one in of))

    useless = idle(task, episodes)
    runs = list(of_policies(episodes, "off", [NONE]))
    line = {"policies": str(len(runs)), "learned nothing": ", ".join(sorted(useless)) or "–"}
    costly = [one for one in disturbances if shares("off", [one], runs).gap_interval.low > 0]
    line["costly disturbances"] = f"{len(costly)} of {len(disturbances)}"
    for words, chosen in (("", costly), ("all: ", disturbances)):
        for l1 in CONTROLLERS:
            returns = of_policies(episodes, l1, chosen).values()
            line[words + l1] = f"{np.mean([one.mean() for one in returns]):.4g}" if chosen else "–"
    line["all: robust less off"] = with_interval(
        difference(episodes, "robust", disturbances), ".3g"
    )
    held_out = [run for run in runs if run not in TUNED.get(task, ())]
    for l1 in ("paper", "robust"):
        kinds = {"recovered": runs, "recovered, not tuned on": held_out}
        for words, chosen_runs in kinds.items():
            line[f"{l1} {words}"] = UNTOLD if chosen_runs else "–"
            if costly and chosen_runs:
                found = shares(l1, costly, chosen_runs)
                if found.share is not None and found.interval is not None:
                    text = f"{found.share:.2f} {found.interval:.2f}"
                    line[f"{l1} {words}"] = text + " over its episodes" * (found.policies == 1)
        single = []
        for run in runs if costly else ():
            off, on, oracle = (
                of_policies(episodes, one, costly)[run].mean() for one in ("off", l1, "oracle")
            )
            share = f"{(on - off) / (oracle - off):.2f}" if oracle > off else ""
            single.append(share + r"\*" * (run in useless))
        line[f"{l1}, by policy"] = ", ".join(single) or "–"
    return line


def main() -> None:
    """Read what is new, then write all tables and figures."""
    lines: list[Row] = []
    totals: list[Row] = []
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
        totals.append({"task": task, **overall(task, episodes)})
        for noise in dict.fromkeys(row["noise"] for row in episodes):
            of = read(more) if more.exists() else episodes
            count = sum(
                (row["l1"], row["noise"]) == ("off", noise) and row["bias"] == 0 == row["signs"]
                for row in of
            )
            policies = str(len({row["run"] for row in of}))
            line = {"task": task, "policies": policies, "noise": noise, "episodes": str(count)}
            for l1 in ("paper", "robust"):
                line[f"L1 {l1}, %"] = harm(of, noise, l1)
            lines.append(line)
        for row in biased:
            if row["l1"] == "robust" and "recovered" in row:
                print(task, disturbance_words(row), f"{row['recovered']:.2f}")
    (HERE / "overall.md").write_text(markdown(totals) + "\n")
    (HERE / "harm.md").write_text(markdown(lines) + "\n")
    print(f"Tables and figures: {HERE}")


if __name__ == "__main__":
    main()
