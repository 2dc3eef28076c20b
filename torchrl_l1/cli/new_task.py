"""``torchrl-l1 new-task``: write a recipe for an environment, with the findings as comments."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from torchrl_l1.checks import check_count, check_positive
from torchrl_l1.cli.evaluate import Gathered
from torchrl_l1.envs import AnyTask, ExternalTask, get_task
from torchrl_l1.envs.references import folders_of
from torchrl_l1.experiment.files import write_atomically
from torchrl_l1.experiment.recipes import yaml_word
from torchrl_l1.experiment.trial import describe

ALGORITHMS = ("pets", "dets", "metrpo", "mbmf")

# Settings of a recipe, and the options that stand for them here.
_OPTIONS = {
    "dt=": "--dt SECONDS",
    "horizon=": "--horizon STEPS",
    "observation_keys=": "--observation-keys PART PART",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``torchrl-l1 new-task``."""
    add = parser.add_argument
    add("file", help="the recipe to write, such as my_task.yaml")
    add(
        "--from",
        dest="source",
        required=True,
        metavar="ENV",
        help="gymnasium/ID, PACKAGE:ID, dm_control/DOMAIN/TASK, MODULE:FUNCTION or "
        "FILE.py:FUNCTION",
    )
    add("--algorithm", choices=ALGORITHMS, default=ALGORITHMS[0], help="learning algorithm")
    add("--dt", type=float, help="seconds per step, if the environment does not tell")
    add("--horizon", type=int, help="steps per episode, if the environment does not tell")
    add(
        "--observation-keys",
        nargs="+",
        action=Gathered,
        default=[],
        help="parts that make up the observation",
    )


def new_task_command(options: argparse.Namespace) -> None:
    """``torchrl-l1 new-task``: write the file and print what was found."""
    file = Path(options.file)
    if file.suffix != ".yaml":
        raise ValueError(f"{file} must end in .yaml")
    if file.exists():
        raise ValueError(f"{file} already exists; choose another name")
    if options.dt is not None:
        check_positive("--dt", options.dt)
    if options.horizon is not None:
        check_count("--horizon", options.horizon)
    folders = folders_of([options.source], [file.parent, Path.cwd()])
    try:
        task = get_task(
            options.source,
            dt=options.dt,
            horizon=options.horizon,
            observation_keys=options.observation_keys,
            search_path=folders,
        )
    except ValueError as error:
        here = [option for setting, option in _OPTIONS.items() if setting in str(error)]
        raise ValueError(f"{error}{f'; here {here[0]}' if here else ''}") from error
    for line in describe(task):
        print(line)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(file, recipe_text(options, task))
    print(f"Recipe: {file}\nTry it for a minute: torchrl-l1 check {shlex.quote(str(file))}")


def recipe_text(options: argparse.Namespace, task: AnyTask) -> str:
    """The recipe, with comments."""
    known = not isinstance(task, ExternalTask) or task.outcome is not None
    word = "builtin" if known else "learned"
    note = task.outcome.note if isinstance(task, ExternalTask) and task.outcome is not None else ""
    keys = ", ".join(map(yaml_word, options.observation_keys))
    file = shlex.quote(options.file)
    lines = [
        f"# {options.algorithm.upper()} on {options.source}:",
        *(f"#   {line}" for line in describe(task)),
        f"# Try it with torchrl-l1 check {file}; train with torchrl-l1 run {file}.",
        "defaults:",
        f"  - /{options.algorithm}/any@_global_",
        "  - _self_",
        "",
        f"recipe: {yaml_word(Path(options.file).stem)}",
        f"task: {yaml_word(options.source)}",
        f"dt: {options.dt!r}  # seconds per step" if options.dt else "# dt: the environment tells",
        f"horizon: {options.horizon}  # steps per episode"
        if options.horizon
        else f"# horizon: {task.horizon}  # fewer steps give shorter episodes",
        f"observation_keys: [{keys}]"
        if keys
        else "# observation_keys: [..]  # if the observation comes in parts",
        "",
        "# Reward of imagined steps, and where they end: builtin, learned, or MODULE:FUNCTION or",
        "# FILE.py:FUNCTION written in torch; termination may be none.",
        f"reward: {word}" + (f"  # {note}" if note else ""),
        f"termination: {word}",
        "",
        "# L1 is off; turn it on with l1=robust, which needs no tuning, on the command line.",
        "outer_iterations: 20",
        "",
    ]
    return "\n".join(lines)
