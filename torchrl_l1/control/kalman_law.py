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
    narrow_state,
    project,
    saturate,
    wide,
    wide_state,
)
from torchrl_l1.control.state import L1State, ResidualStatistics

CONTRADICTION = 1.0
"""Standard deviations beyond which an inward push at a bound does not count as noise.

These are standard deviations of the inflated covariance, well beyond ordinary residuals. A larger
value would ignore weak evidence; with a smaller one, noise at the bounds pulls the estimate of a
bias towards zero.
"""

GLITCH = 25.0
"""Largest ratio of a residual's square to its expected value that counts for the running mean.

A single wild value of a sensor would otherwise blind the filter for hundreds of steps. A sensor
that stays noisy is known within twenty.
"""


class Estimate(NamedTuple):
    """What the Kalman filter knows before it decides what to do.

    Attributes:
        posterior: posterior of the matched disturbance; zero where it is not finite.
        noise: running ratios of the residuals' squares to their expected values ``(..., n)``.
        skill: sums of :func:`~.kalman.record_forecast` ``(..., 2)``; ``None`` without.
        innovation: the prediction's error ``(..., n)``, state units.
        residual: the model's error ``(..., n)``: the innovation plus the effect expected of the
            disturbance.
        effect_matched: the part of it that the posterior explains ``(..., n)``.
        finite: whether all of this is finite ``(..., 1)``, bool.
    """

    posterior: Posterior
    noise: Tensor
    skill: Tensor | None
    innovation: Tensor
    residual: Tensor
    effect_matched: Tensor
    finite: Tensor


class Reach(NamedTuple):
    """The part of a disturbance that reaches a plant whose actuators end at the action's bounds.

    Whether it is cut off there is not known: a motor's limit cuts off a bias of its command but not
    a load on its axis. What would lie beyond is expected to be cut off, as in most simulators, but
    may be present all the same: that is no reason to take it for noise, and none to learn from it.
    An inward push is different: no disturbance beyond a bound explains it, see :meth:`counting`.

    Attributes:
        passed: the part of the mean that stays within the bounds ``(..., m)``, action units.
        within: entries whose whole effect is certain ``(..., m)``, bool.
        deviation: standard deviation of what, in the other entries, may act in addition to
            ``passed`` ``(..., m)``; zero for those within.
        outward: direction of the bound, one or minus one ``(..., m)``; meaningless for entries
            within.
    """

    passed: Tensor
    within: Tensor
    deviation: Tensor
    outward: Tensor

    @classmethod
    def of(cls, config: L1Config, executed: Tensor, posterior: Posterior) -> Reach:
        """From an executed input ``(..., m)`` and what is known of the disturbance."""
        mean = posterior.mean
        both = executed + mean
        passed = saturate(config, both) - executed
        # No smaller than rounding: unbounded actions may be large.
        rounding = 64 * torch.finfo(mean.dtype).eps * both.abs()
        margin = 1e-3 * like(mean, config.half_range) + rounding
        above, below = saturate(config, both + margin), saturate(config, both - margin)
        # Rounding may remove up to twice the margin, a bound removes at least half.
        within = above - below > 1.5 * margin
        outward = ((both - below) - (above - both)).sign()
        variance = posterior.covariance.diagonal(dim1=-2, dim2=-1) + (mean - passed).square()
        return cls(passed, within, variance.sqrt().masked_fill(within, 0.0), outward)

    def counting(self, columns: Tensor, innovation: Tensor) -> Reach:
        r"""Count entries as within if their actuator is pushed inwards, against expectation.

        Where actuators push too little at both bounds, as under a dead zone or a lower gain, the
        steps at one bound alone would confirm whichever sign the estimate took first. An entry
        counts as pushed inwards if :math:`z_i = (C^\top r)_i / \sqrt{(C^\top C)_{ii}}` exceeds
        :data:`CONTRADICTION` in that direction.

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
    r"""Estimate the matched disturbance from the observation: one step of a Kalman filter.

    The disturbance :math:`d` is a random walk, observed through the last step's Jacobian in the
    model's residual:

    .. math::

        d_t = d_{t-1} + \nu_t, \quad \nu_t \sim N(0, q^2 I), \qquad
        x_t - x_{t-1} - \hat f(x_{t-1}, u_{t-1}) = J_{t-1} d_t + w_t, \quad
        w_t \sim N(0, D_t \Lambda D_t)

    if the input plus the disturbance stays within the bounds of the action. What lies beyond may or
    may not reach the plant, and counts only where it is contradicted, see :class:`Reach`. Here
    :math:`\Lambda` is the inflated covariance of the residuals. The squares of the diagonal
    :math:`D_t` are running means of :func:`~.kalman.noise_ratio`, none below one, times their mean
    over the states: a state whose sensor has become noisy loses weight, and all states do if many
    have. A single residual beyond expectation loses weight at once, see :func:`~.kalman.doubt`.
    Both ask what no disturbance explains that has just set in, as at a reset: a filter that has
    long been sure would take any later change of the disturbance for noise.

    Args:
        config: the settings.
        state: from :func:`~torchrl_l1.control.init` with these settings, or the previous step.
        observation: ``(..., n)``, raw units.
        residuals: as in :func:`step`.
        restart: as in :func:`step`.

    Returns:
        the posterior and the terms that led to it.

    Raises:
        ValueError: if the state was made with other settings.
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
    # With observations noisier than its data, a model also errs persistently: the policy reacts to
    # the noise, and the mean of a nonlinear function is not that of its argument.
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
    units = half_range if isinstance(config.half_range, tuple) else None
    if config.forgetting < 1:
        # A disturbance may change at any step, and by more than the random walk expects: only what
        # no change of it explains is noise. With no more states than actions a change explains
        # everything, and the random walk has to tell.
        sudden = initial if n > m else torch.zeros_like(initial)
        unsure = Posterior(prior.mean, prior.covariance + sudden)
        root = kalman.factor(unsure.covariance, units)
        fit = kalman.measurement_update(unsure, columns, white, root)
        # A residual far beyond expectation loses that much weight at once.
        doubt = kalman.doubt(columns, white, fit.mean - prior.mean).sqrt()
        columns, white = columns / doubt.unsqueeze(-1), white / doubt
        left = residual - (jacobian @ fit.mean.unsqueeze(-1)).squeeze(-1)
        # The common factor of the scale, taken for noise here, would feed on itself.
        common = larger.mean(-1)[..., None, None]
        fit = fit._replace(covariance=fit.covariance / common)
        ratio = kalman.noise_ratio(covariance, jacobian, fit, left, unknown)
        ratio = torch.minimum(ratio, GLITCH * larger)
        noise = torch.where(fresh, noise, torch.lerp(ratio, noise, config.forgetting))
    root = kalman.factor(prior.covariance, units)
    posterior = kalman.measurement_update(prior, columns, white, root)

    skill = past.skill
    if skill is not None:
        acted_on = kalman.significant(prior, config.dead_zone)
        forecast = (columns @ acted_on.unsqueeze(-1)).squeeze(-1)
        error = white + (columns @ (prior.mean - acted_on).unsqueeze(-1)).squeeze(-1)
        skill = skill.masked_fill(fresh, 0.0)
        skill = kalman.record_forecast(skill, forecast, error, config.skill_forgetting)

    flat = posterior.covariance.flatten(-2)
    entries = [observation, posterior.mean, flat, noise, *([] if skill is None else [skill])]
    finite = is_finite(torch.cat(entries, -1))
    skill = None if skill is None else skill.masked_fill(~finite, 0.0)
    posterior = Posterior(
        project(config, posterior.mean.masked_fill(~finite, 0.0)),
        posterior.covariance.masked_fill(~finite.unsqueeze(-1), 0.0),
    )
    effect = (jacobian @ posterior.mean.unsqueeze(-1)).squeeze(-1)
    return Estimate(posterior, noise, skill, innovation, residual, effect, finite)


