"""The L1 adaptive law as pure functions: predictor, adaptation by least squares, filter."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_l1.control.config import L1Config
from torchrl_l1.control.kalman_law import estimate, follow
from torchrl_l1.control.least_squares import any_of, solve_matched, whitened, without_effect
from torchrl_l1.control.signals import (
    ControlInput,
    Terms,
    credible,
    diagnose,
    like,
    narrow,
    narrow_state,
    project,
    saturate,
    wide,
    wide_state,
)
from torchrl_l1.control.state import L1Diagnostics, L1State, ResidualStatistics

_ABSURD = 1e6
"""A matched estimate this many times half the range of the actions counts as none."""


def filtered(config: L1Config, q: Tensor, sigma_m: Tensor) -> Tensor:
    r"""Next state of the low-pass filter, :math:`q + \alpha (\sigma_m - q)`.

    This is arXiv 2403.14860, control law of section 3.2, with :math:`K = \omega I`.
    """
    return torch.lerp(q, sigma_m, config.filter_gain)


def control_input(
    config: L1Config, state: L1State, u_rl: Tensor, fresh: Tensor, sigma_m: Tensor | None = None
) -> ControlInput:
    """The control law of arXiv 2403.14860, section 3.2.

    Args:
        config: the settings.
        state: from the previous step.
        u_rl: the policy's action within its bounds ``(..., m)``.
        fresh: where the filter starts ``(..., 1)``, bool.
        sigma_m: this step's estimate, for a filter that takes that in.
    """
    if sigma_m is None:
        q = filtered(config, state.q, state.sigma_m).masked_fill(fresh, 0.0)
    else:
        q = filtered(config, state.q.masked_fill(fresh, 0.0), sigma_m)
    return ControlInput.of(config, u_rl, q)


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
        q &\leftarrow q + \alpha (\sigma_{m, t-1} - q) \\
        u &= \mathrm{clip}(u_{RL} - q) \\
        \hat x &\leftarrow \hat x + d_t + J u + T (\hat\sigma + A_s \tilde x)

    An episode begins with :math:`\hat x = x` and :math:`q = \sigma_m = 0`. The filter takes in the
    matched part of the previous step or, with ``filter_input="current"``, of this one. The estimate
    :math:`\hat\sigma` is in state units per second and the matched part :math:`\sigma_m` in action
    units. The residual of the least squares is unmatched: it enters the prediction, and no action
    cancels it. The predictor sees the saturated input. Before the filter takes :math:`\sigma_m` in,
    it is projected, see :func:`project`.

    The function is pure, batched over leading dimensions and free of data-dependent branches. If
    any input of an environment is not finite, or its prediction error exceeds
    :attr:`L1Config.max_error`, the output is ``u_rl``, ``non_finite`` is set and that environment
    restarts at its next step; the others are unaffected. A column of the Jacobian without a visible
    effect takes no part in the least squares, see
    :func:`~torchrl_l1.control.least_squares.without_effect`. Half-precision inputs are computed in
    single precision.

    With ``filter="kalman"`` the step consists of :func:`~.kalman_law.estimate` and
    :func:`~.kalman_law.follow` instead.

    Args:
        config: the settings; switching fields other than the filter's are not used here.
        state: from :func:`init` or the previous step.
        observation: ``(..., n)``, raw units.
        u_rl: the policy's action ``(..., m)``; it is clipped to the bounds first.
        drift: ``(..., n)``, state units per step.
        jacobian: ``(..., n, m)``, state units per step and action unit.
        restart: ``(..., 1)`` bool, true where predictor and filter restart before this step.
        residuals: what is known of the residuals; white ones of unit variance if ``None``.

    Returns:
        the executed input ``(..., m)``, the next state and the diagnostics (the two of the
        switching law, which this function does not evaluate, hold ``restart`` and zeros).

    Raises:
        ValueError: if a setting or a shape does not match the state's.

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
    config.check_dimensions(state.x_hat.shape[-1], state.q.shape[-1])
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
    control: ControlInput | None = None,
    believed: Tensor | None = None,
) -> tuple[Tensor, L1State, Terms]:
    """:func:`step` without diagnostics, on ``x' = x + change + jacobian (u - u_bar)``.

    Args:
        config: the settings.
        state: as in :func:`step`.
        observation: as in :func:`step`.
        u_rl: the policy's action within its bounds ``(..., m)``.
        change: predicted change at ``u_bar`` ``(..., n)``, state units per step.
        jacobian: as in :func:`step`.
        u_bar: operating point ``(..., m)``; zero if ``None``.
        restart: as in :func:`step`.
        residuals: as in :func:`step`.
        control: the input, if it is already known since it does not depend on this step's estimate.
        believed: ``(..., 1)`` bool, false where the model is not finite at another input.

    Returns:
        the executed input, the next state (except for what a switch changes) and what
        :func:`diagnose` needs.
    """
    _check_shapes(state, observation, u_rl, change, "change", jacobian, restart)
    dtype, policy = state.x_hat.dtype, u_rl
    state = wide_state(state)
    observation, u_rl, change, jacobian = map(wide, (observation, u_rl, change, jacobian))
    fresh = ~state.started if restart is None else ~state.started | restart
    x_hat = torch.where(fresh, observation, state.x_hat)

    # State prediction error, estimate and its matched part. Everything here is in state units per
    # step: the estimate is T sigma_hat, so that no division by a small T enters the state.
    x_err = x_hat - observation
    estimate = x_err * -like(x_err, config.adaptation_gain)
    reach = like(x_err, config.half_range)
    invisible = without_effect(jacobian, torch.maximum(observation.abs(), x_hat.abs()), reach)
    columns, residual = jacobian, estimate
    if config.estimator == "weighted" and residuals is not None:
        covariance = wide(residuals.covariance)
        columns, white = whitened(covariance, jacobian, estimate.unsqueeze(-1))
        residual = white.squeeze(-1)
    matched, ill_conditioned = solve_matched(columns, residual, invisible)
    if config.matched_bound is not None:
        # An effect that would take a million times the actions' range is not matched.
        absurd = any_of(matched.abs() > _ABSURD * reach)
        matched = matched.masked_fill(absurd, 0.0)
        ill_conditioned = ill_conditioned | absurd
    sigma_m = project(config, matched)

    if control is None:
        current = sigma_m if config.filter_input == "current" else None
        control = control_input(config, state, u_rl, fresh, current)
    u = control.u

    # State predictor.
    step_u = u if u_bar is None else u - wide(u_bar)
    effect_u, effect_matched = _effects(jacobian, step_u, matched)
    x_hat = x_hat + change + effect_u - x_err * like(x_err, config.predictor_gain)

    finite = credible(config, dtype, x_err, observation, x_hat)
    finite = finite if believed is None else finite & believed
    non_finite = ~finite
    # The least squares gives finite numbers for any input, so q and sigma_m need no check.
    following = L1State(
        x_hat=x_hat.masked_fill(non_finite, 0.0),
        u_bar=state.u_bar,
        q=control.q,
        sigma_m=sigma_m,
        n_switch=state.n_switch,
        started=finite,
    )
    terms = Terms(x_err, estimate, effect_matched, control, ill_conditioned, non_finite, dtype)
    u = torch.where(finite, narrow(u, policy.dtype), policy)
    return u, narrow_state(following, dtype), terms


def _effects(jacobian: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
    """The effect of inputs ``(..., m)`` on the state: ``(..., n)`` each."""
    if jacobian.shape[-1] == 1:  # the same, without a matrix product
        column = jacobian.squeeze(-1)
        return tuple(column * each for each in inputs)
    return (jacobian @ torch.stack(inputs, dim=-1)).unbind(-1)


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
        # Broadcasting would hide some of these errors.
        if value is not None and value.shape != expected:
            raise ValueError(
                f"{name} has shape {tuple(value.shape)}, expected {tuple(expected)} as the state"
            )
