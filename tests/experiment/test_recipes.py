"""Recipes: what they compose to, and that it stays what it is, key by key and in order.

The digests are those of the layout before, db6b824; settings that are newer are left out of them.
What is meant to change is written anew by
``python tests/experiment/test_recipes.py``.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from functools import cache
from pathlib import Path

import pytest
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from torchrl_l1.campaign import read_campaign
from torchrl_l1.campaign.plan import cells
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import ControlAffineDynamics, EnsembleDynamics
from torchrl_l1.envs import DISTURBANCES, get_task
from torchrl_l1.experiment.errors import RecipeError
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.recipes import (
    available_campaigns,
    available_recipes,
    copy_recipe,
    find_recipe,
    recipes_dir,
)
from torchrl_l1.experiment.settings import (
    METRPORecipe,
    PETSRecipe,
    RunSettings,
    l1_config,
    schema_of,
)


@cache
def resolved(recipe: str, *overrides: str) -> DictConfig:
    return compose(recipe, [*overrides, "run_dir=/run"])


def composed(name: str, *overrides: str) -> RunSettings:
    task = ["task=gymnasium/Pendulum-v1"] if name.endswith("/any") else []
    recipe = OmegaConf.to_object(resolved(name, *task, *overrides))
    assert isinstance(recipe, RunSettings)
    return recipe


def typed(name: str, *overrides: str) -> METRPORecipe:
    recipe = composed(name, *overrides)
    assert isinstance(recipe, METRPORecipe)
    return recipe


@pytest.mark.parametrize("name", available_recipes())
@pytest.mark.parametrize("l1", ["off", "paper", "reference", "slow"])
def test_every_recipe_composes_and_says_which_task_it_is(name: str, l1: str) -> None:
    recipe = composed(name, "preset=cpu", f"l1={l1}")
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


@pytest.mark.parametrize("name", available_recipes())
def test_a_preset_changes_neither_the_task_nor_the_controller(name: str) -> None:
    cpu, paper = (composed(name, f"preset={preset}", "l1=slow") for preset in ("cpu", "paper"))
    for key in ("recipe", "algorithm", "task", "dt", "l1"):
        assert getattr(cpu, key) == getattr(paper, key)


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


def test_a_users_own_recipe_inherits_a_shipped_one_by_a_line(tmp_path: Path) -> None:
    own = tmp_path / "mine.yaml"
    own.write_text("defaults: [dets/half_cheetah, _self_]\nparticles: 7\n")
    recipe = composed(str(own), "preset=paper", "l1=off")
    assert isinstance(recipe, PETSRecipe)
    assert (recipe.recipe, recipe.task, recipe.particles) == ("mine", "half_cheetah", 7)
    assert recipe.model.head == "deterministic" and not recipe.l1.enabled
    own.write_text("defaults: [metrpo/hopper, {override l1: 'off'}, _self_]\n")
    assert not typed(str(own)).l1.enabled
    assert typed(str(own), "recipe=other").recipe == "other"


@pytest.mark.parametrize("name", available_recipes())
def test_every_shipped_recipe_can_be_inherited_by_a_line(name: str, tmp_path: Path) -> None:
    own = tmp_path / "mine.yaml"
    own.write_text(f"defaults: [{name}, _self_]\nseed: 3\n")
    task = ["task=swimmer"] if name.endswith("/any") else []
    mine, shipped = composed(str(own), *task), composed(name, *task)
    assert (mine.recipe, mine.seed) == ("mine", 3)
    mine.recipe, mine.seed = shipped.recipe, shipped.seed
    assert mine == shipped


def test_a_recipe_that_is_called_like_a_schema_is_named(tmp_path: Path) -> None:
    """Hydra takes the file for the schema, and would say that it is nested too deeply."""
    (tmp_path / "metrpo_recipe.yaml").write_text("defaults: [/metrpo_recipe, _self_]\n")
    (tmp_path / "mine.yaml").write_text("defaults: [metrpo/swimmer, _self_]\n")
    (tmp_path / "pets.yaml").write_text("defaults: [pets/half_cheetah, _self_]\n")
    for name in ("metrpo_recipe", "mine"):
        with pytest.raises(RecipeError, match=r"metrpo_recipe.yaml has the name of the schema"):
            compose(str(tmp_path / f"{name}.yaml"))
    assert compose(str(tmp_path / "pets.yaml")).recipe == "pets"


@pytest.mark.parametrize("entry", ["l1: off", "override l1: off", "l1: no"])
def test_an_option_that_yaml_takes_for_false_is_named(entry: str, tmp_path: Path) -> None:
    own = tmp_path / "mine.yaml"
    own.write_text(f"defaults:\n  - metrpo_recipe\n  - {entry}\n")
    key, _, word = entry.partition(": ")
    message = f"mine.yaml: defaults: {entry} means false in YAML; write {key}: '{word}'"
    with pytest.raises(RecipeError, match=message):
        composed(str(own))


@pytest.mark.parametrize("name", available_recipes())
def test_a_copy_of_a_recipe_is_that_recipe_under_another_name(name: str, tmp_path: Path) -> None:
    copy = copy_recipe(name, str(tmp_path / "mine.yaml"))
    # Those for any environment leave it to the user which.
    task = ["task=swimmer"] if name.endswith("/any") else []
    mine, shipped = composed(str(copy), *task), composed(name, *task)
    assert mine.recipe == "mine"
    mine.recipe = name
    assert mine == shipped


@pytest.mark.parametrize("name", ["a: b", "x #1", "1e3", "true", r"a\d", "it's", "Größe 2"])
def test_a_copy_may_have_any_name(name: str, tmp_path: Path) -> None:
    copy = copy_recipe("pets/half_cheetah", str(tmp_path / f"{name}.yaml"))
    assert composed(str(copy)).recipe == name


def test_no_part_of_a_copy_is_left_where_there_is_no_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as caught:
        copy_recipe("table1", str(tmp_path / "mine.yaml"))
    assert caught.value.filename == str(tmp_path / "mine.yaml")
    assert not list(tmp_path.iterdir())
    monkeypatch.undo()
    copy_recipe("table1", str(tmp_path / "mine.yaml"))


def test_copies_have_names_and_replace_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    copy = copy_recipe("pets/half_cheetah")
    assert str(copy) == "pets_half_cheetah.yaml"
    copy.write_text("mine")
    with pytest.raises(RecipeError, match="already exists"):
        copy_recipe("pets/half_cheetah")
    assert copy.read_text() == "mine"
    with pytest.raises(RecipeError, match=r"must end in \.yaml"):
        copy_recipe("pets/half_cheetah", "mine.yml")
    with pytest.raises(RecipeError, match="Did you mean pets/half_cheetah"):
        copy_recipe("pets/half_cheeta")
    Path("link.yaml").symlink_to("elsewhere.yaml")
    with pytest.raises(RecipeError, match="already exists"):
        copy_recipe("pets/half_cheetah", "link.yaml")
    campaign = read_campaign(str(copy_recipe("table1_first")))
    assert campaign.to_dict()["runs"] == read_campaign("table1_first").to_dict()["runs"]


def test_files_that_are_nearly_there_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yml").touch()
    (tmp_path / "other.yaml").touch()
    with pytest.raises(RecipeError, match=r"rename mine\.yml"):
        find_recipe("mine.yaml")
    with pytest.raises(RecipeError, match="rename it"):
        find_recipe("mine.yml")
    with pytest.raises(RecipeError, match=r"Did you mean the file other\.yaml\?"):
        find_recipe("other")


@pytest.mark.parametrize("name", [n for n in available_recipes() if n.startswith("metrpo/")])
def test_every_recipe_has_an_affine_variant_of_the_same_settings(name: str) -> None:
    for overrides in ([], ["preset=paper"], ["model.hidden=[8]"]):
        nonlinear, affine = typed(name, *overrides), typed(name, "model=affine", *overrides)
        assert (nonlinear.model.form, affine.model.form) == ("nonlinear", "affine")
        affine.model.form = "nonlinear"
        assert affine == nonlinear


def test_the_recipe_wins_over_the_group_and_the_preset_over_both() -> None:
    name = "metrpo/inverted_pendulum"
    assert typed(name, "model=affine").model.hidden == [128, 128]
    assert typed(name, "model=affine", "preset=paper").model.hidden == [1000] * 4


@pytest.mark.parametrize(
    ("form", "expected"), [("nonlinear", EnsembleDynamics), ("affine", ControlAffineDynamics)]
)
def test_the_form_reaches_the_algorithm(form: str, expected: type) -> None:
    recipe = typed("metrpo/half_cheetah", f"model={form}", "model.hidden=[64]", "horizon=5")
    algorithm = recipe.build()
    assert type(algorithm.dynamics) is expected
    # 64 units of the nonlinear network in either case, counted in parameters.
    n, m = algorithm.task.observation_dim, algorithm.task.action_dim
    nonlinear = (n + m + 1) * 64 + (64 + 1) * n
    parameters = sum(p.numel() for p in algorithm.dynamics.parameters()) / 5
    assert parameters == pytest.approx(nonlinear, rel=0.03)


def test_an_unknown_form_is_refused() -> None:
    with pytest.raises(HydraException, match="model/affin"):
        typed("metrpo/inverted_pendulum", "model=affin")
    with pytest.raises(ValueError, match=r"model.form must be 'nonlinear' or 'affine'"):
        typed("metrpo/inverted_pendulum", "model.form=affin")


FILE = Path(__file__).with_name("recipe_digests.json")


# Settings that there were not when the digests were made, with the value that does what was done.
NEWER = {"fit.precision": "float32", "precision": "float32"} | {
    f"perturbation.{entry.setting}": entry.neutral
    for name, entry in DISTURBANCES.items()
    if name not in ("bias", "gain")
}
NEWER |= {
    "on_divergence": "stop",
    "loggers": ["wandb"],
    "checkpoint": {"every": None, "best": False},
    **dict.fromkeys(("wandb.entity", "wandb.group", "wandb.name", "wandb.notes")),
    "wandb.tags": [],
    "dt": None,
    "observation_keys": [],
    "search_path": [],
    "reward": "builtin",
    "termination": "builtin",
    "outcome_model": {"members": 3, "hidden": [128, 128], "activation": "silu"},
    "l1.estimator": "least_squares",
    "l1.filter": "low_pass",
    "l1.covariance": "residuals",
    "l1.dead_zone": 2.0,
    "l1.process_noise": None,
    "l1.inflation": None,
    "l1.initial_deviation": 0.3,
    "l1.forgetting": 0.97,
    "l1.skill_forgetting": 1.0,
}

NEWER_IN_EVALUATIONS = {
    "suite": None,
    **{n: [entry.neutral] for n, entry in DISTURBANCES.items() if n not in ("bias", "gain")},
}


def digest(*settings: DictConfig) -> str:
    text = "---\n".join(OmegaConf.to_yaml(without_newer(one), resolve=True) for one in settings)
    return hashlib.sha256(text.encode()).hexdigest()


def without_newer(settings: DictConfig) -> DictConfig:
    """The settings but for those that are newer, which do what was done without them."""
    older = OmegaConf.create(OmegaConf.to_container(settings, resolve=True))
    algorithm = settings.get("algorithm")
    # Planners have had a precision of their own all along, and offline learning has had both.
    had = {"metrpo": (), "offline": ("precision", "fit.precision")}.get(algorithm, ("precision",))
    # The robust controller is newer as a whole.
    kept = "l1." if OmegaConf.select(settings, "l1.filter") == "kalman" else "nothing"
    newer = [n for n in NEWER if n not in had and not n.startswith(kept)]
    for name in newer if algorithm is not None else []:
        assert OmegaConf.select(older, name) == NEWER[name]
        parent, _, key = name.rpartition(".")
        del (OmegaConf.select(older, parent) if parent else older)[key]
    assert isinstance(older, DictConfig)
    return older


def presets(recipe: str) -> list[str]:
    """Those that a recipe finds: of its folder, its algorithm and all."""
    algorithm = resolved(recipe, "preset=cpu").algorithm  # one of those, resolved anyway
    folders = {find_recipe(recipe).parent, recipes_dir() / algorithm, recipes_dir() / "shared"}
    return sorted({file.stem for folder in folders for file in folder.glob("preset/*.yaml")})


def of_recipe(name: str) -> dict[str, str]:
    return {preset: digest(resolved(name, f"preset={preset}")) for preset in presets(name)}


def of_campaign(name: str) -> dict[str, str]:
    """Of the file, and of the runs in the first and in the last cell of each matrix."""
    campaign = read_campaign(name)
    runs = []
    for matrix in campaign.runs:
        first, *_, last = [*cells(matrix)] * 2
        for cell in (first, last):
            place = (f"{key}={value}" for key, value in cell.items())
            runs.append(resolved(matrix.recipe, *matrix.overrides, *place))
    whole = campaign.to_dict()
    for evaluation in whole["evaluations"]:
        for key, value in NEWER_IN_EVALUATIONS.items():
            if evaluation[key] == value:
                del evaluation[key]
    return {"file": digest(OmegaConf.create(whole)), "runs": digest(*runs)}


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
