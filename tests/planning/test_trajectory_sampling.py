from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_l1.dynamics import EnsembleDynamics, make_dynamics
from torchrl_l1.planning import PlanningNetwork, TrajectorySampler, evaluate

A = [[[-0.2, 0.1], [0.0, 0.1]], [[0.1, 0.0], [-0.3, -0.1]], [[0.0, 0.3], [0.2, -0.5]]]
B = [[[0.5], [0.0]], [[0.3], [-0.2]], [[0.0], [1.0]]]
C = [[0.1, 0.0], [-0.3, 0.2], [0.0, 0.5]]
STD = [[0.3, 0.1], [0.2, 0.4], [0.05, 0.2]]
START = [0.7, -0.4]
ACTIONS = [0.5, -1.0, 0.25, 0.8]
REWARD = [1.0, -0.5]


def linear_reward(x, u, successor):
    return successor @ torch.tensor(REWARD) + 0.1 * u[..., 0]


def moments(members: list[int]) -> tuple[float, float]:
    """Mean and variance of a particle that draws one of the members at each step.

    By the first two moments of (x, return, 1), on which each member acts linearly.
    """
    z = np.array([*START, 0.0, 1.0])
    second = np.outer(z, z)
    weights = np.array(REWARD)
    for action in ACTIONS:
        following_mean, following_second = np.zeros(4), np.zeros((4, 4))
        for j in members:
            state = np.zeros((2, 4))
            state[:, :2] = np.eye(2) + np.array(A[j])
            state[:, 3] = np.array(B[j])[:, 0] * action + np.array(C[j])
            gained = weights @ state + np.array([0, 0, 1, 0.1 * action])
            step = np.vstack([state, gained, [0, 0, 0, 1]])
            spread = np.vstack([np.eye(2), weights, np.zeros(2)]) * np.array(STD[j])
            following_mean += step @ z / len(members)
            following_second += (step @ second @ step.T + spread @ spread.T) / len(members)
        z, second = following_mean, following_second
    return z[2], second[2, 2] - z[2] ** 2


def sampled(model, propagation: str, particles: int, candidates: int = 20_000) -> torch.Tensor:
    actions = torch.tensor(ACTIONS)[None, None, :, None].expand(1, candidates, -1, 1)
    return evaluate(
        model,
        torch.tensor([START]),
        actions,
        linear_reward,
        particles=particles,
        propagation=propagation,
        generator=torch.Generator().manual_seed(3),
    )[0].double()


def check_moments(returns: torch.Tensor, mean: float, variance: float) -> None:
    assert abs(returns.mean().item() - mean) < 5 * math.sqrt(variance / len(returns))
    assert returns.var().item() == pytest.approx(variance, rel=5 * math.sqrt(2 / len(returns)))


@pytest.mark.parametrize("dtype", [torch.bool, torch.int64, torch.float64])
@pytest.mark.parametrize("discount", [1.0, 0.5])
def test_rewards_may_be_of_any_type(linear, dtype, discount):
    returns = evaluate(
        linear(A, B, C),
        torch.tensor([START]),
        torch.zeros(1, 2, 3, 1),
        lambda x, u, successor: torch.ones(u.shape[:2]).to(dtype),
        discount=discount,
    )
    assert returns.dtype == torch.float32
    assert returns.tolist() == [[1 + discount + discount**2] * 2]


@pytest.mark.parametrize("particles", [1, 2, 3, 5])
def test_tsinf_has_the_moments_of_the_linear_gaussian_model(linear, particles):
    returns = sampled(linear(A, B, C, STD), "tsinf", particles)
    each = [moments([p % 3]) for p in range(particles)]
    mean = sum(m for m, _ in each) / particles
    check_moments(returns, mean, sum(v for _, v in each) / particles**2)


@pytest.mark.parametrize("particles", [1, 4])
def test_ts1_has_the_moments_of_the_linear_gaussian_model(linear, particles):
    returns = sampled(linear(A, B, C, STD), "ts1", particles)
    mean, variance = moments([0, 1, 2])
    check_moments(returns, mean, variance / particles)


