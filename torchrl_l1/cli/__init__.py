"""The command ``torchrl-l1``: its subcommands, and how their errors are reported."""

from __future__ import annotations

import argparse
import os
import re
import shlex
import sys
from collections.abc import Sequence
from importlib import import_module
from io import TextIOWrapper

from torchrl_l1._version import __version__

DESCRIPTION = "Robust model-based reinforcement learning with L1 adaptive control."

_TRUST = "let the file configure Hydra itself, which may run arbitrary code"


# Negative numbers are values, not options: before 3.14, Python takes -1e-3 and -inf for options.
_NEGATIVE = re.compile(r"-(?:\.?\d|inf\b|nan\b)", re.IGNORECASE)

_LATER = (
    (
        "evaluate",
        "evaluate trained policies with L1 on and off under noise and disturbances",
        "Evaluates the frozen policy and model for every combination of L1 setting, tuning, noise, "
        "disturbance and stochastic or deterministic policy. Several run directories are treated "
        "as seeds of one study.",
    ),
    (
        "new-task",
        "write a recipe for your own environment",
        "Inspects an environment and writes a commented recipe for it.",
    ),
    (
        "check",
        "try a recipe's environment for a minute and say what to fix",
        "Checks specs, seeds, the effect of actions, and the reward and termination functions "
        "against the environment, and fits the model once.",
    ),
    (
        "robustify",
        "put L1 around any policy and test it under disturbances",
        "Collects data with the policy, fits a model, calibrates L1, and tests the policy under "
        "disturbances with L1 off, with L1 on and with an oracle.",
    ),
    (
        "play",
        "show a policy in a window or a film, with L1 off or on",
        "Plays one episode of a run, a robust controller or a policy in its environment.",
    ),
    (
        "export",
        "export policy and L1 as one function of observation and state",
        "Writes a robust controller as TorchScript, ONNX or a torch.export program and compares "
        "it with the original on steps of the environment.",
    ),
    (
        "dataset",
        "record data with a run's policy for offline learning",
        "Records undisturbed episodes without L1 at one of three qualities: random actions, the "
        "policy with noise, or the policy.",
    ),
)


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of the console script. Exits with status 1 if a request is refused."""
    _print_anything()
    arguments = list(sys.argv[1:] if argv is None else argv)
    parser = argparse.ArgumentParser("torchrl-l1", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"torchrl-l1 {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _run_parser(commands)
    _campaign_parser(commands)
    for name, words, description in _LATER:
        parts = commands.add_parser(name, help=words, description=description)
        # Their options need heavy imports, which no other command should wait for.
        if name in arguments[:1]:
            import_module(f"torchrl_l1.cli.{_module(name)}").add_arguments(parts)
    _report_parser(commands)
    verify = commands.add_parser(
        "verify", help="replay recorded traces of a reference controller in float64"
    )
    verify.add_argument("traces", help="an .npz file of recorded traces")
    verify.add_argument("--tolerance", type=float, default=1e-9, help="largest error allowed")
    recipes = commands.add_parser("recipes", help="list or copy the shipped recipes and campaigns")
    recipes.add_argument(
        "--copy",
        nargs="+",
        metavar=("NAME", "FILE"),
        help="copy a recipe or campaign for editing, to NAME.yaml or to FILE",
    )

    for part in commands.choices.values():
        part._negative_number_matcher = _NEGATIVE
    try:
        options, rest = parser.parse_known_args(arguments)
    except SystemExit:
        _flush(" ".join(arguments[:1]))  # the requested help
        raise
    takes_more = options.command in ("campaign", "check")
    overridden = takes_more and not any(o.startswith("-") for o in rest)
    if rest and options.command != "run" and not overridden:
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if options.command == "check":
        # argparse does not assign the overrides that follow an option.
        options.overrides += rest
    # Import only once the arguments are known to be valid: torch takes seconds to load.
    from torchrl_l1.experiment.shutdown import orderly_end

    with orderly_end():
        _dispatch(options, rest)


def _print_anything() -> None:
    """Keep closed streams and characters that the terminal's encoding lacks from ending a command.

    What would go to a stream that a wrapper has closed is dropped. The characters are escaped, as
    Python does on standard error.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def _module(command: str) -> str:
    return command.replace("-", "_")


