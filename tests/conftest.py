from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from omegaconf import DictConfig

from torchrl_l1.experiment.launch import compose

TINY = [
    "outer_iterations=2",
    "episodes_per_iteration=2",
    "horizon=15",
    "trpo_iterations=2",
    "imagined_steps=100",
    "imagined_horizon=10",
    "model.members=2",
    "model.hidden=[8]",
    "policy.hidden=[8]",
    "fit.batch_size=16",
    "fit.max_epochs=2",
    "fit.validation_fraction=0.3",
    "trpo.fisher_fraction=1.0",
    "wandb.mode=disabled",
]


@pytest.fixture
def tiny_overrides() -> list[str]:
    """Overrides that make a run last about a second."""
    return list(TINY)


@pytest.fixture
def tiny_recipe(tmp_path: Path) -> Callable[..., DictConfig]:
    """A composed recipe of the pendulum that runs in about a second into ``tmp_path / 'run'``."""

    def make(*overrides: str, recipe: str = "metrpo/inverted_pendulum") -> DictConfig:
        return compose(recipe, [*TINY, f"run_dir={tmp_path / 'run'}", *overrides])

    return make
