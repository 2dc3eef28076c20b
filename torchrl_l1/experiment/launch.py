"""Composing a recipe with Hydra, for the command line and for Python."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import fields
from pathlib import Path
from typing import IO, Any, cast

import hydra
import yaml  # type: ignore[import-untyped]
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep
from hydra.errors import CompactHydraException, HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from torchrl_l1.envs.references import folders_of
from torchrl_l1.experiment.errors import USER_ERRORS, RecipeError, message
from torchrl_l1.experiment.files import bounded, problem, yaml_text
from torchrl_l1.experiment.recipes import (
    available_recipes,
    find_recipe,
    recipes_dir,
    shared_dir,
)
from torchrl_l1.experiment.run import final_return, run
from torchrl_l1.experiment.settings import (
    NAMING_KEYS,
    SCHEMAS,
    WandbSettings,
    check_known,
    flatten,
    register,
)

# Settings that do not distinguish results, or that appear in names in another way.
_IN_NO_NAME = (
    *("seed", "run_dir", "resume", "recipe", "loggers", "checkpoint.every", "checkpoint.best"),
    "search_path",
    *(f"wandb.{part.name}" for part in fields(WandbSettings)),
)

# The run opens its directory itself, so Hydra must not create or write to it first.
_HYDRA_SETTINGS = [
    "hydra.output_subdir=null",
    "hydra.run.dir=.",
    "hydra.sweep.dir=runs/sweeps/${now:%Y-%m-%d_%H-%M-%S}",
    "hydra.sweep.subdir=.",
    "hydra/job_logging=disabled",
    "hydra/hydra_logging=disabled",
    # The project stays in the name, so that directories of older runs are found again.
    "hydra.job.config.override_dirname.exclude_keys="
    f"[{','.join(key for key in _IN_NO_NAME if key != 'wandb.project')}]",
]

_FLAGS_WITH_VALUE = (
    *("--cfg", "-c", "--package", "-p", "--info", "-i", "--config-dir", "-cd"),
    *("--config-name", "-cn", "--config-path", "-cp", "--experimental-rerun"),
)


# With these, users compose the configuration in their own way.
_OWN_WAYS = (
    *("--config-dir", "-cd", "--config-name", "-cn", "--config-path", "-cp", "--help", "-h"),
    *("--experimental-rerun", "--hydra-help", "--shell-completion", "-sc"),
)

# What Hydra itself sets: the name of the recipe and the overrides.
_HYDRAS_OWN = ("job.config_name", "job.name", "job.override_dirname", "overrides", "runtime")

_SCHEMA_NAMES = {f"{name}_recipe": name for name in SCHEMAS}


def launch(name: str, arguments: Sequence[str]) -> None:
    """Run a recipe as a Hydra application with overrides and Hydra's own flags, in any order.

    The flag ``--trust`` lets a user's recipe configure Hydra itself, see :func:`check_data`.

    Raises:
        RecipeError: if there is no such recipe, it does not compose, or nothing would run.
    """
    recipe = find_recipe(name)
    register()
    flags, overrides = split_flags([text for text in arguments if text != "--trust"])
    if not any(flag.partition("=")[0] in _OWN_WAYS for flag in flags):
        sweeps = "-m" in flags or "--multirun" in flags
        overrides = _spelled_out(recipe, overrides) if sweeps else overrides
        config = _check(recipe, overrides, sweeps, "--trust" in arguments)
        overrides += _search_path_override(recipe, config, overrides)
    before = sys.argv
    settings = [*_search_path(recipe), *_HYDRA_SETTINGS]
    sys.argv = ["torchrl-l1", *flags, *settings, *overrides, *_name(recipe, overrides)]
    try:
        with redirect_stderr(cast(IO[str], _WithoutOverrides())):
            hydra.main(version_base="1.3", config_path=str(recipe.parent), config_name=recipe.stem)(
                _task
            )()
    finally:
        sys.argv = before


class _WithoutOverrides:
    """Standard error without the overrides and advice that Hydra adds to an error message."""

    _LEFT_OUT = ("Error executing job with overrides", "\nSet the environment variable HYDRA_FULL")

    def __init__(self) -> None:
        self._stream = sys.stderr

    def write(self, text: str) -> int:
        return len(text) if text.startswith(self._LEFT_OUT) else self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _check(recipe: Path, overrides: Sequence[str], sweeps: bool, trusted: bool) -> DictConfig:
    """Compose the first run, and refuse what Hydra would report at length, or not at all."""
    if not trusted:
        check_data(recipe)
    settings = [*_search_path(recipe), *_HYDRA_SETTINGS]
    _check_options(recipe, overrides)
    try:
        with _composing(recipe.parent):
            first = _first(overrides) if sweeps else list(overrides)
            config = _composed(recipe.stem, [*settings, *first, *_name(recipe, overrides)])
        if not trusted and not recipe.is_relative_to(recipes_dir()):
            of_hydra = [
                text for text in first if text.lstrip("+~").startswith(("hydra.", "hydra/"))
            ]
            with _composing(recipes_dir()):
                bare = _composed(None, [*settings, *of_hydra])
            _check_hydra(recipe, config, bare)
    except HydraException as error:
        with suppress(HydraException), _composing(recipe.parent):
            # Without a schema, every override fails: report the missing schema instead.
            check_known(_composed(recipe.stem, settings))
        raise RecipeError(message(error)) from error
    except (yaml.YAMLError, RecursionError, OverflowError, TypeError) as error:
        raise RecipeError(f"{recipe}, or what it includes: {problem(error)}") from error
    check_known(config)
    for text in overrides:
        if "interval(" in text and config.hydra.sweeper._target_.endswith(".BasicSweeper"):
            raise RecipeError(
                f"{text}: an interval needs a sweeper such as hydra/sweeper=optuna; give values, "
                "or that sweeper"
            )
    return config


@contextmanager
def _composing(folder: Path) -> Iterator[None]:
    with hydra.initialize_config_dir(str(folder), version_base="1.3"):
        yield


def _composed(name: str | None, overrides: list[str]) -> DictConfig:
    application = GlobalHydra.instance().hydra
    assert application is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Hydra repeats it when it runs
        return application.compose_config(name, overrides, run_mode=RunMode.RUN, from_shell=False)


def _spelled_out(recipe: Path, overrides: Sequence[str]) -> list[str]:
    """Overrides with globs expanded: Hydra itself only knows options beside the recipe."""
    folders = _group_folders(recipe)
    found = []
    for text in overrides:
        key, _, value = text.partition("=")
        if value.startswith("glob("):
            try:
                pattern: Any = OverridesParser.create().parse_overrides([text])[0].value()
            except HydraException as error:
                raise RecipeError(message(error)) from error
            files = (file for folder in folders for file in (folder / key).glob("*.yaml"))
            options = pattern.filter(sorted({file.stem for file in files}))
            if not options:
                raise RecipeError(f"{text} matches nothing, so there is nothing to run")
            text = f"{key}={','.join(options)}"
        found.append(text)
    return found


def _first(overrides: Sequence[str]) -> list[str]:
    """The overrides of the first run of a sweep."""
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    found = []
    for text, override in zip(overrides, parser.parse_overrides(list(overrides)), strict=True):
        if override.is_sweep_override():
            interval = override.value()
            # A sweeper chooses from an interval; its start will do here.
            if isinstance(interval, IntervalSweep):
                values = [str(interval.start)]
            else:
                values = list(override.sweep_string_iterator())
            if not values:
                raise RecipeError(f"{text} matches nothing, so there is nothing to run")
            text = f"{override.get_key_element()}={values[0]}"
        found.append(text)
    return found


def check_data(recipe: Path) -> None:
    """Make sure that a recipe is data: it may not configure Hydra, which could run code.

    Args:
        recipe: a YAML file.

    Raises:
        RecipeError: if it is not YAML or has a section ``hydra``.
    """
    try:
        content = yaml.load(yaml_text(recipe), yaml.BaseLoader)
    except (yaml.YAMLError, RecursionError) as error:
        raise RecipeError(f"{recipe} is not valid YAML: {problem(error)}") from error
    except (OSError, ValueError, TypeError) as error:
        raise RecipeError(f"{recipe} cannot be read: {message(error)}") from error
    if not isinstance(content, dict):
        raise RecipeError(f"{recipe} is not a mapping of keys to values")
    defaults = content.get("defaults")
    named = [str(one) for one in defaults] if isinstance(defaults, list) else []
    if any(str(key).startswith("hydra") for key in content) or any(
        "hydra/" in text or "@hydra" in text for text in named
    ):
        raise _no_data(recipe, "has a section hydra")
    _check_defaults(recipe, defaults)


def _check_defaults(recipe: Path, texts: Any) -> None:
    """Refuse an option whose name YAML reads as true or false, such as ``off`` of L1."""
    try:
        content = yaml.safe_load(yaml_text(recipe))
    except yaml.YAMLError:
        return  # Hydra reports what is wrong with it
    entries = content.get("defaults")
    if not (isinstance(entries, list) and isinstance(texts, list)):
        return
    for entry, text in zip(entries, texts, strict=False):
        if not (isinstance(entry, dict) and isinstance(text, dict)):
            continue
        for value, (key, word) in zip(entry.values(), text.items(), strict=False):
            if isinstance(value, bool):
                raise RecipeError(
                    f"{recipe}: defaults: {key}: {word} means {str(value).lower()} in YAML; write "
                    f"{key}: '{word}'"
                )


def _check_hydra(recipe: Path, config: DictConfig, bare: DictConfig) -> None:
    """Compare Hydra's own settings with those without the recipe."""
    own, other = (flatten(OmegaConf.to_container(part.hydra)) for part in (config, bare))
    for key in sorted(own.keys() | other.keys()):
        known = any(key == name or key.startswith(f"{name}.") for name in _HYDRAS_OWN)
        if not known and own.get(key) != other.get(key):
            raise _no_data(recipe, f"includes something that sets hydra.{key}")


