"""Behaviour cloning."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_l1.algorithms.cloning import Cloning
from torchrl_l1.algorithms.mbmf_config import CloningConfig
from torchrl_l1.algorithms.policy import GaussianPolicy


def make(**changes: object) -> Cloning:
    torch.manual_seed(0)
    settings = {"batch_size": 64, "max_epochs": 150, "learning_rate": 3e-3, **changes}
    return Cloning(
        GaussianPolicy(3, 2, [32]),
        CloningConfig(**settings),  # type: ignore[arg-type]
        half_range=2.0,
        capacity=10_000,
    )


def expert(observation: torch.Tensor) -> torch.Tensor:
    gain = torch.tensor([[1.0, -0.5], [0.0, 0.3], [0.2, 0.0]])
    return (observation @ gain).tanh()


def test_learns_to_act_as_the_expert_whose_noise_it_averages_out() -> None:
    cloning = make()
    observation = torch.randn(4000, 3) * torch.tensor([1.0, 10.0, 0.1])
    noise = 0.4 * torch.randn(4000, 2)
    cloning.store(observation, expert(observation) + noise)
    report = cloning.fit()
    fresh = torch.randn(2000, 3) * torch.tensor([1.0, 10.0, 0.1])
    mean, _ = cloning.policy(fresh)
    assert (mean - expert(fresh)).square().mean().sqrt() < 0.1
    # What is left is the noise, in halves of the range.
    assert report.validation_loss == pytest.approx((0.4 / 2) ** 2, rel=0.15)


def test_the_weights_of_the_best_epoch_are_kept() -> None:
    cloning = make(learning_rate=0.3, batch_size=16, max_epochs=12, patience=12)
    observation = torch.randn(300, 3)
    cloning.store(observation, expert(observation))
    report = cloning.fit()
    data = cloning.buffer[:]
    held_out = data[data["validation"]]
    mean, _ = cloning.policy(held_out["observation"])
    loss = ((mean - held_out["action"]) / 2).square().mean()
    assert loss.item() == pytest.approx(report.validation_loss, rel=1e-5)


def test_pairs_that_are_not_finite_are_left_out() -> None:
    cloning = make()
    observation, action = torch.zeros(4, 3), torch.zeros(4, 2)
    observation[1, 2], action[3, 0] = math.nan, math.inf
    cloning.store(observation, action)
    assert len(cloning.buffer) == 2
    cloning.store(observation[1:2], action[1:2])
    assert len(cloning.buffer) == 2


def test_nothing_to_learn_from_is_an_error() -> None:
    cloning = make()
    with pytest.raises(ValueError, match="0 training and 0 validation"):
        cloning.fit()
    cloning.store(torch.zeros(1, 3), torch.zeros(1, 2))
    with pytest.raises(ValueError, match=r"cloning\.validation_fraction"):
        cloning.fit()


def test_state_survives() -> None:
    first, second = make(), make()
    observation = torch.randn(100, 3)
    first.store(observation, expert(observation))
    second.load_state_dict(first.state_dict())
    assert (first.buffer[:] == second.buffer[:]).all()
    second.load_state_dict(make().state_dict())
    assert len(second.buffer) == 0


def test_a_range_for_each_action_follows_the_policy_to_its_device() -> None:
    policy = GaussianPolicy(3, 2, (8,)).to("meta")
    cloning = Cloning(policy, CloningConfig(), torch.tensor([1.0, 2.0]), capacity=10)
    data = TensorDict(
        {"observation": torch.zeros(5, 3), "action": torch.zeros(5, 2)}, batch_size=[5]
    )
    assert cloning._loss(data.to("meta")).device.type == "meta"
