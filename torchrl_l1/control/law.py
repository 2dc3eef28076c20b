"""The L1 adaptive law as pure functions: predictor, adaptation by least squares, filter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_l1.control.config import L1Config, Scalars


class L1State(NamedTuple):
    """What the controller remembers from one step to the next.

    Attributes:
        x_hat: predicted observation ``(..., n)``.
        u_bar: operating point of the affine model ``(..., m)``.
        q: filter state ``(..., m)``; the adaptive input is ``-q``.
        sigma_m: matched uncertainty estimated at the last step ``(..., m)``, action units,
            projected if the configuration asks for it.
        n_switch: switches since the reset ``(..., 1)``, int64.
        started: whether the other entries mean anything ``(..., 1)``, bool.
    """

    x_hat: Tensor
    u_bar: Tensor
    q: Tensor
    sigma_m: Tensor
    n_switch: Tensor
    started: Tensor


class L1Diagnostics(NamedTuple):
    """Signals of one step, each ``(..., 1)``; norms are Euclidean.

    Attributes:
        switch: the operating point moved (bool).
        affinization_error: error of the affine model at the tested input, state units.
        prediction_error: norm of the state prediction error, state units.
        matched: norm of the matched part of the uncertainty estimate, state units per second.
        unmatched: norm of the part that no action can cancel, state units per second.
        u_a: norm of the adaptive input before saturation, action units.
        saturation: fraction of the action's entries that a bound cut.
        ill_conditioned: the matched part came from damped least squares (bool).
        non_finite: an input was not finite: L1 stood aside and restarts (bool).
    """

    switch: Tensor
    affinization_error: Tensor
    prediction_error: Tensor
    matched: Tensor
    unmatched: Tensor
    u_a: Tensor
    saturation: Tensor
    ill_conditioned: Tensor
    non_finite: Tensor


def init(
    batch_size: Sequence[int],
    observation_dim: int,
    action_dim: int,
    *,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> L1State:
    """State before the first step: zeros, not started.

    Examples:
        >>> init([5], observation_dim=4, action_dim=1).x_hat.shape
        torch.Size([5, 4])
    """

    def zeros(width: int, dtype: torch.dtype | None) -> Tensor:
        return torch.zeros(*batch_size, width, dtype=dtype, device=device)

    return L1State(
        x_hat=zeros(observation_dim, dtype),
        u_bar=zeros(action_dim, dtype),
        q=zeros(action_dim, dtype),
        sigma_m=zeros(action_dim, dtype),
        n_switch=zeros(1, torch.int64),
        started=zeros(1, torch.bool),
    )


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

    Args:
        config: the settings; switching fields other than the filter's are not used here.
        state: from :func:`init` or the previous step.
        observation: ``(..., n)``, raw units.
        u_rl: the policy's action ``(..., m)``; clipped to the bounds first.
        drift: ``(..., n)``, state units per step.
        jacobian: ``(..., n, m)``, state units per step and action unit.
        restart: ``(..., 1)`` bool, where predictor and filter start afresh before this step.

    Returns:
        the executed input ``(..., m)``, the next state and the diagnostics (the two of the
        switching law, which this function does not evaluate, hold ``restart`` and zeros).

    Raises:
        ValueError: if a shape does not fit the state's.

    Examples:
        >>> config = L1Config(0.04, action_low=-1.0, action_high=1.0)
        >>> state = init([2], observation_dim=3, action_dim=1)
        >>> x, drift, u_rl = torch.zeros(2, 3), torch.zeros(2, 3), torch.full((2, 1), 0.5)
        >>> u, state, diagnostics = step(config, state, x, u_rl, drift, torch.ones(2, 3, 1))
        >>> u.squeeze(-1)
        tensor([0.5000, 0.5000])
        >>> state.x_hat[0]
        tensor([0.5000, 0.5000, 0.5000])
    """
    u, following, terms = respond(
        config, state, observation, saturate(config, u_rl), drift, jacobian, restart=restart
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
        ill_conditioned: see :func:`solve_matched`.
        non_finite: an input was not finite ``(..., 1)``, bool.
    """

    x_err: Tensor
    estimate: Tensor
    effect_matched: Tensor
    q: Tensor
    cut: Tensor
    ill_conditioned: Tensor
    non_finite: Tensor


def respond(
    config: L1Config,
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
    change: Tensor,
    jacobian: Tensor,
    u_bar: Tensor | None = None,
    restart: Tensor | None = None,
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

    Returns:
        the executed input, the next state (but for what a switch changes) and what
        :func:`diagnose` needs.
    """
    # The change at zero is the drift of :func:`step`.
    name = "drift" if u_bar is None else "change"
    _check_shapes(state, observation, u_rl, change, name, jacobian, restart)
    fresh = ~state.started if restart is None else ~state.started | restart
    x_hat = torch.where(fresh, observation, state.x_hat)

    # State prediction error, estimate and its matched part. Everything is in state units per
    # step here: this is T sigma_hat, so that no division by a small T enters the state.
    x_err = x_hat - observation
    estimate = x_err * -_like(x_err, config.adaptation_gain)
    matched, ill_conditioned = solve_matched(jacobian, estimate)
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

    finite = _is_finite(x_hat)
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


def _is_finite(vector: Tensor) -> Tensor:
    """Whether a vector's sum is finite: ``(..., d)`` to ``(..., 1)``, in half of the kernels."""
    total = vector.sum(-1, keepdim=True)
    return total - total == 0


def diagnose(
    config: L1Config,
    terms: Terms,
    switch: Tensor | None = None,
    affinization_error: Tensor | None = None,
) -> L1Diagnostics:
    """The diagnostics of a step, with those of the switching law if they are given."""
    x_err, estimate, effect_matched, q, cut, ill_conditioned, non_finite = terms
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
    )


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


