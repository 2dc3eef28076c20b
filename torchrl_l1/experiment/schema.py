"""What a recipe may contain: the typed schemas behind the YAML files, one for each algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, TypeVar

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf

from torchrl_l1.algorithms import MBMF, METRPO, PETS, MBMFConfig, METRPOConfig, PETSConfig
from torchrl_l1.algorithms.metrpo_config import check_clipping
from torchrl_l1.experiment.settings import RunSettings, compile_mode, flatten, l1_config

_Config = TypeVar("_Config")


# The algorithm's settings come first: they say how many outer iterations there are.
@dataclass
class METRPORecipe(METRPOConfig, RunSettings):
    """A METRPO recipe: run settings and the algorithm's own, side by side.

    Attributes:
        published_horizon: imagined horizon of the published runs, for ``preset=paper``.
    """

    algorithm: str = "metrpo"
    published_horizon: int = 1000

    def __post_init__(self) -> None:
        """Check both parts, and that they fit each other.

        Raises:
            ValueError: naming the setting.
        """
        RunSettings.__post_init__(self)
        METRPOConfig.__post_init__(self)
        check_clipping(self.clip_actions, self.l1.enabled)
        if self.published_horizon < 1:
            raise ValueError(f"published_horizon must be at least 1, got {self.published_horizon}")

    def build(self) -> METRPO:
        """The algorithm, fresh."""
        return METRPO(self.task, _part(self, METRPOConfig), **_surroundings(self))


@dataclass
class PETSRecipe(PETSConfig, RunSettings):
    """A recipe of PETS or DETS: run settings and the algorithm's own, side by side.

    The two differ in what a member of the ensemble predicts: a distribution, or a point.
    """

    algorithm: str = "pets"

    def __post_init__(self) -> None:
        """Check both parts.

        Raises:
            ValueError: naming the setting.
        """
        RunSettings.__post_init__(self)
        PETSConfig.__post_init__(self)

    def build(self) -> PETS:
        """The algorithm, fresh."""
        return PETS(self.task, _part(self, PETSConfig), **_surroundings(self))


@dataclass
class MBMFRecipe(MBMFConfig, RunSettings):
    """An MBMF recipe: run settings and the algorithm's own, side by side."""

    algorithm: str = "mbmf"

    def __post_init__(self) -> None:
        """Check both parts.

        Raises:
            ValueError: naming the setting.
        """
        RunSettings.__post_init__(self)
        MBMFConfig.__post_init__(self)

    def build(self) -> MBMF:
        """The algorithm, fresh."""
        return MBMF(self.task, _part(self, MBMFConfig), **_surroundings(self))


SCHEMAS: dict[str, type[RunSettings]] = {
    "metrpo": METRPORecipe,
    "pets": PETSRecipe,
    "mbmf": MBMFRecipe,
}
"""Schema of the recipes of each algorithm. In a recipe's defaults it is ``<name>_recipe``."""


def register() -> None:
    """Make the schemas known to Hydra."""
    for name, schema in SCHEMAS.items():
        ConfigStore.instance().store(name=f"{name}_recipe", node=schema)


def schema_of(config: Mapping[str, Any]) -> type[RunSettings]:
    """The schema of a stored configuration; of METRPO for those that are older than others.

    Raises:
        ValueError: for an algorithm that there is not.
    """
    name = str(config.get("algorithm", "metrpo"))
    if name not in SCHEMAS:
        raise ValueError(f"unknown algorithm {name!r}; there are {', '.join(SCHEMAS)}")
    return SCHEMAS[name]


def schema_defaults(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """Every key of a configuration's schema that has a default, dotted, with that default."""
    return _defaults(schema_of(config).algorithm)


@cache
def _defaults(algorithm: str) -> Mapping[str, Any]:
    node = OmegaConf.to_container(OmegaConf.structured(SCHEMAS[algorithm]))
    return {key: value for key, value in flatten(node).items() if value != MISSING}


def _part(recipe: RunSettings, config: type[_Config]) -> _Config:
    """The algorithm's part of a recipe."""
    return config(**{f.name: getattr(recipe, f.name) for f in fields(config)})  # type: ignore[arg-type]


def _surroundings(recipe: RunSettings) -> dict[str, Any]:
    """What every algorithm takes beside its own settings."""
    return {
        "l1": l1_config(recipe.l1, recipe.task),
        "perturbation": recipe.perturbation,
        "seed": recipe.seed,
        "horizon": recipe.horizon,
        "device": recipe.device,
        "compile_l1": compile_mode(recipe.l1.compile),
    }