@pytest.mark.parametrize("propagation", ["ts1", "tsinf"])
@pytest.mark.parametrize("block", [None, 7])
def test_common_noise_is_the_same_for_every_candidate(linear, propagation, block):
    members = [A[0]] * 3, [B[0]] * 3, C, STD
    model, particles = linear(*members), 20_000
    actions = torch.randn(1, 5, 4, 1, generator=torch.Generator().manual_seed(1))
    actions = torch.cat([actions, actions[:, :1]], 1)

    def returns(common: bool, particles: int) -> torch.Tensor:
        return evaluate(
            model,
            torch.tensor([START]),
            actions,
            linear_reward,
            particles=particles,
            propagation=propagation,
            common_noise=common,
            block=block and block * particles,
            generator=torch.Generator().manual_seed(3),
        )[0].double()

    common, own = returns(True, particles), returns(False, particles)
    assert common[0] == pytest.approx(common[-1].item(), abs=1e-6)
    assert own[0] != own[-1]
    # Expectations are the same; where members differ in an offset alone, differences between
    # candidates are free of noise, however few the particles.
    torch.testing.assert_close(common, own, rtol=0, atol=0.05)
    few = returns(True, 3)
    torch.testing.assert_close(few - few[0], common - common[0], rtol=0, atol=1e-4)


@pytest.mark.parametrize("propagation", ["ts1", "tsinf"])
def test_agrees_with_a_monte_carlo_simulation_of_the_model(linear, propagation):
    model, runs = linear(A, B, C, STD), 20_000
    model.set_elites([0, 2])
    torch.manual_seed(11)
    x = torch.tensor(START).expand(runs, 2)
    total = torch.zeros(runs)
    row = torch.arange(runs)
    member = torch.tensor([0, 2])[row % 2]
    with torch.no_grad():
        for action in ACTIONS:
            if propagation == "ts1":
                member = torch.tensor([0, 2])[torch.randint(2, (runs,))]
            u = torch.full((runs, 1), action)
            mean, std = model.member_distribution(x, u)
            following = x + mean[member, row] + std[member, row] * torch.randn(runs, 2)
            total += linear_reward(x, u, following)
            x = following
    # A candidate's return is the mean of two particles, one of each kind if they are kept.
    pairs = total.reshape(-1, 2).double().mean(1)
    returns = sampled(model, propagation, 2)
    error = math.sqrt(pairs.var() / len(pairs) + returns.var() / len(returns))
    assert abs(pairs.mean() - returns.mean()) < 5 * error
    assert pairs.var().item() == pytest.approx(returns.var().item(), rel=0.08)


def network_model(head: str = "deterministic", members: int = 5) -> EnsembleDynamics:
    torch.manual_seed(0)
    model = make_dynamics(3, 2, hidden=(16, 16), members=members, activation="tanh", head=head)
    model.fit_statistics(torch.randn(99, 3), torch.randn(99, 2), 0.3 * torch.randn(99, 3))
    return model


def curved_reward(x, u, successor):
    return x[..., 0] - successor.square().sum(-1) - 0.1 * u.square().sum(-1)


@torch.no_grad()
def by_hand(model, x, actions, change) -> torch.Tensor:
    total = 0.0
    for t in range(actions.shape[-2]):
        successor = x + change(x, actions[..., t, :])
        total = total + curved_reward(x, actions[..., t, :], successor)
        x = successor
    return total


