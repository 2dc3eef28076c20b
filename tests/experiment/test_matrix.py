"""What an evaluation varies."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

import pytest
from omegaconf import DictConfig

from torchrl_l1.campaign import CampaignError, EvaluationSettings
from torchrl_l1.cli.evaluate import add_arguments
from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.evaluate import distinct, load_run
from torchrl_l1.experiment.matrix import (
    SUITE_L1,
    SUITES,
    Condition,
    axes,
    conditions,
    disturbance_words,
    disturbed,
    suite,
    undisturbed,
)
from torchrl_l1.experiment.run import run


def test_conditions_vary_bias_and_gain_apart() -> None:
    cells = conditions(bias=[0.0, 1.0], gain=[1.0, 0.5], policy=["stochastic"])
    disturbances = [disturbed(cell.disturbances) for cell in cells if cell.l1 == "off"]
    assert disturbances == [{}, {"bias": 1.0}, {"gain": 0.5}]
    assert len(cells) == 6


def test_conditions_sweep_epsilon_and_alpha_but_not_without_l1() -> None:
    cells = conditions(
        l1=["off", "paper", "slow"],
        bias=[0.0, 1.0],
        policy=["stochastic"],
        epsilon=[0.1, 1.0, 0.1],
        alpha=[0.05, 0.35],
    )
    assert len(cells) == len(set(cells)) == 2 * (1 + 2 * 2 * 2)
    off = [(cell.epsilon, cell.alpha) for cell in cells if cell.l1 == "off"]
    assert off == [(None, None)] * 2
    slow = [cell for cell in cells if cell.l1 == "slow" and cell.disturbances["bias"] == 1.0]
    on = {(cell.epsilon, cell.alpha) for cell in slow}
    assert on == {(0.1, 0.05), (0.1, 0.35), (1.0, 0.05), (1.0, 0.35)}
    only_alpha = conditions(l1=["paper"], policy=["stochastic"], alpha=[0.2])
    assert [(cell.epsilon, cell.alpha) for cell in only_alpha] == [(None, 0.2)]


def test_three_disturbances_vary_one_at_a_time_too(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = DISTURBANCES["bias"]
    monkeypatch.setitem(DISTURBANCES, "lag", replace(entry, name="lag", setting="lag", neutral=2.0))
    values = {"bias": [0.0, 1.0], "gain": [0.5, 1.0], "lag": [2.0, 3.0, 4.0]}
    cells = conditions(l1=["off"], policy=["stochastic"], **values)
    found = [disturbed(cell.disturbances) for cell in cells]
    assert found == [{}, {"bias": 1.0}, {"gain": 0.5}, {"lag": 3.0}, {"lag": 4.0}]


def test_options_keys_and_columns_have_the_same_names_and_defaults() -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    options = vars(parser.parse_args(["somewhere"]))
    settings = EvaluationSettings("e").of_a_run()
    names = list(Condition("off").columns())
    assert names == [axis.name for axis in axes()]
    # As in files that are older than this, how many episodes there are stands between them.
    own = ("episodes", "seed", "suite")
    assert [key for key in settings if key not in own] == names
    after = list(settings).index("policy")
    assert list(settings)[after : after + 3] == ["policy", "episodes", "seed"]
    assert {name: options[name] for name in settings} == settings
    assert conditions(**{name: settings[name] for name in names}) == conditions()


def test_unknown_names_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown disturbance 'bia'; there are bias, gain"):
        Condition("off", disturbances={"bia": 1.0})
    with pytest.raises(ValueError, match="unknown value to vary 'lag'; there are l1, noise, bias"):
        conditions(lag=[1.0])
    with pytest.raises(CampaignError, match="an evaluation does not vary 'lag'"):
        EvaluationSettings("e", matrix={"lag": [1.0]})


def test_conditions_are_equal_by_what_they_set() -> None:
    one = Condition("off", disturbances={"gain": 1.0, "bias": 0.5})
    assert one == Condition("off", disturbances={"bias": 0.5}) != Condition("off")
    assert len({one, Condition("off", disturbances={"bias": 0.5}), Condition("off")}) == 2


@pytest.mark.parametrize("name", SUITES)
def test_a_suite_is_tested_cell_by_cell_with_each_controller(name: str) -> None:
    cells = conditions(name, l1=["off", "paper", "oracle"], policy=["stochastic"], epsilon=[0, 1.0])
    expected = [
        (disturbance, l1, epsilon)
        for disturbance in suite(name)
        for l1, tried in (("off", [None]), ("paper", [0, 1.0]), ("oracle", [None]))
        for epsilon in tried
    ]
    found = [(disturbed(cell.columns()), cell.l1, cell.epsilon) for cell in cells]
    assert found == expected
    assert undisturbed(cells[0].columns()) and not undisturbed(cells[-1].columns())


def test_suites_stand_in_place_of_values_and_bring_an_oracle() -> None:
    assert EvaluationSettings("e", suite="quick").matrix["l1"] == list(SUITE_L1)
    assert EvaluationSettings("e", suite="quick", matrix={"l1": ["off"]}).matrix["l1"] == ["off"]
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    for arguments, l1 in (
        (["--suite", "full"], list(SUITE_L1)),
        (["--suite", "full", "--l1", "off", "paper"], ["off", "paper"]),
        (["--l1", "off", "paper", "--suite", "full"], ["off", "paper"]),
        ([], ["off", "paper"]),
    ):
        assert parser.parse_args(["somewhere", *arguments]).l1 == l1
    with pytest.raises(ValueError, match="unknown suite 'all'; there are quick, full"):
        conditions("all")
    with pytest.raises(ValueError, match="suite and gain both set"):
        conditions("quick", gain=[1.0, 0.5])


def test_conditions_are_named_by_what_is_not_neutral() -> None:
    columns = Condition("off", disturbances={"gain": 0.5}).columns()
    assert (disturbed(columns), disturbance_words(columns)) == ({"gain": 0.5}, "gain 0.5")
    # As in tables that are older than a disturbance.
    assert disturbance_words({"bias": 1.0}) == "bias 1"


def test_a_controller_is_not_tested_again_with_an_epsilon_that_does_not_matter(
    tiny_recipe: Callable[..., DictConfig],
) -> None:
    trained = load_run(run(tiny_recipe("l1=off", "outer_iterations=1")))
    cells = conditions(l1=["paper", "robust"], epsilon=[0.3, 1.0], policy=["stochastic"])
    assert [cell.controller for cell in distinct(trained, cells)] == [
        "paper epsilon=0.3",
        "paper epsilon=1",
        "robust",
    ]
