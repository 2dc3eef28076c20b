"""Linear value baseline over polynomial features of observation and time."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_l1.checks import check_not_negative


class LinearFeatureBaseline(nn.Module):
    """Value estimate, linear in ``[o, o^2, t/100, (t/100)^2, (t/100)^3, 1]`` (o clipped to +-10).

    Refitted in closed form by ridge regression on each batch (arXiv 1604.06778). The fit is exact
    for these features, has no step size to tune and takes milliseconds. It is preferred here to a
    value network because METRPO refits it twenty times per outer iteration.

    Args:
        observation_dim: number of observations, n.
        ridge: regularisation of the least squares problem.

    Raises:
        ValueError: for a negative ``ridge``; at a fit with ``ridge=0``, if the data do not
            determine the coefficients.
    """

    coefficients: Tensor

    def __init__(self, observation_dim: int, ridge: float = 1e-5) -> None:
        super().__init__()
        check_not_negative("ridge", ridge)
        self.ridge = ridge
        self.register_buffer("coefficients", torch.zeros(2 * observation_dim + 4))

    @staticmethod
    def features(observation: Tensor, step: Tensor) -> Tensor:
        """Features ``(..., 2n + 4)`` of observations ``(..., n)`` at steps ``(..., 1)``."""
        o = observation.clamp(-10, 10)
        t = step.to(o.dtype) / 100
        return torch.cat([o, o.square(), t, t.square(), t**3, torch.ones_like(t)], dim=-1)

    def forward(self, observation: Tensor, step: Tensor) -> Tensor:
        """Values ``(..., 1)``."""
        return self.features(observation, step) @ self.coefficients[:, None]

    @torch.no_grad()
    def fit(self, observation: Tensor, step: Tensor, target: Tensor) -> None:
        """Least squares fit to targets ``(..., 1)``, in float64."""
        features = self.features(observation, step).flatten(0, -2).double()
        gram = features.T @ features
        gram.diagonal().add_(self.ridge)
        moment = features.T @ target.reshape(-1, 1).double()
        try:
            solution = torch.linalg.solve(gram, moment)
        except torch.linalg.LinAlgError as error:
            raise ValueError(
                f"the data do not determine the baseline with ridge={self.ridge}: give a larger one"
            ) from error
        self.coefficients.copy_(solution.squeeze(-1))
