from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import scipy.stats
import torch

from torchrl_l1.planning import (
    ModelPredictiveController,
    ShootingConfig,
    TrajectorySampler,
    plan_shooting,
)


def test_takes_the_best_of_uniform_sequences_and_the_given_one():
    drawn = []

    def evaluate(u):
        drawn.append(u)
        returns = -(u - 0.3).square().sum((-2, -1))
        returns[:, 1::2] = math.nan
        return returns

    mean = torch.stack([torch.zeros(2, 1), torch.full((2, 1), 0.3)])
    generator = torch.Generator().manual_seed(0)
    result = plan_shooting(evaluate, mean, -1.0, 3.0, ShootingConfig(2, 2000), generator)
    (u,) = drawn
    best = (u[0, ::2] - 0.3).square().sum((-2, -1)).argmin()
    assert torch.equal(result.actions[0], u[0, ::2][best])
    assert torch.equal(result.actions[1], mean[1])
    assert result.best_return[1] == 0
    uniform = scipy.stats.uniform(-1, 4)
    assert scipy.stats.kstest(u[0, 1:].flatten().numpy(), uniform.cdf).pvalue > 1e-3


@pytest.mark.parametrize("warm_start", [True, False])
def test_the_given_sequence_is_a_candidate_only_of_a_warm_start(warm_start):
    # The given sequence is the best there is, but for those that are drawn in the same place.
    mean = torch.full((2, 3, 1), 0.5)
    config = ShootingConfig(3, 100, warm_start)
    result = plan_shooting(lambda u: -(u - 0.5).abs().sum((-2, -1)), mean, -1.0, 1.0, config)
    assert torch.equal(result.actions, mean) == warm_start
    assert torch.equal(result.best_return == 0, torch.full((2,), warm_start))


@pytest.mark.parametrize("warm_start", [True, False])
def test_keeps_the_given_sequence_where_nothing_is_finite(warm_start):
    mean = torch.full((1, 2, 1), 0.25)
    config = ShootingConfig(2, 5, warm_start)
    result = plan_shooting(lambda u: torch.full(u.shape[:2], math.nan), mean, -1.0, 1.0, config)
    assert torch.equal(result.actions, mean) and result.best_return.item() == -math.inf


def test_finds_what_exhaustive_search_finds_on_a_grid():
    # A walk of four steps by -1, 0 or 1 on a ring of cells, each with its own reward, and a cost
    # of moving: 81 sequences. That 2000 candidates miss one of them has a chance of 2e-11.
    horizon, cells = 4, 11
    rewards = torch.rand(cells, generator=torch.Generator().manual_seed(0))
    start = torch.arange(cells)

    def evaluate(actions):
        moves = (actions[..., 0] * 1.5).round().clamp(-1, 1).long()
        visited = (start[:, None, None] + moves.cumsum(-1)) % cells
        return rewards[visited].sum(-1) - 0.1 * moves.abs().sum(-1)

    result = plan_shooting(
        evaluate,
        torch.zeros(cells, horizon, 1),
        -1.0,
        1.0,
        ShootingConfig(horizon, 2000, warm_start=False),
        torch.Generator().manual_seed(1),
    )
    for cell in range(cells):
        values = []
        for moves in itertools.product((-1, 0, 1), repeat=horizon):
            cell_now, total = cell, 0.0
            for move in moves:
                cell_now = (cell_now + move) % cells
                total += rewards[cell_now].item() - 0.1 * abs(move)
            values.append(total)
        assert result.best_return[cell].item() == pytest.approx(max(values), abs=1e-5)
        (achieved,) = evaluate(result.actions[:, None])[cell]
        assert achieved == result.best_return[cell]


def test_is_as_good_as_exhaustive_search_in_a_model(linear):
    # x' = 0.9 x + 0.5 u, a discounted reward, two actions: the best of a grid of 41 x 41.
    discount, goal = 0.8, 0.7
    config = ShootingConfig(2, 100_000, warm_start=False)

    def reward(x, u, successor):
        return -(successor[..., 0] - goal).square() - 0.1 * u[..., 0].square()

    sampler = TrajectorySampler(
        linear([[[-0.1]]], [[[0.5]]]), reward, particles=1, precision="float32", discount=discount
    )
    generator = torch.Generator().manual_seed(0)
    controller = ModelPredictiveController(sampler, config, -1.0, 1.0, generator=generator)
    starts = np.array([-1.0, 0.2, 1.5])
    result = controller.plan(torch.tensor(starts)[:, None])

    def value(x, first, second):
        one = 0.9 * x + 0.5 * first
        two = 0.9 * one + 0.5 * second
        return (
            -((one - goal) ** 2) - 0.1 * first**2 - discount * ((two - goal) ** 2 + 0.1 * second**2)
        )

    grid = np.linspace(-1, 1, 41)
    best = value(starts[:, None, None], grid[:, None], grid).max((1, 2))
    found = value(starts, *result.actions[:, :, 0].double().numpy().T)
    np.testing.assert_allclose(result.best_return, found, atol=1e-4)
    # All candidates miss the square of half-width e around the best, of which at least a quarter
    # is within the bounds, with a chance below (1 - (e / 2)^2)^C: 1e-6 at e = 0.024. The goal is
    # never further than 2.1 in the first step and 2.5 in the second, so the derivatives by the
    # two actions add up to less than 2.1 + 0.2 + 0.8 (0.9 + 1) 2.5 + 0.8 * 0.2 < 6.3.
    assert (found >= best - 6.3 * 0.024).all()


@pytest.mark.parametrize(
    ("horizon", "share"), [(1, lambda d: d), (2, lambda d: math.pi * d**2 / 4)]
)
def test_best_of_a_quadratic_is_distributed_as_it_must_be(horizon, share):
    # The distance from the middle of [-1, 1]^H exceeds d where none of C points is within d of
    # it: with the chance (1 - share)^C, share being that of the ball in the cube, for d <= 1.
    problems, candidates = 3000, 40
    result = plan_shooting(
        lambda u: -u.square().sum((-2, -1)),
        torch.ones(problems, horizon, 1),
        -1.0,
        1.0,
        ShootingConfig(horizon, candidates, warm_start=False),
        torch.Generator().manual_seed(0),
    )
    distance = result.best_return.neg().sqrt().double().numpy()
    np.testing.assert_allclose(distance, result.actions.norm(dim=(1, 2)), rtol=1e-5)

    def distribution(d):
        return 1 - (1 - share(np.minimum(d, 1.0))) ** candidates

    assert scipy.stats.kstest(distance, distribution).pvalue > 1e-3
    if horizon == 1:
        # Mean of the smallest of C distances uniform in [0, 1].
        assert distance.mean() == pytest.approx(1 / (candidates + 1), rel=0.1)


def test_impossible_settings_are_named():
    with pytest.raises(ValueError, match=r"shooting.candidates must be at least 1, got 0"):
        ShootingConfig(candidates=0)


def test_a_warm_start_needs_something_beside_it():
    with pytest.raises(ValueError, match="candidates must be at least 2 with a warm start"):
        ShootingConfig(candidates=1)
    ShootingConfig(candidates=1, warm_start=False)
