"""PETS and DETS: the loop, its state, its settings."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from torchrl_l1.algorithms import PETS, PETSConfig
from torchrl_l1.algorithms.config import ModelConfig
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import FitConfig, FitReport
from torchrl_l1.planning import CEMConfig

L1 = L1Config(0.04, epsilon=0.2, action_low=-3.0, action_high=3.0)
ROBUST = L1Config.robust(0.04, covariance="sum", action_low=-3.0, action_high=3.0)


def tiny(head: str = "gaussian", **changes: object) -> PETSConfig:
    settings = {
        "outer_iterations": 2,
        "random_episodes": 2,
        "episodes_per_iteration": 2,
        "particles": 3,
        "cem": CEMConfig(horizon=4, candidates=8, elites=2, iterations=2),
        "model": ModelConfig(members=2, hidden=[8], head=head),
        "fit": FitConfig(batch_size=16, max_epochs=2),
    }
    return PETSConfig(**{**settings, **changes})  # type: ignore[arg-type]


def make(l1: L1Config | None = L1, seed: int = 0, **changes: object) -> PETS:
    return PETS("inverted_pendulum", tiny(**changes), l1=l1, seed=seed, horizon=10)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("head", "propagation"), [("gaussian", "ts1"), ("gaussian", "tsinf"), ("deterministic", "mean")]
)
def test_every_metric_is_finite(head: str, propagation: str) -> None:
    algorithm = make(head=head, propagation=propagation)
    results = [result.metrics for result in algorithm.iterate()]
    assert [metrics["real_steps"] for metrics in results] == [40, 60]
    assert all(math.isfinite(value) for metrics in results for value in metrics.values())
    assert all(metrics["return_mean"] == metrics["return_deterministic"] for metrics in results)
    data = algorithm.learning.buffer[:]
    assert data["action"].abs().max() <= 3
    # L1 acts on what the planner chose, once there is a model.
    assert not (data["action"] == data["executed"])[20:].all()


@pytest.mark.parametrize("l1", [None, L1, ROBUST], ids=["off", "paper", "robust"])
def test_resumed_run_repeats_the_unbroken_one(l1: L1Config | None) -> None:
    unbroken = [result.metrics for result in make(l1, outer_iterations=3, fit_every=2).iterate()]
    first = make(l1, outer_iterations=3, fit_every=2)
    iterations = first.iterate()
    before = [next(iterations).metrics]
    second = make(l1, outer_iterations=3, fit_every=2)
    second.load_state_dict(first.state_dict())
    after = [result.metrics for result in second.iterate()]
    assert before + after == unbroken


@pytest.mark.parametrize("shared", [True, False])
def test_candidates_meet_the_same_draws_if_asked_to(shared: bool) -> None:
    assert make(None, common_noise=shared).policy.sampler.common_noise == shared


def test_models_are_fitted_every_so_many_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    algorithm, seen = make(None, outer_iterations=3, fit_every=2), []
    fit = algorithm.learning.fit

    def watched(on_epoch: Callable[[int], None]) -> FitReport:
        seen.append(len(algorithm.learning.buffer))
        return fit(on_epoch)

    monkeypatch.setattr(algorithm.learning, "fit", watched)
    losses = [result.metrics["model/train_loss"] for result in algorithm.iterate()]
    assert seen == [20, 60]
    assert losses[0] == losses[1] != losses[2]


def test_a_plan_acts_for_so_many_steps() -> None:
    data = make(None, replan_every=3).collection.collect(0, 0)
    promised, action = data["next", "plan", "best_return"][..., 0], data["action"]
    for step in range(10):
        fresh = step % 3 == 0
        assert (promised[:, step] == promised[:, step - 1]).any() == (not fresh)
        # What is left of the plan before is where the search for the next begins.
        assert torch.equal(action[:, step], data["plan", "mean"][:, step, 0]) == (not fresh)


def test_seeds_matter() -> None:
    first = next(make(seed=0).iterate()).metrics["return_mean"]
    assert first == next(make(seed=0).iterate()).metrics["return_mean"]
    assert first != next(make(seed=1).iterate()).metrics["return_mean"]


def test_short_episodes_are_measured_on_full_ones() -> None:
    algorithm = make(episode_steps=5, evaluation_episodes=3, outer_iterations=1)
    (result,) = algorithm.iterate()
    assert result.metrics["real_steps"] == 20
    assert result.metrics["episodes"] == 3


def test_planner_balances_with_a_model_of_what_is_near_upright() -> None:
    """Random episodes of 8 steps end before the pole has fallen."""
    settings = {
        "random_episodes": 20,
        "episodes_per_iteration": 20,
        "particles": 2,
        "cem": CEMConfig(horizon=12, candidates=60, elites=8, iterations=3),
        "model": ModelConfig(members=2, hidden=[32], activation="silu"),
        "fit": FitConfig(batch_size=64, max_epochs=200, learning_rate=3e-3),
    }
    config = PETSConfig(outer_iterations=1, episode_steps=8, **settings)  # type: ignore[arg-type]
    algorithm = PETS("inverted_pendulum", config, seed=0, horizon=40)
    (result,) = algorithm.iterate()
    assert result.metrics["return_mean"] > -5  # random actions: -65 in 40 steps


@pytest.mark.parametrize(
    ("compile_plans", "plans"), [(False, "eager"), ("auto", "eager"), (True, "compiled")]
)
def test_the_log_tells_whether_plans_are_compiled(compile_plans: bool | str, plans: str) -> None:
    algorithm = make(compile_plans=compile_plans)
    assert algorithm.choices()["plans"] == plans
    assert algorithm.policy.sampler.compile == compile_plans


@pytest.mark.parametrize(
    ("changes", "culprit"),
    [
        ({"label": "both"}, "label"),
        ({"fit_every": 0}, "fit_every"),
        ({"replan_every": 5}, "cem.horizon"),
        ({"particles": 0}, "particles"),
        ({"propagation": "ts2"}, "propagation"),
        ({"precision": "float16"}, "precision"),
        ({"compile_plans": "always"}, "compile_plans must be True, False or 'auto'"),
        ({"compile_plans": True, "propagation": "ts1"}, "set compile_plans to False or 'auto'"),
        ({"evaluation_episodes": -1}, "evaluation_episodes"),
        ({"episode_steps": 0}, "episode_steps"),
        ({"head": "laplace"}, "model.head"),
    ],
)
def test_bad_settings_are_refused(changes: dict[str, object], culprit: str) -> None:
    with pytest.raises(ValueError, match=culprit):
        tiny(**changes)  # type: ignore[arg-type]
