"""MBMF: the three stages, their state, their settings."""

from __future__ import annotations

import itertools
import math
from copy import deepcopy
from functools import cache
from typing import Any

import pytest
import torch

from torchrl_l1.algorithms import (
    MBMF,
    CloningConfig,
    FineTuningConfig,
    MBMFConfig,
    ModelConfig,
    Perturbation,
)
from torchrl_l1.algorithms.collection import Collection
from torchrl_l1.algorithms.mbmf_config import ClonedPolicyConfig
from torchrl_l1.algorithms.outcomes import OUTCOME_METRICS
from torchrl_l1.control import L1Config, L1Transform
from torchrl_l1.dynamics import FitConfig
from torchrl_l1.envs.perturbations import ActionNoise, ObservationNoise
from torchrl_l1.planning import ShootingConfig

METRICS = MBMF.facts.metrics.keys() - OUTCOME_METRICS.keys()

L1 = L1Config(0.04, epsilon=0.2, action_low=-3.0, action_high=3.0)
ROBUST = L1Config.robust(0.04, action_low=-3.0, action_high=3.0)


def tiny(**changes: object) -> MBMFConfig:
    settings = {
        "outer_iterations": 6,
        "shooting_iterations": 2,
        "random_episodes": 2,
        "shooting_episodes": 2,
        "evaluation_episodes": 3,
        "shooting": ShootingConfig(horizon=4, candidates=16),
        "policy": ClonedPolicyConfig(hidden=[8]),
        "model": ModelConfig(members=1, hidden=[8]),
        "fit": FitConfig(batch_size=16, max_epochs=2),
        "cloning": CloningConfig(iterations=2, episodes=1, max_epochs=3, batch_size=16),
        "fine_tuning": FineTuningConfig(episodes=2, epochs=2, value_epochs=3, minibatches=2),
    }
    return MBMFConfig(**{**settings, **changes})  # type: ignore[arg-type]


def make(l1: L1Config | None = L1, seed: int = 0, **changes: object) -> MBMF:
    return MBMF("inverted_pendulum", tiny(**changes), l1=l1, seed=seed, horizon=10)


def test_every_stage_reports_what_it_did() -> None:
    algorithm = make()
    results = [result.metrics for result in algorithm.iterate()]
    assert [metrics["stage"] for metrics in results] == [1, 1, 2, 2, 3, 3]
    # 20 random ones, twice 20 planned ones, 10 in the second round of cloning, twice 20.
    assert [metrics["real_steps"] for metrics in results] == [40, 60, 60, 70, 90, 110]
    for metrics in results:
        assert metrics.keys() <= METRICS
        assert all(math.isfinite(value) for value in metrics.values())
        with_l1 = any(name.startswith("l1/") for name in metrics)
        assert with_l1 == (metrics["stage"] == 1)
    assert set(METRICS) == {name for metrics in results for name in metrics}
    assert [metrics.get("clone/states") for metrics in results[2:4]] == [40, 50]
    assert results[4]["return_mean"] != results[4]["return_deterministic"]


CONTROLLERS = {"off": None, "paper": L1, "robust": ROBUST}


@cache
def saved(l1: str) -> tuple[list[dict[str, float]], list[dict[str, Any]]]:
    """The metrics of a run, and its state after each iteration."""
    algorithm, rows, states = make(CONTROLLERS[l1]), [], []
    for result in algorithm.iterate():
        rows.append(result.metrics)
        states.append(deepcopy(algorithm.state_dict()))
    # To save it changes nothing.
    assert rows == [result.metrics for result in make(CONTROLLERS[l1]).iterate()]
    return rows, states


@pytest.mark.parametrize(
    ("l1", "done"), [*itertools.product(["off", "paper"], range(1, 6)), ("robust", 1)]
)
def test_resumed_run_repeats_the_unbroken_one(l1: str, done: int) -> None:
    rows, states = saved(l1)
    resumed = make(CONTROLLERS[l1])
    resumed.load_state_dict(deepcopy(states[done - 1]))
    assert [result.metrics for result in resumed.iterate()] == rows[done:]


def test_the_policy_that_labels_states_is_part_of_the_state() -> None:
    first, second = make(), make(seed=1)
    state = deepcopy(first.state_dict())
    second.load_state_dict(state)
    for one, other in zip(first.initial.parameters(), second.initial.parameters(), strict=True):
        assert torch.equal(one, other)
    del state["initial"]  # as in older checkpoints
    make().load_state_dict(state)


def test_policies_are_those_of_the_stages_so_far() -> None:
    algorithm = make()
    reached = []
    assert list(algorithm.policies) == ["shooting"]
    for _ in algorithm.iterate():
        reached.append(list(algorithm.policies)[-1])
    assert reached == ["shooting", "shooting", "cloning", "cloning", "fine_tuning", "fine_tuning"]