def adapted(config: L1Config, estimated: Estimate, u_rl: Tensor) -> ControlInput:
    """The input that cancels the significant part of an estimate, within the bounds."""
    q = kalman.significant(estimated.posterior, config.dead_zone)
    if estimated.skill is not None:
        q = kalman.skill(estimated.skill) * q
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
        state: the state from which the estimate was made.
        estimated: the estimate.
        observation: as in :func:`step`.
        u_rl: the policy's action within its bounds ``(..., m)``.
        change: predicted change at ``u_bar`` ``(..., n)``, state units per step.
        jacobian: as in :func:`step`.
        u_bar: operating point ``(..., m)``; zero if ``None``.
        residuals: as in :func:`step`, at this step's input where they depend on it.
        control: the result of :func:`adapted`, if already known.

    Returns:
        as for :func:`respond`.
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
        skill=None if estimated.skill is None else estimated.skill.masked_fill(non_finite, 0.0),
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
        estimated.skill,
    )
    u = torch.where(finite, narrow(u, policy.dtype), policy)
    return u, narrow_state(following, dtype), terms


class _Memory(NamedTuple):
    """Those entries of a state that the filter needs."""

    covariance: Tensor
    noise: Tensor
    jacobian: Tensor
    skill: Tensor | None


def _memory(config: L1Config, state: L1State) -> _Memory:
    covariance, noise, jacobian = state.covariance, state.noise, state.jacobian
    expected, varies = state.residual_covariance, config.covariance != "residuals"
    skill, judged = state.skill, config.skill_forgetting < 1
    is_whole = varies == (expected is not None) and judged == (skill is not None)
    if covariance is None or noise is None or jacobian is None or not is_whole:
        raise ValueError(
            "the state belongs to a controller with other settings: make it with "
            "init(batch_size, observation_dim, action_dim, config)"
        )
    return _Memory(covariance, noise, jacobian, skill)


def _expected_covariance(
    config: L1Config, state: L1State, residuals: ResidualStatistics, fresh: Tensor
) -> Tensor:
    """Covariance of the residual just seen ``(n, n)`` or ``(..., n, n)``."""
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
    return wide(residuals.covariance).flatten(-2).expand(shape).masked_fill(non_finite, 0.0)


def _unit(observation: Tensor) -> ResidualStatistics:
    n = observation.shape[-1]
    return ResidualStatistics(torch.eye(n, dtype=observation.dtype, device=observation.device))


def _chosen(setting: float | None, measured: Tensor | float) -> Tensor | float:
    return measured if setting is None else setting


def _vector(model: Tensor, value: Scalars, width: int) -> Tensor:
    return torch.as_tensor(value, dtype=model.dtype, device=model.device).expand(width)
