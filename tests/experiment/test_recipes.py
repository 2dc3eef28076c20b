from __future__ import annotations

from pathlib import Path

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf

from torchrl_l1.control import L1Config
from torchrl_l1.envs import get_task
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.recipes import RecipeError, available_recipes, find_recipe
from torchrl_l1.experiment.settings import (
    METRPORecipe,
    PETSRecipe,
    RunSettings,
    l1_config,
    schema_of,
)

RUN_DIR = "run_dir=unused"


def composed(name: str, *overrides: str) -> RunSettings:
    recipe = OmegaConf.to_object(compose(name, [RUN_DIR, *overrides]))
    assert isinstance(recipe, RunSettings)
    return recipe


def typed(name: str, *overrides: str) -> METRPORecipe:
    recipe = composed(name, *overrides)
    assert isinstance(recipe, METRPORecipe)
    return recipe


@pytest.mark.parametrize("name", available_recipes())
@pytest.mark.parametrize("preset", ["cpu", "paper"])
@pytest.mark.parametrize("l1", ["off", "paper", "reference", "slow"])
def test_every_recipe_composes_and_says_which_task_it_is(name: str, preset: str, l1: str) -> None:
    recipe = composed(name, f"preset={preset}", f"l1={l1}")
    assert recipe.recipe == name
    algorithm = name.split("/")[0]
    assert recipe.algorithm == {"dets": "pets"}.get(algorithm, algorithm)
    task = get_task(recipe.task)
    controller = l1_config(recipe.l1, recipe.task)
    assert (controller is None) == (l1 == "off")
    if controller is not None:
        assert controller.dt == task.dt
        assert (controller.action_low, controller.action_high) == (
            task.action_low,
            task.action_high,
        )


@pytest.mark.parametrize("name", ["paper", "reference"])
def test_presets_are_those_of_the_controller(name: str) -> None:
    recipe = typed("metrpo/half_cheetah", f"l1={name}")
    bounds = {"action_low": -1.0, "action_high": 1.0}
    preset = getattr(L1Config, name)(0.05, epsilon=3.0, **bounds)
    assert l1_config(recipe.l1, recipe.task) == preset
    assert preset.filter_gain == 0.35


@pytest.mark.parametrize(
    ("task", "episodes", "horizon", "policy"),
    [
        ("inverted_pendulum", 25, 100, 64),
        ("swimmer", 6, 200, 32),
        ("hopper", 6, 1000, 64),
        ("walker", 6, 1000, 64),
        ("half_cheetah", 6, 1000, 32),
    ],
)
def test_paper_preset_has_the_published_settings(
    task: str, episodes: int, horizon: int, policy: int
) -> None:
    recipe = typed(f"metrpo/{task}", "preset=paper")
    assert recipe.model.hidden == [1000] * 4
    assert (recipe.fit.batch_size, recipe.fit.patience, recipe.fit.max_epochs) == (1000, 20, 200)
    assert recipe.policy.hidden == [policy, policy]
    assert (recipe.policy.std, recipe.policy.normalize) == (1.0, False)
    assert (recipe.episodes_per_iteration, recipe.imagined_horizon) == (episodes, horizon)
    assert (recipe.discount, recipe.gae_lambda, recipe.trpo_iterations) == (0.99, 0.95, 20)
    assert (recipe.trpo.max_kl, recipe.trpo.damping) == (0.01, 0.1)
    assert (recipe.imagined_from_data, recipe.bootstrap, recipe.box_exit) == (0.0, False, "fail")
    assert not recipe.imagined_termination


@pytest.mark.parametrize(
    ("name", "preset", "hidden", "candidates", "horizon", "decay"),
    [
        ("pets/inverted_pendulum", "paper", [200] * 4, 500, 30, 5e-5),
        ("pets/half_cheetah", "paper", [200] * 4, 500, 30, 5e-5),
        ("dets/half_cheetah", "paper", [200] * 4, 500, 30, 2e-4),
        ("pets/cartpole", "paper_cartpole", [500] * 3, 400, 25, 2.5e-4),
    ],
)
def test_paper_presets_of_pets_have_the_published_settings(
    name: str, preset: str, hidden: list[int], candidates: int, horizon: int, decay: float
) -> None:
    recipe = composed(name, f"preset={preset}")
    assert isinstance(recipe, PETSRecipe)
    assert recipe.model.hidden == hidden
    assert (recipe.cem.candidates, recipe.cem.horizon) == (candidates, horizon)
    assert (recipe.cem.elites, recipe.cem.iterations, recipe.cem.momentum) == (
        candidates // 10,
        5,
        0.1,
    )
    assert (recipe.particles, recipe.propagation, recipe.random_episodes) == (20, "tsinf", 1)
    assert (recipe.fit.batch_size, recipe.fit.max_epochs) == (32, 5)
    assert recipe.fit.bootstrap
    # One for each layer, the output's last.
    assert len(recipe.fit.weight_decay) == len(hidden) + 1
    assert recipe.fit.weight_decay[-1] == decay
    assert recipe.model.head == ("gaussian" if name.startswith("pets") else "deterministic")


