from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_l1.dynamics import DataBox, Normalizer


@given(
    offset=st.floats(-1e5, 1e5),
    scale=st.floats(1e-2, 1e3),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=20, deadline=None)
def test_statistics_agree_with_numpy_in_double_precision(
    offset: float, scale: float, seed: int
) -> None:
    data = np.random.default_rng(seed).normal(offset, scale, (500, 3)).astype(np.float32)
    normalizer = Normalizer(3, std_floor=1e-6)
    normalizer.fit(torch.from_numpy(data))
    expected_mean, expected_std = data.astype(np.float64).mean(0), data.astype(np.float64).std(0)
    np.testing.assert_allclose(normalizer.mean.numpy(), expected_mean, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(normalizer.std.numpy(), expected_std, rtol=1e-5, atol=1e-6)


def test_constant_column_gets_the_floor_and_round_trips() -> None:
    data = torch.randn(100, 2)
    data[:, 1] = 7.0
    normalizer = Normalizer(2, std_floor=1e-3)
    normalizer.fit(data)
    assert normalizer.std[1] == pytest.approx(1e-3)
    torch.testing.assert_close(normalizer.denormalize(normalizer.normalize(data)), data)


def test_bad_data_are_named() -> None:
    normalizer = Normalizer(2)
    with pytest.raises(ValueError, match="2 columns, the data 3"):
        normalizer.fit(torch.zeros(4, 3))
    with pytest.raises(ValueError, match="no data"):
        normalizer.fit(torch.zeros(0, 2))
    with pytest.raises(ValueError, match=r"columns \[1\]"):
        normalizer.fit(torch.tensor([[0.0, float("nan")]]))
    for floor in (0.0, float("nan")):
        with pytest.raises(ValueError, match="std_floor"):
            Normalizer(2, std_floor=floor)
    with pytest.raises(ValueError, match="margin must be finite and not negative, got nan"):
        DataBox(2, float("nan"))


def test_box_widens_the_data_range_and_rejects_nan() -> None:
    box = DataBox(1, margin=0.5)
    assert box.contains(torch.tensor([1e9]))
    box.fit(torch.tensor([[0.0], [2.0]]))
    inside = box.contains(torch.tensor([[-1.0], [3.0], [-1.01], [3.01], [float("nan")]]))
    assert inside.tolist() == [True, True, False, False, False]
