"""Finding recipes: in a checkout, in the installed package, or in users' own files."""

from __future__ import annotations

import os
import re
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]
from omegaconf import OmegaConf

import torchrl_l1
from torchrl_l1.atomic import write_atomically
from torchrl_l1.experiment.errors import RecipeError

# Folders beside the recipes: their groups, and campaigns.
_NOT_RECIPES = ("shared", "campaigns")


def recipes_dir() -> Path:
    """The folder of the shipped recipes."""
    package = Path(torchrl_l1.__file__).parent
    # Wheels carry the folder inside the package; a checkout has it beside the package.
    candidates = [package / "recipes", package.parent / "recipes"]
    for candidate in candidates:
        if (candidate / "shared").is_dir():
            return candidate
    raise RecipeError(f"no recipes found in {' or '.join(map(str, candidates))}")


def shared_dir() -> Path:
    """The folder of the groups that all algorithms share, such as ``l1`` and ``noise``."""
    return recipes_dir() / "shared"


def group_options(group: str) -> list[str]:
    """Names of the options of a shared group."""
    return sorted(file.stem for file in (shared_dir() / group).glob("*.yaml"))


def group_setting(group: str, name: str) -> dict[str, Any]:
    """The values of an option of a shared recipe group, such as ``paper`` of ``l1``.

    Raises:
        ValueError: for an unknown option; the message lists the known ones.
    """
    file = shared_dir() / group / f"{name}.yaml"
    if name not in group_options(group):
        options = ", ".join(group_options(group))
        raise ValueError(f"unknown {group} setting {name!r}; there are {options}")
    values = OmegaConf.to_container(OmegaConf.load(file))
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def available_recipes() -> list[str]:
    """Names of the shipped recipes, such as ``metrpo/inverted_pendulum``."""
    root = recipes_dir()
    return sorted(
        f"{path.parent.name}/{path.stem}"
        for path in root.glob("*/*.yaml")
        if path.parent.name not in _NOT_RECIPES
    )


def available_campaigns() -> list[str]:
    """Names of the shipped campaigns, such as ``table1``."""
    return sorted(path.stem for path in (recipes_dir() / "campaigns").glob("*.yaml"))


def find_recipe(name: str) -> Path:
    """The YAML file of a shipped recipe, or of a user's own, given by its path.

    Raises:
        RecipeError: if there is none.
    """
    return _find("recipe", name, available_recipes(), recipes_dir())


def find_campaign(name: str) -> Path:
    """The YAML file of a shipped campaign, or of a user's own, given by its path.

    Raises:
        RecipeError: if there is none.
    """
    return _find("campaign", name, available_campaigns(), recipes_dir() / "campaigns")


def yaml_word(text: str) -> str:
    """A text as a value in a handwritten YAML file, quoted if necessary.

    Examples:
        >>> print(*map(yaml_word, ("envs.py:make_env", "a #1", "1e3", "off")))
        envs.py:make_env 'a #1' '1e3' 'off'
    """
    # YAML does not read some words as strings: off, no, null.
    if re.fullmatch(r"[A-Za-z_/][\w.+/:@-]*(?<!:)", text) and yaml.safe_load(text) == text:
        return text
    return "'" + text.replace("'", "''") + "'"


def copy_recipe(name: str, file: str | None = None) -> Path:
    """Copy a shipped recipe or campaign to where it can be edited.

    Args:
        name: such as ``pets/half_cheetah`` or ``table1``.
        file: the copy, a ``.yaml`` file; by default in the current folder, named like the recipe.

    Returns:
        the copy, which can be run and is named after its file.

    Raises:
        RecipeError: if there is no such recipe, or the copy already exists.
    """
    source = find_campaign(name) if name in available_campaigns() else find_recipe(name)
    copy = Path(file or f"{name.replace('/', '_')}.yaml")
    if copy.suffix != ".yaml" or not copy.stem.strip("."):
        raise RecipeError(f"the copy's name must end in .yaml, got {copy}")
    text = source.read_text(encoding="utf-8")
    named = f"recipe: {yaml_word(copy.stem)}"
    text = re.sub(r"(?m)^recipe: \S+$", lambda _: named, text)
    if os.path.lexists(copy):
        raise RecipeError(f"{copy} already exists; give another FILE")
    # A part of a campaign may itself be a campaign.
    write_atomically(copy, text)
    return copy


def _find(kind: str, name: str, available: list[str], folder: Path) -> Path:
    own = Path(name)
    if own.suffix == ".yaml":
        if not own.is_file():
            other = own.with_suffix(".yml")
            hint = f"; rename {other}, names must end in .yaml" if other.is_file() else ""
            raise RecipeError(f"{kind} file {name} does not exist{hint}")
        if not own.stem.strip("."):
            raise RecipeError(f"{kind} file {name} has no name besides dots; rename it")
        return own.resolve()
    if own.suffix == ".yml":
        raise RecipeError(f"{kind} file {name}: its name must end in .yaml, not .yml; rename it")
    if name not in available:
        close = get_close_matches(name, available, n=1)
        hint = f" Did you mean {close[0]}?" if close else ""
        if Path(f"{name}.yaml").is_file():
            hint = f" Did you mean the file {name}.yaml?"
        raise RecipeError(
            f"unknown {kind} {name!r}.{hint} Available: {', '.join(available)}; "
            "or give the path of a .yaml file."
        )
    return folder / f"{name}.yaml"
