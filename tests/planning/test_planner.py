from __future__ import annotations

import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import InitTracker
from torchrl.modules.utils import get_primers_from_module

from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import TASKS, make_env
from torchrl_l1.planning import (
    CEMConfig,
    ModelPredictiveController,
    MPPIConfig,
    ShootingConfig,
    TrajectorySampler,
    planner,
)

CONFIG = CEMConfig(horizon=4, candidates=24, elites=4, iterations=2)


def upright(x, u, successor):
    return -successor[..., 1].square()


def make_controller(config=CONFIG, low=-3.0, high=3.0, **settings) -> ModelPredictiveController:
    torch.manual_seed(0)
    model = EnsembleDynamics(4, 1, members=2, hidden=(8,))
    sampler = TrajectorySampler(model, upright, particles=3, precision="float32")
    return ModelPredictiveController(sampler, config, low, high, **settings)


def fresh(controller, batch=(3,), **changes) -> TensorDict:
    data = controller.make_primer().primers.zero(batch)
    data = TensorDict({"plan": data["plan"], "observation": torch.zeros(*batch, 4)}, batch)
    return data.update(changes)


class Recorder:
    """Stands in for the sampler: keeps what it is asked and prefers high actions."""

    def __init__(self, controller: ModelPredictiveController) -> None:
        self.dynamics = controller.sampler.dynamics
        self.observations: list[torch.Tensor] = []
        self.first: list[torch.Tensor] = []

    def evaluator(self, observation, generator=None):
        self.observations.append(observation)
        asked = []

        def evaluate(actions):
            if not asked:
                asked.append(actions)
                # Shooting's first candidate is the mean that it was given.
                self.first.append(actions[:, 0])
            return actions.sum((-2, -1))

        return evaluate


def recorded(**settings) -> tuple[ModelPredictiveController, Recorder]:
    controller = make_controller(ShootingConfig(4, 50), low=-1.0, high=3.0, **settings)
    recorder = controller.sampler = Recorder(controller)
    return controller, recorder


def follow(controller, data, **changes) -> TensorDict:
    """The next step's input."""
    following = data["next", "plan"].clone()
    return fresh(controller, data.batch_size, plan=following, **changes)


def test_next_plan_starts_from_the_shifted_one():
    controller, recorder = recorded()
    data = controller(fresh(controller))
    # Fresh: the middle of the bounds.
    assert torch.equal(recorder.first[0], torch.ones(3, 4, 1))
    assert torch.equal(data["next", "plan", "step"], torch.ones(3, 1, dtype=torch.int64))
    assert (data["next", "plan", "mean"][:, -1] == 1).all()
    plan = data["next", "plan", "mean"]
    following = controller(follow(controller, data))
    assert torch.equal(recorder.first[1], plan)
    # Nothing worse than the start is taken.
    gained = following["next", "plan", "best_return"][..., 0]
    assert (gained >= plan.sum((-2, -1)) - 1e-5).all()
    assert torch.equal(following["next", "plan", "step"], torch.full((3, 1), 2))


@pytest.mark.parametrize("how", ["primer", "is_init"])
def test_a_reset_restarts_only_its_environment(how):
    controller, recorder = recorded()
    data = controller(follow(controller, controller(fresh(controller))))
    following = follow(controller, data)
    if how == "is_init":
        following["is_init"] = torch.tensor([[False], [True], [False]])
    else:
        zero = controller.make_primer().primers["plan"].zero([])
        following["plan"][1] = zero
    previous = data["next", "plan", "mean"]
    after = controller(following)
    assert torch.equal(recorder.first[-1][[0, 2]], previous[[0, 2]])
    assert torch.equal(recorder.first[-1][1], torch.ones(4, 1))
    assert after["next", "plan", "step"].flatten().tolist() == [3, 1, 3]


