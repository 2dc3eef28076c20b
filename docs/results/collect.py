"""Tables and curves of the documentation, from finished run directories.

    python docs/results/collect.py labels runs/labels/*
    python docs/results/collect.py half_cheetah runs/half_cheetah/*
    python docs/results/collect.py robustness runs/robustness/evaluation

Writes NAME.md, NAME.csv and NAME.png beside this file; the pages include them.
"""

from __future__ import annotations

import csv
import json
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from omegaconf import OmegaConf

HERE = Path(__file__).parent


@dataclass
class Run:
    """Metrics of a finished run."""

    seed: int
    label: str
    metrics: list[dict[str, float]]
    timing: list[dict[str, float]]
    versions: dict[str, str]

    def column(self, name: str) -> list[float]:
        """One metric over the iterations."""
        return [row[name] for row in self.metrics]


def load(folder: str) -> Run:
    """Read a run directory."""
    path = Path(folder)
    config = OmegaConf.load(path / "config.yaml")
    metrics, timing = (read(path / f"{name}.csv") for name in ("metrics", "timing"))
    if len(metrics) != config.outer_iterations:
        sys.exit(f"{path} is not finished: {len(metrics)} of {config.outer_iterations} iterations")
    versions = json.loads((path / "versions.json").read_text())
    return Run(config.seed, config.label, metrics, timing, versions)


def read(file: Path) -> list[dict[str, float]]:
    """A CSV of numbers."""
    with file.open() as handle:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(handle)]


def write(
    name: str, header: Sequence[str], rows: Sequence[Sequence[object]], note: str, after: str = ""
) -> None:
    """NAME.csv and NAME.md: table, note, figure, and what comes after the figure."""
    with (HERE / f"{name}.csv").open("w", newline="") as handle:
        csv.writer(handle, lineterminator="\n").writerows([header, *rows])
    lines = [f"| {' | '.join(header)} |", "|" + "---|" * len(header)]
    lines += [f"| {' | '.join(map(str, row))} |" for row in rows]
    text = "\n".join([*lines, "", note, "", f"![{name}](results/{name}.png)", ""])
    text += after
    (HERE / f"{name}.md").write_text(text)
    print(text)


def environment(run: Run) -> str:
    """The versions behind a result, in one line."""
    names = ("python", "torch", "torchrl", "mujoco")
    return "Versions: " + ", ".join(f"{name} {run.versions[name]}" for name in names) + "."


def curves(
    name: str, runs: Sequence[Run], color: Callable[[Run], str], heading: str, symlog: bool
) -> None:
    """NAME.png: stochastic (solid) and deterministic (dashed) return against real steps."""
    figure, axis = plt.subplots(figsize=(7, 4.2), constrained_layout=True)
    for run in runs:
        steps, shade = run.column("real_steps"), color(run)
        name_of_line = run.label if heading == "label" else f"seed {run.seed}"
        axis.plot(steps, run.column("return_mean"), color=shade, label=name_of_line)
        axis.plot(steps, run.column("return_deterministic"), "--", color=shade, alpha=0.6)
    if symlog:
        axis.set_yscale("symlog", linthresh=0.1)
    axis.set(
        xlabel="real environment steps", ylabel="return (solid stochastic, dashed mean action)"
    )
    handles, names = axis.get_legend_handles_labels()
    unique = dict(zip(names, handles, strict=True))
    axis.legend(unique.values(), unique.keys())
    axis.grid(alpha=0.3)
    figure.savefig(HERE / f"{name}.png", dpi=130)


def labels(folders: Sequence[str]) -> None:
    """Both labels side by side: the clean pendulum with L1 in the loop."""
    runs = sorted(map(load, folders), key=lambda run: (run.label, run.seed))
    rows = []
    for run in runs:
        returns = run.column("return_mean")
        cells = [returns[0], min(returns[-5:]), returns[-1], run.column("return_deterministic")[-1]]
        rates = run.column("l1/switch_rate")
        rows.append([run.label, run.seed, *(f"{c:.3g}" for c in cells), f"{1000 * rates[-1]:.3g}"])
    header = [
        "label",
        "seed",
        "first iteration",
        "worst of the last five",
        "last",
        "last, mean action",
    ]
    colors = {"executed": "tab:blue", "nominal": "tab:red"}
    curves("labels", runs, lambda run: colors[run.label], "label", symlog=True)
    write("labels", [*header, "switches per 1000 steps, last"], rows, environment(runs[0]))


