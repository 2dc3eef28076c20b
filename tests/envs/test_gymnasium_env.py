from __future__ import annotations

import re
import warnings

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict

from torchrl_l1.envs import (
    TASKS,
    BatchedMujocoEnv,
    MujocoTaskEnv,
    gymnasium_id,
    register_tasks,
)


def test_names_and_horizons():
    expected = {
        "InvertedPendulum": 100,
        "InvertedPendulumUnclamped": 100,
        "Swimmer": 1000,
        "Hopper": 1000,
        "Walker": 1000,
        "HalfCheetah": 1000,
        "Cartpole": 200,
    }
    registered = {
        spec.name: spec.max_episode_steps
        for spec in gymnasium.registry.values()
        if spec.namespace == "torchrl_l1"
    }
    assert registered == expected
    register_tasks()  # again: no warning, no second entry
    env = gymnasium.make("torchrl_l1:torchrl_l1/Walker-v0")
    assert env.unwrapped.task is TASKS["walker"]


@pytest.mark.parametrize("name", TASKS)
def test_env_checker(name):
    env = gymnasium.make(gymnasium_id(name)).unwrapped
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=True)
    # Gymnasium's own MuJoCo environments have unbounded observations as well.
    expected = re.compile(
        "Box observation space m.* value is -?infinity|action space.* symmetric and normalized"
    )
    assert [str(w.message) for w in caught if not expected.search(str(w.message))] == []


@pytest.mark.parametrize("name", TASKS)
def test_same_episodes_as_the_batched_environment(name):
    single = gymnasium.make(gymnasium_id(name))
    batched = BatchedMujocoEnv(name, 1, seed=3, dtype=torch.float64)
    observation, info = single.reset(seed=3)
    assert info == {} and observation.dtype == np.float64
    np.testing.assert_array_equal(observation, batched.reset()["observation"][0].numpy())
    rng = np.random.default_rng(0)
    task, falls = TASKS[name], 0
    for _ in range(60):
        action = 1.2 * rng.uniform(task.action_low, task.action_high, task.action_dim)
        observation, reward, terminated, truncated, info = single.step(action)
        step = TensorDict({"action": torch.from_numpy(action)[None]}, batch_size=[1])
        following = batched.step(step)["next"]
        np.testing.assert_array_equal(observation, following["observation"][0].numpy())
        assert type(reward) is float and type(terminated) is bool
        assert reward == following["reward"].item()
        assert terminated == following["terminated"].item()
        assert (truncated, info) == (False, {"non_finite": False})
        for ours, theirs in zip(
            single.unwrapped.simulator_state(), batched.simulator_state(), strict=True
        ):
            np.testing.assert_array_equal(ours, theirs[0])
        if terminated:
            falls += 1
            observation, _ = single.reset()  # resets go on alike too
            np.testing.assert_array_equal(observation, batched.reset()["observation"][0].numpy())
    assert (falls > 0) == (name == "walker")


def test_truncates_at_the_horizon():
    env = gymnasium.make(gymnasium_id("inverted_pendulum"))
    env.reset(seed=0)
    flags = [env.step(np.zeros(1))[2:4] for _ in range(100)]
    assert flags == [(False, False)] * 99 + [(False, True)]


def test_seeds():
    env = MujocoTaskEnv("half_cheetah")
    first, second = env.reset(seed=5)[0], env.reset()[0]
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(env.reset(seed=5)[0], first)
    np.testing.assert_array_equal(env.reset()[0], second)
    assert not np.array_equal(env.reset(seed=6)[0], first)
    assert not np.array_equal(MujocoTaskEnv("half_cheetah").reset()[0], first)


def test_vector_environments():
    envs = gymnasium.make_vec("torchrl_l1/Swimmer-v0", num_envs=2)
    assert envs.reset(seed=[1, 2])[0].shape == (2, 9)
    _, reward, *_, info = envs.step(envs.action_space.sample())
    assert reward.shape == (2,) and info["non_finite"].tolist() == [False, False]
    envs.close()