def test_plans_every_few_steps_counted_from_each_reset():
    controller, recorder = recorded(replan_every=2)
    observation = torch.arange(12.0).reshape(3, 4)
    data = controller(fresh(controller, observation=observation))
    rest = data["next", "plan", "mean"]
    second = follow(controller, data, observation=observation)
    second["is_init"] = torch.tensor([[False], [False], [True]])
    second = controller(second)
    # Two go on as planned, one was reset and planned.
    assert torch.equal(second["action"][:2], rest[:2, 0])
    assert torch.equal(recorder.observations[1], observation[2:])
    shifted = torch.cat([rest[:2, 1:], torch.ones(2, 1, 1)], 1)
    assert torch.equal(second["next", "plan", "mean"][:2], shifted)
    assert torch.equal(
        second["next", "plan", "best_return"][:2], data["next", "plan", "best_return"][:2]
    )
    third = controller(follow(controller, second, observation=observation))
    assert torch.equal(recorder.observations[2], observation[:2])
    assert torch.equal(third["action"][2], second["next", "plan", "mean"][2, 0])
    controller(follow(controller, third, observation=observation))
    assert torch.equal(recorder.observations[3], observation[2:])
    assert len(recorder.observations) == 4


@pytest.mark.parametrize("config", [CONFIG, MPPIConfig(4, 24), ShootingConfig(4, 24)])
@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_any_optimiser_and_batch_size(config, batch):
    controller = make_controller(config)
    data = controller(fresh(controller, batch))
    assert data["action"].shape == (*batch, 1)
    assert (data["action"].abs() <= 3).all()
    assert data["next", "plan", "mean"].shape == (*batch, 4, 1)
    assert set(controller.out_keys) <= set(data.keys(True, True))


@pytest.mark.parametrize("num_envs", [1, 3])
def test_is_a_policy_for_a_collector(num_envs):
    controller = make_controller(generator=torch.Generator().manual_seed(0))
    env = make_env(
        "inverted_pendulum",
        num_envs,
        seed=0,
        max_steps=5,
        extra_transforms=[InitTracker(), controller.make_primer()],
    )
    collector = Collector(
        env,
        controller,
        frames_per_batch=12 * num_envs,
        total_frames=24 * num_envs,
        auto_register_policy_transforms=False,
    )
    first, second = (batch.clone() for batch in collector)
    collector.shutdown()
    assert first["action"].shape == (num_envs, 12, 1)
    for data in (first, second):
        # The state at each step is what the step before left, unless the episode ended there.
        goes_on = ~data["next", "done"][:, :-1, 0]
        left = data["next", "plan", "mean"][:, :-1][goes_on]
        assert torch.equal(data["plan", "mean"][:, 1:][goes_on], left)
        assert (data["plan", "step"][:, 1:][~goes_on] == 0).all() and (~goes_on).any()
    # Episodes go on from batch to batch, and so do plans.
    assert first["plan", "step"][0, :, 0].tolist() == [0, 1, 2, 3, 4] * 2 + [0, 1]
    assert second["plan", "step"][0, 0, 0] == 2


def test_torchrl_finds_the_primer():
    controller = make_controller()
    env = make_env(
        "inverted_pendulum", 2, seed=0, extra_transforms=[get_primers_from_module(controller)]
    )
    data = env.rollout(3, controller)
    assert data["next", "plan", "step"][:, :, 0].tolist() == [[1, 2, 3]] * 2


def integrator(linear, terminated=None) -> ModelPredictiveController:
    """A point at x' = x + 0.1 u that is paid for going right."""
    sampler = TrajectorySampler(
        linear([[[0.0]], [[0.0]]], [[[0.1]], [[0.12]]]),
        lambda x, u, successor: 1.0 + successor[..., 0],
        terminated,
        particles=3,
        precision="float32",
    )
    return ModelPredictiveController(
        sampler,
        CEMConfig(8, 200, 20, 5),
        -1.0,
        1.0,
        generator=torch.Generator().manual_seed(0),
    )


@pytest.mark.parametrize("ends", [False, True])
def test_avoids_what_terminates_the_model(linear, ends):
    controller = integrator(linear, (lambda x: x[..., 0] > 1) if ends else None)
    x, visited = torch.tensor([[0.0], [0.8]]), []
    data = fresh(controller, (2,), observation=x)
    for _ in range(25):
        data = controller(data)
        x = x + 0.12 * data["action"]
        visited.append(x)
        data = follow(controller, data, observation=x)
    highest = torch.stack(visited).amax(0)
    if ends:
        # Near the edge, where it pays, and not beyond it.
        assert (highest <= 1).all() and (highest > 0.9).all()
    else:
        assert (highest > 1.5).all()


