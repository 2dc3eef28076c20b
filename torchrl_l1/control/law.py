"""The L1 adaptive law as pure functions: predictor, adaptation by least squares, filter."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_l1.control import kalman
from torchrl_l1.control.config import L1Config, Scalars
from torchrl_l1.control.kalman import Posterior
from torchrl_l1.control.least_squares import is_finite, solve_matched, whitened
from torchrl_l1.control.state import L1Diagnostics, L1State, ResidualStatistics


def saturate(config: L1Config, action: Tensor) -> Tensor:
    """The action within the configured bounds."""
    low, high = config.action_low, config.action_high
    if isinstance(low, tuple) or isinstance(high, tuple):
        # The configuration expands a number beside a tuple, so neither is a plain number here.
        low_bound = None if low is None else _like(action, low)
        high_bound = None if high is None else _like(action, high)
        return torch.clamp(action, low_bound, high_bound)  # type: ignore[arg-type]
    if low is None and high is None:
        return action
    return torch.clamp(action, low, high)


def project(config: L1Config, sigma_m: Tensor) -> Tensor:
    r"""The matched estimate within :attr:`L1Config.matched_bound`.

    This is the projection of adaptive control for a box. The authors' formulas have none, but
    least squares with an almost vanishing :math:`J` turns any prediction error into an estimate
    without bound, and the low-pass filter would take long to forget it.
    """
    bound = config.matched_bound
    if bound is None:
        return sigma_m
    if isinstance(bound, tuple):
        limit = torch.tensor(bound, dtype=sigma_m.dtype, device=sigma_m.device)
        return torch.clamp(sigma_m, -limit, limit)
    return torch.clamp(sigma_m, -bound, bound)


def filtered(config: L1Config, q: Tensor, sigma_m: Tensor) -> Tensor:
    r"""Next state of the low-pass filter, :math:`q + \alpha (\sigma_m - q)`.

    This is arXiv 2403.14860, control law of section 3.2, with :math:`K = \omega I`.
    """
    return torch.lerp(q, sigma_m, config.filter_gain)


def step(
    config: L1Config,
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
    drift: Tensor,
    jacobian: Tensor,
    restart: Tensor | None = None,
    residuals: ResidualStatistics | None = None,
) -> tuple[Tensor, L1State, L1Diagnostics]:
    r"""One step of the L1 adaptive controller on the affine model ``x' = x + drift + jacobian u``.

    arXiv 2403.14860, Algorithm 1 and the discrete-time law of section 3.2. With
    :math:`\tilde x = \hat x - x` the prediction error, :math:`d_t` the drift, :math:`J` the
    Jacobian, :math:`T` the sampling time and :math:`A_s` diagonal,

    .. math::

        \hat\sigma &= -\Phi^{-1} \exp(A_s T)\, \tilde x,
            \qquad \Phi = A_s^{-1} (\exp(A_s T) - I) \\
        J \sigma_m &\approx T \hat\sigma \quad\text{(least squares)} \\
        q &\leftarrow q + \alpha (\sigma_m - q) \\
        u &= \mathrm{clip}(u_{RL} - q) \\
        \hat x &\leftarrow \hat x + d_t + J u + T (\hat\sigma + A_s \tilde x)

    The estimate :math:`\hat\sigma` is in state units per second and the matched part
    :math:`\sigma_m` in action units. What the least squares leaves over is unmatched: it enters
    the prediction and no action cancels it. The predictor sees the saturated input. Before the
    filter takes :math:`\sigma_m` in, it is projected, see :func:`project`.

    Pure, batched over leading dimensions and free of data-dependent branches. Where any input
    of an environment is not finite the output is ``u_rl``, ``non_finite`` is set and that
    environment restarts at its next step; the others are not touched.

    With ``filter="kalman"`` the step is that of :func:`estimate` and :func:`follow` instead.

    Args:
        config: the settings; switching fields other than the filter's are not used here.
        state: from :func:`init` or the previous step.
        observation: ``(..., n)``, raw units.
        u_rl: the policy's action ``(..., m)``; clipped to the bounds first.
        drift: ``(..., n)``, state units per step.
        jacobian: ``(..., n, m)``, state units per step and action unit.
        restart: ``(..., 1)`` bool, where predictor and filter start afresh before this step.
        residuals: what is known of the residuals; white ones of unit variance if ``None``.

    Returns:
        the executed input ``(..., m)``, the next state and the diagnostics (the two of the
        switching law, which this function does not evaluate, hold ``restart`` and zeros).

    Raises:
        ValueError: if a shape does not fit the state's.

    Examples:
        >>> from torchrl_l1.control import init
        >>> config = L1Config(0.04, action_low=-1.0, action_high=1.0)
        >>> state = init([2], observation_dim=3, action_dim=1)
        >>> x, drift, u_rl = torch.zeros(2, 3), torch.zeros(2, 3), torch.full((2, 1), 0.5)
        >>> u, state, diagnostics = step(config, state, x, u_rl, drift, torch.ones(2, 3, 1))
        >>> u.squeeze(-1)
        tensor([0.5000, 0.5000])
        >>> state.x_hat[0]
        tensor([0.5000, 0.5000, 0.5000])
    """
    u_rl = saturate(config, u_rl)
    _check_shapes(state, observation, u_rl, drift, "drift", jacobian, restart)
    if config.filter == "kalman":
        estimated = estimate(config, state, observation, residuals, restart)
        u, following, terms = follow(
            config, state, estimated, observation, u_rl, drift, jacobian, residuals=residuals
        )
    else:
        u, following, terms = respond(
            config, state, observation, u_rl, drift, jacobian, None, restart, residuals
        )
    return u, following, diagnose(config, terms, restart)


class Terms(NamedTuple):
    """What of a step :func:`diagnose` makes its signals of, in state units per step.

    Attributes:
        x_err: state prediction error ``(..., n)``.
        estimate: the uncertainty estimate ``(..., n)``.
        effect_matched: its part that an action could cancel ``(..., n)``.
        q: next filter state ``(..., m)``.
        cut: entries of the action that a bound cut ``(..., m)``, bool.
        ill_conditioned: see :func:`~torchrl_l1.control.solve_matched`.
        non_finite: an input was not finite ``(..., 1)``, bool.
        posterior: of the matched disturbance, with a Kalman filter.
    """

    x_err: Tensor
    estimate: Tensor
    effect_matched: Tensor
    q: Tensor
    cut: Tensor
    ill_conditioned: Tensor
    non_finite: Tensor
    posterior: Posterior | None = None


def respond(
    config: L1Config,
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
    change: Tensor,
    jacobian: Tensor,
    u_bar: Tensor | None = None,
    restart: Tensor | None = None,
    residuals: ResidualStatistics | None = None,
) -> tuple[Tensor, L1State, Terms]:
    """:func:`step` without its diagnostics, on ``x' = x + change + jacobian (u - u_bar)``.

    Args:
        config: the settings.
        state: as in :func:`step`.
        observation: as in :func:`step`.
        u_rl: the policy's action within its bounds ``(..., m)``.
        change: of the model at ``u_bar`` ``(..., n)``, state units per step.
        jacobian: as in :func:`step`.
        u_bar: operating point ``(..., m)``; zero if ``None``.
        restart: as in :func:`step`.
        residuals: as in :func:`step`.

    Returns:
        the executed input, the next state (but for what a switch changes) and what
        :func:`diagnose` needs.
    """
    _check_shapes(state, observation, u_rl, change, "change", jacobian, restart)
    fresh = ~state.started if restart is None else ~state.started | restart
    x_hat = torch.where(fresh, observation, state.x_hat)

    # State prediction error, estimate and its matched part. Everything is in state units per
    # step here: this is T sigma_hat, so that no division by a small T enters the state.
    x_err = x_hat - observation
    estimate = x_err * -_like(x_err, config.adaptation_gain)
    columns, residual = jacobian, estimate
    if config.estimator == "weighted" and residuals is not None:
        columns, white = whitened(residuals.covariance, jacobian, estimate.unsqueeze(-1))
        residual = white.squeeze(-1)
    matched, ill_conditioned = solve_matched(columns, residual)
    sigma_m = project(config, matched)

    # Control input.
    if config.filter_input == "previous":
        q = filtered(config, state.q, state.sigma_m).masked_fill(fresh, 0.0)
    else:
        q = filtered(config, state.q.masked_fill(fresh, 0.0), sigma_m)
    unbounded = u_rl - q
    u = saturate(config, unbounded)

    # State predictor.
    step_u = u if u_bar is None else u - u_bar
    effect_u, effect_matched = (jacobian @ torch.stack([step_u, matched], dim=-1)).unbind(-1)
    x_hat = x_hat + change + effect_u - x_err * _like(x_err, config.predictor_gain)

    finite = is_finite(x_hat)
    non_finite = ~finite
    # The least squares gives finite numbers whatever it gets, so q and sigma_m need no care.
    following = L1State(
        x_hat=x_hat.masked_fill(non_finite, 0.0),
        u_bar=state.u_bar,
        q=q,
        sigma_m=sigma_m,
        n_switch=state.n_switch,
        started=finite,
    )
    terms = Terms(x_err, estimate, effect_matched, q, u != unbounded, ill_conditioned, non_finite)
    return torch.where(finite, u, u_rl), following, terms


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

    with :math:`\Lambda` the inflated covariance of the residuals. The squares of the diagonal
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
    """
    assert state.covariance is not None and state.noise is not None and state.jacobian is not None
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
            kalman.time_update(state.covariance.unflatten(-1, (m, m)), process_noise),
        ),
    )
    jacobian = state.jacobian.masked_fill(fresh, 0.0).unflatten(-1, (n, m))
    innovation = (observation - state.x_hat).masked_fill(fresh, 0.0)
    expected = (jacobian @ prior.mean.unsqueeze(-1)).squeeze(-1)
    residual = innovation + expected

    covariance = _expected_covariance(config, state, statistics, fresh)
    noise = state.noise.masked_fill(fresh, 1.0)
    larger = noise.clamp_min(1.0)
    # From observations that are noisier than its data were, a model errs in a lasting way too: the
    # policy reacts to the noise, and the mean of a nonlinear function is not that of its argument.
    scale = (larger * larger.mean(-1, keepdim=True)).sqrt().unsqueeze(-1)
    columns, white = whitened(covariance, jacobian / scale, innovation.unsqueeze(-1) / scale)
    white = white.squeeze(-1)
    posterior = kalman.measurement_update(prior, columns, white)
    if config.forgetting < 1:
        # A residual far beyond what is expected counts for as much less, at once.
        doubt = kalman.doubt(columns, white, posterior.mean - prior.mean).sqrt()
        posterior = kalman.measurement_update(prior, columns / doubt.unsqueeze(-1), white / doubt)
        left = residual - (jacobian @ posterior.mean.unsqueeze(-1)).squeeze(-1)
        ratio = kalman.noise_ratio(covariance, jacobian, posterior, left)
        noise = torch.where(fresh, noise, torch.lerp(ratio, noise, config.forgetting))

    flat = posterior.covariance.flatten(-2)
    finite = is_finite(torch.cat([observation, posterior.mean, flat, noise], -1))
    posterior = Posterior(
        project(config, posterior.mean.masked_fill(~finite, 0.0)),
        posterior.covariance.masked_fill(~finite.unsqueeze(-1), 0.0),
    )
    effect = (jacobian @ posterior.mean.unsqueeze(-1)).squeeze(-1)
    return Estimate(posterior, noise, innovation, residual, effect, finite)


