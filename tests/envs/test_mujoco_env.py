from __future__ import annotations

import copy
import multiprocessing
import pickle
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import MultiAction, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_l1.envs import (
    TASKS,
    BatchedMujocoEnv,
    BatchedSimulator,
    ExternalEnv,
    ExternalTask,
    environment_source,
)


def _step(env, action):
    return env.step(TensorDict({"action": action}, batch_size=env.batch_size))["next"]


def pendulums(count: int) -> ExternalEnv:
    return ExternalTask(environment_source("gymnasium/Pendulum-v1")).environment(count)


def test_derived_quantities_belong_to_the_state_that_was_set():
    simulator = BatchedSimulator(TASKS["inverted_pendulum"], 2)
    positions = simulator.batch.body("cart").xpos
    simulator.set_state(np.array([[0.5, 0.0]]), np.zeros((1, 2)), [1])
    assert positions[:, 0].tolist() == [0.0, 0.5]


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize(("num_envs", "dtype"), [(1, torch.float32), (3, torch.float64)])
def test_specs(name, num_envs, dtype):
    env = BatchedMujocoEnv(name, num_envs, seed=0, dtype=dtype)
    check_env_specs(env)
    assert env.batch_size == (num_envs,)
    assert env.action_spec.space.low.unique().tolist() == [TASKS[name].action_low]
    assert env.action_spec.space.high.unique().tolist() == [TASKS[name].action_high]


def test_truncates_at_the_horizon_and_only_there():
    env = BatchedMujocoEnv("inverted_pendulum", 2, seed=0)
    rollout = env.rollout(250, break_when_any_done=False)["next"]
    ends = rollout["truncated"].squeeze(-1).nonzero()[:, 1].tolist()
    assert ends == [99, 199, 99, 199]
    assert not rollout["terminated"].any()
    torch.testing.assert_close(rollout["done"], rollout["truncated"])
    short = BatchedMujocoEnv("half_cheetah", 2, seed=0, max_steps=7)
    assert short.rollout(100).shape == (2, 7)


@given(mask=st.lists(st.booleans(), min_size=4, max_size=4), steps=st.integers(1, 9))
@settings(max_examples=15, deadline=None)
def test_partial_reset(mask, steps):
    env = BatchedMujocoEnv("half_cheetah", 4, seed=0, max_steps=10, dtype=torch.float64)
    twin = BatchedMujocoEnv("half_cheetah", 4, seed=0, max_steps=10, dtype=torch.float64)
    current = env.reset()
    twin.reset()
    actions = torch.rand(10, 4, 6, dtype=torch.float64) * 2 - 1
    for action in actions[:steps]:
        current = _step(env, action)
        _step(twin, action)
    chosen = torch.tensor(mask)
    before = current["observation"].clone()
    after = env.reset(
        TensorDict({"observation": before, "_reset": chosen.unsqueeze(-1)}, batch_size=[4])
    )
    assert torch.equal(after["observation"][~chosen], before[~chosen])
    assert (after["observation"][chosen] != before[chosen]).all()
    assert (after["observation"][chosen][:, :8].abs() <= 0.1).all()
    for count, action in enumerate(actions[steps:], start=steps + 1):
        ours, theirs = _step(env, action), _step(twin, action)
        kept = ~chosen
        assert torch.equal(ours["observation"][kept], theirs["observation"][kept])
        assert ours["truncated"].squeeze(-1)[kept].tolist() == [count == 10] * int(kept.sum())
        assert not ours["truncated"].squeeze(-1)[chosen].any()


@given(mask=st.lists(st.booleans(), min_size=3, max_size=3))
@settings(max_examples=6, deadline=None)
def test_environments_that_a_mask_leaves_out_stay_as_they_are(mask):
    env = BatchedMujocoEnv("swimmer", 3, seed=0, max_steps=5, dtype=torch.float64)
    twin = BatchedMujocoEnv("swimmer", 3, seed=0, max_steps=5, dtype=torch.float64)
    chosen = torch.tensor(mask)
    actions = torch.rand(5, 3, 2, dtype=torch.float64) * 2 - 1
    for each in (env, twin):
        before = each.step(each.reset().set("action", actions[0]))
    masked = env.step_mdp(before).set("_step", chosen.unsqueeze(-1))
    masked["action"] = actions[1].masked_fill(~chosen.unsqueeze(-1), torch.nan)
    stayed, went = env.step(masked)["next"], _step(twin, actions[1])
    assert torch.equal(stayed["observation"][chosen], went["observation"][chosen])
    assert torch.equal(stayed["observation"][~chosen], before["next", "observation"][~chosen])
    assert (stayed["reward"][~chosen] == 0).all()
    # Those left out take their second step now, the others their third.
    following = _step(env, actions[1])["observation"]
    assert torch.equal(following[~chosen], went["observation"][~chosen])
    assert env._steps.tolist() == [2 + one for one in mask]


