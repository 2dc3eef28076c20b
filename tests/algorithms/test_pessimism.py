from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_l1.algorithms import ModelConfig, OfflineConfig
from torchrl_l1.algorithms.pessimism import (
    Pessimism,
    Uncertainty,
    disagreement,
    halt,
    largest_deviation,
)
from torchrl_l1.algorithms.policy_improvement import imagined_advantages
from torchrl_l1.dynamics import EnsembleDynamics, FitConfig, GaussianHead

N, M = 3, 2
LOW, HIGH = torch.full((M,), -1.0), torch.full((M,), 1.0)


def fitted(gaussian: bool = False, members: int = 4) -> EnsembleDynamics:
    """A model of random weights, with statistics of data."""
    torch.manual_seed(0)
    head = GaussianHead(N) if gaussian else None
    dynamics = EnsembleDynamics(N, M, members=members, hidden=(16, 16), head=head)
    x, u = 3 * torch.randn(200, N), torch.randn(200, M)
    dynamics.fit_statistics(x, u, torch.randn(200, N) * torch.tensor([0.1, 1.0, 10.0]))
    return dynamics


def trajectories(batch: int = 2, steps: int = 6) -> TensorDict:
    """None ends before the last step."""
    flags = torch.zeros(batch, steps, 1, dtype=torch.bool)
    done = flags.clone()
    done[:, -1] = True
    torch.manual_seed(1)
    return TensorDict(
        {
            "observation": torch.randn(batch, steps, N),
            "action": 3 * torch.randn(batch, steps, M),
            "valid": ~flags,
            "next": {
                "reward": torch.randn(batch, steps, 1),
                "done": done,
                "terminated": flags.clone(),
                "left_box": flags.clone(),
            },
        },
        batch_size=[batch, steps],
    )


def test_disagreement_is_the_largest_distance_between_two_members() -> None:
    dynamics, x, u = fitted(), torch.randn(30, N), torch.rand(30, M)
    changes = (dynamics.member_changes(x, u) / dynamics.change_normalizer.std).detach().numpy()
    pairs = [np.linalg.norm(a - b, axis=-1) for a, b in combinations(changes, 2)]
    found = Uncertainty(dynamics, "disagreement")(x, u)
    np.testing.assert_allclose(found, np.max(pairs, axis=0), rtol=2e-5)
    # Elites alone count.
    dynamics.set_elites([1, 3])
    found = Uncertainty(dynamics, "disagreement")(x, u)
    np.testing.assert_allclose(found, np.linalg.norm(changes[1] - changes[3], axis=-1), rtol=2e-5)


def test_deviation_is_that_of_the_member_that_is_least_certain() -> None:
    dynamics, x, u = fitted(gaussian=True), torch.randn(30, N), torch.rand(30, M)
    _, std = dynamics.member_distribution(x, u)
    expected = (std / dynamics.change_normalizer.std).square().sum(-1).sqrt().amax(0)
    found = Uncertainty(dynamics, "deviation")(x, u)
    torch.testing.assert_close(found, expected.detach(), rtol=1e-4, atol=1e-6)


def test_many_rows_are_taken_in_parts() -> None:
    dynamics = fitted()
    x, u = torch.randn(12_000, N), torch.rand(12_000, M)
    uncertainty = Uncertainty(dynamics, "disagreement")
    whole = uncertainty(x, u)
    assert whole.shape == (12_000,)
    torch.testing.assert_close(whole[7000:7010], uncertainty(x[7000:7010], u[7000:7010]))
    assert uncertainty(x[:0], u[:0]).shape == (0,)


def test_one_member_agrees_with_itself() -> None:
    assert disagreement(torch.randn(1, 5, N)).tolist() == [0.0] * 5
    assert largest_deviation(torch.zeros(1, 5, N)).tolist() == [0.0] * 5


def pessimism(penalty: str, **settings: object) -> Pessimism:
    config = OfflineConfig(penalty=penalty, **settings)  # type: ignore[arg-type]
    return Pessimism(fitted(), config, LOW, HIGH)


def test_mopo_takes_the_uncertainty_off_the_reward() -> None:
    imagined = trajectories()
    reward = imagined["next", "reward"].clone()
    pessimist = pessimism("mopo", penalty_coefficient=0.7)
    # The model sees clipped actions.
    x, u = imagined["observation"].flatten(0, 1), imagined["action"].clamp(-1, 1).flatten(0, 1)
    known = Uncertainty(pessimist.dynamics, "disagreement")(x, u).view(2, 6, 1)
    changed = pessimist(imagined)
    torch.testing.assert_close(changed["next", "reward"], reward - 0.7 * known)
    assert changed["valid"].all()
    metrics = pessimist.metrics()
    assert metrics["penalty/uncertainty"] == pytest.approx(float(known.mean()), rel=1e-5)
    assert metrics["penalty/halted"] == 0


def test_without_a_penalty_nothing_changes_but_what_is_known() -> None:
    imagined = trajectories()
    before = imagined.clone()
    pessimist = pessimism("none")
    assert (pessimist(imagined) == before).all()
    assert pessimist.metrics()["penalty/uncertainty"] > 0


