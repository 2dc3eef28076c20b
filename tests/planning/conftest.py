"""Linear-Gaussian ensembles, whose returns have moments in closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from torchrl_l1.dynamics import EnsembleDynamics, GaussianHead


def _linear(a, b, c=None, std=None) -> EnsembleDynamics:
    """Members ``x' = x + a_j x + b_j u + c_j + std_j noise`` behind arbitrary normalisers.

    ``a`` is ``(E, n, n)``, ``b`` ``(E, n, m)``, ``c`` and ``std`` ``(E, n)``.
    """
    a, b = (torch.as_tensor(np.asarray(part, dtype=np.float64)) for part in (a, b))
    members, n, m = b.shape
    c = torch.zeros(members, n) if c is None else torch.as_tensor(c)
    # Bounds so wide that they leave the log-variance what it is.
    head = None if std is None else GaussianHead(n, -50.0, 50.0)
    model = EnsembleDynamics(n, m, hidden=(), members=members, head=head)
    generator = torch.Generator().manual_seed(7)
    for normalizer in (
        model.observation_normalizer,
        model.action_normalizer,
        model.change_normalizer,
    ):
        normalizer.mean.copy_(torch.randn(normalizer.mean.shape, generator=generator))
        normalizer.std.copy_(0.5 + torch.rand(normalizer.std.shape, generator=generator))
    x_norm, u_norm, d_norm = (
        (part.mean.double(), part.std.double())
        for part in (
            model.observation_normalizer,
            model.action_normalizer,
            model.change_normalizer,
        )
    )
    slope = torch.cat([a * x_norm[1], b * u_norm[1]], -1) / d_norm[1][:, None]
    offset = (a @ x_norm[0] + b @ u_norm[0] + c.double() - d_norm[0]) / d_norm[1]
    with torch.no_grad():
        model.network.weights[0].zero_()[:, :, :n] = slope.transpose(1, 2).float()
        model.network.biases[0].zero_()[:, 0, :n] = offset.float()
        if std is not None:
            log_variance = 2 * (torch.as_tensor(std).double() / d_norm[1]).log()
            model.network.biases[0][:, 0, n:] = log_variance.float()
    return model


@pytest.fixture(scope="session")
def linear() -> Callable[..., EnsembleDynamics]:
    return _linear
