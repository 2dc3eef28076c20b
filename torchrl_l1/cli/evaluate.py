"""``torchrl-l1 evaluate``: from options to tables, plots and films."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_l1.envs import DISTURBANCES, Task
from torchrl_l1.envs.rendering import (
    RenderingUnavailable,
    animation,
    filmstrip,
    rollout_frames,
)
from torchrl_l1.experiment.evaluate import (
    TrainedRun,
    check_controllers,
    check_plants,
    distinct,
    evaluate_episodes,
    load_run,
    make_collection,
    reachable,
)
from torchrl_l1.experiment.files import make_folder, refuse_link, write_table
from torchrl_l1.experiment.l1_options import check_tested
from torchrl_l1.experiment.matrix import (
    SUITE_L1,
    SUITES,
    Condition,
    axes,
    check_suite,
    check_values,
    conditions,
)
from torchrl_l1.experiment.provenance import same_code_in
from torchrl_l1.experiment.recipes import group_setting
from torchrl_l1.experiment.settings import VOLATILE_KEYS
from torchrl_l1.experiment.tracking import Evaluated, log_evaluation
from torchrl_l1.report.evaluation_figures import RANGES, plot_disturbances
from torchrl_l1.report.evaluation_summary import summarize, summary_tables
from torchrl_l1.report.recovery import MEDIANS, SHARES, is_about_robustness, plot_heat_map

_SECONDS_SHOWN = 4.0
_COLUMNS = 10


# Files that an evaluation may write beside its tables.
_PICTURES = ("robustness.png", "returns.png", "recovered.png", "filmstrip.png", "rollout.gif")


class _Given(list[Any]):
    """Values given by the user, as opposed to defaults."""


class Gathered(argparse.Action):
    """Values of an option that may be repeated: later values are added to earlier ones."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Add values to those given before."""
        before = getattr(namespace, self.dest)
        given = before if isinstance(before, _Given) else []
        setattr(namespace, self.dest, _Given([*given, *values]))


class _Suite(argparse.Action):
    """The name of a suite, which brings its own controllers if none are given."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        if namespace.l1 is parser.get_default("l1"):
            namespace.l1 = list(SUITE_L1)
        setattr(namespace, self.dest, values)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``torchrl-l1 evaluate``: one for each thing that it varies, and its own."""
    add = parser.add_argument
    add(
        "run_dir",
        nargs="+",
        help="one or more run directories or kept checkpoints, such as RUN_DIR/checkpoints/best.pt",
    )
    group = parser.add_argument_group("disturbances", "Varied one at a time, or by a suite.")
    group.add_argument(
        "--suite",
        choices=SUITES,
        action=_Suite,
        help="all disturbances, each at a few values, instead of the options below; --l1 then "
        f"defaults to {' '.join(SUITE_L1)}",
    )
    for axis in axes():
        where = group if axis.name in DISTURBANCES else parser
        where.add_argument(
            f"--{axis.name}",
            nargs="+",
            action=Gathered,
            type=axis.kind,
            default=list(axis.values),
            choices=axis.choices or None,
            help=axis.help,
        )
    add("--episodes", type=int, default=25, help="episodes per cell and run")
    add("--seed", type=int, default=0, help="seed of resets, noise and sampled actions")
    add("--output", help="folder for the results; RUN_DIR/evaluation by default")
    add(
        "--filmstrip",
        action="store_true",
        help="also render L1 off and on at the worst value of the varied disturbance",
    )


