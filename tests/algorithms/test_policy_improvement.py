from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import ReplayBuffer

from torchrl_l1.algorithms import METRPOConfig, Outcomes, policy_improvement
from torchrl_l1.algorithms.policy import GaussianPolicy
from torchrl_l1.algorithms.policy_improvement import (
    PolicyImprovement,
    PolicyStep,
    _standardize,
    imagined_advantages,
    policy_metrics,
    spread_fisher,
)
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import get_task
from torchrl_l1.objectives import TRPOConfig, TRPOReport
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


def imagined_pair() -> TensorDict:
    """Two of four steps; the second leaves the box in its second, and stays where it was."""
    torch.manual_seed(0)
    states = torch.randn(2, 5, 4)
    states[1, 2:] = states[1, 1]
    left = torch.zeros(2, 4, 1, dtype=torch.bool)
    left[1, 1] = True
    done, valid = left.clone(), torch.ones_like(left)
    done[:, -1] = True
    valid[1, 2:] = False
    following = {
        "observation": states[:, 1:],
        "reward": torch.tensor([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 0.0, 0.0]])[..., None],
        "done": done,
        "left_box": left,
        "terminated": torch.zeros_like(left),
    }
    columns = {"observation": states[:, :-1], "action": torch.randn(2, 4, 1), "valid": valid}
    step = torch.arange(4)[None, :, None].expand(2, 4, 1)
    return TensorDict({**columns, "step": step, "next": following}, batch_size=[2, 4])


@pytest.mark.parametrize("box_exit", ["truncate", "fail"])
@pytest.mark.parametrize("bootstrap", [False, True])
def test_policy_and_baseline_learn_from_what_is_valid(
    bootstrap: bool, box_exit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, seen = imagined_pair(), []

    def improve(mean, log_std, *samples_and_config):
        seen.extend(samples_and_config[:3])
        return TRPOReport(0.0, 0.0, True, 0)

    monkeypatch.setattr(policy_improvement, "imagine", lambda *given, **named: data)
    monkeypatch.setattr(policy_improvement, "gaussian_trpo_step", improve)
    config = METRPOConfig(
        imagined_steps=8, imagined_horizon=4, bootstrap=bootstrap, box_exit=box_exit,
        discount=GAMMA, gae_lambda=LAMBDA,
    )  # fmt: skip
    task = get_task("inverted_pendulum")
    model, policy = EnsembleDynamics(4, 1, members=1, hidden=(4,)), GaussianPolicy(4, 1, (4,))
    improvement = PolicyImprovement(task, model, policy, config, Outcomes(task))
    # The value is the first entry of the observation, and the step where it looks at the time.
    improvement.baseline.coefficients[[0, 8]] = torch.tensor([1.0, 100.0])
    found = improvement.step(ReplayBuffer())

    states = np.concatenate([data["observation"], data["next", "observation"][:, -1:]], axis=1)
    time = np.arange(4) * (not bootstrap)
    values = states[:, :4, 0] + time
    last = states[0, 4, 0] if bootstrap else 0.0
    beyond = values[1, 2] if box_exit == "truncate" else 0.0
    advantage = np.array(
        loop([1, 2, 3, 4], values[0], last) + loop([5, 6], values[1, :2].tolist(), beyond)
    )
    valid = data["valid"][..., 0].numpy()
    x = states[:, :4][valid]
    expected = (advantage - advantage.mean()) / advantage.std(ddof=1)
    assert torch.equal(seen[0], data["observation"][valid])
    assert torch.equal(seen[1], data["action"][valid])
    np.testing.assert_allclose(seen[2][:, 0], expected, rtol=1e-4, atol=1e-5)

    t = np.broadcast_to(time, (2, 4))[valid][:, None] / 100
    features = np.hstack([x, x**2, t, t**2, t**3, np.ones_like(t)]).astype(float)
    gram = features.T @ features + 1e-5 * np.eye(12)
    ridge = np.linalg.solve(gram, features.T @ (advantage + values[valid]))
    np.testing.assert_allclose(improvement.baseline.coefficients, ridge, rtol=1e-3, atol=1e-3)
    assert (found.imagined_return, found.left_box) == (10.5, 0.5)


def test_metrics_are_of_the_first_of_the_last_and_of_all_steps() -> None:
    steps = [
        PolicyStep(TRPOReport(0.3, 0.01, True, 2), imagined_return=-5.0, left_box=0.5),
        PolicyStep(TRPOReport(0.0, 0.0, False, 15), imagined_return=-4.0, left_box=0.75),
        PolicyStep(TRPOReport(0.6, 0.02, True, 0), imagined_return=-1.0, left_box=0.25),
    ]
    assert policy_metrics(steps) == {
        "imagined/return_first": -5.0,
        "imagined/return_last": -1.0,
        "imagined/left_box": 0.25,
        "trpo/kl": pytest.approx(0.01),
        "trpo/improvement": pytest.approx(0.3),
        "trpo/accepted": pytest.approx(2 / 3),
    }
    assert all(math.isnan(value) for value in policy_metrics([]).values())