def test_the_plan_stays_where_nothing_is_finite():
    controller = make_controller()
    with torch.no_grad():
        controller.sampler.dynamics.network.biases[-1].fill_(math.nan)
    data = fresh(controller)
    data["plan", "step"] += 1
    data["plan", "mean"] += 0.25
    out = controller(data)
    assert torch.equal(out["action"], torch.full((3, 1), 0.25))
    assert (out["next", "plan", "best_return"] == -math.inf).all()
    # An observation that is not finite stops only its own environment.
    controller = make_controller()
    data = fresh(controller)
    data["observation"][1] = math.nan
    out = controller(data)
    assert torch.isfinite(out["action"]).all()
    assert torch.isfinite(out["next", "plan", "best_return"])[:, 0].tolist() == [True, False, True]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_reward_that_is_not_finite_is_named(value):
    controller = make_controller()
    controller.sampler = TrajectorySampler(
        controller.sampler.dynamics, lambda x, u, successor: x[..., 0] + value
    )
    with pytest.raises(ValueError, match=f"the reward function gives {value} at the observation"):
        controller(fresh(controller))


def test_the_model_is_referred_to_and_seen_to_change():
    def act(controller):
        controller.generator = torch.Generator().manual_seed(3)
        return controller(fresh(controller, observation=0.5 * torch.ones(3, 4)))["action"]

    controller = make_controller()
    assert not list(controller.parameters()) and not controller.state_dict()
    before = act(controller)
    assert torch.equal(act(controller), before)
    assert torch.equal(act(pickle.loads(pickle.dumps(make_controller()))), before)
    with torch.no_grad():
        controller.sampler.dynamics.network.weights[0].neg_()
    assert not torch.equal(act(controller), before)


@pytest.mark.parametrize("config", [CONFIG, MPPIConfig(4, 24), ShootingConfig(4, 24)])
def test_plans_for_observations_are_those_of_fresh_environments(config):
    controller, observation = make_controller(config, low=-1.0), torch.randn(5, 4)

    def seeded():
        controller.generator = torch.Generator().manual_seed(0)
        return controller

    data = seeded()(fresh(controller, (5,), observation=observation))
    plan = seeded().plan(observation)
    assert torch.equal(plan.actions[:, 0], data["action"])
    assert torch.equal(plan.best_return[:, None], data["next", "plan", "best_return"])
    again = seeded().plan(observation.double(), torch.ones(5, 4, 1))
    assert torch.equal(again.actions, plan.actions)  # one is the middle of the bounds


def test_many_observations_are_planned_for_in_portions(monkeypatch):
    # Two environments at a time: 50 candidates of 4 actions each.
    monkeypatch.setattr(planner, "_PORTION", 2 * 50 * 4 + 1)
    controller, recorder = recorded()
    observation, start = torch.randn(5, 4), torch.rand(5, 4, 1)
    plan = controller.plan(observation, start)
    assert [len(portion) for portion in recorder.observations] == [2, 2, 1]
    assert torch.equal(torch.cat(recorder.observations), observation)
    assert torch.equal(torch.cat(recorder.first), start)
    assert plan.actions.shape == (5, 4, 1) and plan.best_return.shape == (5,)
    torch.testing.assert_close(plan.actions.sum((1, 2)), plan.best_return)


def test_no_environments_get_no_actions():
    data = make_controller()(fresh(make_controller(), (2, 0)))
    assert data["action"].shape == (2, 0, 1) and data["next", "plan", "mean"].shape == (2, 0, 4, 1)


def test_a_generator_of_another_device_is_named():
    sampler = TrajectorySampler(make_controller().sampler.dynamics.to("meta"), upright)
    with pytest.raises(ValueError, match=r"is on cpu, but .* on meta.*torch.Generator\('meta'\)"):
        ModelPredictiveController(sampler, CONFIG, -1.0, 1.0, generator=torch.Generator())


