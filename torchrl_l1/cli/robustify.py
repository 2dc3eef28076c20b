"""``torchrl-l1 robustify``: from a policy's file to a table, a chart and a robust controller."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import wandb

from torchrl_l1.checks import check_count
from torchrl_l1.cli.evaluate import Gathered
from torchrl_l1.deployment import Assessment, RobustController, robustify
from torchrl_l1.deployment.controller_folder import FILE, check_replaces
from torchrl_l1.deployment.policies import FORMS
from torchrl_l1.deployment.robust_controller import PRESETS
from torchrl_l1.envs import DISTURBANCES, SUITES, environment_source
from torchrl_l1.experiment.checkpoints import kept_by
from torchrl_l1.experiment.errors import message
from torchrl_l1.experiment.evaluate import load_run
from torchrl_l1.experiment.files import bounded, make_folder, write_atomically, write_table
from torchrl_l1.experiment.matrix import check_disturbance
from torchrl_l1.experiment.tracking import (
    MODES,
    Evaluated,
    check_wandb_mode,
    chosen_mode,
    log_evaluation,
    own_run,
)
from torchrl_l1.experiment.wandb_files import known_id

_PROJECT = "torchrl_l1"

_RESULTS = ("evaluation.csv", "episodes.csv", "evaluation.png", "README.md")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``torchrl-l1 robustify``."""
    add = parser.add_argument
    add(
        "env",
        help="gymnasium/ID, PACKAGE:ID, a built-in task, dm_control/DOMAIN/TASK, or "
        "MODULE:FUNCTION or FILE.py:FUNCTION that returns a TorchRL environment",
    )
    add(
        "--policy",
        required=True,
        help=FORMS,
    )
    add(
        "--normalization",
        metavar="FILE",
        help="statistics of VecNormalize for sb3:FILE.zip, or none; the file is a pickle, and "
        "loading it executes its contents",
    )
    add("--weights", metavar="FILE", help="a state dict to load into the policy's module")
    add("--steps", type=int, default=20_000, help="number of environment steps to collect")
    add("--preset", choices=PRESETS, default=PRESETS[0], help="L1 preset used by default")
    add("--dt", type=float, help="seconds per step; the environment's own by default")
    add("--epsilon", type=float, help="tolerance of the paper's switching law, in state units")
    add(
        "--noise",
        type=float,
        default=0.3,
        help="exploration noise, as a fraction of half the action range",
    )
    group = parser.add_argument_group(
        "disturbances", "Varied one at a time, or by a suite; a few biases if none are given."
    )
    group.add_argument("--suite", choices=SUITES, help="all disturbances, each at a few values")
    for name, entry in DISTURBANCES.items():
        group.add_argument(
            f"--{name}", nargs="+", action=Gathered, type=float, default=[], help=entry.help
        )
    add("--episodes", type=int, default=10, help="episodes per cell")
    add(
        "--most-steps",
        type=int,
        default=1000,
        help="number of steps after which an episode is cut off",
    )
    add("--seed", type=int, default=0, help="seed of data, weights and resets")
    add("--output", help="folder for the results; runs/robustify/ENV by default")
    add("--wandb", choices=MODES, default="disabled", help="mode of Weights & Biases")


def robustify_command(options: argparse.Namespace) -> None:
    """``torchrl-l1 robustify``: print a table; write CSV, PNG, Markdown and the controller."""
    disturbances: Any = {
        name: values for name in DISTURBANCES if (values := getattr(options, name))
    }
    if options.suite and disturbances:
        raise ValueError(f"give --suite or --{next(iter(disturbances))}, not both")
    disturbances = options.suite or disturbances
    check_wandb_mode(options.wandb)
    _check_disturbances(options.env, {} if options.suite else disturbances or {})
    check_count("episodes", options.episodes)
    check_count("most_steps", options.most_steps)
    output = Path(options.output or Path("runs/robustify", _folder(options.env)))
    if output.exists() and not output.is_dir():
        raise ValueError(f"{output} is a file; choose another --output")
    made_of = (options.env, options.policy, options.normalization, options.weights)
    controller = output / "controller"
    check_replaces(controller, *made_of)
    _check_results(output)
    fresh = [folder for folder in (controller, *controller.parents) if not folder.exists()]
    make_folder(output)
    make_folder(controller)
    try:
        robust = robustify(
            options.env,
            options.policy,
            options.steps,
            preset=options.preset,
            dt=options.dt,
            epsilon=options.epsilon,
            normalization=options.normalization,
            weights=options.weights,
            noise=options.noise,
            seed=options.seed,
        )
    except BaseException:
        with suppress(OSError):  # another process may have begun to write there
            for folder in fresh:
                folder.rmdir()
        raise
    # At once, so that an interrupted test does not cost the controller.
    folder = robust.save(controller)
    table = robust.evaluate(
        disturbances or _some_biases(robust),
        episodes=options.episodes,
        most_steps=options.most_steps,
        seed=options.seed,
    )
    # Before anything is printed: the reader of the output may have exited long ago.
    write_table(output / "evaluation.csv", table.rows)
    write_table(output / "episodes.csv", table.episodes)
    print(f"\n{table.words}\n\n{table}\n")
    chart = table.plot(output / "evaluation.png")
    usage = usage_lines(folder)
    write_atomically(output / "README.md", page(options, robust, table, usage))
    print(f"Table: {output / 'evaluation.csv'}, {output / 'episodes.csv'}")
    print(f"Chart: {chart}\nPage: {output / 'README.md'}\nController: {folder}\n")
    print(f"To use it:\n\n{usage}")
    if options.wandb != "disabled":
        try:
            _log(options, table, chart, output)
        except Exception as error:  # those of a W&B process that has died have no common class
            print(f"W&B: {message(error)}; all other results are written", file=sys.stderr)


