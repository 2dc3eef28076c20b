from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_l1.envs import TASKS


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
