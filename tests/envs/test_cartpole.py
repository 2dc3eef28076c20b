"""The cart-pole against its equations of motion, integrated here, and its published numbers."""

from __future__ import annotations

import math

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_l1.envs import TASKS, BatchedMujocoEnv, make_env
from torchrl_l1.envs.rendering import RenderingUnavailable, rollout_frames

TASK = TASKS["cartpole"]
DENSITY, GRAVITY, DAMPING, GEAR = 1000.0, 9.81, 1.0, 100.0


def _capsule(radius, length):
    """Mass, and moment of inertia about an axis across it through its centre."""
    cylinder = DENSITY * math.pi * radius**2 * length
    cap = DENSITY * 2 / 3 * math.pi * radius**3
    # A half ball's centre is 3/8 of its radius from the plane that cuts it.
    inertia = cylinder * (radius**2 / 4 + length**2 / 12)
    inertia += 2 * cap * (83 / 320 * radius**2 + (length / 2 + 3 / 8 * radius) ** 2)
    return cylinder + 2 * cap, inertia


CART = _capsule(0.1, 0.2)[0]
POLE, INERTIA = _capsule(0.049, math.hypot(0.001, 0.6))


def _acceleration(position, velocity, action):
    """Lagrange's equations of cart and pole ``(x, theta)``; the pole hangs at zero."""
    angle, turning = position[1], velocity[1]
    # The pole's centre of mass relative to the hinge, and its derivatives by the angle.
    aside, down = 0.0005, 0.3
    slope = -(aside * math.sin(angle) + down * math.cos(angle))
    bend = -(aside * math.cos(angle) - down * math.sin(angle))
    lift = -aside * math.cos(angle) + down * math.sin(angle)
    mass = np.array(
        [
            [CART + POLE, POLE * slope],
            [POLE * slope, INERTIA + POLE * (aside**2 + down**2)],
        ]
    )
    force = GEAR * min(max(action, -3.0), 3.0)
    push = force - DAMPING * velocity[0] - POLE * bend * turning**2
    torque = -DAMPING * turning - POLE * GRAVITY * lift
    return np.linalg.solve(mass, [push, torque])


def _integrated(position, velocity, action, steps, dt):
    """Classical Runge-Kutta."""
    state = np.array([position, velocity])

    def slope(state):
        return np.array([state[1], _acceleration(*state, action)])

    for _ in range(steps):
        first = slope(state)
        second = slope(state + dt / 2 * first)
        third = slope(state + dt / 2 * second)
        fourth = slope(state + dt * third)
        state = state + dt / 6 * (first + 2 * second + 2 * third + fourth)
    return state


def _step(env, action):
    actions = torch.as_tensor(action, dtype=torch.float64).reshape(-1, 1)
    return env.step(TensorDict({"action": actions}, batch_size=env.batch_size))["next"]


def test_follows_the_equations_of_motion():
    env = BatchedMujocoEnv("cartpole", 1, seed=0, dtype=torch.float64)
    env.reset()
    rng = np.random.default_rng(0)
    for _ in range(40):
        # All angles, fast, far enough from the ends of the rail to stay off them.
        qpos = rng.uniform([-1.0, -math.pi], [1.0, math.pi])
        qvel = rng.uniform([-2.0, -8.0], [2.0, 8.0])
        env.set_simulator_state(qpos[None], qvel[None])
        for _ in range(3):
            action = rng.uniform(-4.0, 4.0)  # some beyond what the motor can do
            qpos, qvel = _integrated(qpos, qvel, action, 2, 0.02)
            found = _step(env, action)["observation"][0].numpy()
            np.testing.assert_allclose(found, [*qpos, *qvel], rtol=1e-8, atol=1e-8)


