from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.data import Bounded

from torchrl_l1.control import L1Config


def test_presets_are_those_of_the_paper_and_of_the_released_code():
    paper, reference = L1Config.paper(0.04, epsilon=1.0), L1Config.reference(0.04, epsilon=3.0)
    assert paper == L1Config(0.04)
    assert (paper.on_switch, paper.switch_on, paper.filter_input) == (
        "keep",
        "executed",
        "previous",
    )
    assert (reference.on_switch, reference.switch_on, reference.filter_input) == (
        "reset",
        "policy",
        "current",
    )
    assert reference.epsilon == 3.0
    assert paper.project and not reference.project
    assert paper.filter_gain == reference.filter_gain == 0.35
    assert L1Config.reference(0.04, on_switch="keep").on_switch == "keep"


def test_cutoff_and_alpha_are_two_names_of_one_gain():
    assert L1Config(0.01, cutoff=20.0).filter_gain == pytest.approx(0.2)
    assert L1Config(0.01, alpha=0.2).filter_gain == 0.2
    assert L1Config(0.01, cutoff=0.0).filter_gain == 0.0


def test_gains_at_the_default_rate():
    config = L1Config(0.05)
    kappa = 0.05 / (math.exp(0.05) - 1)
    assert config.adaptation_gain == pytest.approx(kappa, rel=1e-14)
    assert config.predictor_gain == pytest.approx(kappa + 0.05, rel=1e-14)
    assert L1Config(1e-12).adaptation_gain == pytest.approx(1.0, rel=1e-11)
    assert len(L1Config(0.05, a_s=[-1.0, -2.0]).adaptation_gain) == 2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dt": 0.0}, "dt must be a positive"),
        ({"dt": -0.1}, "dt must be a positive"),
        ({"dt": float("nan")}, "dt must be a finite"),
        ({"dt": "0.1"}, "dt must be a finite number, got '0.1'"),
        ({"epsilon": -1.0}, "epsilon must not be negative"),
        ({"epsilon": float("inf")}, "epsilon must be a finite"),
        ({"cutoff": 5.0, "alpha": 0.2}, "not both"),
        ({"alpha": 1.5}, r"alpha must lie in \[0, 1\]"),
        ({"alpha": -0.1}, r"alpha must lie in \[0, 1\]"),
        ({"cutoff": 50.0}, r"cutoff \* dt must lie in \[0, 1\]"),
        ({"a_s": 0.0}, "a_s must be negative"),
        ({"a_s": (-1.0, 2.0)}, "a_s must be negative"),
        ({"a_s": ()}, "non-empty"),
        ({"a_s": "fast"}, "a_s must be a number"),
        ({"a_s": -17.0}, "too fast for dt"),
        ({"on_switch": "restart"}, "on_switch must be 'keep' or 'reset', got 'restart'"),
        ({"switch_on": "input"}, "switch_on must be 'policy' or 'executed'"),
        ({"filter_input": "next"}, "filter_input must be 'current' or 'previous'"),
        ({"action_low": 1.0, "action_high": 1.0}, "action_low must be below"),
        ({"action_low": (-1.0, 2.0), "action_high": 1.0}, "action_low must be below"),
        ({"action_low": (-1.0, -1.0), "action_high": (1.0,) * 3}, "2 entries and action_high has"),
        ({"action_low": float("nan")}, "action_low must be a number"),
        ({"project": "yes"}, "project must be True or False"),
        ({"action_low": [True]}, "action_low must be a number"),
        ({"action_low": float("inf")}, "action_low must not be inf"),
        ({"action_low": (-1.0, float("inf"))}, "action_low must not be inf"),
        ({"action_high": float("-inf")}, "action_high must not be -inf"),
        ({"process_noise": 0.01}, "belong to the Kalman filter: leave them out"),
        ({"inflation": 2.0}, "belong to the Kalman filter: leave them out"),
    ],
)
def test_bad_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        L1Config(**{"dt": 0.1, **settings})


def test_rates_up_to_the_stability_limit_are_accepted():
    for product in (0.1, 1.0, 1.59):
        gain = L1Config(0.1, a_s=-product / 0.1).predictor_gain
        assert abs(1 - gain) < 1
    with pytest.raises(ValueError, match="unstable"):
        L1Config(0.1, a_s=-16.0)


def test_dimensions_are_checked():
    config = L1Config(0.1, a_s=(-1.0, -2.0), action_low=(-1.0,), action_high=1.0)
    config.check_dimensions(2, 1)
    with pytest.raises(ValueError, match="a_s has 2 entries, expected one number or 3"):
        config.check_dimensions(3, 1)
    with pytest.raises(ValueError, match="action_low has 1 entries, expected one number or 2"):
        config.check_dimensions(2, 2)


def test_lists_become_tuples_and_configurations_hash():
    config = L1Config(0.1, a_s=[-1, -2], action_low=[-1.0, -2.0], action_high=3)
    assert config.a_s == (-1.0, -2.0)
    assert config.action_high == (3.0, 3.0)
    assert hash(config) == hash(L1Config(0.1, a_s=(-1.0, -2.0), action_low=(-1.0, -2.0),
                                         action_high=(3.0, 3.0)))  # fmt: skip


def test_unknown_setting_is_refused():
    with pytest.raises(TypeError, match="omega"):
        L1Config(0.1, omega=3.0)


def test_numbers_arrays_tensors_and_specs_of_others():
    low, high = torch.tensor([-2.0, -1.0]), torch.tensor([2.0, 3.0])
    expected = L1Config(0.5, epsilon=3.0, action_low=(-2.0, -1.0), action_high=(2.0, 3.0))
    spec = Bounded(low, high, (2,))
    batched = spec.expand(4, 2)
    box = gymnasium.spaces.Box(low.numpy(), high.numpy())
    for given in ((low, high), (low.numpy(), high.numpy()), (low.tolist(), high.tolist())):
        assert L1Config(np.float64(0.5), epsilon=3, action_low=given[0], action_high=given[1]) == (
            expected
        )
    for given in (spec, batched, spec.space, box):
        found = L1Config(
            torch.tensor(0.5), epsilon=np.float32(3), action_low=given, action_high=given
        )
        assert found == expected and hash(found) == hash(expected)
        assert all(type(value) is float for value in (found.dt, found.epsilon, *found.action_low))
    scalar = L1Config(0.1, action_low=np.float32(-2), action_high=torch.tensor(2.0))
    assert (scalar.action_low, scalar.action_high) == (-2.0, 2.0)
    assert L1Config(0.1, a_s=np.array([-1.0, -2.0])).a_s == (-1.0, -2.0)
    assert L1Config(0.1, project=np.bool_(False)).project is False


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"action_low": torch.tensor([[-1.0], [-2.0]])}, "same entries for all environments"),
        ({"action_low": torch.tensor([torch.nan])}, "action_low must be a number"),
        ({"action_low": np.array([])}, "non-empty"),
        ({"epsilon": torch.zeros(2)}, "epsilon must be a finite number"),
        ({"epsilon": np.bool_(True)}, "epsilon must be a finite number"),
        ({"dt": torch.tensor(torch.nan)}, "dt must be a finite number"),
    ],
)
def test_bad_arrays_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        L1Config(**{"dt": 0.1, **settings})
