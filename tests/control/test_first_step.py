"""What the first step tells of a model that may be taken, but will serve badly."""

from __future__ import annotations

import warnings
from dataclasses import replace

import pytest
import torch
from torchrl.envs import TransformedEnv

from tests.control.test_probe import M, N, WithCovariance
from torchrl_l1.control import ActionJacobian, L1Config, L1Transform, init
from torchrl_l1.control.affine import make_step
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import BatchedMujocoEnv


def test_observations_in_other_units_than_those_of_the_fit_are_noticed():
    torch.manual_seed(0)
    ensemble = EnsembleDynamics(N, M, members=2, hidden=(8,))
    config = L1Config(0.05)
    seen = torch.tensor([1.0, 100.0, 0.0]) * (torch.rand(200, N) - 0.5)
    x, u = torch.tensor([[0.4, -40.0, 0.3]]).expand(3, N), torch.zeros(3, M)

    def first_step(observation: torch.Tensor) -> None:
        step = make_step(config, ActionJacobian(ensemble), False)
        step(init([len(observation)], N, M), observation, u[: len(observation)])

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        first_step(100 * x)  # nothing is known of a fit
        ensemble.box.fit(seen)
        first_step(x)  # the third entry did not vary
        first_step(torch.cat([x[:2], 100 * x[:1]]))  # a single one may be odd
    with pytest.warns(UserWarning, match=r"the model EnsembleDynamics .* in the entries \[0, 1\]"):
        first_step(10 * x)
    with pytest.warns(UserWarning, match="other units"):
        first_step(x[:1] - torch.tensor([4.0, 0.0, 0.0]))


@pytest.mark.parametrize(("settings", "warned"), [({}, True), ({"inflation": 2.0}, False)])
def test_a_model_that_nobody_has_calibrated_is_told_of_once(settings, warned):
    model = EnsembleDynamics(4, 1, members=2, hidden=(8,))
    model.residuals.measure(torch.eye(4))
    env = TransformedEnv(
        BatchedMujocoEnv("inverted_pendulum", 2, seed=0),
        L1Transform(model, replace(L1Config.robust(0.04), **settings)),
    )
    for expected in (warned, False):
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            env.rollout(2)
        told = ["call calibrate_filter(" in str(each.message) for each in found]
        assert told == [True] * expected


@pytest.mark.parametrize("law", [L1Config, L1Config.robust])
def test_effects_that_are_lost_in_rounding_are_told_of_once(law):
    x, u = 1e-11 * torch.randn(5, 3), torch.randn(5, 2)
    config = law(0.05, action_low=-1.0, action_high=1.0)
    for unit, rows, told in ((1.0, 5, [0, 1]), (1e9, 5, []), (1.0, 1, [0, 1]), (1e9, 1, [])):
        gain = unit * 5e-11 * torch.tensor([[1.0, 0.5, 0.0], [0.0, 1.0, 0.5]])
        dynamics = WithCovariance(lambda x: torch.eye(3))
        dynamics.mean_change = lambda x, u, gain=gain: u @ gain
        step = make_step(config, ActionJacobian(dynamics), False)
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            for _ in range(2):
                step(init([rows], 3, 2, config), unit * x[:rows], u[:rows])
        lost = [f"actions {told} is lost in rounding" in str(each.message) for each in found]
        assert lost == [True] * bool(told)


@pytest.mark.parametrize(
    ("gain", "told"),
    [
        ([[1.0, 0.5, 0.3], [2.0, 1.0, 0.6]], [0, 1]),  # the same, but for its size
        ([[1.0, 0.5, 0.3], [1.0, 0.51, 0.3]], [0, 1]),  # nearly
        ([[1.0, 0.5, 0.3], [0.0, 0.0, 0.0]], []),
        ([[1.0, 0.5, 0.3], [1.0, -0.5, 0.3], [2.0, 1.0, 0.6]], [0, 2]),
        ([[1.0, 0.5, 0.3], [1.0, -0.5, 0.3], [0.0, 0.0, 1.0]], []),
        ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]], [0, 1, 2]),
    ],
)
def test_actions_whose_effects_cannot_be_told_apart_are_named(gain, told):
    gain = torch.tensor(gain)
    config = L1Config.robust(0.05, action_low=-1.0, action_high=1.0)
    dynamics = WithCovariance(lambda x: 0.01 * torch.eye(3))
    dynamics.mean_change = lambda x, u: u @ gain
    step = make_step(config, ActionJacobian(dynamics), False)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        step(init([2], 3, len(gain), config), torch.randn(2, 3), torch.randn(2, len(gain)))
    named = [f"actions {told} cannot be told apart" in str(each.message) for each in found]
    assert named == [True] * bool(told)
