"""The matched disturbance as the state of a Kalman filter, and where to act on it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

TRUST = 10.0
"""Gain and promise of forecasts before any: so many squares of one standard deviation."""


class Posterior(NamedTuple):
    """What is known of the matched disturbance.

    Attributes:
        mean: ``(..., m)``, action units.
        covariance: ``(..., m, m)``, action units squared.
    """

    mean: Tensor
    covariance: Tensor


def time_update(covariance: Tensor, process_noise: Tensor | float) -> Tensor:
    """Covariance after one step of a random walk.

    Args:
        covariance: ``(..., m, m)``.
        process_noise: standard deviation of the walk's step, ``(..., m)`` or a number.

    Returns:
        ``(..., m, m)``.
    """
    variance = torch.as_tensor(process_noise, dtype=covariance.dtype, device=covariance.device)
    variance = variance.square().expand(covariance.shape[:-1])
    return covariance + torch.diag_embed(variance)


def factor(covariance: Tensor, units: Tensor | None = None) -> Tensor:
    r"""Cholesky factor :math:`L` of a covariance ``(..., m, m)``.

    Args:
        covariance: positive definite up to rounding.
        units: the unit of each entry ``(m,)``, where their sizes differ: the small entries would
            otherwise lose their digits beside the large ones.
    """
    if units is None:
        return torch.linalg.cholesky_ex(_bolstered(covariance))[0]
    relative = covariance / (units.unsqueeze(-1) * units)
    return units.unsqueeze(-1) * torch.linalg.cholesky_ex(_bolstered(relative))[0]


def measurement_update(
    prior: Posterior, jacobian: Tensor, innovation: Tensor, root: Tensor | None = None
) -> Posterior:
    r"""Condition the disturbance on ``innovation = jacobian (d - mean) + white noise``.

    With :math:`P = L L^\top`, white measurements of unit variance and :math:`M = I + (J L)^\top J L
    = C C^\top`, the posterior covariance is :math:`(C^{-1} L^\top)^\top C^{-1} L^\top`. It is
    positive semi-definite whatever the rounding and needs no inverse of the observation's size.

    Args:
        prior: mean and positive definite covariance.
        jacobian: whitened input matrix ``(..., n, m)``.
        innovation: whitened residual minus what the prior expects ``(..., n)``.
        root: :func:`factor` of the prior's covariance, if known.

    Returns:
        the posterior.

    Examples:
        >>> prior = Posterior(torch.zeros(1), torch.eye(1))
        >>> measurement_update(prior, torch.ones(1, 1), torch.ones(1))
        Posterior(mean=tensor([0.5000]), covariance=tensor([[0.5000]]))
    """
    root = factor(prior.covariance) if root is None else root
    seen = jacobian @ root
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
    inner = torch.linalg.cholesky_ex(eye + seen.mT @ seen)[0]
    half = torch.linalg.solve_triangular(inner, root.mT, upper=False)
    covariance = half.mT @ half
    score = jacobian.mT @ innovation.unsqueeze(-1)
    return Posterior(prior.mean + (covariance @ score).squeeze(-1), covariance)


def _bolstered(covariance: Tensor) -> Tensor:
    # Beside directions that were never seen, well observed ones may make variances whose ratio is
    # beyond the type's digits.
    least = 8 * torch.finfo(covariance.dtype).eps
    trace = covariance.diagonal(dim1=-2, dim2=-1).mean(-1)
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    return covariance + (least * trace)[..., None, None] * eye


def noise_ratio(
    covariance: Tensor,
    jacobian: Tensor,
    posterior: Posterior,
    left: Tensor,
    unknown: Tensor | None = None,
) -> Tensor:
    r"""Ratio of one residual's squares to those expected, state by state: ``(..., n)``.

    :math:`((r - J d)_i^2 + (J P J^\top)_{ii}) / \Lambda_{ii}` with the posterior mean and
    covariance of the disturbance. This is the E step of expectation maximisation: what the
    disturbance explains is not noise, and the part of it that remains unknown counts as expected.
    The share that effects of another kind explain is removed likewise.

    Args:
        covariance: expected covariance of the residual :math:`\Lambda` ``(..., n, n)``.
        jacobian: ``(..., n, m)``.
        posterior: posterior of the disturbance, this residual included.
        left: the part of the residual it leaves unexplained, :math:`r - J d` ``(..., n)``.
        unknown: a factor of the covariance of other effects ``(..., n, k)``.

    Returns:
        the ratios ``(..., n)``; their mean is one if the expectation is right.
    """
    unseen = ((jacobian @ posterior.covariance) * jacobian).sum(-1)
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    square = left.square() + unseen
    if unknown is None:
        return square / variance
    others = unknown.square().sum(-1)
    share = variance / (variance + others)
    return share * share * square / variance + (1 - share)


def doubt(jacobian: Tensor, innovation: Tensor, change: Tensor) -> Tensor:
    r"""Factor on the covariance of one residual that is larger than expected: ``(..., 1)``.

    The mean square of what an update leaves unexplained, in white coordinates, but at least one:
    the weight of an observation with heavy-tailed noise, from one step of iteratively reweighted
    least squares. Without it, contacts that the model misses, and the first steps of a sensor that
    is worse than expected, would confidently be taken for a disturbance.

    Args:
        jacobian: whitened input matrix ``(..., n, m)``.
        innovation: whitened innovation ``(..., n)``.
        change: change of the disturbance's mean by the update ``(..., m)``.
    """
    left = innovation - (jacobian @ change.unsqueeze(-1)).squeeze(-1)
    return left.square().mean(-1, keepdim=True).clamp_min(1.0)


def significant(posterior: Posterior, dead_zone: float) -> Tensor:
    r"""The part of the disturbance that is acted on, entry by entry: ``(..., m)``.

    :math:`d \max(0, 1 - (z s / |d|)^2)` with :math:`s` the posterior standard deviation: zero
    within ``dead_zone`` standard deviations, nearly all of it far beyond.

    Args:
        posterior: posterior of the disturbance.
        dead_zone: :math:`z`; zero acts on the whole mean.

    Examples:
        >>> posterior = Posterior(torch.tensor([0.1, 1.0]), 0.01 * torch.eye(2))
        >>> significant(posterior, 2.0)
        tensor([0.0000, 0.9600])
    """
    variance = posterior.covariance.diagonal(dim1=-2, dim2=-1)
    square = posterior.mean.square().clamp_min(torch.finfo(variance.dtype).tiny)
    return posterior.mean * (1 - dead_zone**2 * variance / square).clamp_min(0)


def record_forecast(
    sums: Tensor, forecast: Tensor, innovation: Tensor, forgetting: float
) -> Tensor:
    r"""Sums over past steps of what forecasts of the residual have gained and promised.

    A forecast :math:`f` of a residual :math:`r` takes :math:`|r|^2 - |r - f|^2` off its square.
    Where it is right but for noise that is :math:`|f|^2` in the mean.

    Args:
        sums: of the gains and of the promises before ``(..., 2)``.
        forecast: whitened effect of the disturbance that was acted on ``(..., n)``.
        innovation: whitened :math:`r - f` ``(..., n)``.
        forgetting: factor on the sums before.

    Returns:
        the sums with this step ``(..., 2)``.
    """
    gained = (forecast * (2 * innovation + forecast)).sum(-1)
    promised = forecast.square().sum(-1)
    return forgetting * sums + torch.stack([gained, promised], -1)


def skill(sums: Tensor) -> Tensor:
    """Share of what forecasts promised that they have gained, from 0 to 1: ``(..., 1)``.

    An estimate that comes too late for what it follows, as of a delay, forecasts no better than
    nothing does. Without a record it is trusted: :data:`TRUST` counts as gained and promised.

    Args:
        sums: of :func:`record_forecast`.

    Examples:
        >>> skill(torch.tensor([0.0, 0.0])), skill(torch.tensor([-5.0, 100.0]))
        (tensor([1.]), tensor([0.0455]))
    """
    gained, promised = (sums + TRUST).split(1, -1)
    return (gained / promised).clamp(0.0, 1.0)


def summary(posterior: Posterior) -> tuple[Tensor, Tensor]:
    """Norm of the standard deviations and the mean's largest entry in them, ``(..., 1)`` each."""
    deviation = posterior.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    limits = torch.finfo(deviation.dtype)
    relative = (posterior.mean.abs() / deviation.clamp_min(limits.tiny)).clamp_max(limits.max)
    norm = torch.linalg.vector_norm(deviation, dim=-1, keepdim=True)
    return norm, relative.amax(-1, keepdim=True)