def _dispatch(options: argparse.Namespace, rest: list[str]) -> None:
    from torchrl_l1.experiment.errors import USER_ERRORS, message

    try:
        if options.command == "run":
            _run(options, rest)
        elif options.command == "campaign":
            from torchrl_l1.campaign.command import campaign_command

            campaign_command(options, rest)
        elif options.command in [name for name, *_ in _LATER]:
            name = _module(options.command)
            getattr(import_module(f"torchrl_l1.cli.{name}"), f"{name}_command")(options)
        elif options.command == "report":
            from torchrl_l1.report.build import report_command

            report_command(options)
        elif options.command == "verify":
            from torchrl_l1.experiment.verify import verify_command

            if not verify_command(options.traces, options.tolerance):
                sys.exit(1)
        else:
            _recipes(options.copy)
    except SystemExit:
        _flush(options.command)
        raise
    except USER_ERRORS as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        _flush(options.command)
        print(f"torchrl-l1 {options.command}: {message(error)}", file=sys.stderr)
        sys.exit(1)
    _flush(options.command)


def _flush(command: str) -> None:
    """Write the remaining output while a failure can still be reported.

    Exits with status 1 on failure.
    """
    try:
        sys.stdout.flush()
    except OSError as error:
        from torchrl_l1.experiment.errors import message

        where = "" if isinstance(error, BrokenPipeError) else "standard output: "
        print(f"torchrl-l1 {command}: {where}{message(error)}", file=sys.stderr)
        # Nothing more can be written there, not even when the interpreter exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _run_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    run = commands.add_parser(
        "run",
        help="run a recipe",
        description="A Hydra application: overrides (seed=3 l1=off noise=action), sweeps (-m) "
        "and Hydra's own flags (--cfg job, --info) work as usual.",
    )
    run.add_argument("recipe", help="such as metrpo/inverted_pendulum, or your own YAML file")
    run.add_argument("--resume", action="store_true", help="continue from the last checkpoint")
    run.add_argument("--trust", action="store_true", help=_TRUST)


def _campaign_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    campaign = commands.add_parser(
        "campaign",
        help="run a matrix of runs and evaluate them",
        usage="torchrl-l1 campaign NAME [options] [KEY=VALUE ...]",
        description="Runs every combination of the recipes, settings and seeds in a campaign file, "
        "each in its own process. Overrides (outer_iterations=2) apply to all runs. Finished runs "
        "are skipped and interrupted ones continue, so the same command can be repeated.",
    )
    add = campaign.add_argument
    add("campaign", metavar="NAME", help="such as table1, or your own YAML file")
    add("--output", help="folder for all runs; runs/campaigns/NAME by default")
    add("--workers", type=int, help="number of parallel runs; the number of cores by default")
    add("--list", action="store_true", help="show the runs and their progress, start nothing")
    add(
        "--reuse",
        nargs="+",
        action="extend",
        default=[],
        metavar="DIR",
        help="copy finished runs with the same settings from these folders and their subfolders",
    )
    add("--trust", action="store_true", help=_TRUST)
    add("--launcher", help="start the runs with one of Hydra's launchers, such as joblib")


def _report_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    report = commands.add_parser(
        "report",
        help="tables and figures of all runs in a folder, beside the paper's",
        description="Writes report.md, CSV tables and PNG figures. Runs are found by their "
        "config.yaml in the folders and their subfolders; the runs are not changed.",
    )
    add = report.add_argument
    add("dir", nargs="+", help="folders of runs, such as runs/campaigns/NAME")
    add("--output", help="folder for the results; DIR/report by default")
    add(
        "--reference-curves",
        metavar="FILE",
        help="the authors' curves, drawn in the background: .csv or .csv.xz",
    )


def _recipes(copy: Sequence[str] | None) -> None:
    from torchrl_l1.experiment.recipes import (
        available_campaigns,
        available_recipes,
        copy_recipe,
    )

    if copy is None:
        print("\n".join([*available_recipes(), "", "Campaigns:", *available_campaigns()]))
        return
    if len(copy) > 2:
        raise ValueError(f"--copy takes a NAME and an optional FILE, got {' '.join(copy)}")
    file = copy_recipe(*copy)
    command = "campaign" if copy[0] in available_campaigns() else "run"
    print(f"{file} is yours: torchrl-l1 {command} {shlex.quote(str(file))}")


def _run(options: argparse.Namespace, overrides: list[str]) -> None:
    from torchrl_l1.experiment.launch import launch

    flags = ["--trust"] if options.trust else []
    launch(options.recipe, overrides + flags + (["resume=true"] if options.resume else []))
