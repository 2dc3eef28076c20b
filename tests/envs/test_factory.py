from __future__ import annotations

import gymnasium
import pytest
import torch
from torchrl.envs import Transform
from torchrl.envs.utils import check_env_specs

from torchrl_l1.envs import (
    DISTURBANCES,
    TASKS,
    BatchedMujocoEnv,
    disturbed_model,
    environment_source,
    get_task,
    make_env,
    suite,
)
from torchrl_l1.envs.factory import acting_on, episode_steps


class _Controller(Transform):
    """Stands where a controller would: subtracts 1 and keeps what it saw and sent."""

    def __init__(self):
        super().__init__()
        self.seen, self.sent = [], []

    def _inv_call(self, tensordict):
        self.seen.append(tensordict["observation"].clone())
        tensordict["action"] = tensordict["action"] - 1
        self.sent.append(tensordict["action"].clone())
        return tensordict


def _names(env):
    return [type(transform).__name__ for transform in env.transform]


def test_neutral_values_add_no_transform():
    env = make_env("inverted_pendulum", 2, seed=0, actuator_bias=[0.0], actuator_gain=[1.0])
    assert _names(env) == []
    twin = BatchedMujocoEnv("inverted_pendulum", 2, seed=0)
    torch.manual_seed(0)
    ours = env.rollout(100)
    torch.manual_seed(0)
    assert (ours == twin.rollout(100)).all()


def test_order_and_composition():
    controller = _Controller()
    env = make_env(
        "inverted_pendulum",
        3,
        action_noise=0.1,
        observation_noise=0.2,
        actuator_bias=0.5,
        actuator_gain=0.6,
        extra_transforms=[controller],
        seed=0,
        max_steps=5,
    )
    assert _names(env) == [
        "ActuatorGain",
        "ActuatorBias",
        "ActionNoise",
        "ObservationNoise",
        "_Controller",
    ]
    check_env_specs(env)
    controller.seen.clear()
    controller.sent.clear()
    received = []
    base_step = env.base_env._step

    def spy(tensordict):
        received.append(tensordict["action"].clone())
        return base_step(tensordict)

    env.base_env._step = spy
    rollout = env.rollout(12, break_when_any_done=False)
    assert torch.equal(torch.stack(controller.seen, 1), rollout["observation"])
    sent = torch.stack(controller.sent, 1)
    torch.testing.assert_close(sent, rollout["action"] - 1)
    noise = torch.stack(received, 1) / 0.6 - 0.5 - sent
    assert 0 < noise.abs().max() <= 0.1 + 1e-5
    assert noise.unique().numel() > 30


def test_arguments_reach_the_environment():
    env = make_env("half_cheetah", 2, seed=4, max_steps=6, dtype=torch.float64)
    assert env.rollout(100).shape == (2, 6)
    assert env.reset()["observation"].dtype == torch.float64
    twin = make_env("half_cheetah", 2, seed=4)
    again = make_env("half_cheetah", 2, seed=4)
    assert torch.equal(twin.reset()["observation"], again.reset()["observation"])


def test_errors():
    with pytest.raises(
        KeyError, match="Available: cartpole, half_cheetah, hopper, inverted_pendulum"
    ):
        make_env("pendulum", 2)
    for argument in ("action_noise", "observation_noise"):
        with pytest.raises(ValueError, match="half_width"):
            make_env("half_cheetah", 2, **{argument: -0.1})


def test_settings_of_a_task_go_through():
    name = "gymnasium/MountainCarContinuous-v0"
    env = make_env(name, 2, dt=0.5, horizon=7, seed=0)
    assert env.base_env.task.dt == 0.5 and env.rollout(20).shape == (2, 7)
    own = get_task("hopper", horizon=50)
    assert own.horizon == 50 and get_task("hopper", horizon=1000) is get_task("hopper")
    assert get_task(own, horizon=30).horizon == 30
    for settings in ({"dt": 0.3}, {"observation_keys": ["x"]}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            get_task(own, **settings)
    with pytest.raises(ValueError, match=r"horizon .* go with a name"):
        get_task(env.base_env.task, horizon=5)


@pytest.mark.filterwarnings("ignore:.* does nothing here")
@pytest.mark.parametrize(
    ("task", "idle"),
    [
        ("inverted_pendulum_unclamped", {"step", "friction", "armature", "softness"}),
        ("gymnasium/InvertedPendulum-v5", {"step", "friction", "armature", "softness", "wind"}),
        ("swimmer", {"step", "friction", "damping", "softness"}),
        ("half_cheetah", {"step"}),
    ],
)
def test_what_is_left_out_changes_no_episode_and_what_is_kept_does(task, idle):
    def episode(**disturbance):
        torch.manual_seed(0)
        env = make_env(task, 1, seed=0, max_steps=40, **disturbance)
        return env.rollout(40, break_when_any_done=False)["next", "observation"]

    can_act = acting_on(environment_source(task), 40)
    undisturbed = episode()
    assert can_act({})
    found = set()
    for cell in suite("quick")[1:]:
        if can_act(cell):
            assert not torch.equal(episode(**cell), undisturbed), cell
        else:
            found |= set(cell)
            if "wind" not in cell:
                assert torch.equal(episode(**cell), undisturbed), cell
    assert found == idle


def test_contacts_that_are_as_hard_as_the_time_step_allows():
    can_act = acting_on(environment_source("half_cheetah"), 40)
    assert [can_act({"softness": value}) for value in (0.5, 1.5)] == [False, True]


def test_steps_of_an_episode_are_those_that_environments_say():
    assert episode_steps(environment_source("hopper")) == 1000
    assert episode_steps(environment_source("gymnasium/Reacher-v5")) == 50
    unlimited = environment_source(lambda: gymnasium.make("Reacher-v5").unwrapped)
    assert episode_steps(unlimited) == float("inf")
    can_act = acting_on(environment_source("gymnasium/Reacher-v5"), 50)
    assert not can_act({"step": 0.3}) and can_act({"bias": 0.3})


def test_what_does_nothing_although_it_is_asked_for_gets_a_warning():
    with pytest.warns(UserWarning, match=r"friction 0.5 does nothing here: the model has no cont"):
        make_env("swimmer", 2, friction=0.5)
    with pytest.warns(UserWarning, match=r"step .* begins at step 50, and an episode has 50 steps"):
        make_env("gymnasium/Reacher-v5", 1, step=0.3)
    with pytest.warns(UserWarning, match=r"armature 2 does nothing here: .* no inertia of rotors"):
        environment_source("gymnasium/InvertedPendulum-v5").several(1, {"armature": 2.0})
    model = TASKS["swimmer"].build_model()
    plant = {n: e.neutral for n, e in DISTURBANCES.items() if e.of_plant and n != "wind"}
    disturbed_model(model, plant)  # without one
