"""MBMF: the three stages, their state, their settings."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_l1.algorithms import MBMF, CloningConfig, MBMFConfig, ModelConfig, TuningConfig
from torchrl_l1.algorithms.mbmf_metrics import METRICS
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import FitConfig
from torchrl_l1.planning import ShootingConfig

L1 = L1Config(0.04, epsilon=0.2, action_low=-3.0, action_high=3.0)


def tiny(**changes: object) -> MBMFConfig:
    settings = {
        "outer_iterations": 6,
        "shooting_iterations": 2,
        "random_episodes": 2,
        "shooting_episodes": 2,
        "evaluation_episodes": 3,
        "shooting": ShootingConfig(horizon=4, candidates=16),
        "hidden": [8],
        "model": ModelConfig(members=1, hidden=[8]),
        "fit": FitConfig(batch_size=16, max_epochs=2),
        "cloning": CloningConfig(iterations=2, episodes=1, max_epochs=3, batch_size=16),
        "tuning": TuningConfig(episodes=2, epochs=2, value_epochs=3, minibatches=2),
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
        assert metrics.keys() <= METRICS.keys()
        assert all(math.isfinite(value) for value in metrics.values())
        with_l1 = any(name.startswith("l1/") for name in metrics)
        assert with_l1 == (metrics["stage"] == 1)
    assert set(METRICS) == {name for metrics in results for name in metrics}
    assert [metrics.get("clone/states") for metrics in results[2:4]] == [40, 50]
    assert results[4]["return_mean"] != results[4]["return_deterministic"]


@pytest.mark.parametrize("l1", [None, L1], ids=["off", "on"])
@pytest.mark.parametrize("done", range(1, 6))
def test_resumed_run_repeats_the_unbroken_one(l1: L1Config | None, done: int) -> None:
    unbroken = [result.metrics for result in make(l1).iterate()]
    first = make(l1)
    iterations = first.iterate()
    before = [next(iterations).metrics for _ in range(done)]
    second = make(l1)
    second.load_state_dict(first.state_dict())
    after = [result.metrics for result in second.iterate()]
    assert before + after == unbroken


def test_policies_are_those_of_the_stages_so_far() -> None:
    algorithm = make()
    reached = []
    assert list(algorithm.policies) == ["shooting"]
    for _ in algorithm.iterate():
        reached.append(list(algorithm.policies)[-1])
    assert reached == ["shooting", "shooting", "cloning", "cloning", "tuning", "tuning"]


def test_fine_tuning_starts_from_the_clone_and_leaves_it_alone() -> None:
    algorithm = make(outer_iterations=4)
    list(algorithm.iterate())
    cloned = {name: value.clone() for name, value in algorithm.clone.state_dict().items()}
    algorithm.config.outer_iterations = 5
    algorithm.config.tuning.learning_rate = 0.0
    list(algorithm.iterate())
    tuned = algorithm.policy.state_dict()
    assert all(
        torch.equal(tuned[name], value) for name, value in cloned.items() if name != "log_std"
    )
    assert tuned["log_std"].exp().item() == pytest.approx(0.5)
    algorithm.config.outer_iterations = 6
    algorithm.config.tuning.learning_rate = 1e-2
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
    assert wide.learning.buffer[:]["action"].abs().max() > 1.5


@pytest.mark.parametrize("states", ["current", "initial"])
def test_the_planner_labels_the_states_of_the_policy_asked_for(states: str) -> None:
    """With the published error, what has been learned never reaches the policy that collects."""
    cloning = CloningConfig(
        iterations=2, episodes=1, max_epochs=30, learning_rate=0.05, states=states, std=1e-6
    )
    algorithm = make(None, cloning=cloning, outer_iterations=4)
    iterations = algorithm.iterate()
    for _ in range(3):
        next(iterations)
    learned = algorithm.clone if states == "current" else algorithm.initial
    expected = [parameter.clone() for parameter in learned.mean.parameters()]
    normalizer = learned.normalizer.normalize(torch.ones(4))
    next(iterations)
    data = algorithm.learning.buffer[:]
    visited, action = data["observation"][-10:], data["action"][-10:]
    with torch.no_grad():
        for parameter, value in zip(learned.mean.parameters(), expected, strict=True):
            parameter.copy_(value)
    if states == "initial":
        assert torch.equal(normalizer, torch.ones(4))
        mean, _ = learned(visited)
        torch.testing.assert_close(action, mean.detach().clamp(-3, 3), atol=1e-4, rtol=1e-4)
    labels = algorithm.cloning.buffer[:]
    assert torch.equal(labels["observation"][-10:], visited)
    # They are the planner's, not what the policy did.
    assert (labels["action"][-10:] - action).abs().mean() > 0.1


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
        ({"hidden": [0]}, "hidden"),
    ],
)
def test_bad_settings_are_refused(changes: dict[str, object], culprit: str) -> None:
    with pytest.raises(ValueError, match=culprit):
        tiny(**changes)


@pytest.mark.parametrize(
    ("settings", "changes", "culprit"),
    [
        (CloningConfig, {"iterations": 0}, r"cloning\.iterations"),
        (CloningConfig, {"std": 0.0}, r"cloning\.std"),
        (CloningConfig, {"states": "all"}, r"cloning\.states"),
        (CloningConfig, {"validation_fraction": 1.0}, r"cloning\.validation_fraction"),
        (TuningConfig, {"minibatches": 0}, r"tuning\.minibatches"),
        (TuningConfig, {"clip": 0.0}, r"tuning\.clip"),
        (TuningConfig, {"entropy": -1.0}, r"tuning\.entropy"),
        (TuningConfig, {"discount": 1.5}, r"tuning\.discount"),
        (TuningConfig, {"anneal_steps": 0}, r"tuning\.anneal_steps"),
        (TuningConfig, {"value_hidden": [0]}, r"tuning\.value_hidden"),
    ],
)
def test_bad_settings_of_a_stage_are_refused(
    settings: type, changes: dict[str, object], culprit: str
) -> None:
    with pytest.raises(ValueError, match=culprit):
        settings(**changes)
