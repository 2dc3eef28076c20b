from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchrl_l1.envs import TASKS, Task, get_task


@pytest.mark.parametrize(
    ("name", "n", "m", "dt", "horizon", "bound"),
    [("inverted_pendulum", 4, 1, 0.04, 100, 3.0), ("half_cheetah", 17, 6, 0.05, 1000, 1.0)],
)
def test_facts_of_the_published_tasks(name, n, m, dt, horizon, bound):
    task = TASKS[name]
    model = task.build_model()
    assert (task.observation_dim, task.action_dim, task.horizon) == (n, m, horizon)
    assert task.dt == pytest.approx(dt, abs=1e-12)
    assert (task.action_low, task.action_high) == (-bound, bound)
    observation = task.observe(np.zeros((5, model.nq)), np.zeros((5, model.nv)))
    assert observation.shape == (5, n)


def test_build_model_equals_gymnasiums_compilation():
    for task in TASKS.values():
        ours = task.build_model()
        theirs = mujoco.MjModel.from_xml_path(str(task.model_path))
        arrays = [name for name in dir(theirs) if isinstance(getattr(theirs, name), np.ndarray)]
        assert len(arrays) > 100
        for name in arrays:
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), name)
        assert ours.opt.integrator == theirs.opt.integrator


def test_observation_layout():
    qpos, qvel = np.arange(9.0)[None], 100 + np.arange(9.0)[None]
    expected = [1, 2, 3, 4, 5, 6, 7, 8, 100, 101, 102, 103, 104, 105, 106, 107, 108]
    np.testing.assert_array_equal(TASKS["half_cheetah"].observe(qpos, qvel), [expected])
    pendulum = TASKS["inverted_pendulum"].observe(np.array([[1.0, 2.0]]), np.array([[3.0, 4.0]]))
    np.testing.assert_array_equal(pendulum, [[1.0, 2.0, 3.0, 4.0]])


@given(
    batch=st.lists(st.integers(1, 3), max_size=2),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    seed=st.integers(0, 2**31),
)
def test_rewards_against_loops(batch, dtype, seed):
    generator = torch.Generator().manual_seed(seed)

    def draw(size):
        return 2 * torch.randn(*batch, size, generator=generator, dtype=dtype)

    for name, task in TASKS.items():
        observation, action = draw(task.observation_dim), draw(task.action_dim)
        # The reward belongs to the state before the step: whatever follows must not matter.
        following = torch.full_like(observation, float("nan"))
        reward = task.reward(observation, action, following)
        assert reward.shape == tuple(batch) and reward.dtype == dtype
        rows = zip(
            observation.reshape(-1, task.observation_dim).tolist(),
            action.reshape(-1, task.action_dim).tolist(),
            reward.reshape(-1).tolist(),
            strict=True,
        )
        for obs, act, value in rows:
            if name == "inverted_pendulum":
                expected = -(obs[1] ** 2)
            else:
                expected = obs[8] - 0.1 * sum(min(max(a, -1.0), 1.0) ** 2 for a in act)
            assert value == pytest.approx(expected, rel=1e-5, abs=1e-5)
        assert task.imagined_reward is task.reward
        assert not task.terminated(observation).any()
        assert task.terminated(observation).shape == tuple(batch)


def test_reset_distributions():
    rng = np.random.default_rng(0)
    for name, half_width in (("inverted_pendulum", 0.01), ("half_cheetah", 0.1)):
        zeros = np.zeros(9 if name == "half_cheetah" else 2)
        qpos, qvel = TASKS[name].sample_reset(rng, zeros + 5.0, zeros, 20_000)
        assert np.abs(qpos - 5.0).max() <= half_width
        np.testing.assert_allclose(qpos.std(0), half_width / np.sqrt(3), rtol=0.02)
        velocity_std = 0.1 if name == "half_cheetah" else half_width / np.sqrt(3)
        np.testing.assert_allclose(qvel.std(0), velocity_std, rtol=0.03)
        np.testing.assert_allclose(qvel.mean(0), 0, atol=4e-3 * velocity_std * 10)
        if name == "half_cheetah":
            assert np.abs(qvel).max() > 0.3  # normal, not uniform


def test_get_task_passes_tasks_through_and_lists_names():
    task = TASKS["half_cheetah"]
    assert get_task(task) is task
    with pytest.raises(KeyError, match=r"half_cheeta.*half_cheetah, inverted_pendulum"):
        get_task("half_cheeta")


def _altered(**changes: object) -> Task:
    return replace(TASKS["inverted_pendulum"], **changes)


def test_patch_edits_the_model():
    def heavier(spec: mujoco.MjSpec) -> None:
        spec.option.gravity = [0.0, 0.0, -20.0]

    assert _altered(patch=heavier).build_model().opt.gravity[2] == -20.0
    assert TASKS["inverted_pendulum"].build_model().opt.gravity[2] == pytest.approx(-9.81)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"timestep": 0.01}, "timestep"),
        ({"action_dim": 2}, "actuators"),
        ({"action_high": 1.0}, "action bounds"),
    ],
)
def test_a_changed_asset_is_noticed(changes, message):
    with pytest.raises(ValueError, match=message):
        _altered(**changes).build_model()
