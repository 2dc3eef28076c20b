from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_l1.dynamics import (
    ControlAffineDynamics,
    EnsembleDynamics,
    make_dynamics,
    matched_hidden,
)


def count(model: EnsembleDynamics) -> int:
    return sum(parameter.numel() for parameter in model.parameters())


@pytest.mark.parametrize("hidden", [[128, 128], [256, 256], [1000] * 4, [64]])
@pytest.mark.parametrize(("n", "m"), [(4, 1), (9, 2), (18, 6)])
def test_affine_model_has_the_size_of_the_nonlinear_one(n: int, m: int, hidden: list[int]) -> None:
    nonlinear = make_dynamics(n, m, "nonlinear", hidden, members=1)
    affine = make_dynamics(n, m, "affine", hidden, members=1)
    assert type(nonlinear) is EnsembleDynamics
    assert type(affine) is ControlAffineDynamics
    assert abs(count(affine) / count(nonlinear) - 1) < 0.02


@given(
    n=st.integers(1, 20),
    m=st.integers(1, 6),
    width=st.integers(1, 60),
    layers=st.integers(1, 3),
)
@settings(max_examples=20, deadline=None)
def test_no_other_width_is_closer(n: int, m: int, width: int, layers: int) -> None:
    target = count(EnsembleDynamics(n, m, members=1, hidden=[width] * layers))
    found = matched_hidden(n, m, [width] * layers)
    assert len(set(found)) == 1

    def difference(candidate: int) -> int:
        model = ControlAffineDynamics(n, m, members=1, hidden=[candidate] * layers)
        return abs(count(model) - target)

    best = min(difference(candidate) for candidate in range(1, 2 * width + 20))
    assert difference(found[0]) == best


def test_unequal_widths_keep_their_proportions() -> None:
    wide, narrow = matched_hidden(18, 6, [400, 100])
    assert wide / narrow == pytest.approx(4, rel=0.05)
    assert matched_hidden(18, 6, []) == []


def test_settings_reach_both_forms() -> None:
    for form in ("nonlinear", "affine"):
        model = make_dynamics(
            3, 2, form, hidden=(8,), members=4, activation="silu", std_floor=0.5, box_margin=0.25
        )
        assert (model.members, model.network.activation) == (4, "silu")
        assert (model.change_normalizer.std_floor, model.box.margin) == (0.5, 0.25)
        assert model.mean_change(torch.zeros(2, 3), torch.zeros(2, 2)).shape == (2, 3)


def test_an_unknown_form_is_named() -> None:
    with pytest.raises(ValueError, match="'nonlinear' or 'affine', got 'linear'"):
        make_dynamics(3, 2, "linear")


@pytest.mark.parametrize(("n", "m"), [(4, 1), (18, 6)])
def test_affine_model_with_a_gaussian_head_has_the_size_too(n: int, m: int) -> None:
    nonlinear = make_dynamics(n, m, "nonlinear", [128, 128], head="gaussian", members=1)
    affine = make_dynamics(n, m, "affine", [128, 128], head="gaussian", members=1)
    assert nonlinear.network.weights[-1].shape[-1] == 2 * n
    assert affine.network.weights[-1].shape[-1] == 2 * n * (1 + m)
    assert abs(count(affine) / count(nonlinear) - 1) < 0.02
