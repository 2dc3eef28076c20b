from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_l1.planning import CEMConfig, TrajectorySampler, plan_cem
from torchrl_l1.planning.cem import sample_around


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def quadratic(target: torch.Tensor):
    return lambda u: -(u - target).square().sum((-2, -1))


@pytest.mark.parametrize("return_best", [False, True])
def test_finds_the_optimum_of_each_environment(return_best):
    target = torch.tensor([[0.5, -1.5], [1.0, 0.0], [-0.25, 1.9]])
    config = CEMConfig(3, 500, 50, 80, 0.8, minimum_variance=0.0, return_best=return_best)
    low, high = torch.tensor([-1.0, -2.0]), torch.tensor([1.0, 2.0])
    result = plan_cem(
        quadratic(target[:, None, None]), torch.zeros(3, 3, 2), low, high, config, generator()
    )
    expected = target[:, None].expand(-1, 3, -1)
    torch.testing.assert_close(result.actions, expected, atol=0.03, rtol=0)
    assert torch.equal(result.actions, result.best if return_best else result.mean)
    value = quadratic(target[:, None])(result.best)
    torch.testing.assert_close(value, result.best_return)


@pytest.mark.parametrize("target", [[1.0, -1.0], [3.0, -1.0], [5.0, -5.0]])
def test_finds_an_optimum_at_or_beyond_a_bound(target):
    config = CEMConfig(1, 500, 50, 80, 0.5, minimum_variance=0.0)
    evaluate = quadratic(torch.tensor(target))
    result = plan_cem(evaluate, torch.zeros(1, 1, 2), -1.0, 1.0, config, generator())
    expected = torch.tensor([1.0, -1.0]).reshape(1, 1, 2)
    torch.testing.assert_close(result.actions, expected, atol=0.01, rtol=0)


def riccati_cost(a, b, q, r, horizon: int, x: np.ndarray) -> float:
    p = q
    for _ in range(horizon):
        gain = np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
        p = q + a.T @ p @ (a - b @ gain)
    return float(x @ p @ x)


def test_costs_within_one_percent_of_the_riccati_solution(linear):
    horizon, x = 12, np.array([1.0, 0.0])
    a, b = np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.02], [0.2]])
    q, r = np.diag([1.0, 0.1]), np.array([[0.1]])
    optimum = riccati_cost(a, b, q, r, horizon, x)
    model = linear([a - np.eye(2)], [b])
    # The recursion's cost counts the first state, which no action changes, and the last.
    first = float(x @ q @ x)

    def reward(x, u, successor):
        return -(successor.square() @ torch.tensor([1.0, 0.1]) + 0.1 * u[..., 0].square())

    sampler = TrajectorySampler(model, reward, propagation="mean", precision="float32")
    start = torch.tensor(x, dtype=torch.float32)[None]
    config = CEMConfig(horizon, 500, 50, 25, minimum_variance=0.0)
    result = plan_cem(
        sampler.evaluator(start), torch.zeros(1, horizon, 1), -4.0, 4.0, config, generator()
    )
    cost, state = 0.0, x
    for action in result.actions[0].double().numpy():
        cost += state @ q @ state + action @ r @ action
        state = a @ state + b @ action
    cost += state @ q @ state
    assert optimum - 1e-6 <= cost <= 1.01 * optimum
    assert -result.best_return.item() + first == pytest.approx(cost, rel=0.01)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    share=st.floats(0, 1),
    elites=st.integers(1, 11),
    iterations=st.integers(1, 3),
    value=st.sampled_from([math.nan, math.inf, -math.inf]),
    return_best=st.booleans(),
)
def test_returns_that_are_not_finite_are_never_chosen(
    seed, share, elites, iterations, value, return_best
):
    noise, seen = generator(seed), []

    def evaluate(u):
        returns = quadratic(torch.tensor(0.1))(u)
        bad = torch.rand(returns.shape, generator=noise) < share
        seen.append((u, returns, bad))
        return torch.where(bad, value, returns)

    start = 0.2 * torch.ones(2, 3, 1)
    config = CEMConfig(3, 12, elites, iterations, minimum_variance=0.0, return_best=return_best)
    result = plan_cem(evaluate, start, -1.0, 1.0, config, noise)
    for field in (result.actions, result.mean, result.variance, result.best):
        assert torch.isfinite(field).all()
    for i in range(2):
        good = [
            (returns[i, c], u[i, c]) for u, returns, bad in seen for c in range(12) if not bad[i, c]
        ]
        if good:
            best_return, best = max(good, key=lambda pair: pair[0])
            assert result.best_return[i] == best_return
            assert torch.equal(result.best[i], best)
        else:
            assert result.best_return[i] == -math.inf
            for field in (result.actions, result.mean, result.best):
                assert torch.equal(field[i], start[i])
            assert torch.equal(result.variance[i], torch.full((3, 1), 0.25))


