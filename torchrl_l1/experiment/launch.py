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
from torchrl_l1.experiment.recipes import (
    available_recipes,
    find_recipe,
    recipes_dir,
    shared_dir,
)
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


_SCHEMA_NAMES = {f"{name}_recipe": name for name in SCHEMAS}


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
    """Where Hydra looks beside the recipe: with its algorithm, in ``shared``, and from the root."""
    folders = [shared_dir(), *_folders(recipe), recipes_dir()]
    unique = dict.fromkeys(folder for folder in folders if folder != recipe.parent)
    quoted = ",".join(f"'file://{folder}'" for folder in unique)
    return [f"hydra.searchpath=[{quoted}]"]


def _folders(recipe: Path) -> list[Path]:
    """Those with the groups of a recipe: of the algorithms whose schemas it names or includes."""
    found = []
    for name in _included(recipe):
        if name in _SCHEMA_NAMES:
            found.append(recipes_dir() / _SCHEMA_NAMES[name])
        elif name in available_recipes():
            shipped = find_recipe(name)
            found += [shipped.parent, *_folders(shipped)]
    return found


def _included(recipe: Path) -> list[str]:
    """What the defaults of a recipe include, as ``pets_recipe`` and ``pets/half_cheetah``."""
    try:
        content = OmegaConf.to_container(OmegaConf.load(recipe))
    except (OSError, ValueError, yaml.YAMLError):
        return []  # Hydra says what is wrong with it
    defaults = content.get("defaults") if isinstance(content, dict) else None
    names = [entry for entry in defaults or [] if isinstance(entry, str)]
    return [name.partition("@")[0].removeprefix("/") for name in names]


def _task(config: DictConfig) -> None:
    try:
        run(config)
    except USER_ERRORS as error:
        # Hydra prints such an exception as one line and exits with status 1.
        raise CompactHydraException(f"torchrl-l1 run: {message(error)}") from error
