from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import ReplayBuffer

from torchrl_l1.algorithms import METRPOConfig, Outcomes
from torchrl_l1.algorithms.policy import GaussianPolicy
from torchrl_l1.algorithms.policy_improvement import (
    PolicyImprovement,
    _standardize,
    imagined_advantages,
    spread_fisher,
)
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import get_task
from torchrl_l1.objectives import TRPOConfig
from torchrl_l1.objectives.trpo import fisher_stride

GAMMA, LAMBDA = 0.9, 0.8


def trajectories() -> TensorDict:
    """Three of five steps; the second leaves the box in its third, the third ends in its second."""
    torch.manual_seed(0)
    left, fell = torch.zeros(2, 3, 5, 1, dtype=torch.bool)
    left[1, 2] = fell[2, 1] = True
    done = left | fell
    done[:, -1] = True
    following = {"done": done, "left_box": left, "terminated": fell}
    return TensorDict(
        {"next": {"reward": torch.randn(3, 5, 1), **following}},
        batch_size=[3, 5],
    )


def loop(rewards: list[float], values: list[float], last_value: float) -> list[float]:
    """The definition: a discounted sum of temporal differences."""
    following = [*values[1:], last_value]
    advantage, result = 0.0, []
    for r, v, w in reversed(list(zip(rewards, values, following, strict=True))):
        advantage = r + GAMMA * w - v + GAMMA * LAMBDA * advantage
        result.append(advantage)
    return result[::-1]


@pytest.mark.parametrize("box_exit", ["truncate", "fail"])
def test_advantages_follow_the_definition(box_exit: str) -> None:
    data = trajectories()
    value = torch.randn(3, 5, 1)
    value[1, 3] = value[1, 2]  # after an exit the observation stays
    last_value = torch.tensor([0.7, -0.4, 0.9]).reshape(3, 1, 1)
    advantage, target = imagined_advantages(data, value, last_value, GAMMA, LAMBDA, box_exit)
    rewards, values = data["next", "reward"][..., 0].tolist(), value[..., 0].tolist()
    whole = loop(rewards[0], values[0], last_value=0.7)
    torch.testing.assert_close(advantage[0, :, 0], torch.tensor(whole))
    beyond = values[1][2] if box_exit == "truncate" else 0.0
    until_exit = loop(rewards[1][:3], values[1][:3], last_value=beyond)
    torch.testing.assert_close(advantage[1, :3, 0], torch.tensor(until_exit))
    until_fall = loop(rewards[2][:2], values[2][:2], last_value=0.0)
    torch.testing.assert_close(advantage[2, :2, 0], torch.tensor(until_fall))
    torch.testing.assert_close(target, advantage + value)


def test_a_single_sample_says_nothing() -> None:
    # All trajectories may leave the box at once, or there is one of one step.
    assert _standardize(torch.tensor([[3.0]])).item() == 0
    torch.testing.assert_close(_standardize(torch.tensor([[1.0], [3.0]])).std(), torch.tensor(1.0))


@given(horizon=st.integers(1, 1000), fraction=st.floats(0.02, 1.0))
def test_the_fisher_matrix_sees_more_than_the_first_steps(horizon: int, fraction: float) -> None:
    config = TRPOConfig(fisher_fraction=fraction)
    stride = fisher_stride(spread_fisher(config, horizon))
    seen = {row % horizon for row in range(0, stride * horizon, stride)}
    assert len(seen) >= min(horizon, 5)
    assert fisher_stride(config) <= stride < fisher_stride(config) + 10
    # Those of the recipes are what they were.
    assert all(spread_fisher(TRPOConfig(), steps) == TRPOConfig() for steps in (50, 100, 200, 1000))


def test_steps_are_of_a_length_that_few_backtracks_change() -> None:
    torch.manual_seed(0)
    config = METRPOConfig(trpo_iterations=1, imagined_steps=4000, imagined_horizon=10)
    task, policy = get_task("hopper"), GaussianPolicy(11, 3, (32, 32))
    model = EnsembleDynamics(11, 3, members=2, hidden=(16,))
    # Away from where the task starts, as unstable systems go.
    with torch.no_grad():
        model.change_normalizer.std.fill_(0.3)
    improvement = PolicyImprovement(task, model, policy, config, Outcomes(task))
    reports = [improvement.step(ReplayBuffer()).report for _ in range(4)]
    assert all(report.accepted for report in reports)
    assert sum(report.backtracks for report in reports) <= 4