def test_fine_tuning_starts_from_the_clone_and_leaves_it_alone() -> None:
    algorithm = make(outer_iterations=4)
    list(algorithm.iterate())
    cloned = {name: value.clone() for name, value in algorithm.clone.state_dict().items()}
    algorithm.config.outer_iterations = 5
    algorithm.config.fine_tuning.learning_rate = 0.0
    list(algorithm.iterate())
    tuned = algorithm.policy.state_dict()
    assert all(
        torch.equal(tuned[name], value) for name, value in cloned.items() if name != "log_std"
    )
    assert tuned["log_std"].exp().item() == pytest.approx(0.5)
    algorithm.config.outer_iterations = 6
    algorithm.config.fine_tuning.learning_rate = 1e-2
    list(algorithm.iterate())
    assert all(torch.equal(algorithm.clone.state_dict()[k], v) for k, v in cloned.items())
    assert not torch.equal(algorithm.policy.mean[0].weight, algorithm.clone.mean[0].weight)


def test_random_and_planned_actions_stay_within_their_bound() -> None:
    algorithm = make(None, action_bound=1.0, outer_iterations=2)
    list(algorithm.iterate())
    action = algorithm.learning.buffer[:]["action"]
    assert 0.9 < action.abs().max() <= 1.0
    wide = make(None, outer_iterations=2)
    list(wide.iterate())
    action = wide.learning.buffer[:]["action"]
    assert action[:20].abs().max() > 1.5 and action[20:].abs().max() > 1.5


@pytest.mark.parametrize("states", ["current", "initial"])
def test_the_planner_labels_the_states_of_the_policy_asked_for(states: str) -> None:
    """With the published error, what has been learned never reaches the policy that collects."""
    cloning = CloningConfig(
        iterations=3, episodes=1, max_epochs=30, learning_rate=0.05, label_states=states, std=1e-6
    )
    algorithm = make(None, cloning=cloning, outer_iterations=5)
    iterations = algorithm.iterate()
    for _ in range(3):
        next(iterations)
    for _ in range(2):
        before = deepcopy(algorithm.clone if states == "current" else algorithm.initial)
        next(iterations)
        data = algorithm.learning.buffer[:][-10:]
        mean, _ = before(data["observation"])
        expected = mean.detach().clamp(-3, 3)
        torch.testing.assert_close(data["action"], expected, atol=1e-4, rtol=1e-4)
        labels = algorithm.cloning.buffer[:][-10:]
        assert torch.equal(labels["observation"], data["observation"])
        # They are the planner's, not what the policy did.
        assert (labels["action"] - data["action"]).abs().mean() > 0.1


def test_labels_are_drawn_even_where_doing_nothing_is_best() -> None:
    """No plan is there to go on with; the middle of the bounds must not pass for one."""
    algorithm = make(None)
    iterations = algorithm.iterate()
    for _ in range(4):
        next(iterations)
    labels = algorithm.cloning.buffer[:]["action"][-10:]
    assert (labels != 0).all()
    upright = torch.zeros(20, 4)
    assert (algorithm.labeller.plan(upright).actions[:, 0] != 0).all()


def test_only_fresh_plans_are_cloned_and_what_was_planned_not_what_acted() -> None:
    algorithm = make(L1, replan_every=3, outer_iterations=2)
    list(algorithm.iterate())
    # 4 of the 10 steps of each of 4 episodes.
    assert len(algorithm.cloning.buffer) == 16
    real, cloned = algorithm.learning.buffer[:], algorithm.cloning.buffer[:]
    last = real[-10:]
    torch.testing.assert_close(cloned["action"][-4:], last["action"][::3])
    assert not torch.equal(cloned["action"][-4:], last["executed"][::3])


def test_later_rewards_count_for_less_in_plans() -> None:
    algorithm = make(None, plan_discount=0.9)
    assert [one.sampler.discount for one in (algorithm.planner, algorithm.labeller)] == [0.9] * 2


def test_noise_is_in_all_stages_and_l1_around_the_planner_alone() -> None:
    perturbation = Perturbation(action_noise=0.1, observation_noise=0.2)
    algorithm = MBMF("inverted_pendulum", tiny(), L1, perturbation, horizon=10)
    stages = {k: v for k, v in vars(algorithm).items() if isinstance(v, Collection)}
    assert len(stages) == 7
    for name, collection in stages.items():
        kinds = {type(transform) for transform in collection.env.transform}
        assert {ActionNoise, ObservationNoise} <= kinds, name
        assert (L1Transform in kinds) == (name in ("start", "shooting", "shooting_measured")), name


