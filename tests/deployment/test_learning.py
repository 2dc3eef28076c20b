from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, LazyTensorStorage, ReplayBuffer, Unbounded
from torchrl.envs import GymEnv, SerialEnv

from torchrl_l1.deployment import Exploration, environment_source, load_policy, target_switch_rate
from torchrl_l1.deployment.assessment import run_episodes, summarize_episodes
from torchrl_l1.deployment.learning import (
    agreed_time_step,
    collect,
    epsilon_for,
    recorded,
    switch_rates,
)
from torchrl_l1.dynamics import EnsembleDynamics

from .conftest import balance

ZERO = TensorDictModule(lambda x: 0 * x[..., :2], ["observation"], ["action"])


def explored(action, noise, steps=400):
    torch.manual_seed(0)
    policy = Exploration(ZERO, action, noise)
    data = TensorDict(observation=torch.zeros(5, 3), batch_size=[5])
    return torch.stack([policy(data.clone())["action"] for _ in range(steps)])


def test_noise_is_relative_to_the_range_and_partly_held():
    wide = explored(Bounded(-40.0, 40.0, (5, 2)), 0.1)
    narrow = explored(Bounded(-4.0, 4.0, (5, 2)), 0.1)
    free = explored(Unbounded((5, 2)), 0.1)
    torch.testing.assert_close(wide, 10 * narrow)
    torch.testing.assert_close(wide, 40 * free)
    # The mean square of a level between none and twice is 4/3 of its mean's square.
    assert free.std().item() == pytest.approx(0.1 * (4 / 3) ** 0.5, rel=0.15)
    lagged = (free[1:] * free[:-1]).mean() / free.square().mean()
    assert 0.3 < lagged < 0.6  # half of it, nine times in ten


def test_noise_stays_within_the_bounds():
    assert explored(Bounded(-1.0, 1.0, (5, 2)), 3.0).abs().max() == 1.0
    assert explored(Bounded(-1.0, 1.0, (5, 2)), 0.0).abs().max() == 0.0


def test_data_are_those_of_the_seed():
    source = environment_source("inverted_pendulum")
    policy = load_policy(balance, source.one())
    counted = []
    first, same, other = (
        collect(source, policy, 25, 2, 0.3, seed, counted.append) for seed in (0, 0, 1)
    )
    assert first.shape == (2, 13) and sum(counted) >= 24
    assert torch.equal(first["next", "observation"], same["next", "observation"])
    assert not torch.equal(first["next", "observation"], other["next", "observation"])


def test_rates_are_those_of_the_switching_law_step_by_step():
    torch.manual_seed(1)
    model = EnsembleDynamics(3, 2, members=2, hidden=(16,), activation="tanh")
    x, u = torch.randn(2, 30, 3), torch.randn(2, 30, 2)
    started = torch.ones(2, 30, dtype=torch.bool)
    started[:, 0] = started[1, 12] = False
    epsilons = [0.02, 0.1, 0.5]
    expected = []
    for epsilon in epsilons:
        count = 0
        for row in range(2):
            for step in range(30):
                if not started[row, step]:
                    u_bar = u[row, step]
                    continue
                value, jacobian = model.value_and_jacobian(x[row, step], u_bar)
                tangent = value + jacobian @ (u[row, step] - u_bar)
                error = model.mean_change(x[row, step], u[row, step]) - tangent
                if np.linalg.norm(error.detach().numpy()) > epsilon:
                    count, u_bar = count + 1, u[row, step]
        expected.append(1000 * count / 57)
    assert expected[0] > expected[-1]
    found = switch_rates(model, x, u, started, torch.tensor(epsilons))
    assert found.tolist() == pytest.approx(expected)


@pytest.mark.parametrize("rate", [50.0, 350.0])
def test_epsilon_gives_the_rate_that_is_asked_for(rate):
    torch.manual_seed(2)
    model = EnsembleDynamics(3, 1, members=2, hidden=(16,), activation="tanh")
    data = TensorDict(
        {"observation": torch.randn(4, 250, 3), "action": torch.randn(4, 250, 1)}, [4, 250]
    )
    done = torch.zeros(4, 250, 1, dtype=torch.bool)
    data["next"] = TensorDict({"done": done}, [4, 250])
    epsilon, found = epsilon_for(model, data, rate)
    assert epsilon > 0 and found == pytest.approx(rate, rel=0.1)


def test_the_rule_of_thumb_changes_at_five_entries():
    assert [target_switch_rate(n) for n in (1, 4, 5, 18)] == [50.0, 50.0, 350.0, 350.0]


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda x: x[..., 0], r"action of shape \[3\] for 3 environments .* expected \[3, 1\]"),
        (lambda x: x[..., None, :1], r"action of shape \[3, 1, 1\]"),
        (
            torch.nn.Linear(4, 1).double(),
            r"failed at its first call, .* \[3, 4\] .*: mat1 ",
        ),
    ],
)
def test_actions_that_do_not_fit_never_reach_the_environment(act, message):
    policy = TensorDictModule(act, ["observation"], ["action"])
    source = environment_source("inverted_pendulum")
    with pytest.raises(ValueError, match=message):
        collect(source, policy, 30, 3, 0.3, 0)
    with pytest.raises(ValueError, match=message):
        run_episodes(source, policy, {}, [], 3, 10, 0)


def test_environments_in_rows_and_columns_are_laid_side_by_side():
    def grid():
        return SerialEnv(2, lambda: SerialEnv(3, lambda: GymEnv("Pendulum-v1")))

    source = environment_source(grid)
    policy = TensorDictModule(lambda x: -x[..., 1:2], ["observation"], ["action"])
    data = collect(source, policy, 60, 1, 0.3, 0)
    assert data.shape == (6, 10)
    assert torch.equal(data["observation"][:, 1:], data["next", "observation"][:, :-1])
    assert len(summarize_episodes(run_episodes(source, policy, {}, [], 1, 7, 0)).returns) == 6


def test_actions_beyond_the_bounds_are_told():
    source = environment_source("inverted_pendulum")
    policy = TensorDictModule(lambda x: 0 * x[..., :1] + 3.5, ["observation"], ["action"])
    with pytest.warns(UserWarning, match="10 of 10 actions .* beyond the environment's bounds"):
        data = run_episodes(source, policy, {}, [], 2, 5, 0)
    assert (data["action"] == 3.5).all()


def test_another_time_step_is_noticed_before_anything_is_done():
    source = environment_source("inverted_pendulum")
    assert agreed_time_step(source, None) == agreed_time_step(source, 0.04) == 0.04
    with pytest.raises(ValueError, match=r"dt=0.05 was given, but a step of inverted_p.* 0.04 s"):
        agreed_time_step(source, 0.05)
    count = torch.arange(20.0)[:, None].expand(20, 4)
    data = TensorDict(
        {"observation": count, "action": count[:, :1], "next": {"observation": count + 1}},
        batch_size=[20],
    )
    for step, right in ((0.04, True), (0.0405, True), (0.02, False)):
        kept = data.clone().set("dt", torch.full((20, 1), step))
        buffer = ReplayBuffer(storage=LazyTensorStorage(20))
        buffer.extend(kept)
        for form in (kept, [kept], buffer):
            if right:
                assert recorded(form, source.one(), 0.04).numel() == 20
            else:
                with pytest.raises(ValueError, match=r"with steps of 0.02 s, .* takes 0.04 s"):
                    recorded(form, source.one(), 0.04)
