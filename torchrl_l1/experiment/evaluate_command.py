"""``torchrl-l1 evaluate``: from its options to tables, plots and films."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from torchrl_l1.experiment.evaluate import (
    TrainedRun,
    conditions,
    evaluate,
    load_run,
)
from torchrl_l1.experiment.filmstrip import write_filmstrip
from torchrl_l1.experiment.l1_options import check_tuning
from torchrl_l1.experiment.recipes import group_setting
from torchrl_l1.experiment.robustness import plot_robustness, summarize, table
from torchrl_l1.experiment.run_directory import write_table
from torchrl_l1.experiment.settings import RunSettings, WandbSettings


def _check_one_study(runs: Sequence[TrainedRun]) -> None:
    """Runs may differ in their seed and in nothing that matters."""

    def settings(trained: TrainedRun) -> RunSettings:
        return replace(trained.recipe, seed=0, run_dir="", resume=False, wandb=WandbSettings())

    for trained in runs[1:]:
        if settings(trained) != settings(runs[0]):
            raise ValueError(
                f"{runs[0].path} and {trained.path} differ in more than their seed; evaluate them "
                "one at a time"
            )


def evaluate_command(options: argparse.Namespace) -> None:
    """``torchrl-l1 evaluate``: table on the screen, CSV, PNG and, if asked, a filmstrip."""
    tuning = (options.epsilon, options.alpha)
    check_tuning(*tuning, prefix="--")
    for name in options.l1:
        group_setting("l1", name)
    for name in options.noise:
        group_setting("noise", name)
    if options.episodes < 1:
        raise ValueError(f"--episodes must be positive, got {options.episodes}")
    runs = [load_run(path) for path in dict.fromkeys(map(Path, options.run_dir))]
    _check_one_study(runs)
    policies = options.policy or (
        ["stochastic", "deterministic"] if runs[0].algorithm.stochastic else ["stochastic"]
    )
    cells = conditions(options.l1, options.noise, options.bias, options.gain, policies, *tuning)
    output = Path(options.output) if options.output else runs[0].path / "evaluation"
    rows = []
    total = len(runs) * len(cells)
    with tqdm(total=total, desc="evaluate", unit="cell", disable=None) as progress:
        for trained in runs:
            for row in evaluate(trained, cells, options.episodes, options.seed):
                rows.append(row)
                progress.update()

    output.mkdir(parents=True, exist_ok=True)
    summary = summarize(rows)
    print(table(summary))
    write_table(output / "evaluation.csv", rows)
    write_table(output / "summary.csv", summary)
    plot_robustness(summary, output / "robustness.png", title=runs[0].recipe.recipe)
    print(f"Table: {output / 'evaluation.csv'}, {output / 'summary.csv'}")
    print(f"Plot: {output / 'robustness.png'}")
    if options.filmstrip:
        worst = max(options.bias, key=abs)
        shown = conditions(options.l1, ["none"], [worst], [1.0], ["deterministic"], *tuning)
        write_filmstrip(runs[0], shown, options.seed, output)