def half_cheetah(folders: Sequence[str]) -> None:
    """The baseline: HalfCheetah without L1."""
    runs = sorted(map(load, folders), key=lambda run: run.seed)
    rows = []
    for run in runs:
        last = [fmean(run.column(c)[-3:]) for c in ("return_mean", "return_deterministic")]
        rows.append([run.seed, *last, *milliseconds(run)])
    columns = list(zip(*rows, strict=True))[1:]
    cells = [[row[0], *rounded(row[1:])] for row in rows]
    cells.append(["mean", *rounded([fmean(column) for column in columns])])
    if len(runs) > 1:
        cells.append(["standard deviation", *rounded([stdev(column) for column in columns])])
    curves("half_cheetah", runs, lambda run: f"C{run.seed}", "seed", symlog=False)
    header = [
        "seed",
        "return, last three iterations",
        "with the mean action",
        "ms per real step",
        "ms per real step, all",
    ]
    note = (
        "Milliseconds per real step count fit, TRPO and collection with its random data; `all` "
        "adds the episodes that only measure returns."
    )
    write("half_cheetah", header, cells, f"{note} {environment(runs[0])}")


def milliseconds(run: Run) -> tuple[float, float]:
    """Milliseconds per real step: fit, TRPO and collection, and with the evaluation."""
    phases = {name for row in run.timing for name in row} - {"iteration"}
    totals = {name: sum(row[name] for row in run.timing) for name in phases}
    everything = sum(totals.values())
    scale = 1000 / run.metrics[-1]["real_steps"]
    return scale * (everything - totals["evaluate"]), scale * everything


def rounded(row: Sequence[float]) -> list[str]:
    """Two returns in full units, two times in hundredths."""
    return [*(f"{value:.0f}" for value in row[:2]), *(f"{value:.2f}" for value in row[2:])]


def robustness(folders: Sequence[str]) -> None:
    """The output of ``torchrl-l1 evaluate``: table, plot and filmstrip."""
    source = Path(folders[0])
    with (source / "summary.csv").open() as handle:
        summary = list(csv.DictReader(handle))
    for kind in ("robustness.png", "filmstrip.png"):
        if (source / kind).exists():
            shutil.copy(source / kind, HERE / kind)
    shutil.copy(source / "evaluation.csv", HERE / "robustness_cells.csv")
    controllers = list(dict.fromkeys(row["l1"] for row in summary))
    keys = list(dict.fromkeys((row["policy"], row["bias"]) for row in summary))
    rows = []
    for policy, bias in keys:
        cells = []
        for controller in controllers:
            key = (policy, bias, controller)
            row = next(r for r in summary if (r["policy"], r["bias"], r["l1"]) == key)
            median, low, high = (float(row[f"return_{k}"]) for k in ("median", "lowest", "highest"))
            cells.append(f"{median:.3g} [{low:.3g}, {high:.3g}]")
        rows.append([policy, bias, *cells])
    names = ["L1 off" if c == "off" else f"L1 `{c}`" for c in controllers]
    seeds, episodes = summary[0]["training_seeds"], summary[0]["episodes_per_seed"]
    note = (
        f"Mean return: median [lowest, highest] of {seeds} training seeds, {episodes} episodes "
        "each. The action bound is 3."
    )
    write("robustness", ["policy", "bias", *names], rows, note, filmstrip_figure(summary))


def filmstrip_figure(summary: Sequence[dict[str, str]]) -> str:
    """The filmstrip with a caption, or nothing where it could not be rendered."""
    if not (HERE / "filmstrip.png").exists():
        return ""
    worst = max((float(row["bias"]) for row in summary), key=abs)
    caption = f"The first training seed's policy (mean action) at a bias of {worst:g}."
    return f"\n![filmstrip](results/filmstrip.png)\n\n*{caption}*\n"


if __name__ == "__main__":
    commands = {"labels": labels, "half_cheetah": half_cheetah, "robustness": robustness}
    if len(sys.argv) < 3 or sys.argv[1] not in commands:
        sys.exit(__doc__)
    commands[sys.argv[1]](sys.argv[2:])
