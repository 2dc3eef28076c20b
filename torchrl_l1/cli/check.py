"""``torchrl-l1 check``: try a recipe's environment for a minute and say what to fix."""

from __future__ import annotations

import argparse
import shlex
import sys

from omegaconf import OmegaConf

from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.settings import RunSettings, check_known
from torchrl_l1.experiment.trial import STEPS, trial


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``torchrl-l1 check``."""
    add = parser.add_argument
    add("recipe", help="your own YAML file or a shipped recipe")
    add("overrides", nargs="*", metavar="KEY=VALUE", help="as for torchrl-l1 run")
    add("--steps", type=int, default=STEPS, help="number of random steps to try")
    add("--trust", action="store_true", help="let the file configure Hydra itself")


def check_command(options: argparse.Namespace) -> None:
    """``torchrl-l1 check``: a line for each finding; status 1 if there is something to fix."""
    if options.steps < 10:
        raise ValueError(f"--steps must be at least 10, got {options.steps}")
    overrides = [*options.overrides, "run_dir=runs/check", "device=cpu"]
    config = compose(options.recipe, overrides, trusted=options.trust)
    check_known(config)
    recipe = OmegaConf.to_object(config)
    assert isinstance(recipe, RunSettings)
    to_fix = 0
    for finding in trial(recipe, options.steps):
        print(finding, flush=True)
        to_fix += bool(finding.fix)
    if to_fix:
        print(f"{to_fix} thing{'s' * (to_fix > 1)} to fix")
        sys.exit(1)
    print(f"nothing to fix: torchrl-l1 run {shlex.join([options.recipe, *options.overrides])}")
