from __future__ import annotations

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf

from torchrl_l1.dynamics import ControlAffineDynamics, EnsembleDynamics
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.recipes import available_recipes
from torchrl_l1.experiment.settings import METRPORecipe


def typed(name: str, *overrides: str) -> METRPORecipe:
    recipe = OmegaConf.to_object(compose(name, ["run_dir=unused", *overrides]))
    assert isinstance(recipe, METRPORecipe)
    return recipe


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
