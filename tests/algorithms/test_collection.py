from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_l1.algorithms.collection import (
    ORACLE,
    Collection,
    episode_lengths,
    episode_returns,
    first_episodes,
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