def test_step_size_falls_with_the_real_steps_of_fine_tuning() -> None:
    settings = FineTuningConfig(
        episodes=2, epochs=1, value_epochs=1, minibatches=2, anneal_steps=50, learning_rate=1e-3
    )
    algorithm = make(None, fine_tuning=settings, outer_iterations=8)
    rates = []
    for result in algorithm.iterate():
        if result.metrics["stage"] == 3:
            rates.append(algorithm.fine_tuning.optimizers["policy"].param_groups[0]["lr"])
    assert rates == pytest.approx([1e-3, 0.6e-3, 0.2e-3, 0.0])


def test_episodes_that_end_early_go_through_all_stages() -> None:
    algorithm = MBMF("walker", tiny(), None, horizon=40)
    results = [result.metrics for result in algorithm.iterate()]
    assert [metrics["stage"] for metrics in results] == [1, 1, 2, 2, 3, 3]
    assert all(math.isfinite(value) for metrics in results for value in metrics.values())
    # Each environment takes as many steps as a full episode has.
    assert results[-1]["real_steps"] == 40 * (2 + 4 + 1 + 4)
    assert algorithm.practice.collect(0, 9)["next", "terminated"].any()


def test_networks_are_saved_once_their_stage_has_begun() -> None:
    algorithm = make(None)
    names = [list(algorithm.weights()) for _ in algorithm.iterate()]
    assert names == [["model"]] * 2 + [["model", "clone"]] * 2 + [["model", "clone", "policy"]] * 2


def test_short_episodes_are_measured_on_full_ones() -> None:
    algorithm = make(episode_steps=5)
    results = [result.metrics for result in algorithm.iterate()]
    assert [metrics["real_steps"] for metrics in results] == [20, 30, 30, 35, 45, 55]
    assert [metrics["episodes"] for metrics in results] == [2, 2, 3, 3, 3, 3]


def test_the_clone_acts_as_well_as_the_planner() -> None:
    """A real, short run: both hold the pole, which random actions drop within half a second."""
    algorithm = MBMF(
        "inverted_pendulum",
        MBMFConfig(
            outer_iterations=6,
            shooting_iterations=4,
            random_episodes=20,
            random_steps=8,
            shooting_episodes=10,
            evaluation_episodes=10,
            shooting=ShootingConfig(horizon=12, candidates=200),
            model=ModelConfig(members=1, hidden=[32], activation="silu"),
            fit=FitConfig(batch_size=64, max_epochs=200, learning_rate=3e-3),
            cloning=CloningConfig(iterations=2, episodes=10, max_epochs=100, batch_size=64),
        ),
        seed=0,
        horizon=40,
    )
    results = [result.metrics for result in algorithm.iterate()]
    planner, clone = results[3]["return_mean"], results[5]["return_mean"]
    assert planner > -3  # random actions: -65
    assert clone >= planner


@pytest.mark.parametrize(
    ("changes", "culprit"),
    [
        ({"label": "both"}, "label"),
        ({"shooting_iterations": 0}, "shooting_iterations"),
        ({"evaluation_episodes": 0}, "evaluation_episodes"),
        ({"replan_every": 5}, "shooting.horizon"),
        ({"particles": 0}, "particles"),
        ({"propagation": "ts2"}, "propagation"),
        ({"episode_steps": 0}, "episode_steps"),
        ({"plan_discount": 0.0}, "plan_discount"),
        ({"action_bound": 0.0}, "action_bound"),
    ],
)
def test_bad_settings_are_refused(changes: dict[str, object], culprit: str) -> None:
    with pytest.raises(ValueError, match=culprit):
        tiny(**changes)


@pytest.mark.parametrize(
    ("settings", "changes", "culprit"),
    [
        (ClonedPolicyConfig, {"hidden": [0]}, r"policy\.hidden"),
        (CloningConfig, {"iterations": 0}, r"cloning\.iterations"),
        (CloningConfig, {"std": 0.0}, r"cloning\.std"),
        (CloningConfig, {"label_states": "all"}, r"cloning\.label_states"),
        (CloningConfig, {"validation_fraction": 1.0}, r"cloning\.validation_fraction"),
        (FineTuningConfig, {"minibatches": 0}, r"fine_tuning\.minibatches"),
        (FineTuningConfig, {"clip_epsilon": 1.5}, r"fine_tuning\.clip_epsilon"),
        (FineTuningConfig, {"entropy_coefficient": -1.0}, r"fine_tuning\.entropy"),
        (FineTuningConfig, {"discount": 1.5}, r"fine_tuning\.discount"),
        (FineTuningConfig, {"anneal_steps": 0}, r"fine_tuning\.anneal_steps"),
        (FineTuningConfig, {"value_hidden": [0]}, r"fine_tuning\.value_hidden"),
    ],
)
def test_bad_settings_of_a_stage_are_refused(
    settings: type, changes: dict[str, object], culprit: str
) -> None:
    with pytest.raises(ValueError, match=culprit):
        settings(**changes)