def test_algorithm_is_that_of_the_schema() -> None:
    with pytest.raises(ValueError, match="algorithm is 'metrpo' by the recipe's schema"):
        typed("metrpo/inverted_pendulum", "algorithm=pets")
    assert schema_of({"task": "swimmer"}) is METRPORecipe, "older runs do not say"
    assert schema_of({"algorithm": "pets"}) is PETSRecipe
    with pytest.raises(ValueError, match="unknown algorithm 'pet'; there are metrpo, pets"):
        schema_of({"algorithm": "pet"})


@pytest.mark.parametrize(
    ("noise", "expected"),
    [("none", (0, 0)), ("action", (0.1, 0)), ("observation", (0, 0.1)), ("both", (0.1, 0.1))],
)
def test_noise_settings(noise: str, expected: tuple[float, float]) -> None:
    perturbation = typed("metrpo/inverted_pendulum", f"noise={noise}").perturbation
    assert (perturbation.action_noise, perturbation.observation_noise) == expected


def test_typos_are_refused() -> None:
    with pytest.raises(HydraException, match="sed"):
        typed("metrpo/inverted_pendulum", "sed=3")
    with pytest.raises(HydraException, match="epsillon"):
        typed("metrpo/inverted_pendulum", "l1.epsillon=3")
    with pytest.raises(HydraException, match="outer_iterations"):
        typed("metrpo/inverted_pendulum", "outer_iterations=many")
    with pytest.raises(RecipeError, match="Did you mean metrpo/half_cheetah"):
        find_recipe("metrpo/half_cheeta")
    with pytest.raises(RecipeError, match="does not exist"):
        find_recipe("nowhere.yaml")


def test_cutoff_or_alpha_but_not_both() -> None:
    controller = l1_config(typed("metrpo/inverted_pendulum", "l1.cutoff=5.0").l1, "half_cheetah")
    assert controller is not None
    assert controller.filter_gain == pytest.approx(5.0 * 0.05)
    recipe = typed("metrpo/inverted_pendulum", "l1.cutoff=5.0", "l1.alpha=0.1")
    with pytest.raises(ValueError, match="cutoff"):
        l1_config(recipe.l1, recipe.task)


def test_a_users_own_recipe_builds_on_the_shipped_groups(tmp_path: Path) -> None:
    own = tmp_path / "mine.yaml"
    own.write_text(
        "defaults: [metrpo_recipe, {l1: slow}, {noise: action}, {preset: cpu}, _self_]\n"
        "recipe: mine\ntask: half_cheetah\nmodel: {hidden: [64]}\n"
    )
    recipe = typed(str(own))
    assert recipe.l1.alpha == 0.1
    assert recipe.model.hidden == [64]
    assert recipe.fit.batch_size == 500


def test_a_users_own_recipe_finds_the_groups_of_its_algorithm(tmp_path: Path) -> None:
    own = tmp_path / "mine.yaml"
    own.write_text(
        "defaults: [pets_recipe, {l1: slow}, {preset: paper}, _self_]\n"
        "recipe: mine\ntask: swimmer\nparticles: 7\n"
    )
    recipe = composed(str(own))
    assert isinstance(recipe, PETSRecipe)
    assert (recipe.particles, recipe.cem.candidates) == (7, 500)


def test_a_users_own_recipe_may_include_a_shipped_one(tmp_path: Path) -> None:
    own = tmp_path / "half_cheetah.yaml"  # the name of the recipe that it includes
    own.write_text(
        "defaults: [/dets/half_cheetah@_global_, _self_]\n"
        "recipe: mine\nparticles: 7\nfit: {batch_size: 64}\n"
    )
    recipe = composed(str(own))
    assert isinstance(recipe, PETSRecipe)
    assert (recipe.recipe, recipe.task, recipe.particles) == ("mine", "half_cheetah", 7)
    assert (recipe.model.head, recipe.l1.enabled) == ("deterministic", True)
    # The presets are those of what is included, and this file has the last word.
    recipe = composed(str(own), "preset=paper", "l1=off")
    assert isinstance(recipe, PETSRecipe)
    assert recipe.fit.weight_decay[-1] == 2e-4
    assert (recipe.fit.batch_size, recipe.particles, recipe.cem.horizon) == (64, 7, 30)
    assert not recipe.l1.enabled