def adapted(config: L1Config, estimated: Estimate, u_rl: Tensor) -> Tensor:
    """The input that cancels what of an estimate is significant, within the bounds."""
    return saturate(config, u_rl - kalman.significant(estimated.posterior, config.dead_zone))


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

    Returns:
        as :func:`respond`.
    """
    posterior = estimated.posterior
    q = kalman.significant(posterior, config.dead_zone)
    unbounded = u_rl - q
    u = saturate(config, unbounded)
    step_u = (u if u_bar is None else u - u_bar) + posterior.mean
    x_hat = observation + change + (jacobian @ step_u.unsqueeze(-1)).squeeze(-1)

    finite = estimated.finite & is_finite(x_hat) & is_finite(jacobian.flatten(-2))
    non_finite = ~finite
    assert state.covariance is not None
    following = L1State(
        x_hat=x_hat.masked_fill(non_finite, 0.0),
        u_bar=state.u_bar,
        q=q,
        sigma_m=posterior.mean,
        n_switch=state.n_switch,
        started=finite,
        covariance=posterior.covariance.flatten(-2),
        noise=estimated.noise.masked_fill(non_finite, 1.0),
        jacobian=jacobian.flatten(-2).masked_fill(non_finite, 0.0),
        residual_covariance=_remembered(state, residuals, non_finite),
    )
    terms = Terms(
        -estimated.innovation,
        estimated.residual,
        estimated.effect_matched,
        q,
        u != unbounded,
        torch.zeros_like(finite),
        non_finite,
        posterior,
    )
    return torch.where(finite, u, u_rl), following, terms


def _expected_covariance(
    config: L1Config, state: L1State, residuals: ResidualStatistics, fresh: Tensor
) -> Tensor:
    """Of the residual just seen ``(n, n)`` or ``(..., n, n)``."""
    covariance = residuals.covariance
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
    state: L1State, residuals: ResidualStatistics | None, non_finite: Tensor
) -> Tensor | None:
    if state.residual_covariance is None:
        return None
    assert residuals is not None, "a covariance that depends on state and action must be given"
    shape = state.residual_covariance.shape
    return residuals.covariance.flatten(-2).expand(shape).masked_fill(non_finite, 0.0)


def _unit(observation: Tensor) -> ResidualStatistics:
    n = observation.shape[-1]
    return ResidualStatistics(torch.eye(n, dtype=observation.dtype, device=observation.device))


def _chosen(setting: float | None, measured: Tensor | float) -> Tensor | float:
    return measured if setting is None else setting


def _vector(like: Tensor, value: Scalars, width: int) -> Tensor:
    return torch.as_tensor(value, dtype=like.dtype, device=like.device).expand(width)


def diagnose(
    config: L1Config,
    terms: Terms,
    switch: Tensor | None = None,
    affinization_error: Tensor | None = None,
) -> L1Diagnostics:
    """The diagnostics of a step, with those of the switching law if they are given."""
    x_err, estimate, effect_matched, q, cut, ill_conditioned, non_finite, posterior = terms
    norms = torch.linalg.vector_norm(
        torch.stack([x_err, effect_matched, estimate - effect_matched], dim=-2), dim=-1
    )
    prediction_error, matched, unmatched = norms.masked_fill(non_finite, 0.0).split(1, dim=-1)
    return L1Diagnostics(
        switch=torch.zeros_like(non_finite) if switch is None else switch,
        affinization_error=(
            torch.zeros_like(prediction_error) if affinization_error is None else affinization_error
        ),
        prediction_error=prediction_error,
        matched=matched / config.dt,
        unmatched=unmatched / config.dt,
        u_a=torch.linalg.vector_norm(q, dim=-1, keepdim=True),
        saturation=(cut & ~non_finite).to(q.dtype).mean(-1, keepdim=True),
        ill_conditioned=ill_conditioned,
        non_finite=non_finite,
        **_significance(posterior, prediction_error),
    )


def _significance(posterior: Posterior | None, like: Tensor) -> dict[str, Tensor]:
    if posterior is None:
        zero = torch.zeros_like(like)
        return {"posterior_deviation": zero, "significance": zero}
    deviation, significance = kalman.summary(posterior)
    return {"posterior_deviation": deviation, "significance": significance}


def _check_shapes(
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
    change: Tensor,
    change_name: str,
    jacobian: Tensor,
    restart: Tensor | None,
) -> None:
    n, m = state.x_hat.shape, state.q.shape
    for name, value, expected in (
        ("observation", observation, n),
        ("u_rl", u_rl, m),
        (change_name, change, n),
        ("jacobian", jacobian, (*n, m[-1])),
        ("restart", restart, state.started.shape),
    ):
        # Broadcasting would hide some of these.
        if value is not None and value.shape != expected:
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}, expected {tuple(expected)} as the state"
            )


def _like(tensor: Tensor, value: Scalars) -> Tensor | float:
    # Numbers stay numbers: they need no device and cost no kernel.
    if isinstance(value, tuple):
        return torch.tensor(value, dtype=tensor.dtype, device=tensor.device)
    return value