def test_plans_of_bad_observations():
    controller = make_controller()
    observation = torch.randn(3, 4)
    observation[1] = math.nan
    plan = controller.plan(observation, torch.full((3, 4, 1), 0.5))
    assert torch.isneginf(plan.best_return).tolist() == [False, True, False]
    assert (plan.actions[1] == 0.5).all() and (plan.actions[[0, 2]] != 0.5).any()
    for wrong in (torch.zeros(3, 5), torch.zeros(4), torch.zeros(0, 4), torch.zeros(())):
        with pytest.raises(ValueError, match=r"observation must have shape \(N, 4\) with at least"):
            controller.plan(wrong)
    for wrong in (torch.zeros(3, 4), torch.zeros(2, 4, 1), torch.zeros(3, 5, 1)):
        with pytest.raises(ValueError, match=r"start must have shape \(3, 4, 1\) for these"):
            controller.plan(torch.zeros(3, 4), wrong)
    controller.sampler = TrajectorySampler(
        controller.sampler.dynamics, lambda x, u, successor: x[..., 0] + math.nan
    )
    with pytest.raises(ValueError, match="the reward function gives nan at the observation"):
        controller.plan(torch.zeros(3, 4))


def test_a_reward_that_is_no_number_where_something_moves_is_named():
    controller = make_controller()
    controller.sampler = TrajectorySampler(
        controller.sampler.dynamics,
        lambda x, u, successor: torch.where((successor == x).all(-1), 0.0, torch.nan),
    )
    with pytest.raises(ValueError, match=r"gives nan at the observation .* and the next"):
        controller.plan(torch.ones(3, 4))


def test_a_start_that_is_no_number_is_named():
    with pytest.raises(ValueError, match="start must be finite"):
        make_controller().plan(torch.zeros(3, 4), torch.full((3, 4, 1), torch.nan))


def test_bad_settings_are_named():
    for wrong, message in (
        ({"low": 3.0}, "bounds are empty"),
        ({"high": [1.0, 2.0]}, r"bound high has shape \(2,\), expected \(1,\)"),
        ({"replan_every": 0}, "replan_every must be at least 1, got 0"),
        ({"replan_every": 1.5}, "replan_every must be an integer, got 1.5"),
        ({"high": torch.finfo(torch.float32).max}, "bound high must be finite"),
        ({"replan_every": 5}, "replan_every must be between 1 and the horizon 4, got 5"),
    ):
        with pytest.raises(ValueError, match=message):
            make_controller(**wrong)
    with pytest.raises(TypeError, match=r"config must be one of CEMConfig, .* got dict"):
        make_controller({"horizon": 3})


def test_bad_data_are_named():
    controller = make_controller()
    data = fresh(controller)
    with pytest.raises(KeyError, match=r"found no 'observation' in the tensordict, only .*plan"):
        controller(data.exclude("observation"))
    with pytest.raises(KeyError, match=r"found no \('plan', 'mean'\): append the primer"):
        controller(data.exclude("plan"))
    with pytest.raises(ValueError, match=r"'observation' has shape \(3, 5\), expected \(3, 4\)"):
        controller(data.clone().update({"observation": torch.zeros(3, 5)}))
    with pytest.raises(ValueError, match=r"float64, but plans are float32: append DoubleToFloat"):
        controller(data.clone().update({"observation": torch.zeros(3, 4).double()}))
    data["plan", "mean"] = torch.zeros(3, 6, 1)
    with pytest.raises(ValueError, match=r"\('plan', 'mean'\) has shape .* expected \(3, 4, 1\)"):
        controller(data)


def test_takes_reward_and_termination_of_every_task():
    for task in TASKS.values():
        torch.manual_seed(0)
        env = make_env(task, 2, seed=0)
        n = env.observation_spec["observation"].shape[-1]
        sampler = TrajectorySampler(
            EnsembleDynamics(n, task.action_dim, members=2, hidden=(8,)),
            task.imagined_reward,
            task.terminated,
            particles=3,
            propagation="ts1",
        )
        controller = ModelPredictiveController(sampler, CONFIG, task.action_low, task.action_high)
        data = TensorDict({"observation": env.reset()["observation"]}, [2])
        data["plan"] = controller.make_primer().primers["plan"].zero([2])
        assert torch.isfinite(controller(data)["next", "plan", "best_return"]).all()
