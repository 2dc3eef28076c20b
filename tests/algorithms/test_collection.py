from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from torchrl_l1.algorithms.collection import (
    ORACLE,
    Collection,
    episode_lengths,
    episode_returns,
    first_episodes,
    policy_returns,
    return_metrics,
    returns_of_one_way,
    signal_metrics,
)
from torchrl_l1.algorithms.policy import GaussianPolicy, acting
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import Perturbation, get_task


def test_returns_are_those_of_first_episodes() -> None:
    done = torch.tensor([[0, 1, 0, 1], [0, 0, 0, 1]], dtype=torch.bool)[..., None]
    reward = torch.tensor([[1.0, 2.0, 10.0, 20.0], [1.0, 2.0, 3.0, 4.0]])[..., None]
    following = {"done": done, "episode_reward": reward}
    data = TensorDict({"next": following}, batch_size=[2, 4])
    assert episode_returns(data).tolist() == [2.0, 4.0]
    assert episode_lengths(data).tolist() == [2, 4]
    assert first_episodes(data)["next", "episode_reward"].flatten().tolist() == [1, 2, 1, 2, 3, 4]


def test_episodes_that_end_early_are_followed_by_others() -> None:
    task = get_task("walker")
    torch.manual_seed(0)
    policy = GaussianPolicy(task.observation_dim, task.action_dim, [8])
    model = EnsembleDynamics(task.observation_dim, task.action_dim, members=2, hidden=(8,))
    collection = Collection(task, 3, acting(policy, task), model, None, Perturbation(), horizon=80)
    data = collection.collect(0, 0)
    assert data.shape == (3, 80)
    ended = data["next", "terminated"].squeeze(-1)
    assert ended.any()
    assert len(episode_returns(data)) == 3
    for row in range(3):
        length = int(ended[row].nonzero()[0]) + 1
        total = data["next", "reward"][row, :length].sum()
        torch.testing.assert_close(episode_returns(data)[row], total)
        # The step after a fall shows a walker that stands.
        assert data["observation"][row, length, 0] > 1.2


def test_evaluation_ends_with_the_last_episode() -> None:
    task = get_task("walker")
    torch.manual_seed(0)
    policy = GaussianPolicy(task.observation_dim, task.action_dim, [8])
    model = EnsembleDynamics(task.observation_dim, task.action_dim, members=2, hidden=(8,))
    l1 = L1Config.paper(task.dt, epsilon=0.3, action_low=-1.0, action_high=1.0)
    collection = Collection(task, 4, acting(policy, task), model, l1, Perturbation())
    data = collection.evaluate(0, deterministic=False)
    lengths = [int(row.nonzero()[0]) + 1 for row in data["next", "done"].squeeze(-1)]
    assert data.shape == (4, max(lengths)) and min(lengths) < max(lengths) < 200
    assert len(first_episodes(data)) == sum(lengths)
    assert episode_lengths(data).tolist() == lengths
    returns = [data["next", "reward"][i, :length].sum() for i, length in enumerate(lengths)]
    torch.testing.assert_close(episode_returns(data), torch.stack(returns))


def test_the_oracle_stands_in_the_place_of_l1_and_is_labelled_alike() -> None:
    task = get_task("walker")
    torch.manual_seed(0)
    policy = GaussianPolicy(task.observation_dim, task.action_dim, [8])
    model = EnsembleDynamics(task.observation_dim, task.action_dim, members=2, hidden=(8,))
    biased = Perturbation(actuator_bias=0.25)
    collection = Collection(task, 3, acting(policy, task), model, ORACLE, biased, horizon=20)
    data = collection.collect(0, 0)
    executed = (data["action"] - 0.25).clamp(-1.0, 1.0)
    torch.testing.assert_close(data["executed"], executed)
    assert list(signal_metrics(data)) == ["non_finite_steps"]


def ended(*returns: float, terminated: bool = False) -> TensorDict:
    """Episodes of one step each."""
    done = torch.ones(len(returns), 1, 1, dtype=torch.bool)
    following = {
        "done": done,
        "terminated": done & terminated,
        "episode_reward": torch.tensor(returns).reshape(-1, 1, 1),
    }
    return TensorDict({"next": following}, batch_size=[len(returns), 1])


def test_statistics_of_returns() -> None:
    expected = {
        "return_mean": 4.0,
        "return_std": pytest.approx((38 / 3) ** 0.5),
        "return_min": 1.0,
        "return_max": 9.0,
        "episodes": 3,
    }
    assert return_metrics(ended(2.0, 9.0, 1.0)) == expected
    assert returns_of_one_way(ended(2.0, 9.0, 1.0)) == expected | {"return_deterministic": 4.0}


@pytest.mark.parametrize(
    ("horizon", "terminated", "sampled"), [(10, False, 2.0), (5, False, 20.0), (10, True, 20.0)]
)
def test_sampled_actions_are_measured_anew_unless_the_episodes_are_full(
    horizon: int, terminated: bool, sampled: float
) -> None:
    asked = []

    def evaluate(seed: int, iteration: int, deterministic: bool) -> TensorDict:
        asked.append((seed, iteration))
        return ended(300.0, 500.0) if deterministic else ended(10.0, 30.0)

    collected = SimpleNamespace(horizon=horizon)
    measured = SimpleNamespace(horizon=10, evaluate=evaluate)
    data = ended(1.0, 3.0, terminated=terminated)
    metrics = policy_returns(data, collected, measured, 7, 3)  # type: ignore[arg-type]
    assert (metrics["return_mean"], metrics["return_deterministic"]) == (sampled, 400.0)
    assert metrics["return_max"] == 1.5 * sampled
    assert set(asked) == {(7, 3)}


def test_signals_are_summed_up_as_their_words_say() -> None:
    def column(*values: float | bool) -> torch.Tensor:
        return torch.tensor(values).reshape(2, 3, 1)

    yes, no = True, False
    signals = {
        "switch": column(yes, no, no, no, no, yes),
        "saturation": column(0.0, 0.5, 1.0, 0.0, 0.0, 0.0),
        "forecast_skill": column(1.0, 1.0, 0.5, 1.0, 1.0, 0.0),
        "ill_conditioned": column(no, no, no, yes, no, no),
        "non_finite": column(no, yes, no, yes, yes, no),
    }
    # Means of 2, 12, 22, ..., the largest in the middle.
    names = ("affinization_error", "prediction_error", "matched", "unmatched", "u_a")
    for index, name in enumerate(names):
        signals[name] = column(*(10.0 * index + value for value in (1, 0, 5, 2, 3, 1)))
    lost = column(no, no, yes, no, no, yes)
    data = TensorDict({"next": {"non_finite": lost, "l1": signals}}, batch_size=[2, 3])
    expected = {
        "non_finite_steps": 2,
        "l1/switch_rate": 1 / 3,
        "l1/saturation": 0.25,
        "l1/forecast_skill": 0.75,
        "l1/ill_conditioned": 1 / 6,
        "l1/non_finite": 3,
    }
    for index, name in enumerate(names):
        expected |= {f"l1/{name}": 10 * index + 2, f"l1/{name}_max": 10 * index + 5}
    assert signal_metrics(data) == pytest.approx(expected)