def _no_data(recipe: Path, what: str) -> RecipeError:
    return RecipeError(
        f"{recipe} {what}, which may run arbitrary code; leave that out, or give --trust if the "
        "file is yours"
    )


def split_flags(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Hydra's flags with their values, and the overrides: argparse needs them separated.

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


def compose(name: str, overrides: Sequence[str] = (), *, trusted: bool = False) -> DictConfig:
    """The configuration of a recipe, without running it; ``run_dir`` must be overridden to run.

    Raises:
        RecipeError: if there is no such recipe, or it is not plain data and not ``trusted``.

    Examples:
        >>> compose("metrpo/half_cheetah", ["seed=3", "l1=off"]).l1.enabled
        False
    """
    recipe = find_recipe(name)
    register()
    if not trusted:
        check_data(recipe)
    _check_options(recipe, overrides)
    with _composing(recipe.parent):
        own = [*overrides, *_name(recipe, overrides)]
        config = hydra.compose(recipe.stem, [*_search_path(recipe), *own])
    if "search_path" in config and not config.search_path:
        config.search_path = _folders_of_code(recipe, config, overrides)
    return config


def _name(recipe: Path, overrides: Sequence[str]) -> list[str]:
    """An override that names a user's recipe after its file, if it has no name of its own."""
    if recipe.is_relative_to(recipes_dir()) or any(
        text.startswith("recipe=") for text in overrides
    ):
        return []
    try:
        content = yaml.load(yaml_text(recipe), yaml.BaseLoader)
    except (yaml.YAMLError, OSError, ValueError, RecursionError):
        return []  # Hydra reports what is wrong with it
    named = not isinstance(content, dict) or "recipe" in content
    stem = recipe.stem.replace("'", "\\'")
    return [] if named else [f"recipe='{stem}'"]


def _search_path_override(recipe: Path, config: DictConfig, overrides: Sequence[str]) -> list[str]:
    """The folders of the code that a recipe names, for every process that runs a part of it."""
    if config.get("search_path"):
        return []
    folders = _folders_of_code(recipe, config, overrides)
    return [f"search_path=[{_quoted(folders)}]"] if folders else []


def _quoted(texts: Iterable[str]) -> str:
    """Texts as the elements of a list in Hydra's grammar."""
    return ",".join("'" + text.replace("'", "\\'") + "'" for text in texts)


def _folders_of_code(recipe: Path, config: DictConfig, overrides: Sequence[str]) -> list[str]:
    """Folders with modules and files that settings name: the recipe's, or the current one."""
    given = [text.partition("=") for text in overrides]
    names = [name for key, _, value in given if key in NAMING_KEYS for name in value.split(",")]
    values = (OmegaConf.select(config, key) for key in NAMING_KEYS)
    names += [str(value) for value in values if value is not None]
    own = [] if recipe.is_relative_to(recipes_dir()) else [recipe.parent]
    return folders_of(names, [*own, Path.cwd()])


def _search_path(recipe: Path) -> list[str]:
    """Where else Hydra looks: the folder of its algorithm, ``shared``, and the root of recipes."""
    folders = [shared_dir(), *_folders(recipe), recipes_dir()]
    for name, algorithm in _SCHEMA_NAMES.items():
        own = recipe.parent / f"{name}.yaml"
        if recipes_dir() / algorithm in folders and own.is_file():
            raise RecipeError(
                f"{own} has the name of the schema {name} and hides it from recipes beside it; "
                "rename the file"
            )
    unique = dict.fromkeys(folder for folder in folders if folder != recipe.parent)
    return [f"hydra.searchpath=[{_quoted(f'file://{folder}' for folder in unique)}]"]


def _check_options(recipe: Path, overrides: Sequence[str]) -> None:
    """Refuse several options of a group in one run: all but the last would be ignored silently."""
    folders = _group_folders(recipe)
    for text in overrides:
        key, _, value = text.lstrip("+").partition("=")
        several = value.strip().removeprefix("[").removesuffix("]")
        if (
            value.strip().startswith("[")
            and key
            and any((folder / key).is_dir() for folder in folders)
        ):
            raise RecipeError(
                f"{text}: a run has one {key}; use -m {key}={several.replace(' ', '')} or a "
                "campaign's matrix for a run of each"
            )


def _group_folders(recipe: Path) -> list[Path]:
    """Folders with the groups of a recipe: beside it, shared, and those of its algorithms."""
    return [recipe.parent, shared_dir(), *_folders(recipe)]


def _folders(recipe: Path) -> list[Path]:
    """Folders of the algorithms whose schemas a recipe names or includes."""
    found = []
    for name in _included(recipe):
        if name in _SCHEMA_NAMES:
            found.append(recipes_dir() / _SCHEMA_NAMES[name])
        elif name in available_recipes():
            shipped = find_recipe(name)
            found += [shipped.parent, *_folders(shipped)]
    return found


def _included(recipe: Path) -> list[str]:
    """Names in the defaults of a recipe, such as ``pets_recipe`` and ``pets/half_cheetah``."""
    try:
        content = OmegaConf.to_container(OmegaConf.load(recipe))
    except (OSError, ValueError, yaml.YAMLError):
        return []  # Hydra reports what is wrong with it
    defaults = content.get("defaults") if isinstance(content, dict) else None
    names = [entry for entry in defaults or [] if isinstance(entry, str)]
    return [name.partition("@")[0].removeprefix("/") for name in names]


def _task(config: DictConfig) -> float:
    """Run a composed recipe; returns the objective for sweepers that optimise settings."""
    try:
        check_known(config)
        if config.wandb.name is None:
            config.wandb.name = _shown(config)
        return final_return(run(config))
    except USER_ERRORS as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        line = f"torchrl-l1 run: {message(error)}"
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            # The other runs continue; Hydra prints the line at the end and exits with status 1.
            raise CompactHydraException(line) from error
        print(line, file=sys.stderr)
        sys.exit(1)


def _shown(config: DictConfig) -> str:
    """A name for loggers that tells arms apart: the recipe, its overrides and the seed."""
    overrides = HydraConfig.get().overrides.task
    differs = [text for text in overrides if text.lstrip("+~").split("=")[0] not in _IN_NO_NAME]
    return bounded(" ".join([config.recipe, *differs, f"seed={config.seed}"]))
