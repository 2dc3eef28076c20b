from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from torchrl_l1.envs import TASKS, StartStates, Task, get_task
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
