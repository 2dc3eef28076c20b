from __future__ import annotations

import math
from dataclasses import replace

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_l1.envs import TASKS, BatchedMujocoEnv, StartStates, Task, get_task, make_env
from torchrl_l1.envs.rendering import RenderingUnavailable, rollout_frames
from torchrl_l1.envs.tasks import Task as TaskOfTheTable


@pytest.mark.parametrize(
    ("name", "n", "m", "dt", "horizon", "bound"),
    [
        ("inverted_pendulum", 4, 1, 0.04, 100, 3.0),
        ("inverted_pendulum_unclamped", 4, 1, 0.04, 100, 3.0),
        ("swimmer", 9, 2, 0.04, 1000, 1.0),
        ("hopper", 11, 3, 0.008, 1000, 1.0),
        ("walker", 17, 6, 0.008, 1000, 1.0),
        ("half_cheetah", 17, 6, 0.05, 1000, 1.0),
        ("cartpole", 4, 1, 0.04, 200, 3.0),
    ],
)
def test_facts_of_the_published_tasks(name, n, m, dt, horizon, bound):
    task = TASKS[name]
    model = task.build_model()
    assert (task.observation_dim, task.action_dim, task.horizon) == (n, m, horizon)
    assert task.dt == pytest.approx(dt, abs=1e-12)
    assert (task.action_low, task.action_high) == (-bound, bound)
    qpos = np.zeros((5, model.nq))
    assert task.observe(qpos, np.zeros((5, model.nv)), qpos).shape == (5, n)


def test_the_observation_of_swimmer_uses_its_own_duration():
    task = TASKS["swimmer"]
    moved, zeros = np.array([[task.dt, 0, 0, 0, 0]]), np.zeros((1, 5))
    assert task.observe(moved, zeros, zeros)[0, -1] == pytest.approx(1.0)


@pytest.mark.parametrize("name", TASKS)
def test_build_model_equals_mujocos_compilation_of_the_file(name):
    task = TASKS[name]
    ours = task.build_model()
    theirs = mujoco.MjModel.from_xml_path(str(task.model_path))
    if name == "inverted_pendulum_unclamped":
        assert theirs.actuator_ctrllimited.all() and not ours.actuator_ctrllimited.any()
        theirs.actuator_ctrllimited[:] = 0
    arrays = [name for name in dir(theirs) if isinstance(getattr(theirs, name), np.ndarray)]
    assert len(arrays) > 100
    for array in arrays:
        np.testing.assert_array_equal(getattr(ours, array), getattr(theirs, array), array)
    assert ours.opt.integrator == theirs.opt.integrator


def test_walkers_feet_differ_as_the_authors_do():
    model = TASKS["walker"].build_model()
    friction = {foot: model.geom(foot).friction[0] for foot in ("foot_geom", "foot_left_geom")}
    assert friction == {"foot_geom": 0.9, "foot_left_geom": 1.9}


@pytest.mark.parametrize("name", TASKS)
def test_imagined_starts_are_those_of_the_real_task(name):
    task = TASKS[name]
    torch.manual_seed(0)
    starts = StartStates(name)(4000)
    assert starts.shape == (4000, task.observation_dim) and starts.dtype == torch.float32
    if name == "cartpole":
        torch.testing.assert_close(starts.std(0), torch.full((4,), 0.1), rtol=0.05, atol=0)
        torch.testing.assert_close(starts.mean(0), torch.zeros(4), rtol=0, atol=0.01)
        return
    rest = {"hopper": 1.25, "walker": 1.25}
    width = {"swimmer": 0.1, "half_cheetah": 0.1, "hopper": 0.005, "walker": 0.005}
    torch.testing.assert_close(
        starts[:, 0].mean(), torch.tensor(rest.get(name, 0.0)), rtol=0, atol=0.01
    )
    assert (starts[:, 0] - rest.get(name, 0.0)).abs().max() <= width.get(name, 0.01) + 1e-6
    assert not task.terminated(starts).any()
    if name == "swimmer":
        assert (starts[:, -1] == 0).all()


def test_get_task_passes_tasks_through_and_lists_names():
    task = TASKS["half_cheetah"]
    assert get_task(task) is task
    assert TaskOfTheTable is Task
    with pytest.raises(KeyError, match=r"half_cheeta.*half_cheetah, hopper, inverted_pendulum"):
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


def _clipped_cost(action):
    return 0.1 * sum(min(max(a, -1.0), 1.0) ** 2 for a in action)


