"""What is particular to tasks whose observation depends on the step, or whose episodes end."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from torchrl_l1.envs import TASKS, BatchedMujocoEnv, make_env


def _swimmers(num_envs=4, **kwargs):
    env = BatchedMujocoEnv("swimmer", num_envs, seed=0, dtype=torch.float64, **kwargs)
    env.reset()
    return env


def _step(env, action):
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def _tip_x(env):
    qpos, _ = env.simulator_state()
    return qpos[:, 0] + 1.5 * np.cos(qpos[:, 2])


def test_tip_velocity_starts_at_zero_for_those_that_reset_and_stays_for_the_others():
    env, rng = _swimmers(), torch.Generator().manual_seed(0)
    chosen = torch.tensor([True, False, True, False])
    for _ in range(5):
        current = _step(env, 2 * torch.rand(4, 2, generator=rng, dtype=torch.float64) - 1)
    before = current["observation"].clone()
    assert (before[:, -1] != 0).all()
    request = TensorDict({"observation": before, "_reset": chosen.unsqueeze(-1)}, batch_size=[4])
    after = env.reset(request)["observation"]
    assert (after[chosen, -1] == 0).all()
    assert torch.equal(after[~chosen], before[~chosen])
    # The clean state within the environment agrees, not only what TorchRL merged.
    assert torch.equal(env._simulation.observation, after)
    start = _tip_x(env)
    following = _step(env, torch.ones(4, 2, dtype=torch.float64))["observation"]
    np.testing.assert_allclose(following[:, -1].numpy(), (_tip_x(env) - start) / 0.04, atol=1e-12)


def test_setting_the_state_starts_an_episode():
    env = _swimmers(2)
    _step(env, torch.ones(2, 2, dtype=torch.float64))
    assert (env.set_simulator_state(*env.simulator_state())[:, -1] == 0).all()


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_copies_in_the_middle_of_an_episode(duplicate):
    env = _swimmers(2)
    action = torch.tensor([[1.0, -1.0], [0.3, 0.9]], dtype=torch.float64)
    _step(env, action)
    twin = duplicate(env)
    assert (_step(twin, -action) == _step(env, -action)).all()


def test_a_bad_simulation_repeats_the_whole_observation():
    env = _swimmers(3)
    before = _step(env, torch.ones(3, 2, dtype=torch.float64))["observation"]
    assert (before[:, -1] != 0).all()
    batch = env._simulation.simulator.batch

    class Breaks:
        def __getattr__(self, name):
            return getattr(batch, name)

        def step(self, nstep):
            batch.step(nstep=nstep)
            batch.qvel[1, 0] = np.nan

    env._simulation.simulator.batch = Breaks()
    following = _step(env, torch.ones(3, 2, dtype=torch.float64))
    assert following["non_finite"].squeeze(-1).tolist() == [False, True, False]
    assert torch.equal(following["observation"][1], before[1])
    assert (following["observation"][[0, 2]] != before[[0, 2]]).all()
    assert following["reward"].isfinite().all()


@pytest.mark.parametrize("name", ["swimmer", "walker"])
def test_noise_does_not_reach_rewards_or_terminations(name):
    def record(**noise):
        torch.manual_seed(0)
        env = make_env(name, 3, seed=0, dtype=torch.float64, **noise)
        env.reset()
        rows = []
        generator = torch.Generator().manual_seed(1)
        for _ in range(40):
            draw = torch.rand(3, env.action_spec.shape[-1], generator=generator).double()
            rows.append(_step(env, 2 * draw - 1))
        return torch.stack(rows, 1)

    clean, noisy = record(), record(observation_noise=0.1)
    for key in ("reward", "terminated"):
        assert torch.equal(clean[key], noisy[key])
    assert clean["terminated"].any() == (name == "walker")
    noise = noisy["observation"] - clean["observation"]
    assert noise.abs().amax((0, 1)).min() > 0.09 and noise.abs().max() <= 0.1  # v_tip too


def test_action_noise_enters_the_control_costs():
    # Swimmer pays for the action as received, Hopper for the clipped one.
    for name, cost in (
        ("swimmer", lambda a: 1e-4 * a.square().sum(-1)),
        ("hopper", lambda a: 0.1 * a.clamp(-1, 1).square().sum(-1)),
    ):
        env = BatchedMujocoEnv(name, 2, seed=0, dtype=torch.float64)
        env.reset()
        state = env.simulator_state()
        bound = torch.ones(2, env.action_spec.shape[-1], dtype=torch.float64)
        rewards = []
        for action in (bound, 1.1 * bound):
            env.set_simulator_state(*state)
            rewards.append(_step(env, action)["reward"].squeeze(-1))
        # Both actions saturate the motors, so only the cost can differ.
        torch.testing.assert_close(
            rewards[1] - rewards[0], cost(bound) - cost(1.1 * bound), rtol=0, atol=1e-12
        )


def test_a_falling_walker_terminates_loses_the_one_and_restarts():
    env = BatchedMujocoEnv("walker", 2, seed=0, dtype=torch.float64)
    env.reset()
    qpos, qvel = env.simulator_state()
    qpos[1, 2], qvel[1, 2] = 0.999, 5.0  # pitch, and falling forward
    start = env.set_simulator_state(qpos, qvel)
    assert not env.task.terminated(start).any()
    stepped = env.step(TensorDict({"action": torch.zeros(2, 6)}, batch_size=[2]))
    following = stepped["next"]
    assert following["terminated"].squeeze(-1).tolist() == [False, True]
    assert following["done"].squeeze(-1).tolist() == [False, True]
    assert not following["truncated"].any() and not following["non_finite"].any()
    alive = following["reward"].squeeze(-1) - start[:, 8] + 3 * (start[:, 0] - 1.3).square()
    torch.testing.assert_close(alive, torch.tensor([1.0, 0.0], dtype=torch.float64))
    root = env.maybe_reset(step_mdp(stepped))
    assert torch.equal(root["observation"][0], following["observation"][0])
    assert root["observation"][1, 1].abs() <= 0.005


def test_a_task_may_observe_the_live_positions():
    def observe(qpos, qvel, previous_qpos):
        return qpos

    task = replace(TASKS["inverted_pendulum"], name="own", observation_dim=2, observe=observe)
    env = BatchedMujocoEnv(task, 2, seed=0, dtype=torch.float64)
    before, push = env.reset()["observation"], torch.full((2, 1), 3.0, dtype=torch.float64)
    for _ in range(3):
        following = _step(env, push)
        reward = following["reward"].squeeze(-1)
        torch.testing.assert_close(reward, -before[:, 1].square(), rtol=0, atol=0)
        before = following["observation"]
