"""What an evaluation varies."""

from __future__ import annotations

import argparse
from dataclasses import replace

import pytest

from torchrl_l1.campaign import CampaignError, EvaluationSettings
from torchrl_l1.cli.evaluate import add_arguments
from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.matrix import Condition, axes, conditions


def test_conditions_vary_bias_and_gain_apart() -> None:
    cells = conditions(bias=[0.0, 1.0], gain=[1.0, 0.5], policy=["stochastic"])
    disturbances = [tuple(cell.disturbances.values()) for cell in cells if cell.l1 == "off"]
    assert disturbances == [(0.0, 1.0), (1.0, 1.0), (0.0, 0.5)]
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
    assert [tuple(cell.disturbances.values()) for cell in cells] == [
        (0.0, 1.0, 2.0),
        (1.0, 1.0, 2.0),
        (0.0, 0.5, 2.0),
        (0.0, 1.0, 3.0),
        (0.0, 1.0, 4.0),
    ]


def test_options_keys_and_columns_have_the_same_names_and_defaults() -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    options = vars(parser.parse_args(["somewhere"]))
    settings = EvaluationSettings("e").of_a_run()
    names = list(Condition("off").columns())
    assert names == [axis.name for axis in axes()]
    # As in files that are older than this, how many episodes there are stands between them.
    assert [key for key in settings if key not in ("episodes", "seed")] == names
    assert list(settings)[4:7] == ["policy", "episodes", "seed"]
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
