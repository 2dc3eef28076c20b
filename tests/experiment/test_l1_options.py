from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from omegaconf import DictConfig

from torchrl_l1.control import L1Config, L1Transform
from torchrl_l1.envs import get_task
from torchrl_l1.experiment.evaluate import check_controllers, evaluate, load_run, make_collection
from torchrl_l1.experiment.l1_options import (
    closest_option,
    departures,
    filter_gain,
    l1_options,
    same_controller,
)
from torchrl_l1.experiment.matrix import Condition
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.settings import L1Settings, l1_config

Recipe = Callable[..., DictConfig]


def test_settings_of_recipes_have_the_names_and_defaults_of_the_controllers() -> None:
    ours = {n: v for n, v in vars(L1Settings()).items() if n not in ("enabled", "compile")}
    assert ours == {name: getattr(L1Config(0.04), name) for name in ours}


def test_shipped_options_are_closest_to_themselves() -> None:
    assert set(l1_options()) >= {"off", "paper", "reference", "slow"}
    for name, settings in l1_options().items():
        assert closest_option(settings, "swimmer") == name
        assert departures(settings, name, "swimmer") == {}


@pytest.mark.parametrize(
    ("settings", "by_filter", "without"),
    [
        ({"alpha": 0.1}, "slow", "paper"),
        ({"alpha": 0.05}, "paper", "paper"),
        ({"on_switch": "reset"}, "paper", "paper"),
        ({"on_switch": "reset", "switch_on": "policy", "project": False}, "reference", "reference"),
        ({"alpha": 0.1, "epsilon": 7.0, "compile": "auto"}, "slow", "paper"),
    ],
)
def test_closest_option(settings: dict[str, object], by_filter: str, without: str) -> None:
    own = L1Settings(enabled=True, **settings)  # type: ignore[arg-type]
    assert closest_option(own, "hopper") == by_filter
    assert closest_option(own, "hopper", by_filter=False) == without


def test_cutoff_counts_by_the_gain_that_it_makes() -> None:
    # Swimmer takes a step in 0.04 s, HalfCheetah in 0.05 s.
    assert filter_gain(L1Settings(cutoff=7.0), "swimmer") == 0.28
    assert filter_gain(L1Settings(cutoff=7.0), "half_cheetah") == 0.35
    assert departures(L1Settings(cutoff=7.0), "paper", "half_cheetah") == {}


def controller(*arguments: object) -> L1Config:
    transforms = make_collection(*arguments).env.transform  # type: ignore[arg-type]
    return next(one for one in transforms if isinstance(one, L1Transform)).config


def test_a_run_is_tested_with_the_controller_it_was_trained_with(tiny_recipe: Recipe) -> None:
    tuned = ("l1.alpha=0.2", "l1.a_s=-2", "l1.on_switch=reset", "l1.project=false")
    trained = load_run(run(tiny_recipe("l1=paper", "l1.epsilon=0.5", *tuned)))
    cells = [Condition(l1) for l1 in ("off", "paper", "slow")]
    assert [row["own_l1"] for row in evaluate(trained, cells, 2)] == [0, 1, 0]
    stricter = [replace(cell, epsilon=0.4) for cell in cells]
    assert [row["own_l1"] for row in evaluate(trained, stricter, 2)] == [0, 0, 0]
    own, slow = (controller(trained, cell, 2) for cell in cells[1:])
    assert (own.filter_gain, own.a_s, own.on_switch, own.project) == (0.2, -2.0, "reset", False)
    assert (slow.filter_gain, slow.a_s, slow.on_switch, slow.project) == (0.1, -1.0, "keep", True)
    assert own.epsilon == slow.epsilon == 0.5
    assert controller(trained, stricter[1], 2).epsilon == 0.4


def test_values_that_a_test_sets_take_the_place_of_the_runs_own(tiny_recipe: Recipe) -> None:
    # 2.5 rad/s at 0.04 s make a gain of 0.1.
    trained = load_run(run(tiny_recipe("l1=paper", "l1.epsilon=0.5", "l1.cutoff=2.5", "l1.a_s=-2")))
    cell = Condition("slow")
    # The option that it is closest to is slow, whose gain it has.
    tests = [
        (cell, 1, 0.5, 0.1, -2.0),
        (replace(cell, alpha=0.1), 1, 0.5, 0.1, -2.0),
        (replace(cell, epsilon=0.5, alpha=0.1), 1, 0.5, 0.1, -2.0),
        (replace(cell, alpha=0.3), 0, 0.5, 0.3, -2.0),
        (replace(cell, epsilon=2.0), 0, 2.0, 0.1, -2.0),
        (replace(cell, l1="paper", alpha=0.1), 0, 0.5, 0.1, -1.0),
    ]
    rows = list(evaluate(trained, [test[0] for test in tests], 1))
    assert [row["own_l1"] for row in rows] == [test[1] for test in tests]
    assert [(row["epsilon"], row["alpha"]) for row in rows[:3]] == [
        (None, None), (None, 0.1), (0.5, 0.1)
    ]  # fmt: skip
    for test, _, epsilon, gain, a_s in tests:
        config = controller(trained, test, 1)
        assert (config.epsilon, config.filter_gain, config.a_s) == pytest.approx(
            (epsilon, gain, a_s)
        )


@pytest.mark.parametrize(
    ("name", "value"),
    [("epsilon", -3), ("alpha", 7), ("filter", "kalmn"), ("process_noise", -1), ("a_s", 1)],
)
def test_settings_of_a_controller_that_is_off_are_checked(name: str, value: Any) -> None:
    """Evaluations turn it on: what no controller can have would be found after the training."""
    with pytest.raises(ValueError, match=name):
        l1_config(L1Settings(**{name: value}), "swimmer")


def test_a_controller_that_is_off_may_be_tuned_for_any_other() -> None:
    for settings in ({"process_noise": 0.02, "alpha": 0.1}, {"cutoff": 90.0}):
        assert l1_config(L1Settings(**settings), "swimmer") is None


def test_the_robust_controller_has_no_epsilon_of_the_run() -> None:
    """One that could not be used anywhere else is nothing to it."""
    check_controllers(L1Settings(epsilon=-3.0), get_task("swimmer"), [Condition("robust")])


def test_controllers_that_are_off_are_the_same() -> None:
    off, on = L1Settings(epsilon=0.3), L1Settings(enabled=True)
    assert same_controller(off, L1Settings(alpha=0.1), "swimmer")
    assert not same_controller(off, on, "swimmer")
    assert same_controller(on, replace(on, compile="auto", alpha=0.35), "swimmer")
    assert not same_controller(on, replace(on, alpha=0.34), "swimmer")
