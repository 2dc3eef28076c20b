"""Covariance of a fitted model's one-step residuals, and what L1 derives from it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_l1.control import Calibration, L1Config, calibrate

SEQUENCES, STEPS = 32, 100
"""The amount of undisturbed data that a calibration replays: number of stretches and of steps."""

_INFLATION, _PROCESS_NOISE = 1.0, 0.01  # for a model that nobody has calibrated


class Residuals(nn.Module):
    """Statistics of a model's one-step residuals on data that it was not trained on.

    Args:
        dim: width of the observation, n.

    Attributes:
        covariance: second moments of the residuals, shrunk, ``(n, n)``, state units squared; the
            identity until they are measured.
        measured: whether the covariance comes from data, ``()``, bool.
        inflation: factor on the covariance that a Kalman filter needs, ``()``; see
            :class:`~torchrl_l1.control.ResidualStatistics`, also for the next.
        process_noise: process noise of a disturbance, ``()``.
        calibrated: whether these two come from data, ``()``, bool.
    """

    covariance: Tensor
    measured: Tensor
    inflation: Tensor
    process_noise: Tensor
    calibrated: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("covariance", torch.eye(dim))
        self.register_buffer("measured", torch.tensor(False))
        self.register_buffer("inflation", torch.tensor(_INFLATION))
        self.register_buffer("process_noise", torch.tensor(_PROCESS_NOISE))
        self.register_buffer("calibrated", torch.tensor(False))

    @torch.no_grad()
    def measure(self, residual: Tensor, change: Tensor | None = None) -> None:
        """Measure the covariance of residuals ``(N, n)`` and store it.

        Args:
            residual: the model's errors.
            change: the changes of state that were to be predicted ``(N, n)``, by which small
                errors are told from small units, see :func:`shrunk_covariance`.

        Raises:
            ValueError: for residuals that are not finite, of the wrong width, or absent.
        """
        n = self.covariance.shape[0]
        if residual.ndim != 2 or residual.shape[0] < 1 or residual.shape[1] != n:
            raise ValueError(
                f"residuals must have shape (N, {n}) with N at least 1, got {tuple(residual.shape)}"
            )
        if not residual.isfinite().all():
            raise ValueError("residuals have entries that are not finite: leave them out first")
        self.covariance.copy_(shrunk_covariance(residual, change))
        self.measured.fill_(True)
        # Any calibration was that of another model.
        self.inflation.fill_(_INFLATION)
        self.process_noise.fill_(_PROCESS_NOISE)
        self.calibrated.fill_(False)

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        # Older checkpoints have none of this.
        fresh = Residuals(self.covariance.shape[0])
        for name, value in fresh.named_buffers():
            state_dict.setdefault(prefix + name, value)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def shrunk_covariance(residual: Tensor, change: Tensor | None = None) -> Tensor:
    r"""Second moments of residuals ``(N, n)``, not centred, with shrunk correlations: ``(n, n)``.

    A constant error of the model is an error too. Correlations are shrunk towards zero with the
    optimal intensity (Schäfer and Strimmer, 2005). No variance is below a millionth of the mean
    square of the state's change or, where that is zero or not given, of the median variance, which
    may be in other units. The result is positive definite.

    Args:
        residual: the model's errors.
        change: the changes of state that were to be predicted ``(N, n)``.

    Examples:
        >>> shrunk_covariance(torch.tensor([[1.0, 0.0], [-1.0, 0.0]]))
        tensor([[1.0000e+00, 0.0000e+00],
                [0.0000e+00, 1.0000e-06]])
    """
    # Sums of squares over many rows lose digits in single precision.
    rows = residual.to(torch.float64)
    count, n = rows.shape
    variance = rows.square().mean(0)
    some = variance[variance > 0]
    least = 1e-6 * some.median() if some.numel() else variance.new_tensor(1e-12)
    if change is not None:
        moved = change.to(torch.float64).square().mean(0)
        least = torch.where(moved > 0, 1e-6 * moved, least)
    deviation = variance.clamp_min(least).sqrt()
    scaled = rows / deviation
    correlation = scaled.T @ scaled / count
    if count > 1:
        # Variance of each correlation, of products of standardised residuals.
        products = (scaled.square().T @ scaled.square()) / count - correlation.square()
        off = ~torch.eye(n, dtype=torch.bool, device=rows.device)
        signal = correlation[off].square().sum()
        noise = products[off].sum() / (count - 1)
        intensity = (noise / signal).clamp(0, 1) if bool(signal > 0) else signal.new_ones(())
    else:
        intensity = rows.new_ones(())
    # Never exactly singular, whatever the data are.
    intensity = intensity.clamp_min(1e-3)
    eye = torch.eye(n, dtype=rows.dtype, device=rows.device)
    correlation = torch.lerp(correlation, eye, intensity)
    correlation.diagonal().fill_(1.0)
    return (correlation * torch.outer(deviation, deviation)).to(residual.dtype)


@torch.no_grad()
def calibrate_filter(
    residuals: Residuals,
    value_and_jacobian: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]],
    data: TensorDictBase,
    config: L1Config,
    action_key: str = "action",
    residual_covariance: Callable[[Tensor, Tensor, str], Tensor] | None = None,
) -> Calibration | None:
    """Find the inflation and process noise that suit a model and the data.

    Args:
        residuals: the model's residual statistics, changed in place; their covariance is measured
            on the same data if no fit has measured it.
        value_and_jacobian: the model's method, see :class:`~torchrl_l1.control.ActionJacobian`.
        data: transitions ``[N]`` in the order in which they were collected, without disturbances
            that the controller is to cancel; the last of them are used.
        config: the controller's settings, with the bounds of the action.
        action_key: key of the action to which the model was fitted.
        residual_covariance: the model's method, needed if the settings take a ``covariance`` other
            than its ``"residuals"``.

    Returns:
        the result of :func:`~torchrl_l1.control.calibrate`; ``None``, without any change, if no
        episode has 20 steps in a row.

    Raises:
        ValueError: without a ``residual_covariance`` if one is needed.
    """
    if config.covariance != "residuals" and residual_covariance is None:
        raise ValueError(
            f"covariance={config.covariance!r} is not that of the measured residuals: give "
            "calibrate_filter residual_covariance=model.residual_covariance"
        )
    rows = stretches(data)
    if rows is None:
        return None
    # Tables are read as float64, models are mostly float32.
    observation, action, following = (
        data[key][rows].to(residuals.covariance)
        for key in ("observation", action_key, ("next", "observation"))
    )
    change, jacobian = value_and_jacobian(observation, action)
    residual = following - observation - change
    parts = (residual, jacobian, action)
    whole = torch.stack([part.isfinite().flatten(1).all(1) for part in parts]).all(0)
    if not whole.any():
        return None
    residual, jacobian, action = residual[whole], jacobian[whole], action[whole]
    if not residuals.measured:
        moved = (following - observation)[whole]
        residuals.measure(residual.flatten(0, 1), moved.flatten(0, 1))
    covariance = residuals.covariance
    if config.covariance != "residuals" and residual_covariance is not None:
        covariance = residual_covariance(observation[whole], action, config.covariance)
    found = calibrate(config, residual, jacobian, covariance, action=action)
    residuals.inflation.fill_(found.inflation)
    residuals.process_noise.fill_(found.process_noise)
    residuals.calibrated.fill_(True)
    return found


def stretches(data: TensorDictBase) -> Tensor | None:
    """Rows of the last unbroken stretches of episodes ``(S, T)``; ``None`` if all are too short.

    A stretch continues while the next observation of one transition is the observation of the
    following one.
    """
    following, observation = data["next", "observation"], data["observation"]
    if data.shape[0] < 2:
        return None
    broken = (following[:-1] != observation[1:]).any(-1).nonzero().flatten() + 1
    edges = torch.cat([broken.new_zeros(1), broken, broken.new_tensor([data.shape[0]])])
    lengths = edges.diff()
    steps = min(STEPS, int(lengths.max()))
    if steps < STEPS // 5:
        return None
    firsts = [
        torch.arange(int(first), int(first + length) - steps + 1, steps)
        for first, length in zip(edges[:-1], lengths, strict=True)
        if length >= steps
    ]
    return torch.cat(firsts)[-SEQUENCES:, None] + torch.arange(steps)