@pytest.mark.parametrize("momentum", [0.0, 0.3])
def test_fits_to_the_finite_elites_with_momentum(momentum):
    drawn = []

    def evaluate(u):
        drawn.append(u)
        returns = u.sum((-2, -1))
        # Only the three best of environment 0 are finite; in environment 1 all are.
        third = returns[0].sort(descending=True).values[2]
        returns[0] = torch.where(returns[0] < third, math.nan, returns[0])
        return returns

    start = torch.tensor([0.1, -0.2])[:, None, None].expand(2, 2, 1)
    config = CEMConfig(2, 40, 5, 1, momentum)
    result = plan_cem(evaluate, start, -1.0, 1.0, config, generator())
    for i, count in enumerate((3, 5)):
        order = drawn[0][i].sum((-2, -1)).argsort(descending=True)
        elites = drawn[0][i][order[:count]]
        mean = momentum * start[i] + (1 - momentum) * elites.mean(0)
        variance = momentum * 0.25 + (1 - momentum) * elites.var(0, correction=0)
        torch.testing.assert_close(result.mean[i], mean)
        torch.testing.assert_close(result.variance[i], variance)


def test_stops_where_the_variance_is_small():
    calls = []

    def evaluate(u):
        calls.append(u.clone())
        return quadratic(torch.tensor([0.0, 0.5])[:, None, None, None])(u)

    config = CEMConfig(2, 200, 5, 50, minimum_variance=0.01)
    result = plan_cem(evaluate, torch.zeros(2, 2, 1), -1.0, 1.0, config, generator())
    assert 1 < len(calls) < 50
    assert (result.variance <= 0.01).all()


def test_a_minimum_variance_that_ends_every_plan_at_once_is_named():
    def plan(reach, **settings):
        evaluate, config = quadratic(torch.tensor(0.4 * reach)), CEMConfig(2, 200, 5, **settings)
        return plan_cem(evaluate, torch.zeros(1, 2, 1), -reach, reach, config, generator())

    with pytest.raises(ValueError, match=r"minimum_variance \(0.001\) must be below .* square of"):
        plan(0.05)
    scaled = plan(0.05, minimum_variance=0.001 * 0.05**2).mean / 0.05
    torch.testing.assert_close(scaled, plan(1.0).mean, rtol=0, atol=1e-4)
    plan(0.05, iterations=1)  # which is all that was asked for
    with pytest.raises(ValueError, match="minimum_variance"):
        plan(1.0, initial_variance=1e-4)


@pytest.mark.parametrize("return_best", [True, False])
def test_a_plan_does_not_depend_on_others_of_its_batch(return_best):
    uniform = torch.rand(20, 60, 3, 1, generator=generator())

    def plan(targets):
        calls = iter(uniform)
        config = CEMConfig(
            3, 60, 6, 20, momentum=0.0, minimum_variance=0.01, return_best=return_best
        )
        like = torch.zeros(len(targets), 3, 1)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(torch, "rand", lambda shape, **_: next(calls).expand(shape).clone())
            evaluate = quadratic(torch.tensor(targets)[:, None, None, None])
            return plan_cem(evaluate, like, -1.0, 1.0, config).actions[0]

    # The second, whose optimum is at a bound where few sequences are drawn, takes longer.
    assert torch.equal(plan([0.1]), plan([0.1, 0.9]))


def test_the_mean_stays_within_the_bounds():
    start = torch.full((1, 4, 1), 0.7)
    config = CEMConfig(4, 20, 5, iterations=7, momentum=0.3, minimum_variance=0.0)
    for reach in (0.1, 0.3, 0.7):
        result = plan_cem(lambda u: u.sum((-2, -1)), start, -reach, reach, config, generator())
        assert (result.actions <= torch.tensor(reach)).all()