@settings(max_examples=15, deadline=None)
@given(
    particles=st.integers(1, 12),
    elites=st.lists(st.integers(0, 4), min_size=1, max_size=5, unique=True),
    environments=st.integers(1, 3),
    candidates=st.integers(1, 7),
    block=st.one_of(st.none(), st.integers(1, 20)),
)
def test_particles_keep_their_elite_in_any_number_and_block(
    particles, elites, environments, candidates, block
):
    model = network_model()
    model.set_elites(elites)
    x, actions = torch.randn(environments, 3), torch.randn(environments, candidates, 4, 2)
    returns = evaluate(model, x, actions, curved_reward, particles=particles, block=block)
    start = x[:, None].expand(-1, candidates, -1)
    per_member = [
        by_hand(model, start, actions, lambda x, u, j=j: model.member_changes(x, u)[j])
        for j in sorted(elites)
    ]
    expected = sum(per_member[p % len(elites)] for p in range(particles)) / particles
    torch.testing.assert_close(returns, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("head", ["deterministic", "gaussian"])
def test_mean_propagation_follows_the_mean_of_the_elites(head):
    model = network_model(head)
    model.set_elites([0, 3, 4])
    x, actions = torch.randn(2, 3), torch.randn(2, 6, 5, 2)
    returns = evaluate(model, x, actions, curved_reward, propagation="mean", block=4)
    expected = by_hand(model, x[:, None].expand(-1, 6, -1), actions, model.mean_change)
    torch.testing.assert_close(returns, expected, rtol=1e-4, atol=1e-4)


def test_ts1_draws_members_anew_and_reproducibly():
    model, x, actions = (
        network_model(),
        torch.randn(1, 3),
        torch.randn(1, 1, 6, 2).expand(1, 50, 6, 2),
    )

    def returns(seed, **settings):
        generator = torch.Generator().manual_seed(seed)
        return evaluate(model, x, actions, curved_reward, generator=generator, **settings)

    first = returns(0, propagation="ts1", particles=1)
    # With 5 members over 6 steps hardly two of 50 particles go the same way.
    assert len(first.unique()) > 40
    assert torch.equal(first, returns(0, propagation="ts1", particles=1))
    assert not torch.equal(first, returns(1, propagation="ts1", particles=1))
    model.set_elites([2])
    alone = returns(0, propagation="ts1", particles=3)
    torch.testing.assert_close(alone, returns(0, propagation="tsinf", particles=3))


def test_a_terminated_particle_earns_nothing_more(linear):
    # x' = x + u, from 0: 1, 2, 3, 4.
    model = linear([[[0.0]]], [[[1.0]]])
    x, actions = torch.zeros(1, 1), torch.ones(1, 1, 4, 1)

    def returns(reward, terminated=None):
        return evaluate(model, x, actions, reward, terminated=terminated).item()

    def paid(x, u, successor):
        return successor[..., 0]

    def fallen(successor):
        return (successor[..., 0] > 1.5) & (successor[..., 0] < 2.5)

    assert returns(paid) == pytest.approx(10, abs=1e-3)
    # The step that terminates counts; that the state would recover does not matter.
    assert returns(paid, fallen) == pytest.approx(3, abs=1e-3)

    def breaks_at(limit, value):
        def reward(x, u, successor):
            return torch.where(successor[..., 0] > limit, value, successor[..., 0])

        return reward

    for value in (math.nan, math.inf, -math.inf):
        assert returns(breaks_at(2.5, value), fallen) == pytest.approx(3, abs=1e-3)
        assert returns(breaks_at(1.5, value), fallen) == -math.inf
        assert returns(breaks_at(3.5, value)) == -math.inf


def test_later_rewards_count_less(linear):
    # x' = x + u, from 0: 1, 2, 3, 4.
    model = linear([[[0.0]]], [[[1.0]]])
    x, actions = torch.zeros(1, 1), torch.ones(1, 1, 4, 1)

    def paid(x, u, successor):
        return successor[..., 0]

    def returns(discount, **settings):
        sampler = TrajectorySampler(
            model, paid, particles=2, precision="float32", discount=discount, **settings
        )
        return sampler.evaluator(x)(actions).item()

    assert returns(0.5) == pytest.approx(1 + 2 / 2 + 3 / 4 + 4 / 8, abs=1e-3)
    assert returns(0.5, terminated=lambda s: s[..., 0] > 1.5) == pytest.approx(1 + 2 / 2, abs=1e-3)
    assert returns(1e-30) == pytest.approx(1, abs=1e-3)  # powers that float32 cannot hold
    assert returns(1.0) == evaluate(model, x, actions, paid, particles=2).item()


def test_a_state_that_is_not_finite_is_never_worth_anything(linear):
    # Doubling 30 times per step overflows; the reward does not look at the state.
    model = linear([[[1e9]], [[0.0]]], [[[1.0]], [[1.0]]])
    actions = torch.ones(1, 1, 8, 1)

    def reward(x, u, successor):
        return u[..., 0]

    for terminated in (None, lambda successor: successor[..., 0].isnan()):
        returns = evaluate(
            model, torch.ones(1, 1), actions, reward, particles=2, terminated=terminated
        )
        assert returns.item() == -math.inf
    model.set_elites([1])
    assert evaluate(model, torch.ones(1, 1), actions, reward).item() == pytest.approx(8)
    start = torch.tensor([[math.nan], [0.0]])
    both = evaluate(model, start, actions.expand(2, 1, 8, 1), reward)[:, 0]
    assert both.tolist() == [-math.inf, pytest.approx(8)]


@pytest.mark.parametrize("propagation", ["ts1", "tsinf", "mean"])
def test_precisions_agree(propagation):
    torch.manual_seed(0)
    model = make_dynamics(3, 2, hidden=(64, 64, 64), activation="silu")
    model.fit_statistics(torch.randn(99, 3), torch.randn(99, 2), 0.1 * torch.randn(99, 3))
    x, actions = torch.randn(1, 3), torch.rand(1, 200, 15, 2) * 2 - 1
    exact, rounded = (
        evaluate(
            model,
            x,
            actions,
            curved_reward,
            propagation=propagation,
            precision=precision,
            generator=torch.Generator().manual_seed(0),
        )
        for precision in ("float32", "bfloat16")
    )
    error = (exact - rounded).square().mean().sqrt()
    assert 0 < error < 0.03 * exact.std()


def test_sampler_copies_the_model_at_each_plan():
    model = network_model("gaussian")
    sampler = TrajectorySampler(model, curved_reward, particles=7, precision="float32")
    x, actions = torch.randn(1, 3), torch.randn(1, 4, 5, 2)
    frozen = sampler.evaluator(x, torch.Generator().manual_seed(0))
    before = evaluate(
        model,
        x,
        actions,
        curved_reward,
        particles=7,
        common_noise=True,
        generator=torch.Generator().manual_seed(0),
    )
    with torch.no_grad():
        model.network.weights[0].mul_(1.5)
    torch.testing.assert_close(frozen(actions), before)
    changed = sampler.evaluator(x, torch.Generator().manual_seed(0))(actions)
    assert not torch.allclose(changed, before)


def test_bad_input_is_named():
    model = network_model()
    x, actions = torch.zeros(2, 3), torch.zeros(2, 4, 5, 2)

    def check(message, observation=x, actions=actions, reward=curved_reward, **settings):
        with pytest.raises(ValueError, match=message):
            evaluate(model, observation, actions, reward, **settings)

    check(r"observation must have shape \(environments, 3\)", observation=torch.zeros(2, 4))
    check(r"actions must have shape \(2, candidates, horizon, 2\)", actions=actions[..., :1])
    check(r"actions must have shape \(2, ", actions=actions[:1])
    check("nothing to evaluate", actions=actions[:, :0])
    check(r"propagation must be .* got 'ts2'", propagation="ts2")
    check("precision must be", precision="half")
    check("particles must be at least 1", particles=0)
    check("block must be at least 1 or null", block=0)
    for discount in (0.0, 1.01, math.nan):
        check(rf"discount must be in \(0, 1\], got {discount}", discount=discount)
    check("compile must be True, False or 'auto', got 'yes'", compile="yes")
    check("the reward function must return", reward=lambda x, u, s: s[..., :1])
    check("the terminated function must return", terminated=lambda s: s[..., :1] > 0)
    check("the reward function writes to", reward=lambda x, u, s: u.mul_(2)[..., 0])
    check("the terminated function writes to", terminated=lambda s: s.abs_()[..., 0] > 1)
    for wrong, message in (
        ({"particles": 0}, "particles must be at least 1"),
        ({"propagation": "all"}, "propagation must be"),
        ({"precision": "double"}, "precision must be"),
        ({"discount": 0}, "discount must be"),
        ({"compile": True, "propagation": "ts1"}, "'ts1' cannot be compiled, .* set compile to"),
    ):
        with pytest.raises(ValueError, match=message):
            TrajectorySampler(model, curved_reward, **wrong)


def test_accepts_a_snapshot():
    model, x, actions = network_model(), torch.randn(1, 3), torch.randn(1, 3, 4, 2)
    snapshot = PlanningNetwork.from_dynamics(model)
    assert torch.equal(
        evaluate(snapshot, x, actions, curved_reward), evaluate(model, x, actions, curved_reward)
    )


@pytest.mark.parametrize("propagation", ["ts1", "tsinf", "mean"])
@pytest.mark.parametrize("common_noise", [False, True])
def test_models_of_float64_are_planned_with_in_float32(propagation, common_noise):
    torch.manual_seed(0)
    model = make_dynamics(2, 1, hidden=(8,), head="gaussian")
    found = []
    for kind in (torch.float32, torch.float64):
        before = torch.get_default_dtype()
        try:
            torch.set_default_dtype(kind)
            found.append(
                evaluate(
                    model.to(kind),
                    torch.tensor([START]),
                    torch.tensor(ACTIONS)[None, None, :, None],
                    lambda x, u, successor: successor.sum(-1),
                    propagation=propagation,
                    common_noise=common_noise,
                    generator=torch.Generator().manual_seed(0),
                )
            )
        finally:
            torch.set_default_dtype(before)
    assert found[0].dtype == found[1].dtype == torch.float32
    torch.testing.assert_close(*found)


def test_a_flag_of_any_type_ends_a_particle(linear):
    model = linear([[[0.0]]], [[[1.0]]])
    x, actions = torch.zeros(1, 1), torch.ones(1, 1, 4, 1)
    for flag in (True, 1, 0.9):
        found = evaluate(
            model,
            x,
            actions,
            lambda x, u, successor: successor[..., 0],
            terminated=lambda successor, flag=flag: flag * (successor[..., 0] > 1.5),
        )
        assert found.item() == pytest.approx(3, abs=1e-3)


def test_a_reward_that_is_no_tensor_is_named(linear):
    model = linear([[[0.0]]], [[[1.0]]])
    with pytest.raises(ValueError, match=r"the reward function must return shape .* got float"):
        evaluate(model, torch.zeros(1, 1), torch.ones(1, 1, 4, 1), lambda x, u, successor: 1.0)