def write_filmstrip(
    trained: TrainedRun,
    cells: Sequence[Condition],
    disturbance: str,
    seed: int,
    output: Path,
) -> list[Path]:
    """Render one deterministic episode per condition into ``filmstrip.png`` and ``.gif``.

    The conditions share the disturbance of that name; rows are named after their controllers, and
    after their stages if there are several. Without working headless OpenGL, a line says so and
    nothing is written.

    Returns:
        the files written.
    """
    task = trained.algorithm.task
    if not isinstance(task, Task):
        print(
            f"No filmstrip: poses are drawn for built-in tasks only, not for {task.name}; use "
            f"torchrl-l1 play {trained.path} --output film.gif to see an episode"
        )
        return []
    several = len({cell.stage for cell in cells}) > 1
    steps = min(trained.algorithm.horizon, round(_SECONDS_SHOWN / task.dt))
    try:
        rows = {
            _label(cell, several): rollout_frames(task, _poses(trained, cell, steps, seed))
            for cell in cells
        }
    except RenderingUnavailable as error:
        print(f"No filmstrip: {error}")
        return []
    strip = filmstrip(rows, output / "filmstrip.png", every=max(1, steps // _COLUMNS), dt=task.dt)
    moving = animation(rows, output / "rollout.gif", dt=task.dt)
    value = cells[0].disturbances[disturbance]
    print(f"Filmstrip at {disturbance} {value:g}: {strip}, animation: {moving}")
    return [strip, moving]


def _label(cell: Condition, several: bool) -> str:
    """One line for each value that is set, because rows are narrow."""
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
    """Refuse runs that differ in more than their seed."""

    def settings(trained: TrainedRun) -> dict[str, Any]:
        told = vars(trained.recipe).items()
        return {key: value for key, value in told if key not in (*VOLATILE_KEYS, "seed")}

    for number, trained in enumerate(runs):
        for other in runs[:number]:
            if other.path.resolve() == trained.path.resolve():
                raise ValueError(
                    f"{other.name} and {trained.name} are of one run, not of two seeds; evaluate "
                    "them one at a time"
                )
    for trained in runs[1:]:
        if not same_code_in(vars(runs[0].recipe), vars(trained.recipe)):
            raise ValueError(
                f"{runs[0].path} and {trained.path} name files that are not the same (search_path);"
                " evaluate them one at a time"
            )
        if settings(trained) != settings(runs[0]):
            raise ValueError(
                f"{runs[0].path} and {trained.path} differ in more than their seed; evaluate them "
                "one at a time"
            )
    seeds: dict[int, TrainedRun] = {}
    for trained in runs:
        other = seeds.setdefault(trained.recipe.seed, trained)
        if other is not trained:  # a copy would count twice and make intervals too narrow
            raise ValueError(
                f"{other.name} and {trained.name} are both of seed {trained.recipe.seed}, so they "
                "are one training, not two; leave one of them out"
            )


def _stages(runs: Sequence[TrainedRun], asked: Sequence[str]) -> list[str]:
    """The stages to evaluate: those requested, otherwise the last one reached.

    A best checkpoint may be of any iteration.

    Raises:
        ValueError: for a stage that a run does not have, or if none is requested and the runs have
            not progressed equally far.
    """
    names = asked or (None,)
    found = [list(dict.fromkeys(map(trained.stage, names))) for trained in runs]
    for trained, stages in zip(runs, found, strict=True):
        if stages != found[0]:
            raise ValueError(
                f"{runs[0].path} has reached the stage {found[0][0]} and {trained.path} "
                f"{stages[0]}; choose with --stage which one to evaluate"
            )
    if not asked and any(trained.checkpoint != "best" for trained in runs):
        for trained in runs:
            if trained.algorithm.iteration != runs[0].algorithm.iteration:
                raise ValueError(
                    f"{runs[0].name} is of {runs[0].algorithm.iteration} iterations and "
                    f"{trained.name} of {trained.algorithm.iteration}; train both equally far, "
                    "or evaluate them one at a time"
                )
    return found[0]


def _worst(values: Mapping[str, Sequence[float]]) -> tuple[str, float]:
    """The first varied disturbance (or else simply the first) at its strongest value."""
    worst = [
        (name, max(values[name], key=lambda value: abs(value - entry.neutral)))
        for name, entry in DISTURBANCES.items()
    ]
    varied = [(name, value) for name, value in worst if value != DISTURBANCES[name].neutral]
    return (varied or worst)[0]


def _plots(summary: Sequence[Mapping[str, Any]], run: TrainedRun, output: Path) -> list[Path]:
    """Draw returns against magnitudes and, where more informative, heat maps."""
    heading, facts = run.recipe.recipe, run.algorithm.facts
    robust = is_about_robustness(summary)
    lines = output / "robustness.png"
    drawn = [plot_disturbances(summary, heading, lines, facts, (RANGES,), always=not robust)]
    for shown, name in ((MEDIANS, "returns"), (SHARES, "recovered")) if robust else ():
        drawn.append(plot_heat_map(summary, shown, heading, output / f"{name}.png", facts))
    return [file for file in drawn if file is not None]


def _check_results(output: Path) -> None:
    """Refuse a folder that has files named like the results but no evaluation."""
    for name in ("episodes.csv", "summary.csv", *_PICTURES):
        if (output / name).exists() and not (output / "evaluation.csv").exists():
            raise ValueError(
                f"{output / name} already exists, and is of no evaluation: give another --output"
            )


def evaluate_command(options: argparse.Namespace) -> None:
    """``torchrl-l1 evaluate``: print a table and write CSV, PNG and, on request, a filmstrip."""
    values = {axis.name: getattr(options, axis.name) for axis in axes()}
    check_values(values, prefix="--")
    check_suite(options.suite, values, prefix="--")
    check_tested(values["l1"])
    for name in values["noise"]:
        group_setting("noise", name)
    if options.filmstrip and options.suite:
        raise ValueError("--filmstrip shows one disturbance; name it instead of giving --suite")
    if options.episodes < 1:
        raise ValueError(f"--episodes must be positive, got {options.episodes}")
    runs = [load_run(path) for path in dict.fromkeys(map(Path, options.run_dir))]
    _check_one_study(runs)
    values["stage"] = _stages(runs, options.stage)
    cells = distinct(runs[0], conditions(options.suite, **values))
    if options.suite:  # whose disturbances cannot be left out by hand
        cells = reachable(runs[0], cells)
    check_plants(runs[0].algorithm.task, cells)
    check_controllers(runs[0].recipe.l1, runs[0].algorithm.task, cells)
    # A kept checkpoint has its own folder: its results are not the run's.
    folder = "_".join(filter(None, ["evaluation", runs[0].checkpoint]))
    output = Path(options.output) if options.output else runs[0].path / folder
    if not options.output:
        refuse_link(output)
    _check_results(output)
    make_folder(output)
    rows, episodes = [], []
    total = len(runs) * len(cells)
    with tqdm(total=total, desc="evaluate", unit="cell", disable=None) as progress:
        for trained in runs:
            for row, single in evaluate_episodes(trained, cells, options.episodes, options.seed):
                rows.append(row)
                episodes += single
                progress.update()

    summary = summarize(rows, episodes)
    for name in _PICTURES:  # those of an earlier evaluation do not match these tables
        (output / name).unlink(missing_ok=True)
    # Before anything is printed: the reader of the output may have exited long ago.
    tables = {"evaluation": rows, "episodes": episodes, "summary": summary}
    for name, table in tables.items():
        write_table(output / f"{name}.csv", table)
    print(f"\n{runs[0].recipe.task}: {summary_tables(summary)}\n")
    plots = _plots(summary, runs[0], output)
    print(f"Table: {', '.join(str(output / f'{name}.csv') for name in tables)}")
    print(f"Plot: {', '.join(map(str, plots))}")
    pictures = plots
    if options.filmstrip:
        shown: dict[str, Any] = {name: [entry.neutral] for name, entry in DISTURBANCES.items()}
        name, worst = _worst(values)
        shown |= {name: [worst], "noise": ["none"], "policy": ["deterministic"]}
        # Without the undisturbed cell, whose rows would have the same names.
        cells = [
            cell for cell in conditions(**{**values, **shown}) if cell.disturbances[name] == worst
        ]
        pictures = plots + write_filmstrip(runs[0], cells, name, options.seed, output)
    for trained in runs:
        own = [row for row in rows if row["run"] == trained.name]
        log_evaluation(trained.recipe, trained.path, Evaluated(folder, own, pictures))
