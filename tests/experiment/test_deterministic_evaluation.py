"""Sampled and mean actions in evaluations: each in the rows that say so."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_l1.algorithms.collection import episode_returns
from torchrl_l1.experiment.evaluate import TrainedRun, evaluate, make_collection
from torchrl_l1.experiment.matrix import Condition


def test_rows_are_of_the_actions_that_they_name(
    tiny_recipe: Callable[..., DictConfig], tmp_path: Path
) -> None:
    recipe = OmegaConf.to_object(tiny_recipe("policy.std=3.0"))
    trained = TrainedRun(tmp_path, recipe, recipe.build_on_cpu())
    cells = [Condition("off", policy=kind) for kind in ("deterministic", "stochastic")]
    rows = {row["policy"]: row for row in evaluate(trained, cells, 4, seed=5)}
    returns = {}
    for kind in rows:
        collection = make_collection(trained, Condition("off"), 4)
        data = collection.evaluate(5, deterministic=kind == "deterministic")
        mean, _ = trained.algorithm.policy(data["observation"])
        assert torch.allclose(data["action"], mean.clamp(-3, 3)) == (kind == "deterministic")
        returns[kind] = episode_returns(data).mean().item()
        assert rows[kind]["return_mean"] == returns[kind]
    assert returns["deterministic"] > returns["stochastic"] + 1
