"""Algorithms on environments that are no tasks of ours."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box

from torchrl_l1.algorithms import (
    MBMF,
    METRPO,
    PETS,
    MBMFConfig,
    METRPOConfig,
    ModelConfig,
    OutcomeConfig,
    PETSConfig,
    PolicyConfig,
)
from torchrl_l1.algorithms.algorithm import Algorithm
from torchrl_l1.algorithms.mbmf_config import ClonedPolicyConfig, CloningConfig, FineTuningConfig
from torchrl_l1.algorithms.policy_improvement import SeenStarts
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import FitConfig
from torchrl_l1.envs import ExternalTask, environment_source, get_task
from torchrl_l1.objectives import TRPOConfig
from torchrl_l1.planning import CEMConfig, ShootingConfig

LOW, HIGH = (-1.0, -0.2), (1.0, 0.8)
SMALL: dict[str, Any] = {"model": ModelConfig(members=2, hidden=[8])}
FIT = FitConfig(batch_size=16, max_epochs=2)
CONFIGS: dict[type[Algorithm], Any] = {
    PETS: PETSConfig(
        outer_iterations=3, random_episodes=2, particles=2, fit=FIT,
        cem=CEMConfig(horizon=3, candidates=6, elites=2, iterations=1),
        model=ModelConfig(members=2, hidden=[8], head="gaussian"),
    ),
    METRPO: METRPOConfig(
        outer_iterations=3, episodes_per_iteration=2, evaluation_episodes=1, trpo_iterations=1,
        imagined_steps=60, imagined_horizon=6, policy=PolicyConfig(hidden=[8]), fit=FIT,
        trpo=TRPOConfig(fisher_fraction=1.0), imagined_termination=True, **SMALL,
    ),
    MBMF: MBMFConfig(
        outer_iterations=3, shooting_iterations=1, random_episodes=2, shooting_episodes=2,
        evaluation_episodes=1, fit=FIT, policy=ClonedPolicyConfig(hidden=[8]),
        shooting=ShootingConfig(horizon=3, candidates=6), model=ModelConfig(members=1, hidden=[8]),
        cloning=CloningConfig(iterations=1, episodes=1, max_epochs=2),
        fine_tuning=FineTuningConfig(episodes=2, epochs=1, value_epochs=1, minibatches=2),
    ),
}  # fmt: skip


class Raft(gymnasium.Env):
    """Two thrusters of different strength; it sinks where it drifts too far."""

    dt = 0.1
    observation_space = Box(-np.inf, np.inf, (3,), np.float64)
    action_space = Box(np.array(LOW, np.float32), np.array(HIGH, np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1.0, 1.0, 3)
        return self.state.copy(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.state[:2] += self.dt * action
        self.state[2] += self.dt * self.state[0]
        reward = -float(np.square(self.state).sum())
        return self.state.copy(), reward, bool(abs(self.state[2]) > 1.05), False, {}


def make(kind: type[Algorithm], l1: bool = False, seed: int = 0, **more: Any) -> Algorithm:
    task = ExternalTask(environment_source(Raft), horizon=12)
    settings = {
        "reward": "learned",
        "termination": "learned",
        "outcome_model": OutcomeConfig(members=2, hidden=[8]),
    }
    config = L1Config.paper(task.dt, action_low=LOW, action_high=HIGH) if l1 else None
    return kind(task, CONFIGS[kind], config, seed=seed, **{**settings, **more})


@pytest.mark.parametrize("l1", [False, True], ids=["off", "on"])
@pytest.mark.parametrize("kind", CONFIGS, ids=lambda kind: kind.__name__)
def test_resumed_run_repeats_the_unbroken_one(kind: type[Algorithm], l1: bool) -> None:
    unbroken = [result.metrics for result in make(kind, l1).iterate()]
    assert len(unbroken) == 3
    assert all(math.isfinite(row["return_mean"]) for row in unbroken)
    first = make(kind, l1)
    iterations = first.iterate()
    before = [next(iterations).metrics]
    second = make(kind, l1)
    second.load_state_dict(first.state_dict())
    after = [result.metrics for result in second.iterate()]
    # What is not a number is not equal to itself.
    assert [str(row) for row in before + after] == [str(row) for row in unbroken]
    executed = second.learning.buffer[:]["executed"]
    for entry in range(2):
        assert executed[:, entry].min() >= LOW[entry] - 1e-6
        assert executed[:, entry].max() <= HIGH[entry] + 1e-6


def test_imagination_starts_where_real_episodes_did() -> None:
    algorithm = make(METRPO)
    next(algorithm.iterate())
    starts = algorithm.improvement.start_states
    assert isinstance(starts, SeenStarts)
    buffer = algorithm.learning.buffer[:]["observation"]
    known = (starts.observations[:, None] == buffer[None]).all(-1).any(1)
    # Each episode's first step is among the data.
    assert bool(known.all()) and len(starts.observations) >= 4
    drawn = starts(50)
    assert bool((drawn[:, None] == starts.observations[None]).all(-1).any(1).all())


def test_a_reward_that_is_not_known_is_asked_for_before_work_starts() -> None:
    with pytest.raises(ValueError, match=r"say reward=learned or"):
        make(PETS, reward="builtin")
    with pytest.raises(ValueError, match=r"say termination=learned, none or"):
        make(METRPO, termination="builtin")


def test_functions_of_the_user_are_tried_on_the_environments_own_states(tmp_path: Any) -> None:
    file = tmp_path / "own.py"
    file.write_text(
        "def cost(observation, action, following):\n    return -following.square().sum(-1)\n"
        "def wide(observation, action, following):\n    return following\n"
    )
    algorithm = make(PETS, reward="own.py:cost", termination="none", search_path=[str(tmp_path)])
    x = torch.randn(4, 3)
    torch.testing.assert_close(algorithm.outcomes.reward(x, x[:, :2], x), -x.square().sum(-1))
    with pytest.raises(ValueError, match="must return shape"):
        make(PETS, reward=f"{file}:wide")


def test_known_rewards_are_those_of_imagination() -> None:
    algorithm = PETS("gymnasium/InvertedPendulum-v5", CONFIGS[PETS], horizon=10)
    task = get_task("gymnasium/InvertedPendulum-v5")
    x = torch.tensor([[0.0, 0.1, 0.0, 0.0], [0.0, 0.3, 0.0, 0.0]])
    sampler = algorithm.policy.sampler
    assert sampler.reward(x, x[:, :1], x).tolist() == [1.0, 0.0]
    assert sampler.terminated(x).tolist() == [False, True]
    assert task.horizon == 1000


def test_robust_l1_acts_within_bounds_of_each_entry() -> None:
    robust = L1Config.robust(0.1, action_low=LOW, action_high=HIGH)
    task = ExternalTask(environment_source(Raft), horizon=12)
    algorithm = PETS(task, CONFIGS[PETS], robust, reward="learned", termination="none")
    (first, *_) = algorithm.iterate()
    assert math.isfinite(first.metrics["l1/u_a"])
    executed = algorithm.learning.buffer[:]["executed"]
    assert bool((executed >= torch.tensor(LOW) - 1e-6).all())
    assert bool((executed <= torch.tensor(HIGH) + 1e-6).all())