def test_threshold_and_worst_reward_are_those_of_the_data() -> None:
    x, u, reward = torch.randn(500, N), torch.rand(500, M), torch.randn(500)
    pessimist = pessimism("morel", halt_deviations=2.0, penalty_coefficient=0.5)
    pessimist.calibrate(x, u, reward)
    known = Uncertainty(pessimist.dynamics, "disagreement")(x, u).numpy()
    assert pessimist.data_uncertainty == pytest.approx(known.mean(), rel=1e-5)
    assert pessimist.threshold == pytest.approx(known.mean() + 2 * known.std(), rel=1e-5)
    assert pessimist.halted_reward == pytest.approx(float(reward.min()) - 0.5)
    other = pessimism("morel")
    other.load_state_dict(pessimist.state_dict())
    assert other.metrics() == pessimist.metrics()


def test_morel_ends_a_trajectory_at_its_first_unknown_step() -> None:
    imagined = trajectories()
    reward = imagined["next", "reward"].clone()
    imagined["next", "left_box"][1, 2] = True
    imagined["next", "done"][1, 2] = True
    imagined["valid"][1, 3:] = False
    pessimist = pessimism("morel", discount=0.9)
    x, u = imagined["observation"].flatten(0, 1), imagined["action"].clamp(-1, 1).flatten(0, 1)
    known = Uncertainty(pessimist.dynamics, "disagreement")(x, u).view(2, 6)
    # Just below the largest of the first trajectory; above all of the second.
    place = 2
    turn = place - int(known[0].argmax())
    for name in ("observation", "action"):
        imagined[name][0] = imagined[name][0].roll(turn, 0)
    assert known[0].max() > known[1, :3].max()
    pessimist.threshold = float(known[0].max()) - 1e-4
    pessimist.halted_reward = -2.0
    changed = pessimist(imagined)
    halted = changed["next", "halted"].squeeze(-1)
    assert halted.nonzero().tolist() == [[0, place], [1, 2]]  # the box's edge is unknown, too
    assert changed["valid"].squeeze(-1).sum(1).tolist() == [place + 1, 3]
    assert not changed["next", "left_box"].any()
    ends = changed["next", "terminated"].squeeze(-1)
    assert (ends == halted).all() and changed["next", "done"].squeeze(-1)[halted].all()
    worth = -2.0 * 0.9 / (1 - 0.9)
    for row, step in ((0, place), (1, 2)):
        assert float(changed["next", "reward"][row, step]) == pytest.approx(
            float(reward[row, step]) + worth, rel=1e-5
        )
    others = ~halted
    assert torch.equal(changed["next", "reward"][others], reward[others])
    assert pessimist.metrics()["penalty/halted"] == 1.0


@given(
    unknown=st.lists(st.booleans(), min_size=1, max_size=8),
    discount=st.floats(0, 1),
    halted_reward=st.floats(-5, 5),
)
def test_a_halted_trajectory_is_worth_what_the_absorbing_state_gives(
    unknown: list[bool], discount: float, halted_reward: float
) -> None:
    """Its discounted return is that of a loop that walks into the state and stays there."""
    imagined = trajectories(1, len(unknown))
    rewards = imagined["next", "reward"].flatten().tolist()
    changed = halt(imagined, torch.tensor([unknown]), halted_reward, discount, bootstrap=False)
    expected, is_halted = 0.0, False
    for step, reward in enumerate(rewards):
        expected += discount**step * (halted_reward if is_halted else reward)
        is_halted |= unknown[step]
    valid = changed["valid"].flatten()
    found = (changed["next", "reward"].flatten() * valid).tolist()
    total = sum(discount**step * reward for step, reward in enumerate(found))
    assert total == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_uncertainty_that_is_no_number_is_unknown() -> None:
    imagined = trajectories()
    imagined["observation"][0, 3] = torch.nan
    pessimist = pessimism("morel")
    pessimist.threshold = 1e9
    changed = pessimist(imagined)
    assert changed["next", "halted"].flatten(1).nonzero().tolist() == [[0, 3]]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"penalty": "mop"}, "penalty must be 'mopo' or 'morel' or 'none', got 'mop'"),
        ({"uncertainty": "deviation"}, "needs members that predict a distribution"),
        ({"model": ModelConfig(members=1)}, "needs two members or more, model.members is 1"),
        ({"fit": FitConfig(elites=1)}, "needs two members or more, fit.elites is 1"),
        ({"penalty": "morel", "discount": 1.0}, "needs a discount below 1"),
        ({"penalty_coefficient": -1.0}, "penalty_coefficient must be finite and not negative"),
        ({"halt_deviations": float("nan")}, "halt_deviations must be finite and not negative"),
        ({"imagined_steps": 10}, "imagined_steps"),
    ],
)
def test_settings_that_make_no_sense(settings: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        OfflineConfig(**settings)  # type: ignore[arg-type]


def test_the_measure_follows_the_head() -> None:
    assert OfflineConfig().measure == "disagreement"
    assert OfflineConfig(model=ModelConfig(head="gaussian")).measure == "deviation"
    both = OfflineConfig(model=ModelConfig(head="gaussian"), uncertainty="disagreement")
    assert both.measure == "disagreement"


def test_rewards_that_are_no_numbers_beyond_a_halt_are_none_before_it() -> None:
    imagined = trajectories(1, 4)
    imagined["next", "reward"][0, 2] = torch.nan
    unknown = torch.tensor([[False, True, False, False]])
    changed = halt(imagined, unknown, -1.0, 0.9, bootstrap=False)
    value = torch.zeros(1, 4, 1)
    advantage, _ = imagined_advantages(changed, value, value[:, :1], 0.9, 0.8, "truncate")
    assert advantage[0, :2].isfinite().all()
