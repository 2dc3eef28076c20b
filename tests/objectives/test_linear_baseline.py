from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_l1.objectives import LinearFeatureBaseline


def test_recovers_a_value_that_is_linear_in_its_features() -> None:
    torch.manual_seed(0)
    observation, step = torch.randn(20, 30, 3), torch.arange(30)[None, :, None].expand(20, -1, 1)
    value = 2 * observation[..., :1] - observation[..., 2:].square() + 0.03 * step + 1
    baseline = LinearFeatureBaseline(3)
    baseline.fit(observation, step, value)
    torch.testing.assert_close(baseline(observation, step), value, rtol=1e-3, atol=1e-3)


def test_agrees_with_numpy_ridge_regression() -> None:
    rng = np.random.default_rng(0)
    observation = rng.normal(size=(200, 2))
    step = rng.integers(0, 100, (200, 1))
    target = rng.normal(size=(200, 1))
    baseline = LinearFeatureBaseline(2, ridge=0.5).double()
    baseline.fit(torch.tensor(observation), torch.tensor(step), torch.tensor(target))
    o, t = np.clip(observation, -10, 10), step / 100
    features = np.hstack([o, o**2, t, t**2, t**3, np.ones_like(t)])
    gram = features.T @ features + 0.5 * np.eye(features.shape[1])
    expected = np.linalg.solve(gram, features.T @ target)[:, 0]
    np.testing.assert_allclose(baseline.coefficients.numpy(), expected, rtol=1e-8)


def test_a_ridge_with_which_nothing_can_be_fitted_is_named() -> None:
    for ridge in (-1.0, float("nan")):
        with pytest.raises(ValueError, match=f"ridge must be finite and not negative, got {ridge}"):
            LinearFeatureBaseline(2, ridge=ridge)
    baseline = LinearFeatureBaseline(2, ridge=0.0)
    with pytest.raises(ValueError, match=r"with ridge=0\.0: give a larger one"):
        baseline.fit(torch.ones(10, 2), torch.arange(10)[:, None], torch.ones(10, 1))