def _standing(state):
    return 0.8 < state[0] < 2.0 and -1.0 < state[1] < 1.0


def _expected(name, imagined, before, action, after):
    """The published formulas, one transition of plain numbers at a time."""
    if name.startswith("inverted_pendulum"):
        return -(before[1] ** 2)
    if name == "cartpole":
        tip = (after[0] - 0.6 * math.sin(after[1]), -0.6 * math.cos(after[1]))
        distance = math.dist(tip, (0.0, 0.6))
        return math.exp(-((distance / 0.6) ** 2)) - 0.01 * action[0] ** 2
    if name == "swimmer":
        return (before if imagined else after)[8] - 1e-4 * sum(a * a for a in action)
    speed = before[5 if name == "hopper" else 8] - _clipped_cost(action)
    if name == "half_cheetah":
        return speed
    if name == "hopper":
        return speed - 3 * (before[0] - 1.3) ** 2 + 1
    height = (after if imagined else before)[0]
    return speed - 3 * (height - 1.3) ** 2 + (1 if _standing(after) else 0)


@pytest.mark.parametrize("name", TASKS)
@given(
    batch=st.lists(st.integers(1, 3), max_size=2),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=25, deadline=None)
def test_rewards_and_terminations_against_loops(name, batch, dtype, seed):
    task = TASKS[name]
    generator = torch.Generator().manual_seed(seed)

    def draw(size):
        return 1.5 * torch.randn(*batch, size, generator=generator, dtype=dtype)

    n = task.observation_dim
    before, action, after = draw(n), draw(task.action_dim), draw(n)
    after[..., 0] = after[..., 0].abs()  # heights, so that some walkers stand
    fallen = task.terminated(after)
    assert fallen.shape == tuple(batch) and fallen.dtype == torch.bool
    for imagined, function in ((False, task.reward), (True, task.imagined_reward)):
        reward = function(before, action, after)
        assert reward.shape == tuple(batch) and reward.dtype == dtype
        rows = (x.reshape(-1, x.shape[-1]).tolist() for x in (before, action, after))
        found = zip(*rows, reward.reshape(-1).tolist(), fallen.reshape(-1).tolist(), strict=True)
        for s, a, following, value, ended in found:
            expected = _expected(name, imagined, s, a, following)
            assert value == pytest.approx(expected, rel=1e-5, abs=1e-5)
            assert ended == (name == "walker" and not _standing(following))


def test_only_the_known_tasks_imagine_another_reward():
    differing = {name for name, task in TASKS.items() if task.imagined_reward is not task.reward}
    assert differing == {"swimmer", "walker"}


@pytest.mark.parametrize(
    ("height", "pitch", "fallen"),
    [
        (1.25, 0.0, False),
        (0.8, 0.0, True),
        (0.8001, 0.0, False),
        (1.9999, 0.0, False),
        (2.0, 0.0, True),
        (1.25, 1.0, True),
        (1.25, -1.0, True),
        (1.25, 0.9999, False),
        (1.25, -0.9999, False),
    ],
)
def test_bounds_of_a_standing_walker(height, pitch, fallen):
    state = torch.zeros(17, dtype=torch.float64)
    state[0], state[1] = height, pitch
    task = TASKS["walker"]
    assert bool(task.terminated(state)) is fallen
    lying = task.reward(torch.zeros(17), torch.zeros(6), torch.zeros(17))
    reward = task.reward(torch.zeros(17), torch.zeros(6), state)
    assert reward - lying == (0.0 if fallen else 1.0)


def test_observation_layouts():
    qpos, qvel = np.arange(9.0)[None], 100 + np.arange(9.0)[None]
    expected = [1, 2, 3, 4, 5, 6, 7, 8, 100, 101, 102, 103, 104, 105, 106, 107, 108]
    for name in ("half_cheetah", "walker"):
        np.testing.assert_array_equal(TASKS[name].observe(qpos, qvel, 7 * qpos), [expected])
    hopper = TASKS["hopper"].observe(qpos[:, :6], qvel[:, :6], qpos[:, :6])
    np.testing.assert_array_equal(hopper, [[1, 2, 3, 4, 5, 100, 101, 102, 103, 104, 105]])
    for name in ("inverted_pendulum", "inverted_pendulum_unclamped", "cartpole"):
        pendulum = TASKS[name].observe(qpos[:, 1:3], qvel[:, 3:5], qpos[:, 1:3])
        np.testing.assert_array_equal(pendulum, [[1, 2, 103, 104]])


