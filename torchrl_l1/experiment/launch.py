"""Composing a recipe with Hydra, for the command line and for Python."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import hydra
from omegaconf import DictConfig

from torchrl_l1.experiment.recipes import find_recipe, recipes_dir, shared_dir
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.schema import register

# The run directory is ours to open, so Hydra must not create or write to it first.
_HYDRA_SETTINGS = [
    "hydra.output_subdir=null",
    "hydra.run.dir=.",
    "hydra.sweep.dir=.",
    "hydra.sweep.subdir=.",
    "hydra/job_logging=disabled",
    "hydra/hydra_logging=disabled",
    "hydra.job.config.override_dirname.exclude_keys=[seed,run_dir,resume,threads,wandb.mode]",
]


def launch(name: str, overrides: Sequence[str]) -> None:
    """Run a recipe as a Hydra application with the given overrides and Hydra flags.

    Raises:
        RecipeError: if there is no such recipe.
    """
    recipe = find_recipe(name)
    register()
    arguments = sys.argv
    sys.argv = ["torchrl-l1", *_search_path(recipe), *_HYDRA_SETTINGS, *overrides]
    try:
        hydra.main(version_base="1.3", config_path=str(recipe.parent), config_name=recipe.stem)(
            _task
        )()
    finally:
        sys.argv = arguments


def compose(name: str, overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration of a recipe, without running it; ``run_dir`` must be overridden to run.

    Examples:
        >>> compose("metrpo/half_cheetah", ["seed=3", "l1=off"]).l1.enabled
        False
    """
    recipe = find_recipe(name)
    register()
    with hydra.initialize_config_dir(str(recipe.parent), version_base="1.3"):
        return hydra.compose(recipe.stem, [*_search_path(recipe), *overrides])


def _search_path(recipe: Path) -> list[str]:
    folders = [shared_dir()]
    if not recipe.is_relative_to(recipes_dir()):
        # A user's own recipe may build on the shipped groups.
        folders.append(recipes_dir() / "metrpo")
    quoted = ",".join(f"'file://{folder}'" for folder in folders)
    return [f"hydra.searchpath=[{quoted}]"]


def _task(config: DictConfig) -> None:
    run(config)
