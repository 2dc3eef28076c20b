from __future__ import annotations

import math
from copy import deepcopy

import pytest
import torch
from torchrl.data import ReplayBuffer

from torchrl_l1.algorithms import METRPO, METRPOConfig, Perturbation
from torchrl_l1.algorithms.config import ModelConfig
from torchrl_l1.algorithms.metrpo_config import PolicyConfig
from torchrl_l1.algorithms.outcomes import OUTCOME_METRICS
from torchrl_l1.algorithms.policy_improvement import PolicyStep
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import FitConfig
from torchrl_l1.objectives import TRPOConfig

METRICS = METRPO.facts.metrics.keys() - OUTCOME_METRICS.keys()

L1 = L1Config(0.04, epsilon=0.2, action_low=-3.0, action_high=3.0)
ROBUST = L1Config.robust(0.04, action_low=-3.0, action_high=3.0)


def tiny(**changes: object) -> METRPOConfig:
    settings = {
        "outer_iterations": 2,
        "episodes_per_iteration": 3,
        "trpo_iterations": 2,
        "imagined_steps": 200,
        "imagined_horizon": 20,
        "label": "executed",
        "model": ModelConfig(members=2, hidden=[16]),
        "policy": PolicyConfig(hidden=[8]),
        "fit": FitConfig(batch_size=32, max_epochs=3),
        "trpo": TRPOConfig(fisher_fraction=1.0),
    }
    return METRPOConfig(**{**settings, **changes})  # type: ignore[arg-type]


def make(l1: L1Config | None = L1, seed: int = 0, **changes: object) -> METRPO:
    return METRPO("inverted_pendulum", tiny(**changes), l1=l1, seed=seed, horizon=25)


def test_a_covariance_that_the_model_does_not_tell_is_refused() -> None:
    few = ModelConfig(members=1, hidden=[8])
    for covariance, settings, words in (
        ("heads", {}, "set model.head=gaussian"),
        ("disagreement", {"model": few}, "model.members is 1"),
        ("disagreement", {"fit": FitConfig(elites=1)}, "fit.elites is 1"),
    ):
        config = tiny(**settings)
        for l1 in (
            L1Config.robust(0.04, covariance=covariance),
            L1Config(0.04, estimator="weighted", covariance=covariance),
        ):
            with pytest.raises(ValueError, match=f"l1.covariance={covariance} .*{words}"):
                METRPO("inverted_pendulum", config, l1)
        METRPO("inverted_pendulum", config, L1Config(0.04, covariance=covariance))
    METRPO("inverted_pendulum", tiny(model=few), L1Config.robust(0.04, covariance="sum"))


def test_every_metric_is_documented_and_finite() -> None:
    results = [result.metrics for result in make().iterate()]
    assert set(results[0]) == set(METRICS)
    assert all(math.isfinite(value) for metrics in results for value in metrics.values())
    assert [metrics["iteration"] for metrics in results] == [0, 1]
    # 3 episodes of 25 random steps, then as many per iteration.
    assert [metrics["real_steps"] for metrics in results] == [150, 225]


def test_without_l1_there_are_no_l1_metrics() -> None:
    (metrics, _) = [result.metrics for result in make(l1=None).iterate()]
    assert set(metrics) == {name for name in METRICS if not name.startswith("l1/")}


def test_buffer_holds_the_policy_action_and_the_executed_one() -> None:
    algorithm = make()
    list(algorithm.iterate())
    data = algorithm.learning.buffer[:]
    assert data.shape == (225,)
    assert data["action"].abs().max() <= 3
    random, learned = data[:75], data[75:]
    assert torch.equal(random["action"], random["executed"])
    assert not torch.allclose(learned["action"], learned["executed"])
    assert 0 < data["validation"].float().mean() < 0.3


def test_actions_can_be_left_unclipped_without_l1_only() -> None:
    algorithm = make(l1=None, clip_actions=False, policy=PolicyConfig(hidden=[8], std=4.0))
    list(algorithm.iterate())
    learned = algorithm.learning.buffer[:][75:]
    assert learned["action"].abs().max() > 3
    assert torch.equal(learned["action"], learned["executed"])
    with pytest.raises(ValueError, match="l1=off"):
        make(clip_actions=False)


def test_noise_on_the_actuator_is_not_in_the_data() -> None:
    algorithm = METRPO(
        "inverted_pendulum", tiny(), perturbation=Perturbation(actuator_bias=2.0), horizon=25
    )
    data = algorithm.collection.random(0)
    assert data["action"].abs().max() <= 3
    # The cart's first acceleration shows the bias all the same.
    assert data["next", "observation"][:, 0, 2].mean() > 0.2


