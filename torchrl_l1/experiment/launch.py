"""Composing a recipe with Hydra, for the command line and for Python."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import hydra
import yaml  # type: ignore[import-untyped]
from hydra.errors import CompactHydraException
from omegaconf import DictConfig, OmegaConf

from torchrl_l1.experiment.errors import USER_ERRORS, message
from torchrl_l1.experiment.recipes import find_recipe, recipes_dir, shared_dir
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.settings import SCHEMAS, register

# The run directory is ours to open, so Hydra must not create or write to it first.
_HYDRA_SETTINGS = [
    "hydra.output_subdir=null",
    "hydra.run.dir=.",
    "hydra.sweep.dir=runs/sweeps/${now:%Y-%m-%d_%H-%M-%S}",
    "hydra.sweep.subdir=.",
    "hydra/job_logging=disabled",
    "hydra/hydra_logging=disabled",
    "hydra.job.config.override_dirname.exclude_keys=[seed,run_dir,resume,wandb.mode]",
]

_FLAGS_WITH_VALUE = (
    *("--cfg", "-c", "--package", "-p", "--info", "-i", "--config-dir", "-cd"),
    *("--config-name", "-cn", "--config-path", "-cp", "--experimental-rerun"),
)


def launch(name: str, arguments: Sequence[str]) -> None:
    """Run a recipe as a Hydra application with overrides and Hydra's own flags, in any order.

    Raises:
        RecipeError: if there is no such recipe.
    """
    recipe = find_recipe(name)
    register()
    flags, overrides = split_flags(arguments)
    before = sys.argv
    sys.argv = ["torchrl-l1", *flags, *_search_path(recipe), *_HYDRA_SETTINGS, *overrides]
    try:
        hydra.main(version_base="1.3", config_path=str(recipe.parent), config_name=recipe.stem)(
            _task
        )()
    finally:
        sys.argv = before


def split_flags(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Hydra's flags, with their values, and the overrides: argparse wants them apart.

    Examples:
        >>> split_flags(["seed=0,1", "-m", "l1=off", "--cfg", "job"])
        (['-m', '--cfg', 'job'], ['seed=0,1', 'l1=off'])
    """
    flags: list[str] = []
    overrides: list[str] = []
    takes_value = False
    for argument in arguments:
        is_flag = argument.startswith("-")
        is_value = takes_value and not is_flag and "=" not in argument
        (flags if is_flag or is_value else overrides).append(argument)
        takes_value = argument in _FLAGS_WITH_VALUE
    return flags, overrides


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
    """Where Hydra looks for groups: beside the recipe, in ``shared`` and with its algorithm."""
    groups = [recipes_dir() / name for name in _algorithms(recipe)]
    folders = [shared_dir(), *(folder for folder in groups if folder != recipe.parent)]
    quoted = ",".join(f"'file://{folder}'" for folder in folders)
    return [f"hydra.searchpath=[{quoted}]"]


def _algorithms(recipe: Path) -> list[str]:
    """Those whose schemas are among a recipe's defaults."""
    try:
        content = OmegaConf.to_container(OmegaConf.load(recipe))
    except (OSError, ValueError, yaml.YAMLError):
        return []  # Hydra says what is wrong with it
    defaults = content.get("defaults") if isinstance(content, dict) else None
    return [name for name in SCHEMAS if f"{name}_recipe" in (defaults or [])]


def _task(config: DictConfig) -> None:
    try:
        run(config)
    except USER_ERRORS as error:
        # Hydra prints such an exception as one line and exits with status 1.
        raise CompactHydraException(f"torchrl-l1 run: {message(error)}") from error
