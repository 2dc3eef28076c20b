"""The registry: what every disturbance has, its suites, and the chain that they make."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs.utils import check_env_specs

from torchrl_l1.envs import (
    DISTURBANCES,
    SUITES,
    ActionNoise,
    ActuatorBias,
    BatchedMujocoEnv,
    Perturbation,
    Uniform,
    make_env,
    suite,
)

ENTRIES = list(DISTURBANCES.values())


@pytest.mark.parametrize("entry", ENTRIES, ids=DISTURBANCES)
def test_each_works_by_name_and_by_setting_and_changes_the_motion(entry):
    (value,) = entry.levels["quick"]
    assert value in entry.levels["full"] or entry.name == "bias"
    assert entry.neutral not in entry.levels["full"]

    def record(**values):
        torch.manual_seed(0)
        env = make_env("half_cheetah", 2, seed=0, **values)
        return env, env.rollout(60)["next", "observation"]

    env, named = record(**{entry.name: value})
    assert torch.equal(named, record(**{entry.setting: value})[1])
    assert not torch.equal(named, record()[1])
    check_env_specs(env)
    assert len(env.transform) == (entry.acts_on != "plant")
    for transform in env.transform:
        assert transform.matched == entry.matched
        assert hasattr(transform, "compensate") or not entry.matched


def test_neutral_values_are_left_out_and_the_motion_is_bit_identical():
    neutral = {entry.setting: entry.neutral for entry in ENTRIES}
    env = make_env("hopper", 2, seed=0, **neutral)
    assert len(env.transform) == 0
    assert env.base_env._simulation.simulator.plant is None
    twin = BatchedMujocoEnv("hopper", 2, seed=0)
    rollouts = []
    for one in (env, twin):
        torch.manual_seed(0)
        rollouts.append(one.rollout(50, break_when_any_done=False))
    assert (rollouts[0] == rollouts[1]).all()


@pytest.mark.parametrize("make", [lambda: ActuatorBias(0.5), lambda: ActionNoise(0.5)])
def test_stored_data_are_refused(make):
    data = TensorDict({"action": torch.zeros(2, 1)}, batch_size=[2])
    buffer = ReplayBuffer(storage=LazyTensorStorage(4), transform=make())
    with pytest.raises(RuntimeError, match=r"belongs to an environment .*not to a replay buffer"):
        buffer.extend(data)


def test_weights_of_another_environment_do_not_change_the_disturbance():
    env, other = (make_env("hopper", bias=bias) for bias in (0.5, 0.25))
    env.load_state_dict(other.state_dict())
    assert env.transform[0].value == 0.5


def test_chain_of_all():
    values = {entry.name: entry.levels["quick"][0] for entry in ENTRIES}
    env = make_env("half_cheetah", 2, seed=0, action_noise=0.1, observation_noise=0.1, **values)
    assert [type(one).__name__ for one in env.transform] == [
        *("ActuatorDelay", "Stiction", "DeadZone", "FailingMotor", "WalkBias", "StepBias"),
        *("SineBias", "ActuatorBias", "ActuatorGain", "ActuatorBias", "ActionNoise"),
        *("ObservationNoise", "SensorBias", "SensorDelay", "SensorDropout"),
    ]
    check_env_specs(env)
    plant = [entry.name for entry in ENTRIES if entry.of_plant]
    assert list(env.base_env._simulation.simulator.plant.values) == plant


def test_arguments_are_given_once_and_known():
    with pytest.raises(TypeError, match="'actuator_bias' twice"):
        make_env("hopper", bias=0.1, actuator_bias=0.2)
    with pytest.raises(TypeError, match="no argument 'viscosity'"):
        make_env("hopper", viscosity=0.1)
    env = make_env("hopper", 3, gain=Uniform(0.5, 1.0, shared=True), mass=[1.0, 2.0, 3.0], seed=0)
    assert env.rollout(5).shape[0] == 3


@pytest.mark.parametrize("name", SUITES)
def test_suites_hold_single_disturbances_after_none(name):
    cells = suite(name)
    assert cells[0] == {} and all(len(cell) == 1 for cell in cells[1:])
    assert len({str(cell) for cell in cells}) == len(cells)
    assert {next(iter(cell)) for cell in cells[1:]} == set(DISTURBANCES)
    for cell in cells[1:]:
        ((disturbance, value),) = cell.items()
        Perturbation(**{DISTURBANCES[disturbance].setting: value})
    with pytest.raises(ValueError, match="unknown suite 'all'; there are quick, full"):
        suite("all")


def test_recipes_refuse_values_before_any_work():
    for setting, value, message in (
        ("actuator_delay", 0.5, "whole"),
        ("body_mass", 0.0, "must be positive"),
        ("sensor_dropout", 2.0, "between 0 and 1"),
        ("ground_slope", 90.0, "within 90 degrees"),
    ):
        with pytest.raises(ValueError, match=rf"perturbation\.{setting}: .*{message}"):
            Perturbation(**{setting: value})


def test_the_page_names_them_all():
    page = (Path(__file__).parents[2] / "docs" / "disturbances.md").read_text(encoding="utf-8")
    for entry in ENTRIES:
        row = next(line for line in page.splitlines() if line.startswith(f"| `{entry.name}` "))
        assert f"`{entry.setting}`" in row and entry.acts_on in row
        assert ("| yes |" in row) == entry.matched


def test_delays_that_are_drawn_are_whole_numbers_alike():
    torch.manual_seed(0)
    env = make_env("hopper", 300, delay=Uniform(0, 3, shared=True), seed=0)
    env.reset()
    counts = env.transform[0]._state["value"].flatten().long().bincount()
    assert counts.shape == (3,) and counts.min() > 70
    assert env.rollout(3).shape == (300, 3)