@pytest.mark.parametrize("l1", [None, L1, ROBUST], ids=["off", "paper", "robust"])
def test_resumed_run_repeats_the_unbroken_one(l1: L1Config | None) -> None:
    unbroken = [result.metrics for result in make(l1, outer_iterations=3).iterate()]
    first = make(l1, outer_iterations=3)
    iterations = first.iterate()
    before = [next(iterations).metrics]
    state = first.state_dict()
    second = make(l1, outer_iterations=3)
    second.load_state_dict(state)
    after = [result.metrics for result in second.iterate()]
    assert before + after == unbroken


def test_a_kalman_filter_is_calibrated_after_every_fit() -> None:
    for l1 in (ROBUST, L1):
        algorithm = make(l1)
        residuals = algorithm.acting_dynamics.residuals
        assert not residuals.calibrated
        next(algorithm.iterate())
        assert residuals.measured and residuals.calibrated == (l1 is ROBUST)


def test_seeds_matter() -> None:
    first = next(make(seed=0).iterate()).metrics["return_mean"]
    assert first == next(make(seed=0).iterate()).metrics["return_mean"]
    assert first != next(make(seed=1).iterate()).metrics["return_mean"]


def test_label_decides_what_the_model_is_fitted_to() -> None:
    nominal, executed = (make(label=label) for label in ("nominal", "executed"))
    results = [list(algorithm.iterate())[1] for algorithm in (nominal, executed)]
    assert results[0].metrics["model/train_loss"] != results[1].metrics["model/train_loss"]
    with pytest.raises(ValueError, match="label must be 'nominal' or 'executed', got 'both'"):
        make(label="both")


def test_imagined_trajectories_start_where_the_configuration_says() -> None:
    algorithm = make(imagined_from_data=0.25)
    algorithm.learning.store(algorithm.collection.random(0))
    starts = algorithm.improvement.starts(40, algorithm.learning.buffer)
    stored = algorithm.learning.buffer[:]["observation"]
    from_data = (starts[:, None] == stored).all(-1).any(-1)
    assert from_data.tolist() == [False] * 30 + [True] * 10
    # The others are the pendulum's resets: within 0.01 of upright rest.
    assert starts[:30].abs().max() <= 0.01


@pytest.mark.parametrize(("reset_std", "normalize"), [(True, False), (False, True)])
def test_each_round_begins_with_the_policy_that_settings_ask_for(
    reset_std: bool, normalize: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = PolicyConfig(hidden=[8], std=2.0, reset_std=reset_std, normalize=normalize)
    algorithm = make(l1=None, policy=settings, trpo_iterations=1)
    policy, improvement, seen = algorithm.policy, algorithm.improvement, []
    step = improvement.step

    def watched(buffer: ReplayBuffer) -> PolicyStep:
        data = buffer[:]["observation"].double()
        seen.append((policy.log_std.exp().item(), policy.normalizer.mean.clone(), data.mean(0)))
        return step(buffer)

    monkeypatch.setattr(improvement, "step", watched)
    results = [result.metrics for result in algorithm.iterate()]
    assert [std for std, *_ in seen] == pytest.approx(
        [2.0, 2.0 if reset_std else results[0]["policy/std"]]
    )
    assert results[0]["policy/std"] != pytest.approx(2.0, rel=1e-4)
    for _, mean, expected in seen:
        torch.testing.assert_close(mean.double(), expected * normalize, atol=1e-5, rtol=1e-4)


def test_two_iterations_learn_to_balance() -> None:
    config = METRPOConfig(
        outer_iterations=2,
        episodes_per_iteration=20,
        imagined_steps=10_000,
        imagined_horizon=100,
        label="executed",
        model=ModelConfig(members=3, hidden=[64, 64]),
        policy=PolicyConfig(hidden=[32]),
        fit=FitConfig(batch_size=250),
    )
    last = list(METRPO("inverted_pendulum", config, seed=0).iterate())[-1].metrics
    assert last["return_deterministic"] > -20  # a random policy is at about -220


def test_unknown_device_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="no CUDA device"):
        METRPO("inverted_pendulum", tiny(), device="cuda")


