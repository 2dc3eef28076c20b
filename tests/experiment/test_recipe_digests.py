"""Composed settings stay what they are, key by key and in order, however recipes are written.

The digests are those of the layout before, db6b824; settings that are newer are left out of them.
What is meant to change is written anew by ``python tests/experiment/test_recipe_digests.py``.
"""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf

from torchrl_l1.campaign import read_campaign
from torchrl_l1.campaign.plan import cells
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.recipes import (
    available_campaigns,
    available_recipes,
    find_recipe,
    recipes_dir,
)

FILE = Path(__file__).with_name("recipe_digests.json")


# Settings that there were not when the digests were made, with the value that does what was done.
NEWER = {"fit.precision": "float32", "precision": "float32"}


def digest(*settings: DictConfig) -> str:
    text = "---\n".join(OmegaConf.to_yaml(without_newer(one), resolve=True) for one in settings)
    return hashlib.sha256(text.encode()).hexdigest()


def without_newer(settings: DictConfig) -> DictConfig:
    """The settings but for those that are newer, which do what was done without them."""
    older = OmegaConf.create(OmegaConf.to_container(settings, resolve=True))
    # Planners have had a precision of their own all along.
    names = [name for name in NEWER if "." in name or settings.get("algorithm") == "metrpo"]
    for name in names if "algorithm" in settings else []:
        assert OmegaConf.select(older, name) == NEWER[name]
        parent, _, key = name.rpartition(".")
        del (OmegaConf.select(older, parent) if parent else older)[key]
    assert isinstance(older, DictConfig)
    return older


def presets(recipe: str) -> list[str]:
    """Those that a recipe finds: of its folder, its algorithm and all."""
    algorithm = composed(recipe, "preset=cpu").algorithm  # one of those, composed anyway
    folders = {find_recipe(recipe).parent, recipes_dir() / algorithm, recipes_dir() / "shared"}
    return sorted({file.stem for folder in folders for file in folder.glob("preset/*.yaml")})


def of_recipe(name: str) -> dict[str, str]:
    return {preset: digest(composed(name, f"preset={preset}")) for preset in presets(name)}


def of_campaign(name: str) -> dict[str, str]:
    """Of the file, and of the runs in the first and in the last cell of each matrix."""
    campaign = read_campaign(name)
    runs = []
    for matrix in campaign.runs:
        first, *_, last = [*cells(matrix)] * 2
        for cell in (first, last):
            place = (f"{key}={value}" for key, value in cell.items())
            runs.append(composed(matrix.recipe, *matrix.overrides, *place))
    return {"file": digest(OmegaConf.create(campaign.to_dict())), "runs": digest(*runs)}


@cache
def composed(recipe: str, *overrides: str) -> DictConfig:
    return compose(recipe, [*overrides, "run_dir=/run"])


@pytest.mark.parametrize("name", available_recipes())
def test_recipe_composes_to_what_it_did(name: str) -> None:
    assert of_recipe(name) == json.loads(FILE.read_text())["recipes"][name]


@pytest.mark.parametrize("name", available_campaigns())
def test_campaign_has_the_runs_that_it_had(name: str) -> None:
    assert of_campaign(name) == json.loads(FILE.read_text())["campaigns"][name]


def test_nothing_is_gone() -> None:
    known = json.loads(FILE.read_text())
    assert list(known["recipes"]) == available_recipes()
    assert list(known["campaigns"]) == available_campaigns()


if __name__ == "__main__":
    every = {
        "recipes": {name: of_recipe(name) for name in available_recipes()},
        "campaigns": {name: of_campaign(name) for name in available_campaigns()},
    }
    FILE.write_text(json.dumps(every, indent=1) + "\n")
