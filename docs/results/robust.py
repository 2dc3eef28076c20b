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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_l1.algorithms import METRPO
from torchrl_l1.experiment.files import write_table
from torchrl_l1.experiment.matrix import disturbance_words
from torchrl_l1.report.evaluation_summary import summarize, summary_lines
from torchrl_l1.report.page import markdown
from torchrl_l1.report.recovery import MEDIANS, plot_heat_map
from torchrl_l1.report.statistics import recovered

HERE = Path(__file__).with_name("robust")
TASKS = ("inverted_pendulum", "swimmer", "hopper", "walker", "half_cheetah")
KEPT = ("run", "l1", "noise", "bias", "signs", "policy", "episode", "return", "steps")
NUMBERS = ("bias", "signs", "episode", "return", "steps")
Row = dict[str, Any]


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


def harm(episodes: Sequence[Row], noise: str, l1: str, draws: int = 4000) -> dict[str, str]:
    """Return less that without L1: mean over policies, and 95 % interval.

    Both in per cent of the mean magnitude of what the policies return without L1: of returns
    about zero, and of either sign, the mean is no scale.
    """
    of: dict[tuple[str, str], np.ndarray] = {}
    runs = sorted({row["run"] for row in episodes})
    for run in runs:
        for option in ("off", l1):
            returns = [
                row["return"]
                for row in episodes
                if (row["run"], row["l1"], row["noise"]) == (run, option, noise)
                and row["bias"] == 0 == row["signs"]
            ]
            of[run, option] = np.array(returns)
    differences = [of[run, l1] - of[run, "off"] for run in runs]
    scale = np.mean([abs(of[run, "off"].mean()) for run in runs]) / 100
    rng = np.random.default_rng(0)
    means = []
    for _ in range(draws):
        chosen = rng.integers(len(runs), size=len(runs))
        drawn = [rng.choice(differences[one], len(differences[one])).mean() for one in chosen]
        means.append(np.mean(drawn) / scale)
    low, high = np.percentile(means, [2.5, 97.5])
    mean = np.mean([one.mean() for one in differences]) / scale
    return {"mean": f"{mean:+.1f}", "interval": f"[{low:+.1f}, {high:+.1f}]"}


def overall(episodes: Sequence[Row]) -> dict[str, str]:
    """What the controllers recover of the disturbances that cost something, of equal weight.

    Those are the ones whose oracle is better than no controller, with its 95 % interval.
    """
    runs = sorted({row["run"] for row in episodes})
    disturbances = sorted({(row["bias"], row["signs"]) for row in episodes} - {(0.0, 0.0)})

    def returns(l1: str, disturbance: tuple[float, float]) -> list[np.ndarray]:
        return [
            np.array(
                [
                    row["return"]
                    for row in episodes
                    if (row["run"], row["l1"], row["noise"]) == (run, l1, "none")
                    and (row["bias"], row["signs"]) == disturbance
                ]
            )
            for run in runs
        ]

    of = {
        (l1, disturbance): returns(l1, disturbance)
        for l1 in ("off", "paper", "robust", "oracle")
        for disturbance in disturbances
    }
    costly = [
        one
        for one in disturbances
        if recovered(of["off", one], of["oracle", one], of["oracle", one]).gap_interval.low > 0
    ]
    line = {"costly disturbances": f"{len(costly)} of {len(disturbances)}"}

    def together(l1: str) -> list[np.ndarray]:
        return [
            np.concatenate([of[l1, one][index] for one in costly]) for index in range(len(runs))
        ]

    for l1 in ("off", "paper", "robust", "oracle") if costly else ():
        line[l1] = f"{np.mean(np.concatenate(together(l1))):.4g}"
    for l1 in ("paper", "robust") if costly else ():
        found = recovered(together("off"), together(l1), together("oracle"))
        assert found.share is not None and found.interval is not None
        low, high = found.interval.low, found.interval.high
        line[f"{l1} recovered"] = f"{found.share:.2f} [{low:.2f}, {high:.2f}]"
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
        policies = str(len({row["run"] for row in episodes}))
        totals.append({"task": task, "policies": policies, **overall(episodes)})
        for noise in dict.fromkeys(row["noise"] for row in episodes):
            of = read(more) if more.exists() else episodes
            count = sum(
                (row["l1"], row["noise"]) == ("off", noise) and row["bias"] == 0 == row["signs"]
                for row in of
            )
            line = {"task": task, "policies": policies, "noise": noise, "episodes": str(count)}
            for l1 in ("paper", "robust"):
                found = harm(of, noise, l1)
                line[f"L1 {l1}, %"] = f"{found['mean']} {found['interval']}"
            lines.append(line)
        for row in biased:
            if row["l1"] == "robust" and "recovered" in row:
                print(task, disturbance_words(row), f"{row['recovered']:.2f}")
    (HERE / "overall.md").write_text(markdown(totals) + "\n")
    (HERE / "harm.md").write_text(markdown(lines) + "\n")
    print(f"Tables and figures: {HERE}")


if __name__ == "__main__":
    main()
