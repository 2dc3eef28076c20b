"""Evaluating frozen policies: L1 off and on, under noise and disturbances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from torchrl_l1.algorithms.collection import (
    Collection,
    Perturbation,
    first_episodes,
    return_metrics,
    signal_metrics,
)
from torchrl_l1.algorithms.metrpo import METRPO
from torchrl_l1.experiment.l1_options import closest_option, l1_option
from torchrl_l1.experiment.recipes import group_setting
from torchrl_l1.experiment.run import build
from torchrl_l1.experiment.run_directory import RunDirectory, RunDirectoryError
from torchrl_l1.experiment.schema import L1Settings, METRPORecipe, l1_config


@dataclass(frozen=True)
class Condition:
    """One cell: which controller, which noise, which disturbance, which kind of policy."""

    l1: str
    noise: str
    bias: float
    gain: float
    policy: str


@dataclass
class TrainedRun:
    """A finished or running training, loaded for evaluation."""

    path: Path
    recipe: METRPORecipe
    algorithm: METRPO


def load_run(path: str | Path) -> TrainedRun:
    """Load recipe, model and policy of a run directory.

    Raises:
        RunDirectoryError: if the directory holds no run, or no checkpoint yet.
    """
    directory = RunDirectory(path)
    if not directory.config_file.exists():
        raise RunDirectoryError(f"{path} holds no run: there is no {directory.config_file.name}")
    checkpoint = directory.load_checkpoint()
    if checkpoint is None:
        raise RunDirectoryError(f"the run in {path} has no checkpoint yet; let it finish first")
    stored = OmegaConf.load(directory.config_file)
    recipe = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(METRPORecipe), stored))
    assert isinstance(recipe, METRPORecipe)
    algorithm = build(replace(recipe, device="cpu"))
    algorithm.load_state_dict({**checkpoint["algorithm"], "buffer": {}})
    return TrainedRun(directory.path, recipe, algorithm)


def conditions(
    l1: Sequence[str],
    noise: Sequence[str],
    bias: Sequence[float],
    gain: Sequence[float],
    policy: Sequence[str],
) -> list[Condition]:
    """Every combination of controller, noise and policy with each bias and, apart, each gain."""
    disturbances = [(b, 1.0) for b in bias] + [(0.0, g) for g in gain if g != 1.0]
    cells = product(policy, noise, disturbances, l1)
    return list(dict.fromkeys(Condition(on, n, b, g, p) for p, n, (b, g), on in cells))


def evaluate(
    trained: TrainedRun,
    cells: Sequence[Condition],
    episodes: int,
    seed: int = 0,
    epsilon: float | None = None,
) -> Iterator[dict[str, Any]]:
    """Returns of a frozen policy, one row per condition.

    Every condition sees the same resets and the same random numbers. Model and policy are
    those of the run's last checkpoint. ``own_l1`` is 1 where the controller is the one that the
    run was trained with, else 0.
    """
    for cell in cells:
        collection = make_collection(trained, cell, episodes, epsilon)
        data = collection.evaluate(seed, deterministic=cell.policy == "deterministic")
        yield {
            "run": str(trained.path),
            "training_seed": trained.recipe.seed,
            **vars(cell),
            "own_l1": int(_tested_l1(trained, cell.l1, epsilon) == trained.recipe.l1),
            **return_metrics(data),
            **signal_metrics(first_episodes(data)),
        }


def make_collection(
    trained: TrainedRun, cell: Condition, episodes: int, epsilon: float | None = None
) -> Collection:
    """The environments of one condition around the frozen policy and model."""
    settings = _tested_l1(trained, cell.l1, epsilon)
    perturbation = Perturbation(
        **group_setting("noise", cell.noise), actuator_bias=cell.bias, actuator_gain=cell.gain
    )
    return Collection(
        trained.algorithm.task,
        episodes,
        trained.algorithm.collection.policy,
        trained.algorithm.acting_dynamics,
        l1_config(settings, trained.recipe.task),
        perturbation,
        trained.recipe.horizon,
    )


def _tested_l1(trained: TrainedRun, option: str, epsilon: float | None) -> L1Settings:
    """The controller of a test.

    Where the option is the one that the run was trained with, however it was tuned, it is the
    run's own. Any other is as shipped, with the run's epsilon.
    """
    own = trained.recipe.l1
    epsilon = own.epsilon if epsilon is None else epsilon
    if option == closest_option(own, trained.recipe.task):
        return replace(own, epsilon=epsilon)
    return replace(l1_option(option), epsilon=epsilon)