def test_observations_are_copies():
    env = MujocoTaskEnv("inverted_pendulum")
    env.reset(seed=0)[0][:] = 7.0
    observation, reward, *_ = env.step(np.zeros(1))
    assert abs(reward) <= 0.01**2
    observation[:] = 7.0
    assert abs(env.step(np.zeros(1))[1]) < 0.1


def test_setting_the_state():
    env = MujocoTaskEnv("inverted_pendulum")
    env.reset(seed=0)
    observation = env.set_simulator_state(np.array([0.1, 0.2]), np.array([0.3, 0.4]))
    assert observation.tolist() == [0.1, 0.2, 0.3, 0.4]
    assert env.step(np.zeros(1))[1] == -(0.2**2)
    with pytest.raises(ValueError, match=r"qpos has shape \(1, 3\), expected \(1, 2\)"):
        env.set_simulator_state(np.zeros(3), np.zeros(2))


def test_a_bad_simulation_ends_the_episode(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves MUJOCO_LOG.TXT where it warns
    env = MujocoTaskEnv("half_cheetah")
    env.reset(seed=0)
    before = env.set_simulator_state(np.zeros(9), np.full(9, 9e9))
    observation, reward, terminated, truncated, info = env.step(np.zeros(6))
    np.testing.assert_array_equal(observation, before)
    assert np.isfinite(reward)
    assert (terminated, truncated, info) == (True, False, {"non_finite": True})
    env.reset()
    assert env.step(np.zeros(6))[4] == {"non_finite": False}


def test_bad_input():
    env = MujocoTaskEnv("half_cheetah")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action has shape \(1,\), expected \(6,\)"):
        env.step(np.zeros(1))
    with pytest.raises(ValueError, match="finite"):
        env.step(np.array([0, 0, np.nan, 0, 0, 0]))
    with pytest.raises(ValueError, match=r"render_mode must be None or one of \['rgb_array'\]"):
        MujocoTaskEnv("half_cheetah", render_mode="ascii")
    with pytest.raises(KeyError, match="Available"):
        MujocoTaskEnv("cheetah")


class _Renderer:
    """Stands for MuJoCo's, which needs OpenGL; draws where the camera looks and what it sees."""

    def __init__(self, model, height, width):
        assert (model.vis.global_.offwidth, model.vis.global_.offheight) >= (width, height)
        self.size, self.closed = (height, width), False

    def update_scene(self, data, camera):
        self.camera, self.heights = camera, data.xpos[:, 2].copy()

    def render(self):
        return np.full((*self.size, 3), 255, dtype=np.uint8)

    def close(self):
        self.closed = True


@pytest.mark.parametrize(
    ("name", "camera"), [("walker", "track"), ("inverted_pendulum", -1), ("cartpole", "track")]
)
def test_frames_show_the_current_state(monkeypatch, name, camera):
    monkeypatch.setattr(mujoco, "Renderer", _Renderer)
    env = MujocoTaskEnv(name, render_mode="rgb_array", width=800, height=60)
    env.reset(seed=0)
    state = env.simulator_state()
    assert env.render().shape == (60, 800, 3)
    renderer = env._renderer
    data = mujoco.MjData(env.task.build_model())
    data.qpos[:] = state[0]
    mujoco.mj_kinematics(data.model, data)
    np.testing.assert_array_equal(renderer.heights, data.xpos[:, 2])
    assert renderer.camera == camera
    np.testing.assert_array_equal(env.simulator_state(), state)
    env.render()
    assert env._renderer is renderer
    env.close()
    assert renderer.closed
    env.close()


def test_without_opengl_or_a_render_mode(monkeypatch):
    def unavailable(*args):
        raise AttributeError("no EGL here")

    monkeypatch.setattr(mujoco, "Renderer", unavailable)
    env = gymnasium.make("torchrl_l1/Walker-v0", render_mode="rgb_array")
    env.reset(seed=0)
    with pytest.raises(RuntimeError, match="MUJOCO_GL to egl or osmesa"):
        env.render()
    assert env.unwrapped.metadata["render_fps"] == 125
    with pytest.warns(UserWarning, match="without a render mode"):
        assert MujocoTaskEnv("walker").render() is None