RANK_TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}
"""Smallest squared pivot of the scaled normal equations that counts as full rank, by dtype.

A squared pivot is one minus the squared multiple correlation of a column with those before it,
so columns within about 0.2 degrees (float32) or 0.0006 degrees (float64) of dependence, and no
others, are flagged.
"""

DAMPING = 1e-3
"""Levenberg damping of flagged systems, relative to columns of unit length.

It bounds the gain along a nearly dependent direction to 16 per unit column and biases the
remaining directions by about 0.1 percent.
"""

_SMALLEST_RELATIVE_COLUMN = 1e-3
"""Columns are scaled to unit length, but by no more than this times the longest column.

Undamped least squares does not depend on the scaling. Shorter columns lose pivot, so that an
action without effect is flagged instead of being given an enormous estimate.
"""


def solve_matched(jacobian: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    r"""Least-squares solution of ``jacobian @ x = residual``, damped where that is ill posed.

    Column-equilibrated normal equations by Cholesky decomposition: for tall, thin Jacobians
    this is the cheapest batched solver, raises nothing and compiles. One action has a closed
    form.

    Args:
        jacobian: ``(..., n, m)``.
        residual: ``(..., n)``.

    Returns:
        the solution ``(..., m)``, always finite, and flags ``(..., 1)``, true where the
        Jacobian is rank deficient, ill conditioned (see :data:`RANK_TOLERANCE`) or not finite.
        A Jacobian or residual that is not finite gives zeros.

    Examples:
        >>> jacobian = torch.tensor([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]])
        >>> solution, flagged = solve_matched(jacobian, torch.tensor([3.0, 4.0, 5.0]))
        >>> solution, flagged
        (tensor([3., 2.]), tensor([False]))
    """
    if jacobian.shape[-1] == 1:
        solution, ill_conditioned = _solve_one_column(jacobian, residual)
        return torch.where(solution.isfinite(), solution, 0.0), ill_conditioned
    solution, ill_conditioned = _solve_columns(jacobian, residual)
    return solution.masked_fill(~_is_finite(solution), 0.0), ill_conditioned


def _solve_one_column(jacobian: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    column = jacobian.squeeze(-1)
    square = column.square().sum(-1, keepdim=True)
    # A comparison with what is not a number is false.
    usable = (square > torch.finfo(square.dtype).tiny) & (square < torch.inf)
    projection = (column * residual).sum(-1, keepdim=True)
    return projection / torch.where(usable, square, torch.inf), ~usable


def _solve_columns(jacobian: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    dtype = jacobian.dtype
    length = torch.linalg.vector_norm(jacobian, dim=-2)
    floor = length.amax(-1, keepdim=True) * _SMALLEST_RELATIVE_COLUMN
    scale = torch.maximum(length, floor.clamp_min_(_smallest_length(dtype)))
    columns = jacobian / scale.unsqueeze(-2)
    products = columns.mT @ torch.cat([columns, residual.unsqueeze(-1)], -1)
    gram, projected = products[..., :-1], products[..., -1:]
    eye = torch.eye(gram.shape[-1], dtype=dtype, device=gram.device)
    # Both systems in one call: choosing between them by a branch would not batch.
    factor, info = torch.linalg.cholesky_ex(torch.stack([gram, gram.add(eye, alpha=DAMPING)]))
    projected = projected.expand(2, *scale.shape, 1)
    plain, damped = torch.cholesky_solve(projected, factor).squeeze(-1).unbind(0)
    pivots = factor[0].diagonal(dim1=-2, dim2=-1).amin(-1, keepdim=True)
    tolerance = RANK_TOLERANCE.get(dtype, RANK_TOLERANCE[torch.float32])
    # Written so that a pivot that is not a number, as of an infinite column, is flagged.
    well_conditioned = (pivots > tolerance**0.5) & (info[0].unsqueeze(-1) == 0)
    return torch.where(well_conditioned, plain, damped) / scale, ~well_conditioned


def _smallest_length(dtype: torch.dtype) -> float:
    # Its square must not underflow.
    return float(torch.finfo(dtype).tiny) ** 0.5