def test_an_environment_that_is_done_stays_as_it_is_while_others_go_on():
    centres = []

    def evaluate(u):
        centres.append(u[0].mean())
        # Environment 0 has an optimum; environment 1 has no finite return, so it stays wide.
        return torch.cat([-(u[:1] - 0.3).abs(), math.nan * u[1:]]).sum((-2, -1))

    config = CEMConfig(1, 1000, 50, 12, minimum_variance=0.01)
    result = plan_cem(evaluate, torch.zeros(2, 1, 1), -1.0, 1.0, config, generator())
    assert len(centres) == 12 and result.variance[1] > 0.01 > result.variance[0]
    # Were it not left alone, its variance would vanish.
    assert result.variance[0] > 1e-5
    torch.testing.assert_close(result.mean[0, 0, 0], torch.tensor(0.3), atol=0.02, rtol=0)


def test_samples_are_truncated_normal_within_the_bounds():
    mean = torch.tensor([0.0, 0.9, -2.0]).reshape(1, 1, 3)
    low, high = torch.tensor([-1.0, -1.0, -2.0]), torch.tensor([1.0, 1.0, 4.0])
    variance = torch.tensor([0.04, 0.25, 1.0]).reshape(1, 1, 3)
    samples = sample_around(mean, variance, low, high, 20_000, generator(1))[0, :, 0]
    assert (samples >= low).all() and (samples <= high).all()
    # In the second column the bound is near: the deviation is half the room to it.
    for column, (centre, std) in enumerate(((0.0, 0.2), (0.9, 0.05))):
        expected = scipy.stats.truncnorm(-2, 2, loc=centre, scale=std)
        assert scipy.stats.kstest(samples[:, column].numpy(), expected.cdf).pvalue > 1e-3
    assert (samples[:, 2] == -2).all()


def test_starts_within_the_bounds():
    config = CEMConfig(2, 10, 2, 1)
    result = plan_cem(
        lambda u: torch.full(u.shape[:2], math.nan),
        torch.tensor([5.0, -5.0])[None, :, None],
        -1.0,
        2.0,
        config,
    )
    assert result.actions.flatten().tolist() == [2.0, -1.0]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"candidates": 10, "elites": 11}, r"elites \(11\) must be fewer than .*candidates \(10\)"),
        ({"horizon": 0}, "cem.horizon must be at least 1, got 0"),
        ({"candidates": 0}, "candidates must be"),
        ({"elites": 0}, "elites must be"),
        ({"iterations": 0}, "iterations must be"),
        ({"momentum": -0.1}, "momentum must be"),
        ({"momentum": 1.0}, r"momentum must be in \[0, 1\), got 1.0"),
        ({"momentum": math.nan}, "momentum must be"),
        ({"minimum_variance": -1.0}, "minimum_variance must be"),
        ({"initial_variance": 0.0}, "initial_variance must be finite and positive"),
        ({"initial_variance": math.inf}, "initial_variance must be finite"),
    ],
)
def test_impossible_settings_are_named(wrong, message):
    with pytest.raises(ValueError, match=message):
        CEMConfig(**wrong)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"low": 1.0}, "bounds are empty"),
        ({"low": 2.0}, "bounds are empty"),
        ({"high": math.inf}, "bound high must be finite"),
        ({"low": math.nan}, "bounds are empty"),
        ({"high": torch.finfo(torch.float32).max}, "bound high must be finite.* look for actions"),
        ({"low": -torch.ones(3)}, r"bound low has shape \(3,\), expected \(2,\)"),
        ({"high": torch.ones(1, 2)}, "bound high has shape"),
        ({"mean": torch.zeros(1, 3, 2)}, r"mean must have shape \(environments, 4, actions\)"),
        ({"mean": torch.zeros(4, 2)}, "mean must have shape"),
        ({"evaluate": lambda u: u[..., 0]}, r"evaluate returned shape \(1, 10, 4\)"),
        ({"evaluate": lambda u: u.neg_().sum((2, 3))}, "evaluate function writes to"),
    ],
)
def test_impossible_problems_are_named(wrong, message):
    problem = {"evaluate": quadratic(torch.zeros(2)), "mean": torch.zeros(1, 4, 2)}
    problem |= {"low": -1.0, "high": 1.0} | wrong
    with pytest.raises(ValueError, match=message):
        plan_cem(config=CEMConfig(4, 10, 2), **problem)