def test_a_chunk_of_actions_ends_where_an_episode_does():
    chunks = TransformedEnv(BatchedMujocoEnv("walker", 2, seed=0), MultiAction())
    single = BatchedMujocoEnv("walker", 2, seed=0)
    actions = torch.stack([torch.zeros(150, 6), torch.full((150, 6), 1.0)])
    state = chunks.reset().set("action", actions)
    chunked = chunks.step(state)["next"]
    single.reset()
    ends, earned = [], torch.zeros(2)
    over = torch.zeros(2, 1, dtype=torch.bool)
    for action in actions.unbind(1):
        data = _step(single, action)
        earned += data["reward"].masked_fill(over, 0.0).squeeze(-1)
        over |= data["terminated"]
        ends.append(over.squeeze(-1).tolist())
    assert [False, True] in ends or [True, False] in ends
    torch.testing.assert_close(chunked["reward"].sum((1, 2)), earned)


def test_seeds():
    def record(env):
        torch.manual_seed(5)
        return env.rollout(30, break_when_any_done=False)

    env = BatchedMujocoEnv("half_cheetah", 3, seed=7, max_steps=10)
    first = record(env)
    assert (record(BatchedMujocoEnv("half_cheetah", 3, seed=7, max_steps=10)) == first).all()
    assert not torch.equal(record(env)["observation"], first["observation"])
    env.set_seed(7)
    assert (record(env) == first).all()
    env.set_seed(8)
    assert not torch.equal(record(env)["observation"], first["observation"])


@pytest.mark.parametrize("make", [partial(BatchedMujocoEnv, "hopper"), pendulums])
def test_workers_without_a_seed_differ(make, monkeypatch):
    starts = []
    for worker in ((), (1,), (2,), (1, 1), (1,)):
        monkeypatch.setattr(multiprocessing.current_process(), "_identity", worker)
        torch.manual_seed(3)  # what a fork copies
        starts.append(make(1).reset()["observation"])
    assert len({str(start.tolist()) for start in starts}) == 4
    assert torch.equal(starts[1], starts[4])


@pytest.mark.parametrize("make", [partial(BatchedMujocoEnv, "hopper"), pendulums])
def test_the_physics_stays_on_the_cpu(make):
    env = make(1)
    assert env.to("cpu") is env
    with pytest.raises(ValueError, match=r"steps on the CPU.*DeviceCastTransform\('meta'\)"):
        TransformedEnv(env, StepCounter()).to("meta")
    assert env.reset().device == torch.device("cpu")


def test_without_a_seed_torch_manual_seed_decides():
    torch.manual_seed(3)
    first = BatchedMujocoEnv("half_cheetah", 2).reset()
    second = BatchedMujocoEnv("half_cheetah", 2).reset()
    torch.manual_seed(3)
    again = BatchedMujocoEnv("half_cheetah", 2).reset()
    assert torch.equal(first["observation"], again["observation"])
    assert not torch.equal(first["observation"], second["observation"])


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
@pytest.mark.parametrize("threads", [1, 2])
def test_copies_continue_independently(duplicate, threads):
    env = BatchedMujocoEnv("half_cheetah", 2, seed=0, dtype=torch.float64, threads=threads)
    env.rollout(5)
    twin = duplicate(env)
    actions = torch.rand(5, 2, 6, dtype=torch.float64)
    expected = [_step(env, a)["observation"] for a in actions]
    found = [_step(twin, a)["observation"] for a in actions]
    assert torch.equal(torch.stack(found), torch.stack(expected))
    assert torch.equal(env.reset()["observation"], twin.reset()["observation"])