def test_fits_and_imagination_have_a_precision_each() -> None:
    wide = {"model": ModelConfig(members=2, hidden=[16, 16])}
    plain = make(l1=None, **wide)
    assert plain.choices() == {"device": "cpu", "fit": "float32", "imagination": "float32"}
    fit = FitConfig(batch_size=32, max_epochs=3, precision="bfloat16")
    rounded = make(l1=None, fit=fit, precision="bfloat16", **wide)
    assert rounded.choices() == {"device": "cpu", "fit": "bfloat16", "imagination": "bfloat16"}
    # Layers this narrow are not worth it.
    narrow = make(fit=FitConfig(precision="auto"), precision="auto")
    assert narrow.choices()["fit"] == narrow.choices()["imagination"] == "float32"
    losses = []
    for algorithm in (plain, rounded):
        results = [result.metrics for result in algorithm.iterate()]
        assert all(math.isfinite(value) for metrics in results for value in metrics.values())
        assert all(weight.dtype == torch.float32 for weight in algorithm.dynamics.parameters())
        losses.append(results[0]["model/validation_loss"])
    assert losses[0] != losses[1] == pytest.approx(losses[0], rel=0.05)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"elites": 9}, "fit.elites is 9, but the model has 5 members"),
        ({"weight_decay": [1.0]}, "fit.weight_decay must hold a coefficient for each"),
    ],
)
def test_a_fit_that_is_not_the_model_s_is_refused_before_work_starts(settings, message) -> None:
    with pytest.raises(ValueError, match=message):
        METRPO("inverted_pendulum", METRPOConfig(fit=FitConfig(**settings)))


def test_unknown_precisions_are_named() -> None:
    with pytest.raises(ValueError, match=r"^precision must be .* got 'half'"):
        tiny(precision="half")
    with pytest.raises(ValueError, match=r"^fit.precision must be .* got 'half'"):
        FitConfig(precision="half")


def test_a_policy_of_ones_own_is_improved_by_autograd() -> None:
    algorithm = make(l1=None)
    # The same function, but not of a kind whose derivatives are written down.
    algorithm.policy.mean = torch.nn.Sequential(algorithm.policy.mean, torch.nn.Identity())
    metrics = next(algorithm.iterate()).metrics
    reference = next(make(l1=None).iterate()).metrics
    assert metrics["trpo/kl"] == pytest.approx(reference["trpo/kl"], rel=0.05)
    assert metrics["trpo/accepted"] == reference["trpo/accepted"]


def test_what_is_frozen_of_the_policy_stays() -> None:
    algorithm = make(l1=None)
    algorithm.policy.log_std.requires_grad_(False)
    before = algorithm.policy.mean[0].weight.clone()
    metrics = next(algorithm.iterate()).metrics
    assert metrics["trpo/accepted"] == 1
    assert algorithm.policy.log_std.tolist() == [0.0]
    assert not torch.equal(algorithm.policy.mean[0].weight, before)


def test_more_iterations_than_there_is_room_for_forget_no_data() -> None:
    algorithm = make(l1=None, outer_iterations=1)
    list(algorithm.iterate())
    algorithm.config.outer_iterations = 2
    with pytest.raises(ValueError, match=r"room for 150 items, not for 225.*state_dict"):
        list(algorithm.iterate())
    assert len(algorithm.learning.buffer) == 150
    longer = make(l1=None, outer_iterations=2)
    longer.load_state_dict(algorithm.state_dict())
    assert [result.metrics["real_steps"] for result in longer.iterate()] == [225]


def test_a_policy_of_another_type_is_refused_before_work_starts() -> None:
    torch.set_default_dtype(torch.float64)
    try:
        with pytest.raises(ValueError, match="set_default_dtype"):
            make(l1=None)
    finally:
        torch.set_default_dtype(torch.float32)


def test_numbers_of_steps_are_whole_and_there_are_some() -> None:
    with pytest.raises(ValueError, match="imagined_steps must be an integer, got 200"):
        tiny(imagined_steps=2e2)
    for horizon in (0, -3, 25.0):
        with pytest.raises(ValueError, match=f"horizon must be .* or null, got {horizon}"):
            METRPO("inverted_pendulum", tiny(), horizon=horizon)  # type: ignore[arg-type]


def test_a_copy_made_on_the_way_goes_on_by_itself() -> None:
    algorithm = make()
    rounds = algorithm.iterate()
    next(rounds)
    copy = deepcopy(algorithm)
    expected = next(rounds).metrics
    assert [result.metrics for result in copy.iterate()] == [expected]
    assert copy.policy is not algorithm.policy
    assert torch.equal(copy.policy.mean[0].weight, algorithm.policy.mean[0].weight)