def test_one_step_is_accurate():
    env = BatchedMujocoEnv("cartpole", 1, seed=0, dtype=torch.float64)
    env.reset()
    start = np.array([[0.1, 2.0]]), np.array([[-0.5, 3.0]])
    env.set_simulator_state(*start)
    fine = _integrated(start[0][0], start[1][0], 1.5, 400, 1e-4)
    found = _step(env, 1.5)["observation"][0].numpy()
    np.testing.assert_allclose(found, fine.flatten(), rtol=1e-4)


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.0, math.pi, 9.0])
def test_the_tip_that_the_reward_means(angle):
    model = TASK.build_model()
    data = mujoco.MjData(model)
    data.qpos[:] = 0.4, angle
    mujoco.mj_kinematics(model, data)
    pole = data.body("pole")
    tip = pole.xpos + pole.xmat.reshape(3, 3) @ [0.0, 0.0, -0.6]
    square = tip[0] ** 2 + (tip[2] - 0.6) ** 2
    state = torch.tensor([0.4, angle, 0.3, -0.2], dtype=torch.float64)
    reward = TASK.reward(torch.full_like(state, 7.0), torch.zeros(1), state)
    assert reward.item() == pytest.approx(math.exp(-square / 0.36), rel=1e-12)


def test_rewards_computed_by_hand():
    still = torch.zeros(4)
    upright = torch.tensor([0.0, math.pi, 0.0, 0.0])
    level = torch.tensor([0.6, math.pi / 2, 0.0, 0.0])  # the tip over the middle, 0.6 m too low
    for state, nearness in ((still, math.exp(-4)), (upright, 1.0), (level, math.exp(-1))):
        for force in (0.0, 3.0, -4.0):
            reward = TASK.reward(still, torch.tensor([force]), state)
            assert reward.item() == pytest.approx(nearness - 0.01 * force**2, abs=1e-6)


def test_the_reward_of_a_step_is_that_of_the_state_reached():
    env = BatchedMujocoEnv("cartpole", 3, seed=0, dtype=torch.float64)
    env.reset()
    action = torch.tensor([[2.0], [-3.0], [5.0]], dtype=torch.float64)
    following = _step(env, action)
    x, theta = following["observation"][:, 0], following["observation"][:, 1]
    square = (x - 0.6 * theta.sin()) ** 2 + (0.6 + 0.6 * theta.cos()) ** 2
    expected = torch.exp(-square / 0.36) - 0.01 * action[:, 0] ** 2
    torch.testing.assert_close(following["reward"][:, 0], expected, rtol=1e-12, atol=1e-12)


def test_the_rail_ends():
    env = BatchedMujocoEnv("cartpole", 2, seed=0, dtype=torch.float64)
    env.reset()
    for _ in range(100):
        following = _step(env, [3.0, -3.0])
    position = following["observation"][:, 0]
    assert (position * torch.tensor([1, -1]) > 2.4).all() and position.abs().max() < 2.7
    assert not following["done"].any()


def test_noise_and_disturbances():
    env = make_env(
        "cartpole", 2, action_noise=0.3, observation_noise=0.01, actuator_bias=1.0, seed=0
    )
    check_env_specs(env)
    weak = make_env("cartpole", 1, actuator_gain=0.5, seed=0, dtype=torch.float64)
    strong = make_env("cartpole", 1, seed=0, dtype=torch.float64)
    weak.reset()
    strong.reset()
    assert torch.equal(_step(weak, [2.0])["observation"], _step(strong, [1.0])["observation"])


def test_an_episode_of_the_single_environment_lasts_200_steps():
    env = gymnasium.make("torchrl_l1/Cartpole-v0")
    env.reset(seed=0)
    flags = [env.step(np.zeros(1))[2:4] for _ in range(200)]
    assert flags == [(False, False)] * 199 + [(False, True)]
    assert env.unwrapped.metadata["render_fps"] == 25


def test_frames_follow_the_cart():
    poses = np.array([[0.0, 0.0], [0.0, math.pi], [1.2, math.pi]])
    try:
        frames = rollout_frames("cartpole", poses, size=(160, 120))
    except RenderingUnavailable as error:
        pytest.skip(f"this machine has no off-screen OpenGL: {error}")
    pole = []
    for frame in frames:
        red, green, blue = frame.astype(int).transpose(2, 0, 1)
        pole.append(np.argwhere((green > red + 40) & (blue > red + 40)).mean(0))
    hanging, upright, moved = pole
    assert hanging[0] > 60 + 5 and upright[0] < 60 - 5
    # The camera goes with the cart; what moves in the picture is the marked rail.
    np.testing.assert_allclose(moved, upright, atol=1)
    assert not np.array_equal(frames[1], frames[2])
