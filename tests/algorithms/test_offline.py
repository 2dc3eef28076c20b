from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_l1.algorithms import (
    ModelConfig,
    Offline,
    OfflineCloningConfig,
    OfflineConfig,
    Perturbation,
    PolicyConfig,
)
from torchrl_l1.algorithms.collection import episode_returns
from torchrl_l1.algorithms.policy_improvement import PolicyStep
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import FitConfig
from torchrl_l1.envs import make_env
from torchrl_l1.objectives import TRPOConfig

METRICS = Offline.facts.metrics
L1 = L1Config(0.04, epsilon=0.2, action_low=-3.0, action_high=3.0)
ROBUST = L1Config.robust(0.04, action_low=-3.0, action_high=3.0)


def recorded(rows: int = 6, steps: int = 40) -> TensorDictBase:
    torch.manual_seed(0)
    return make_env("inverted_pendulum", rows, max_steps=steps, seed=0).rollout(
        steps, break_when_any_done=False
    )


def tiny(**changes: Any) -> OfflineConfig:
    settings: dict[str, Any] = {
        "outer_iterations": 2,
        "evaluation_episodes": 3,
        "trpo_iterations": 2,
        "imagined_steps": 200,
        "imagined_horizon": 10,
        "model": ModelConfig(members=2, hidden=[16]),
        "policy": PolicyConfig(hidden=[8]),
        "fit": FitConfig(batch_size=32, max_epochs=3),
        "cloning": OfflineCloningConfig(max_epochs=3, batch_size=50),
        "trpo": TRPOConfig(fisher_fraction=1.0),
    }
    return OfflineConfig(**{**settings, **changes})


def make(l1: L1Config | None = None, data: Any = None, **changes: Any) -> Offline:
    data = recorded() if data is None else data
    return Offline("inverted_pendulum", tiny(**changes), l1, data=data, horizon=25)


def test_data_of_other_steps_are_refused() -> None:
    """A log that was sampled five times as fast tells of another plant."""
    data = recorded()
    for dt in (0.04, 0.0402):
        make(data=data.set("dt", torch.full((*data.shape, 1), dt))).prepare()
    with pytest.raises(ValueError, match=r"steps of 0\.008 s, and the task .* takes 0\.04 s"):
        make(data=data.set("dt", torch.full((*data.shape, 1), 0.008))).prepare()


@pytest.mark.parametrize("penalty", ["mopo", "morel", "none"])
def test_every_metric_is_documented_and_finite(penalty: str) -> None:
    results = [result.metrics for result in make(L1, penalty=penalty).iterate()]
    assert set(results[0]) == set(METRICS)
    assert all(math.isfinite(value) for metrics in results for value in metrics.values())
    # The data stay what they were.
    assert [metrics["real_steps"] for metrics in results] == [240, 240]
    assert results[0]["data/transitions"] == 240 and results[0]["data/dropped"] == 0
    assert results[0]["model/epochs"] == results[1]["model/epochs"] > 0
    assert 0 <= results[0]["penalty/halted"] <= 1


def test_without_l1_there_are_no_l1_metrics() -> None:
    metrics = next(make().iterate()).metrics
    assert set(metrics) == {name for name in METRICS if not name.startswith("l1/")}


def test_what_is_measured_is_not_learned_from() -> None:
    quiet, disturbed = make(), make()
    disturbed.evaluation = disturbed.real(
        policy=disturbed.evaluation.policy,
        episodes=2,
        horizon=10,
        perturbation=Perturbation(actuator_bias=2.0),
    )
    returns = [[r.metrics["return_mean"] for r in one.iterate()] for one in (quiet, disturbed)]
    assert returns[0] != returns[1]
    for first, second in zip(quiet.policy.parameters(), disturbed.policy.parameters(), strict=True):
        assert torch.equal(first, second)
    assert len(quiet.learning.buffer) == 240


