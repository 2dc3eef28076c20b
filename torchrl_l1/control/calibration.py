"""Settings of the Kalman filter, from residuals of undisturbed episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrl_l1.control import kalman_law
from torchrl_l1.control.config import L1Config
from torchrl_l1.control.probe import is_positive
from torchrl_l1.control.signals import saturate
from torchrl_l1.control.state import L1State, ResidualStatistics, init

INFLATIONS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
# With the largest value, a disturbance drifts as far in a thousand steps as it is expected to be
# from zero at a reset. A faster one is followed sooner, but never known well enough to be cancelled
# completely.
PROCESS_NOISES = (0.001, 0.003, 0.01)
_AS_GOOD = 1.05  # errors up to this factor above the least count as equal to it
_SETTLED = 10  # steps after a reset that reflect the initial deviation more than the residuals


@dataclass(frozen=True)
class Calibration:
    """The Kalman filter's two free settings, found by replaying undisturbed episodes.

    Attributes:
        inflation: the smallest value tried for which the estimates of an absent disturbance are no
            larger than their posterior says; the largest value tried if there is no such value.
        process_noise: the value for which the executed input errs least; of those that are as good
            within 5 %, the largest, since it responds soonest to a change. A fraction of half the
            range of the action, as in :class:`~torchrl_l1.control.ResidualStatistics`.
        table: one row per pair tried: ``process_noise``, ``inflation``, ``consistency`` (the mean
            square of the estimates in posterior standard deviations where there is no disturbance)
            and ``error`` (the root mean square of the disturbance that the input leaves
            uncancelled, in half ranges of the action, over undisturbed and disturbed replays).
    """

    inflation: float
    process_noise: float
    table: list[dict[str, float]]


@torch.no_grad()
def calibrate(
    config: L1Config,
    residual: Tensor,
    jacobian: Tensor,
    covariance: Tensor,
    *,
    action: Tensor | None = None,
    inflations: Sequence[float] = INFLATIONS,
    process_noises: Sequence[float] = PROCESS_NOISES,
    generator: torch.Generator | None = None,
) -> Calibration:
    r"""Choose inflation and process noise by replaying residuals through the Kalman filter.

    A model's residuals are neither white nor normal: contacts and whatever else the model lacks
    recur step after step, and a filter that takes them for independent becomes sure of disturbances
    that are not there. How much their covariance must be inflated for the posterior to be honest is
    a question of *consistency* (Bar-Shalom, Li and Kirubarajan, 2001, section 5.4): the normalised
    square of the estimation error :math:`\hat d^2 / P` has mean one. The bandwidth is found on the
    same episodes with disturbances added: the filter's initial deviation with random signs, from
    the reset on in every other stretch and from a random moment on in the rest, added to the
    residuals as :math:`r_t + J_t d_t` within the bounds of the action. Neither needs the real
    system.

    Args:
        config: the settings for which to choose the two; its own values of the two are ignored.
        residual: the model's error in each step of undisturbed episodes ``(S, T, n)``, state units.
        jacobian: the model's Jacobian in the same steps ``(S, T, n, m)``.
        covariance: covariance of the residuals ``(n, n)``, or of each of them ``(S, T, n, n)``.
        action: the executed action in the same steps ``(S, T, m)``; zero if ``None``.
        inflations: the values to try.
        process_noises: the values to try.
        generator: source of the added disturbances; one with a fixed seed if ``None``.

    Returns:
        the two settings and the table from which they were chosen.

    Raises:
        ValueError: if the episodes have fewer than 20 steps, an entry is not finite, the covariance
            is not positive definite, or the settings have no Kalman filter.

    Examples:
        >>> generator = torch.Generator().manual_seed(0)
        >>> white = 0.1 * torch.randn(64, 100, 2, generator=generator)
        >>> config = L1Config.robust(0.02, action_low=-1.0, action_high=1.0)
        >>> calibrate(config, white, torch.ones(64, 100, 2, 1), 0.01 * torch.eye(2)).inflation
        1.0
    """
    if not config.needs_calibration:
        raise ValueError("there is nothing to calibrate without filter='kalman'")
    sequences, steps, _, m = jacobian.shape
    action = jacobian.new_zeros(sequences, steps, m) if action is None else action
    covariance = covariance.to(residual)
    _check_recorded(config, residual, jacobian, action, covariance)
    if generator is None:
        generator = torch.Generator().manual_seed(0)
    half_range = torch.as_tensor(config.half_range).to(residual).expand(m)
    disturbance = _steps(sequences, steps, m, generator).to(residual)
    disturbance = disturbance * config.initial_deviation * half_range
    disturbance = torch.cat([torch.zeros_like(disturbance), disturbance])
    residual, action = residual.repeat(2, 1, 1), action.repeat(2, 1, 1)
    jacobian = jacobian.repeat(2, 1, 1, 1)
    covariance = covariance if covariance.ndim == 2 else covariance.repeat(2, 1, 1, 1)
    passed = saturate(config, action + disturbance) - action
    residual = residual + (jacobian @ passed.unsqueeze(-1)).squeeze(-1)

    tried = [
        {"process_noise": noise, "inflation": inflation}
        for noise in process_noises
        for inflation in sorted(inflations)
    ]
    # All pairs side by side, along a leading dimension.
    noise, inflation = residual.new_tensor([list(pair.values()) for pair in tried]).T
    statistics = ResidualStatistics(
        covariance, inflation[:, None, None, None], noise[:, None, None]
    )
    # The covariance is given here, wherever it comes from: none needs to be remembered.
    free = replace(config, process_noise=None, inflation=None, covariance="residuals")
    q, mean, variance = replay(free, residual, jacobian, action, statistics, len(tried))
    left = (q - disturbance) / half_range
    error = left.square().mean((1, 2, 3)).sqrt()
    square = (mean.square() / variance)[:, :sequences, _SETTLED:].mean((1, 2, 3))
    table = [
        {**pair, "consistency": consistency, "error": root}
        for pair, consistency, root in zip(tried, square.tolist(), error.tolist(), strict=True)
    ]
    honest = [_honest(table, noise) for noise in process_noises]
    least = min(row["error"] for row in honest)
    best = max(
        (row for row in honest if row["error"] <= _AS_GOOD * least),
        key=lambda row: row["process_noise"],
    )
    return Calibration(best["inflation"], best["process_noise"], table)


def _check_recorded(
    config: L1Config, residual: Tensor, jacobian: Tensor, action: Tensor, covariance: Tensor
) -> None:
    """Reject episodes unfit for calibration; the shapes follow from the Jacobian."""
    sequences, steps, n, m = jacobian.shape
    if residual.shape != (sequences, steps, n):
        raise ValueError(
            f"residual has shape {tuple(residual.shape)}, expected {(sequences, steps, n)} as the "
            "Jacobian"
        )
    if steps < 2 * _SETTLED or sequences < 1:
        raise ValueError(
            f"calibration needs episodes of at least {2 * _SETTLED} steps, got {sequences} of "
            f"{steps}"
        )
    if action.shape != (sequences, steps, m):
        raise ValueError(
            f"action has shape {tuple(action.shape)}, expected {(sequences, steps, m)} as the "
            "Jacobian"
        )
    if not all(values.isfinite().all() for values in (residual, jacobian, action)):
        raise ValueError(
            "calibration needs finite residuals, Jacobians and actions: leave out all others"
        )
    is_whole = config.estimator == "weighted"
    shapes = (n, n), (sequences, steps, n, n)
    if covariance.shape not in shapes or not is_positive(covariance, is_whole):
        raise ValueError(
            f"calibration needs a positive definite covariance of the shape {shapes[0]} or "
            f"{shapes[1]}, got {tuple(covariance.shape)}: give states without residuals a small "
            "variance"
        )


def _honest(table: list[dict[str, float]], process_noise: float) -> dict[str, float]:
    rows = [row for row in table if row["process_noise"] == process_noise]
    return next((row for row in rows if row["consistency"] <= 1), rows[-1])


def _steps(sequences: int, steps: int, m: int, generator: torch.Generator) -> Tensor:
    """Random signs, from the start or from a random moment of the first half ``(S, T, m)``."""
    start = torch.randint(0, steps // 2, (sequences, 1, 1), generator=generator)
    start[::2] = 0
    signs = 2.0 * torch.randint(0, 2, (sequences, 1, m), generator=generator) - 1
    return signs * (torch.arange(steps).reshape(1, -1, 1) >= start)


def replay(
    config: L1Config,
    residual: Tensor,
    jacobian: Tensor,
    action: Tensor,
    statistics: ResidualStatistics,
    candidates: int = 1,
) -> tuple[Tensor, Tensor, Tensor]:
    """Run the Kalman filter over recorded residuals, without acting on its estimates.

    Args:
        config: the settings.
        residual: ``(S, T, n)``, state units.
        jacobian: ``(S, T, n, m)``.
        action: the executed action ``(S, T, m)``.
        statistics: statistics of the residuals; entries that differ between candidates have a
            leading dimension of that size. The covariance is ``(n, n)``, or ``(S, T, n, n)`` with
            one per step.
        candidates: C.

    Returns:
        after each step what the input would subtract, and the posterior's mean and variance
        ``(C, S, T, m)`` each.
    """
    sequences, steps, n, m = jacobian.shape
    state = init(
        [candidates, sequences], n, m, config, dtype=residual.dtype, device=residual.device
    )
    zero = torch.zeros_like(state.x_hat)

    def known(t: int) -> ResidualStatistics:
        if statistics.covariance.ndim == 2:
            return statistics
        return statistics._replace(covariance=statistics.covariance[:, t])

    # The first step only starts the filter, which knows nothing yet.
    estimated = kalman_law.estimate(config, state, zero, known(0))
    inputs, means, variances = [], [], []
    for t in range(steps):
        state = _before(config, state, estimated, jacobian[:, t], action[:, t])
        estimated = kalman_law.estimate(config, state, residual[:, t].expand_as(zero), known(t))
        inputs.append(kalman_law.adapted(config, estimated, state.u_bar).q)
        means.append(estimated.posterior.mean)
        variances.append(estimated.posterior.covariance.diagonal(dim1=-2, dim2=-1))
    return torch.stack(inputs, -2), torch.stack(means, -2), torch.stack(variances, -2)


def _before(
    config: L1Config,
    state: L1State,
    estimated: kalman_law.Estimate,
    jacobian: Tensor,
    action: Tensor,
) -> L1State:
    """The state before a residual, which this action and Jacobian have led to."""
    posterior = estimated.posterior
    action = action.expand_as(posterior.mean)
    passed = kalman_law.Reach.of(config, action, posterior).passed
    return state._replace(
        x_hat=(jacobian @ passed.unsqueeze(-1)).squeeze(-1),
        u_bar=action,
        sigma_m=posterior.mean,
        started=torch.ones_like(state.started),
        covariance=posterior.covariance.flatten(-2),
        noise=estimated.noise,
        skill=estimated.skill,
        jacobian=jacobian.flatten(-2).expand(*state.started.shape[:-1], -1),
    )