@given(
    x=st.floats(-50, 50),
    dx=st.floats(-1, 1),
    angle=st.floats(-10, 10),
    turn=st.floats(-1, 1),
)
def test_swimmers_last_entry_is_the_velocity_of_its_tip(x, dx, angle, turn):
    qpos = np.array([[x + dx, 3.0, angle + turn, 0.4, 0.5]])
    previous = np.array([[x, -3.0, angle, -0.4, -0.5]])
    qvel = np.arange(10.0, 15.0)[None]
    found = TASKS["swimmer"].observe(qpos, qvel, previous)
    np.testing.assert_array_equal(found[0, :8], [angle + turn, 0.4, 0.5, 10, 11, 12, 13, 14])
    expected = (dx + 1.5 * math.cos(angle + turn) - 1.5 * math.cos(angle)) / 0.04
    assert found[0, 8] == pytest.approx(expected, abs=1e-9)
    assert TASKS["swimmer"].observe(qpos, qvel, qpos)[0, 8] == 0


@pytest.mark.parametrize(
    ("name", "half_width"),
    [("inverted_pendulum", 0.01), ("swimmer", 0.1), ("hopper", 0.005), ("walker", 0.005)],
)
def test_uniform_resets(name, half_width):
    rng, start = np.random.default_rng(0), np.array([5.0, 0.0, 1.25])
    for values in TASKS[name].sample_reset(rng, start, start, 20_000):
        assert values.shape == (20_000, 3)
        assert 0.999 * half_width < np.abs(values - start).max() <= half_width * (1 + 1e-9)
        np.testing.assert_allclose(values.std(0), half_width / np.sqrt(3), rtol=0.02)
        np.testing.assert_allclose(values.mean(0), start, atol=0.03 * half_width)


def test_cheetah_resets():
    rng, zeros = np.random.default_rng(0), np.zeros(9)
    qpos, qvel = TASKS["half_cheetah"].sample_reset(rng, zeros + 5.0, zeros, 20_000)
    assert np.abs(qpos - 5.0).max() <= 0.1
    np.testing.assert_allclose(qpos.std(0), 0.1 / np.sqrt(3), rtol=0.02)
    np.testing.assert_allclose(qvel.std(0), 0.1, rtol=0.03)
    np.testing.assert_allclose(qvel.mean(0), 0, atol=4e-3)
    assert np.abs(qvel).max() > 0.3  # normal, not uniform


def test_cartpole_resets():
    rng, start = np.random.default_rng(0), np.array([5.0, 0.0])
    for values in TASKS["cartpole"].sample_reset(rng, start, start, 20_000):
        assert values.shape == (20_000, 2)
        np.testing.assert_allclose(values.std(0), 0.1, rtol=0.03)
        np.testing.assert_allclose(values.mean(0), start, atol=4e-3)
        assert np.abs(values - start).max() > 0.3  # normal, not uniform


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


def _cartpole_step(env, action):
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
            found = _cartpole_step(env, action)["observation"][0].numpy()
            np.testing.assert_allclose(found, [*qpos, *qvel], rtol=1e-8, atol=1e-8)


def test_one_step_is_accurate():
    env = BatchedMujocoEnv("cartpole", 1, seed=0, dtype=torch.float64)
    env.reset()
    start = np.array([[0.1, 2.0]]), np.array([[-0.5, 3.0]])
    env.set_simulator_state(*start)
    fine = _integrated(start[0][0], start[1][0], 1.5, 400, 1e-4)
    found = _cartpole_step(env, 1.5)["observation"][0].numpy()
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
    following = _cartpole_step(env, action)
    x, theta = following["observation"][:, 0], following["observation"][:, 1]
    square = (x - 0.6 * theta.sin()) ** 2 + (0.6 + 0.6 * theta.cos()) ** 2
    expected = torch.exp(-square / 0.36) - 0.01 * action[:, 0] ** 2
    torch.testing.assert_close(following["reward"][:, 0], expected, rtol=1e-12, atol=1e-12)


def test_the_rail_ends():
    env = BatchedMujocoEnv("cartpole", 2, seed=0, dtype=torch.float64)
    env.reset()
    for _ in range(100):
        following = _cartpole_step(env, [3.0, -3.0])
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
    assert torch.equal(
        _cartpole_step(weak, [2.0])["observation"], _cartpole_step(strong, [1.0])["observation"]
    )


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
