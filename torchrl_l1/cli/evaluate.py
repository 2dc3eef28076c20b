"""``torchrl-l1 evaluate``: from its options to tables, plots and films."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_l1.cli.robustness import plot_robustness, summarize, table
from torchrl_l1.envs.rendering import (
    RenderingUnavailable,
    animation,
    filmstrip,
    rollout_frames,
)
from torchrl_l1.experiment.evaluate import (
    Condition,
    TrainedRun,
    conditions,
    distinct,
    evaluate,
    load_run,
    make_collection,
)
from torchrl_l1.experiment.l1_options import check_tuning
from torchrl_l1.experiment.recipes import group_setting
from torchrl_l1.experiment.run_directory import write_table
from torchrl_l1.experiment.settings import RunSettings, WandbSettings
from torchrl_l1.experiment.stages import KINDS

_SECONDS_SHOWN = 4.0
_COLUMNS = 10


def write_filmstrip(
    trained: TrainedRun,
    cells: Sequence[Condition],
    seed: int,
    output: Path,
) -> None:
    """Render one deterministic episode per condition into ``filmstrip.png`` and ``.gif``.

    The conditions share their disturbance; rows are named by their controllers, and by their
    stages where there are several. Where no headless OpenGL works, a line says so and nothing is
    written.
    """
    task = trained.algorithm.task
    several = len({cell.stage for cell in cells}) > 1
    steps = min(trained.recipe.horizon or task.horizon, round(_SECONDS_SHOWN / task.dt))
    try:
        rows = {
            _label(cell, several): rollout_frames(task, _poses(trained, cell, steps, seed))
            for cell in cells
        }
    except RenderingUnavailable as error:
        print(f"No filmstrip: {error}")
        return
    strip = filmstrip(rows, output / "filmstrip.png", every=max(1, steps // _COLUMNS), dt=task.dt)
    moving = animation(rows, output / "rollout.gif", dt=task.dt)
    print(f"Filmstrip at bias {cells[0].bias:g}: {strip}, animation: {moving}")


def _label(cell: Condition, several: bool) -> str:
    """A line for each value that is set: a row is not wide."""
    controller = "L1 " + cell.controller.replace(" ", "\n")
    return f"{cell.stage}\n{controller}" if several else controller


def _poses(trained: TrainedRun, cell: Condition, steps: int, seed: int) -> np.ndarray:
    """Simulator positions ``(T, nq)`` of the first environment."""
    poses: list[np.ndarray] = []

    def record(env: EnvBase, _: object) -> None:
        poses.append(env.base_env.simulator_state()[0][0])

    collection = make_collection(trained, cell, 1)
    collection.evaluate(seed, deterministic=True, steps=steps, callback=record)
    return np.stack(poses)


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


def _stages(runs: Sequence[TrainedRun], asked: Sequence[str]) -> list[str]:
    """The stages to evaluate: those asked for, else the last that there is.

    Raises:
        ValueError: for one that a run has not, or if the last is not the same in all runs.
    """
    names = asked or (None,)
    found = [list(dict.fromkeys(map(trained.stage, names))) for trained in runs]
    for trained, stages in zip(runs, found, strict=True):
        if stages != found[0]:
            raise ValueError(
                f"{runs[0].path} has reached the stage {found[0][0]} and {trained.path} "
                f"{stages[0]}; say with --stage which one to evaluate"
            )
    return found[0]


def evaluate_command(options: argparse.Namespace) -> None:
    """``torchrl-l1 evaluate``: table on the screen, CSV, PNG and, if asked, a filmstrip."""
    check_tuning(options.epsilon, options.alpha, prefix="--")
    for name in options.l1:
        group_setting("l1", name)
    for name in options.noise:
        group_setting("noise", name)
    if options.episodes < 1:
        raise ValueError(f"--episodes must be positive, got {options.episodes}")
    runs = [load_run(path) for path in dict.fromkeys(map(Path, options.run_dir))]
    _check_one_study(runs)
    stages = _stages(runs, options.stage)
    every = conditions(
        options.l1,
        options.noise,
        options.bias,
        options.gain,
        options.policy or KINDS,
        options.epsilon,
        options.alpha,
        stages,
    )
    cells = distinct(runs[0], every)
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
        tuning = (options.epsilon, options.alpha)
        kind = ["deterministic"]
        shown = conditions(options.l1, ["none"], [worst], [1.0], kind, *tuning, stages)
        write_filmstrip(runs[0], shown, options.seed, output)