def test_observations_do_not_alias_the_clean_state():
    env = BatchedMujocoEnv("inverted_pendulum", 2, seed=0, dtype=torch.float64)
    env.reset()["observation"].fill_(7.0)
    qpos, qvel = env.simulator_state()
    qpos[:], qvel[:] = 7.0, 7.0
    following = _step(env, torch.zeros(2, 1))
    assert (following["reward"].abs() <= 0.01**2).all()
    following["observation"].fill_(7.0)
    assert (_step(env, torch.zeros(2, 1))["reward"].abs() < 0.1).all()


def test_a_diverging_simulation_ends_one_trajectory(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves MUJOCO_LOG.TXT where it warns
    env = BatchedMujocoEnv("half_cheetah", 3, seed=0, dtype=torch.float64)
    twin = BatchedMujocoEnv("half_cheetah", 3, seed=0, dtype=torch.float64)
    env.reset()
    twin.reset()
    qpos, qvel = env.simulator_state()
    twin.set_simulator_state(qpos, qvel)
    qvel[1, :] = 9e9
    before = env.set_simulator_state(qpos, qvel)
    action = torch.full((3, 6), 0.3, dtype=torch.float64)
    found = env.step(TensorDict({"action": action}, batch_size=[3]))
    following, expected = found["next"], _step(twin, action)
    for key in ("non_finite", "terminated", "done"):
        assert following[key].squeeze(-1).tolist() == [False, True, False]
    assert not following["truncated"].any()
    assert torch.equal(following["observation"][1], before[1])
    assert following["reward"].isfinite().all()
    for index in (0, 2):
        assert torch.equal(following["observation"][index], expected["observation"][index])
    # The usual machinery restarts it, and it is a normal environment again.
    root = env.step_mdp(found)
    root = env.maybe_reset(root)
    assert not root["non_finite"].any()
    assert not _step(env, action)["non_finite"].any()


def test_a_bad_state_after_the_last_substep_is_noticed():
    env = BatchedMujocoEnv("inverted_pendulum", 2, seed=0)
    before = env.reset()["observation"]
    batch = env._simulation.simulator.batch

    class LastSubstepBreaks:
        def __getattr__(self, name):
            return getattr(batch, name)

        def step(self, ids, nstep):
            batch.step(ids, nstep=nstep)
            batch.qvel[1, 0] = np.nan

    env._simulation.simulator.batch = LastSubstepBreaks()
    following = _step(env, torch.ones(2, 1))
    assert following["non_finite"].squeeze(-1).tolist() == [False, True]
    assert torch.equal(following["observation"][1], before[1])
    env._simulation.simulator.batch = batch
    assert not _step(env, torch.ones(2, 1))["non_finite"].any()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e11])
def test_bad_actions_name_the_environment(value):
    env = BatchedMujocoEnv("half_cheetah", 4, seed=0)
    env.reset()
    action = torch.zeros(4, 6)
    action[2, 3] = value
    with pytest.raises(ValueError, match="environment 2"):
        _step(env, action)


def test_bad_shapes():
    env = BatchedMujocoEnv("half_cheetah", 4, seed=0)
    env.reset()
    with pytest.raises(ValueError, match=r"\(4, 1\), expected \(4, 6\)"):
        _step(env, torch.zeros(4, 1))
    qpos, qvel = env.simulator_state()
    with pytest.raises(ValueError, match=r"qpos has shape \(4, 8\), expected \(4, 9\)"):
        env.set_simulator_state(qpos[:, 1:], qvel)
    with pytest.raises(ValueError, match=r"qvel has shape \(3, 9\), expected \(4, 9\)"):
        env.set_simulator_state(qpos, qvel[1:])
    with pytest.raises(ValueError, match="qpos has entries that are not finite"):
        env.set_simulator_state(np.full_like(qpos, np.nan), qvel)


@pytest.mark.parametrize("arguments", [{"num_envs": 0}, {"max_steps": 0}, {"threads": 0}])
def test_bad_counts(arguments):
    with pytest.raises(ValueError, match="must be at least 1"):
        BatchedMujocoEnv("half_cheetah", **arguments)
    with pytest.raises(KeyError, match="Available"):
        BatchedMujocoEnv("cheetah")


@pytest.mark.parametrize("name", TASKS)
def test_threads_change_nothing(name):
    def record(threads):
        torch.manual_seed(0)
        env = BatchedMujocoEnv(name, 5, seed=0, max_steps=7, threads=threads)
        return env.rollout(20, break_when_any_done=False)

    expected = record(1)
    for threads in (2, 3, 64):
        assert (record(threads) == expected).all()