def _check_results(output: Path) -> None:
    """Refuse a folder that has files named like the results but no controller."""
    for name in _RESULTS:
        if (output / name).exists() and not (output / "controller" / FILE).exists():
            raise ValueError(f"{output / name} already exists: give another --output")


def _check_disturbances(env: str, disturbances: Mapping[str, Sequence[float]]) -> None:
    """Refuse what cannot be tested, before data are collected and a model is fitted."""
    for name, values in disturbances.items():
        for value in values:
            check_disturbance(name, value, prefix="--")
    plant = {n: v[0] for n, v in disturbances.items() if DISTURBANCES[n].of_plant}
    if plant:
        environment_source(env).several(1, plant).close()


def _folder(env: str) -> str:
    return bounded("".join(c if c.isalnum() or c in "._-" else "_" for c in env))


def _some_biases(robust: RobustController) -> dict[str, list[float]]:
    """A sixth, a third and a half of half the action range."""
    half = robust.config.half_range
    half = max(half) if isinstance(half, tuple) else half
    return {"bias": [round(half * share, 3) for share in (1 / 6, 1 / 3, 1 / 2)]}


def usage_lines(folder: Path) -> str:
    """The five lines of Python that load a controller and use it."""
    return (
        "from torchrl_l1.deployment import RobustController\n"
        f"robust = RobustController.load({str(folder)!r})\n"
        "env = robust.wrap(robust.source.one())\n"
        "data = env.rollout(1000, robust.policy)\n"
        'data["next", "l1", "u_exec"]  # what L1 sends to the actuators\n'
    )


def page(
    options: argparse.Namespace, robust: RobustController, table: Assessment, usage: str
) -> str:
    """The page of the results, Markdown."""
    settings = "\n".join(f"- `{name}`: `{config}`" for name, config in robust.configs.items())
    return (
        f"# {options.env} with L1\n\n"
        f"Policy `{options.policy}`, {options.steps} steps of data, seed {options.seed}.\n\n"
        f"{table.words}\n\n{table}\n\n![Returns](evaluation.png)\n\n"
        f"## Model\n\n```text\n{robust.model.quality}\n```\n\n"
        f"## Settings of L1\n\n{settings}\n\nThe default is `{robust.preset}`.\n\n"
        f"## Use\n\n```python\n{usage}```\n"
    )


def _log(options: argparse.Namespace, table: Assessment, chart: Path, output: Path) -> None:
    """Log to the W&B run of the training that made the policy, or else to a new run."""
    policy = Path(options.policy)
    if known_id(kept_by(policy) or policy):
        trained = load_run(policy)
        here = replace(trained.recipe.wandb, mode=options.wandb)
        evaluated = Evaluated(f"robustify/{_folder(options.env)}", list(table), [chart])
        log_evaluation(replace(trained.recipe, wandb=here), trained.path, evaluated)
        return
    config = {name: value for name, value in vars(options).items() if name != "command"}
    with wandb.init(
        mode=chosen_mode(options.wandb),  # type: ignore[arg-type]
        project=_PROJECT,
        config=config,
        dir=str(output),
        name=f"robustify {options.env}",
        settings=own_run(),
    ) as run:
        columns: list[str | int] = list(dict.fromkeys(key for row in table for key in row))
        rows = [[row.get(str(key)) for key in columns] for row in table]
        run.log({"evaluation": wandb.Table(columns, rows), "chart": wandb.Image(str(chart))})
