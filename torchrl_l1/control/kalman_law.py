"""The robust law as pure functions: a matched disturbance tracked by a Kalman filter."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_l1.control import kalman
from torchrl_l1.control.config import L1Config, Scalars
from torchrl_l1.control.kalman import Posterior
from torchrl_l1.control.least_squares import any_of, is_finite, whitened, without_effect
from torchrl_l1.control.signals import (
    ControlInput,
    Terms,
    credible,
    like,
    narrow,
    narrow_entries,
    project,
    saturate,
    wide,
    wide_state,
)
from torchrl_l1.control.state import L1State, ResidualStatistics

CONTRADICTION = 1.0
"""Standard deviations beyond which a push inwards at a bound is taken for no noise.

Of the inflated covariance, of which ordinary residuals are well within. More would leave weak
evidence out; with less, noise at the bounds draws the estimate of a bias towards zero.
"""


class Estimate(NamedTuple):
    """What the Kalman filter knows before it says what to do.

    Attributes:
        posterior: of the matched disturbance; zero where it is not finite.
        noise: running ratios of the residuals' squares to those expected ``(..., n)``.
        innovation: what the prediction missed ``(..., n)``, state units.
        residual: what the model missed ``(..., n)``: the innovation and what was expected of
            the disturbance.
        effect_matched: what of it the posterior explains ``(..., n)``.
        finite: whether all of this is finite ``(..., 1)``, bool.
    """

    posterior: Posterior
    noise: Tensor
    innovation: Tensor
    residual: Tensor
    effect_matched: Tensor
    finite: Tensor


class Reach(NamedTuple):
    """What of a disturbance comes through to a plant whose actuators end at the action's bounds.

    Whether they do is not known: a bias of a motor's command is cut off by the motor's limit, a
    load on its axis is not. What would lie beyond is expected to be cut off, as in most
    simulators, and may be there all the same: no reason to take it for noise, and none to learn
    from it. A push inwards is of another kind: no disturbance beyond a bound explains it, see
    :meth:`counting`.

    Attributes:
        passed: what of the mean stays within the bounds ``(..., m)``, action units.
        within: entries whose whole effect is sure ``(..., m)``, bool.
        deviation: standard deviation of what comes beside ``passed`` in the others, if anything
            does, ``(..., m)``; zero for those within.
        outward: the direction of the bound, one or minus one ``(..., m)``; of no meaning for those
            within.
    """

    passed: Tensor
    within: Tensor
    deviation: Tensor
    outward: Tensor

    @classmethod
    def of(cls, config: L1Config, executed: Tensor, posterior: Posterior) -> Reach:
        """For an executed input ``(..., m)`` and what is known of the disturbance."""
        mean = posterior.mean
        both = executed + mean
        passed = saturate(config, both) - executed
        # No smaller than rounding: actions without bounds may be large.
        rounding = 64 * torch.finfo(mean.dtype).eps * both.abs()
        margin = 1e-3 * like(mean, config.half_range) + rounding
        above, below = saturate(config, both + margin), saturate(config, both - margin)
        # Rounding may take some of twice the margin, a bound takes at least half.
        within = above - below > 1.5 * margin
        outward = ((both - below) - (above - both)).sign()
        variance = posterior.covariance.diagonal(dim1=-2, dim2=-1) + (mean - passed).square()
        return cls(passed, within, variance.sqrt().masked_fill(within, 0.0), outward)

    def counting(self, columns: Tensor, innovation: Tensor) -> Reach:
        r"""With those entries within whose actuator is pushed inwards, against the expectation.

        Where actuators push too little at both bounds, as under a dead zone or a lower gain, the
        steps at one bound alone would confirm whichever sign the estimate took first. Such are
        entries with :math:`z_i = (C^\top r)_i / \sqrt{(C^\top C)_{ii}}` of more than
        :data:`CONTRADICTION` inwards.

        Args:
            columns: whitened input matrix :math:`C` ``(..., n, m)``.
            innovation: whitened :math:`r` ``(..., n)``.
        """
        score = (columns.mT @ innovation.unsqueeze(-1)).squeeze(-1)
        length = torch.linalg.vector_norm(columns, dim=-2)
        within = self.within | (self.outward * score < -CONTRADICTION * length)
        return self._replace(within=within, deviation=self.deviation.masked_fill(within, 0.0))


def estimate(
    config: L1Config,
    state: L1State,
    observation: Tensor,
    residuals: ResidualStatistics | None = None,
    restart: Tensor | None = None,
) -> Estimate:
    r"""What the observation tells of the matched disturbance: one step of a Kalman filter.

    The disturbance :math:`d` is a random walk, seen through the last step's Jacobian in the
    model's residual:

    .. math::

        d_t = d_{t-1} + \nu_t, \quad \nu_t \sim N(0, q^2 I), \qquad
        x_t - x_{t-1} - \hat f(x_{t-1}, u_{t-1}) = J_{t-1} d_t + w_t, \quad
        w_t \sim N(0, D_t \Lambda D_t)

    where the input and what adds to it stay within the bounds of the action; what lies beyond may
    reach the plant or not, and counts only where it is contradicted, see :class:`Reach`. Here
    :math:`\Lambda` is the inflated covariance of the residuals. The squares of the diagonal
    :math:`D_t` are a running mean of :func:`~.kalman.noise_ratio`, none below one, times their
    mean over the states: a state whose sensor has become noisy loses its weight, and all do where
    many have. A single residual beyond expectation loses it at once, see
    :func:`~.kalman.doubt`.

    Args:
        config: the settings.
        state: from :func:`~torchrl_l1.control.init` with these settings, or the previous step.
        observation: ``(..., n)``, raw units.
        residuals: as in :func:`step`.
        restart: as in :func:`step`.

    Returns:
        the posterior and what led to it.

    Raises:
        ValueError: if the state is that of other settings.
    """
    state, observation = wide_state(state), wide(observation)
    past = _memory(config, state)
    n, m = observation.shape[-1], state.q.shape[-1]
    fresh = ~state.started if restart is None else ~state.started | restart
    statistics = _unit(observation) if residuals is None else residuals
    half_range = _vector(observation, config.half_range, m)
    process_noise = half_range * _chosen(config.process_noise, statistics.process_noise)
    initial = torch.diag_embed((half_range * config.initial_deviation).square())
    prior = Posterior(
        state.sigma_m.masked_fill(fresh, 0.0),
        torch.where(
            fresh.unsqueeze(-1),
            initial,
            kalman.time_update(past.covariance.unflatten(-1, (m, m)), process_noise),
        ),
    )
    seen = past.jacobian.masked_fill(fresh, 0.0).unflatten(-1, (n, m))
    innovation = (observation - state.x_hat).masked_fill(fresh, 0.0)

    covariance = _expected_covariance(config, state, statistics, fresh)
    noise = past.noise.masked_fill(fresh, 1.0)
    larger = noise.clamp_min(1.0)
    # From observations that are noisier than its data were, a model errs in a lasting way too: the
    # policy reacts to the noise, and the mean of a nonlinear function is not that of its argument.
    scale = (larger * larger.mean(-1, keepdim=True)).sqrt().unsqueeze(-1)
    relative = innovation.unsqueeze(-1) / scale
    columns, white = whitened(covariance, seen / scale, relative)
    reach = Reach.of(config, state.u_bar, prior).counting(columns, white.squeeze(-1))
    jacobian = seen * reach.within.unsqueeze(-2)
    unknown = seen * reach.deviation.unsqueeze(-2)
    residual = innovation + (jacobian @ prior.mean.unsqueeze(-1)).squeeze(-1)
    others = unknown / scale
    columns, white = whitened(covariance + others @ others.mT, jacobian / scale, relative)
    white = white.squeeze(-1)
    has_units = isinstance(config.half_range, tuple)
    factor = kalman.factor(prior.covariance, half_range if has_units else None)
    posterior = kalman.measurement_update(prior, columns, white, factor)
    if config.forgetting < 1:
        # A residual far beyond what is expected counts for as much less, at once.
        doubt = kalman.doubt(columns, white, posterior.mean - prior.mean).sqrt()
        columns, white = columns / doubt.unsqueeze(-1), white / doubt
        posterior = kalman.measurement_update(prior, columns, white, factor)
        left = residual - (jacobian @ posterior.mean.unsqueeze(-1)).squeeze(-1)
        ratio = kalman.noise_ratio(covariance, jacobian, posterior, left, unknown)
        noise = torch.where(fresh, noise, torch.lerp(ratio, noise, config.forgetting))

    flat = posterior.covariance.flatten(-2)
    finite = is_finite(torch.cat([observation, posterior.mean, flat, noise], -1))
    posterior = Posterior(
        project(config, posterior.mean.masked_fill(~finite, 0.0)),
        posterior.covariance.masked_fill(~finite.unsqueeze(-1), 0.0),
    )
    effect = (jacobian @ posterior.mean.unsqueeze(-1)).squeeze(-1)
    return Estimate(posterior, noise, innovation, residual, effect, finite)


def adapted(config: L1Config, estimated: Estimate, u_rl: Tensor) -> ControlInput:
    """The input that cancels what of an estimate is significant, within the bounds."""
    q = kalman.significant(estimated.posterior, config.dead_zone)
    return ControlInput.of(config, wide(u_rl), q)


def follow(
    config: L1Config,
    state: L1State,
    estimated: Estimate,
    observation: Tensor,
    u_rl: Tensor,
    change: Tensor,
    jacobian: Tensor,
    u_bar: Tensor | None = None,
    residuals: ResidualStatistics | None = None,
    control: ControlInput | None = None,
) -> tuple[Tensor, L1State, Terms]:
    """The input, the next state and the terms of the diagnostics after :func:`estimate`.

    Args:
        config: the settings.
        state: that the estimate was made of.
        estimated: the estimate.
        observation: as in :func:`step`.
        u_rl: the policy's action within its bounds ``(..., m)``.
        change: of the model at ``u_bar`` ``(..., n)``, state units per step.
        jacobian: as in :func:`step`.
        u_bar: operating point ``(..., m)``; zero if ``None``.
        residuals: as in :func:`step`, at this step's input where they depend on it.
        control: what :func:`adapted` gave, where that is known already.

    Returns:
        as :func:`respond`.
    """
    dtype, policy = state.x_hat.dtype, u_rl
    observation, u_rl, change, jacobian = map(wide, (observation, u_rl, change, jacobian))
    posterior = estimated.posterior
    control = adapted(config, estimated, u_rl) if control is None else control
    u = control.u
    passed = saturate(config, u + posterior.mean) - u  # see Reach
    step_u = (u if u_bar is None else u - wide(u_bar)) + passed
    x_hat = observation + change + (jacobian @ step_u.unsqueeze(-1)).squeeze(-1)

    finite = estimated.finite & is_finite(jacobian.flatten(-2))
    finite = finite & credible(config, dtype, estimated.innovation, observation, x_hat)
    non_finite = ~finite
    reach = like(observation, config.half_range)
    invisible = without_effect(jacobian, torch.maximum(observation.abs(), x_hat.abs()), reach)
    jacobian = jacobian * ~invisible.unsqueeze(-2)
    following = L1State(
        x_hat=x_hat.masked_fill(non_finite, 0.0),
        u_bar=u.masked_fill(non_finite, 0.0),
        q=control.q,
        sigma_m=posterior.mean,
        n_switch=state.n_switch,
        started=finite,
        covariance=posterior.covariance.flatten(-2),
        noise=estimated.noise.masked_fill(non_finite, 1.0),
        jacobian=jacobian.flatten(-2).masked_fill(non_finite, 0.0),
        residual_covariance=_remembered(state, residuals, observation, non_finite),
    )
    terms = Terms(
        -estimated.innovation,
        estimated.residual,
        estimated.effect_matched,
        control,
        any_of(invisible),
        non_finite,
        dtype,
        posterior,
    )
    u = torch.where(finite, narrow(u, policy.dtype), policy)
    return u, narrow_entries(following, dtype), terms


class _Memory(NamedTuple):
    """Those entries of a state that the filter needs."""

    covariance: Tensor
    noise: Tensor
    jacobian: Tensor


def _memory(config: L1Config, state: L1State) -> _Memory:
    covariance, noise, jacobian = state.covariance, state.noise, state.jacobian
    expected, varies = state.residual_covariance, config.covariance != "residuals"
    if covariance is None or noise is None or jacobian is None or varies == (expected is None):
        raise ValueError(
            "the state is that of a controller with other settings: make it with "
            "init(batch_size, observation_dim, action_dim, config)"
        )
    return _Memory(covariance, noise, jacobian)


def _expected_covariance(
    config: L1Config, state: L1State, residuals: ResidualStatistics, fresh: Tensor
) -> Tensor:
    """Of the residual just seen ``(n, n)`` or ``(..., n, n)``."""
    covariance = wide(residuals.covariance)
    if state.residual_covariance is not None:
        n = state.x_hat.shape[-1]
        remembered = state.residual_covariance.unflatten(-1, (n, n))
        eye = torch.eye(n, dtype=remembered.dtype, device=remembered.device)
        covariance = torch.where(fresh.unsqueeze(-1), eye, remembered)
    if config.estimator == "least_squares":
        mean = covariance.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
        covariance = mean * torch.eye(covariance.shape[-1], dtype=mean.dtype, device=mean.device)
    return covariance * _chosen(config.inflation, residuals.inflation)


def _remembered(
    state: L1State, residuals: ResidualStatistics | None, observation: Tensor, non_finite: Tensor
) -> Tensor | None:
    if state.residual_covariance is None:
        return None
    residuals = _unit(observation) if residuals is None else residuals
    shape = state.residual_covariance.shape
    return residuals.covariance.flatten(-2).expand(shape).masked_fill(non_finite, 0.0)


def _unit(observation: Tensor) -> ResidualStatistics:
    n = observation.shape[-1]
    return ResidualStatistics(torch.eye(n, dtype=observation.dtype, device=observation.device))


def _chosen(setting: float | None, measured: Tensor | float) -> Tensor | float:
    return measured if setting is None else setting


def _vector(model: Tensor, value: Scalars, width: int) -> Tensor:
    return torch.as_tensor(value, dtype=model.dtype, device=model.device).expand(width)