def test_the_model_is_fitted_once_and_the_policy_goes_on() -> None:
    algorithm = make()
    iterations = algorithm.iterate()
    next(iterations)
    model = {name: value.clone() for name, value in algorithm.dynamics.state_dict().items()}
    policy = [value.clone() for value in algorithm.policy.parameters()]
    next(iterations)
    for name, value in algorithm.dynamics.state_dict().items():
        assert torch.equal(value, model[name]), name
    assert not all(map(torch.equal, policy, algorithm.policy.parameters()))
    for name, value in algorithm.acting_dynamics.state_dict().items():
        assert torch.equal(value, model[name]), name


@pytest.mark.parametrize("reset_std", [True, False])
def test_each_round_begins_with_the_spread_that_settings_ask_for(
    reset_std: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = PolicyConfig(hidden=[8], std=2.0, reset_std=reset_std)
    algorithm = make(policy=settings, trpo_iterations=1)
    step, seen = algorithm.improvement.step, []

    def watched(buffer: ReplayBuffer) -> PolicyStep:
        seen.append(algorithm.policy.log_std.exp().item())
        return step(buffer)

    monkeypatch.setattr(algorithm.improvement, "step", watched)
    first, second = (result.metrics for result in algorithm.iterate())
    assert seen == pytest.approx([2.0, 2.0 if reset_std else first["policy/std"]])
    assert first["policy/std"] != pytest.approx(2.0, rel=1e-4)
    # The returns of the last round can be measured again.
    for name, deterministic in (("return_mean", False), ("return_deterministic", True)):
        data = algorithm.evaluation.evaluate(0, 1, deterministic=deterministic)
        assert second[name] == episode_returns(data).mean().item()
    assert second["return_mean"] != second["return_deterministic"]


@pytest.mark.parametrize("penalty", ["mopo", "morel"])
@pytest.mark.parametrize("l1", [None, L1, ROBUST], ids=["off", "paper", "robust"])
def test_resumed_run_repeats_the_unbroken_one(l1: L1Config | None, penalty: str) -> None:
    changes = {"outer_iterations": 3, "penalty": penalty}
    unbroken = [result.metrics for result in make(l1, **changes).iterate()]
    first = make(l1, **changes)
    first.prepare()  # as a run does, before its loop
    before = [next(first.iterate()).metrics]
    # No dataset is needed any more.
    second = Offline("inverted_pendulum", tiny(**changes), l1, horizon=25)
    second.load_state_dict(first.state_dict())
    after = [result.metrics for result in second.iterate()]
    assert before + after == unbroken


def test_a_kalman_filter_is_calibrated_from_the_dataset() -> None:
    for l1 in (ROBUST, L1):
        algorithm = make(l1)
        next(algorithm.iterate())
        residuals = algorithm.acting_dynamics.residuals
        assert residuals.measured and residuals.calibrated == (l1 is ROBUST)


def test_the_first_policy_acts_as_the_data_do() -> None:
    data = recorded()
    data["action"] = (20 * data["observation"][..., 1:2]).clamp(-3, 3)
    settings = {"trpo_iterations": 1, "trpo": TRPOConfig(max_kl=1e-9, fisher_fraction=1.0)}
    cloning = OfflineCloningConfig(max_epochs=400, patience=400, batch_size=50, learning_rate=0.02)
    found = {}
    for enabled in (True, False):
        cloning.enabled = enabled
        algorithm = make(data=data, cloning=cloning, **settings)
        metrics = next(algorithm.iterate()).metrics
        mean, _ = algorithm.policy(data["observation"])
        found[enabled] = float((mean.detach() - data["action"]).square().mean().sqrt())
        assert (metrics["clone/validation_loss"] > 0) == enabled
        # Its own return: TRPO has changed next to nothing.
        assert metrics["clone/return"] == pytest.approx(metrics["return_deterministic"], rel=1e-2)
    assert found[True] < 0.3 < 1 < found[False]


@pytest.mark.parametrize("cloned", [True, False])
def test_the_policy_sees_normalised_observations_where_settings_say_so(cloned: bool) -> None:
    cloning = OfflineCloningConfig(enabled=cloned, max_epochs=1)
    for normalize in (True, False):
        algorithm = make(policy=PolicyConfig(hidden=[8], normalize=normalize), cloning=cloning)
        next(algorithm.iterate())
        mean, every = algorithm.policy.normalizer.mean, recorded()["observation"].flatten(0, 1)
        if not normalize:
            assert torch.equal(mean, torch.zeros(4))
            continue
        # Cloning keeps a tenth of the states for validation.
        assert torch.allclose(mean, every.mean(0), atol=1e-6) == (not cloned)
        assert ((mean - every.mean(0)).abs() < 0.2 * every.std(0)).all()
    assert OfflineConfig().policy.normalize


def test_data_may_be_a_buffer_or_several() -> None:
    data = recorded()
    buffer = ReplayBuffer(storage=LazyTensorStorage(len(data.reshape(-1))))
    buffer.extend(data.reshape(-1))
    made = [make(data=one) for one in (data, buffer, lambda: [data])]
    for one in made:
        one.prepare()
    rows = [one.learning.buffer[:]["observation"] for one in made]
    assert torch.equal(rows[0], rows[1]) and torch.equal(rows[0], rows[2])


def test_rows_that_are_not_finite_are_counted_and_left_out() -> None:
    data = recorded()
    data["observation"][1, 3] = torch.nan
    data["next", "observation"][4, 7, 2] = torch.inf
    algorithm = make(data=data)
    with pytest.warns(UserWarning, match="dropped 2 of 240 transitions"):
        algorithm.prepare()
    metrics = next(algorithm.iterate()).metrics
    assert (metrics["data/transitions"], metrics["data/dropped"]) == (238, 2)
    assert algorithm.learning.buffer[:]["observation"].isfinite().all()


def test_the_label_says_which_action_of_a_run_counts() -> None:
    data = recorded().set("executed", torch.full((6, 40, 1), 0.5))
    for label, expected in (("executed", torch.full((6, 40, 1), 0.5)), ("nominal", data["action"])):
        algorithm = make(data=data, label=label)
        algorithm.prepare()
        stored = algorithm.learning.buffer[:]
        assert torch.equal(stored["action"], expected.reshape(-1, 1))
        assert torch.equal(stored["executed"], stored["action"])


def test_imagined_trajectories_start_in_the_data() -> None:
    algorithm = make()
    algorithm.prepare()
    starts = algorithm.improvement.starts(40, algorithm.learning.buffer)
    stored = algorithm.learning.buffer[:]["observation"]
    assert (starts[:, None] == stored).all(-1).any(-1).all()


def test_datasets_of_no_use_are_refused_at_once() -> None:
    wide = TensorDict(
        {
            "observation": torch.randn(50, 11),
            "action": torch.randn(50, 3),
            "next": {"observation": torch.randn(50, 11)},
        },
        batch_size=[50],
    )
    words = "observations of 11 and actions of 3 entries, the task inverted_pendulum of 4 and 1"
    with pytest.raises(ValueError, match=words):
        make(data=wide).prepare()
    with pytest.raises(ValueError, match="holds no transitions"):
        make(data=recorded()[:0]).prepare()
    with pytest.raises(KeyError, match="no 'action'"):
        make(data=recorded().exclude("action")).prepare()
    with pytest.raises(ValueError, match="needs a dataset"):
        Offline("inverted_pendulum", tiny()).prepare()


def test_the_penalty_reaches_what_is_learned() -> None:
    policies = []
    for coefficient in (0.0, 50.0):
        algorithm = make(penalty_coefficient=coefficient)
        next(algorithm.iterate())
        policies.append([value.clone() for value in algorithm.policy.parameters()])
    assert not all(map(torch.equal, *policies))


def test_a_pendulum_is_balanced_by_a_policy_that_saw_random_actions_alone() -> None:
    data = recorded(rows=50, steps=60)
    config = OfflineConfig(
        outer_iterations=3,
        trpo_iterations=10,
        imagined_steps=5_000,
        imagined_horizon=50,
        imagined_from_data=0.0,  # most of the data is of poles that lie
        penalty_coefficient=0.1,
        evaluation_episodes=5,
        model=ModelConfig(members=3, hidden=[64, 64]),
        policy=PolicyConfig(hidden=[32], std=0.5),
        fit=FitConfig(batch_size=250, max_epochs=60),
    )
    last = list(Offline("inverted_pendulum", config, data=data).iterate())[-1].metrics
    assert last["return_deterministic"] > -60  # random actions are at about -215
