"""Finding recipes: in a checkout, in the installed package, or in a user's own file."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

import torchrl_l1


class RecipeError(Exception):
    """No such recipe; the message lists those that exist."""


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


def available_recipes() -> list[str]:
    """Names of the shipped recipes, such as ``metrpo/inverted_pendulum``."""
    root = recipes_dir()
    return sorted(
        f"{path.parent.name}/{path.stem}"
        for path in root.glob("*/*.yaml")
        if path.parent.name != "shared"
    )


def find_recipe(name: str) -> Path:
    """The YAML file of a shipped recipe, or of a path to a user's own.

    Raises:
        RecipeError: if there is none.
    """
    own = Path(name)
    if own.suffix == ".yaml":
        if not own.is_file():
            raise RecipeError(f"recipe file {name} does not exist")
        return own.resolve()
    available = available_recipes()
    if name not in available:
        close = get_close_matches(name, available, n=1)
        hint = f" Did you mean {close[0]}?" if close else ""
        raise RecipeError(
            f"unknown recipe {name!r}.{hint} Available: {', '.join(available)}; "
            "or give the path of a .yaml file."
        )
    return recipes_dir() / f"{name}.yaml"
