"""What L1 remembers from step to step, what it reports, and what it knows of the residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_l1.control.config import L1Config


class L1State(NamedTuple):
    """What the controller remembers from one step to the next.

    Attributes:
        x_hat: predicted observation ``(..., n)``.
        u_bar: operating point of the affine model ``(..., m)``.
        q: filter state ``(..., m)``; the adaptive input is ``-q``.
        sigma_m: matched uncertainty estimated at the last step ``(..., m)``, action units,
            projected if the configuration asks for it.
        n_switch: switches since the reset ``(..., 1)``, int64.
        started: whether the other entries are valid ``(..., 1)``, bool.
        covariance: covariance of the Kalman filter's estimate, which ``sigma_m`` then holds,
            ``(..., m * m)``; like the following entries ``None`` for the low-pass filter.
        noise: running estimate of the squares of the residuals, relative to their covariance
            ``(..., n)``.
        jacobian: Jacobian of the last step ``(..., n * m)``.
        residual_covariance: covariance expected at the last step ``(..., n * n)``; ``None`` if it
            is the same everywhere.
        skill: what past forecasts of the disturbance have gained and promised ``(..., 2)``;
            ``None`` if the settings do not ask for it.
    """

    x_hat: Tensor
    u_bar: Tensor
    q: Tensor
    sigma_m: Tensor
    n_switch: Tensor
    started: Tensor
    covariance: Tensor | None = None
    noise: Tensor | None = None
    jacobian: Tensor | None = None
    residual_covariance: Tensor | None = None
    skill: Tensor | None = None

    def entries(self) -> dict[str, Tensor]:
        """The entries that are not ``None``, by name."""
        return {name: value for name, value in self._asdict().items() if value is not None}

    def memory(self) -> list[Tensor]:
        """The entries that only some laws have."""
        return [value for value in self[COMMON:] if value is not None]


COMMON = len(L1State._fields) - len(L1State._field_defaults)
"""Number of entries that all laws have; they come first."""


class ResidualStatistics(NamedTuple):
    """What is known of a model's one-step residuals without disturbances.

    Attributes:
        covariance: ``(n, n)``, or one for each row ``(..., n, n)``; state units squared.
        inflation: factor on it that makes the Kalman filter's posterior honest.
        process_noise: standard deviation of a matched disturbance's change per step, as a
            fraction of half the range of the action.
    """

    covariance: Tensor
    inflation: Tensor | float = 1.0
    process_noise: Tensor | float = 0.01


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
        posterior_deviation: norm of the standard deviations of the Kalman filter's estimate, action
            units; zero without that filter, like the next.
        significance: largest entry of its estimate in standard deviations.
        forecast_skill: share of its estimate that is acted on, see
            :func:`~torchrl_l1.control.kalman.skill`; one without a record of forecasts.
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
    posterior_deviation: Tensor
    significance: Tensor
    forecast_skill: Tensor


def init(
    batch_size: Sequence[int],
    observation_dim: int,
    action_dim: int,
    config: L1Config | None = None,
    *,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> L1State:
    """State before the first step: zeros, not started.

    Args:
        batch_size: leading dimensions.
        observation_dim: n.
        action_dim: m.
        config: the settings, which decide what there is to remember; the paper's if ``None``.
        dtype: type of ``x_hat`` and ``u_bar``, which the model meets, and of all other numbers
            unless it is of half precision: these are then float32, since what accumulates over
            many steps, each of which changes it little, would stall.
        device: device of all entries.

    Examples:
        >>> init([5], observation_dim=4, action_dim=1).x_hat.shape
        torch.Size([5, 4])
    """

    def zeros(width: int, dtype: torch.dtype) -> Tensor:
        return torch.zeros(*batch_size, width, dtype=dtype, device=device)

    dtype = torch.get_default_dtype() if dtype is None else dtype
    precise = torch.promote_types(dtype, torch.float32)
    memory: dict[str, Tensor] = {}
    if config is not None and config.filter == "kalman":
        memory["covariance"] = zeros(action_dim**2, precise)
        memory["noise"] = zeros(observation_dim, precise)
        memory["jacobian"] = zeros(observation_dim * action_dim, precise)
        if config.covariance != "residuals":
            memory["residual_covariance"] = zeros(observation_dim**2, precise)
        if config.skill_forgetting < 1:
            memory["skill"] = zeros(2, precise)
    return L1State(
        x_hat=zeros(observation_dim, dtype),
        u_bar=zeros(action_dim, dtype),
        q=zeros(action_dim, precise),
        sigma_m=zeros(action_dim, precise),
        n_switch=zeros(1, torch.int64),
        started=zeros(1, torch.bool),
        **memory,
    )


def state_names(config: L1Config) -> tuple[str, ...]:
    """Names of what a controller with these settings remembers.

    Examples:
        >>> state_names(L1Config(0.05))
        ('x_hat', 'u_bar', 'q', 'sigma_m', 'n_switch', 'started')
    """
    return tuple(init([], 1, 1, config).entries())
