from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchrl_l1.control import L1Config, L1State, init
from torchrl_l1.control.seal import Emitted, seal_width, sealed, verify

NAMES = {"owner": "L1", "observation_key": "observation", "key": "l1"}


def example(
    batch: tuple[int, ...] = (), dtype: torch.dtype = torch.float32
) -> tuple[Tensor, L1State]:
    generator = torch.Generator().manual_seed(0)
    state = init(batch, 3, 2, dtype=dtype)
    values = {
        name: torch.randn(value.shape, generator=generator, dtype=dtype)
        for name, value in state.entries().items()
        if value.is_floating_point()
    }
    flags = {"n_switch": state.n_switch + 3, "started": ~state.started}
    return torch.randn(*batch, 3, generator=generator, dtype=dtype), L1State(**values, **flags)


def test_what_it_holds():
    observation, state = example((5,))
    seal = sealed(observation, state)
    assert seal.shape == (5, seal_width(3, 2, False))
    assert torch.equal(seal[:, :3], observation) and seal.data_ptr() != observation.data_ptr()
    assert torch.equal(seal[:, 3:-2], torch.cat(state[:4], -1))
    assert torch.equal(seal[:, -2:], torch.tensor([[3.0, 1.0]]).expand(5, 2))


def test_what_it_holds_of_a_kalman_filter():
    state = init([5], 3, 2, L1Config.robust(0.1))._replace(noise=torch.rand(5, 3))
    seal = sealed(torch.zeros(5, 3), state)
    assert seal.shape == (5, seal_width(3, 2, True))
    total = sum(value.sum(-1) for value in (state.covariance, state.noise, state.jacobian))
    torch.testing.assert_close(seal[:, -1], total)


@settings(max_examples=25, deadline=None)
@given(
    values=st.lists(st.floats(width=64, allow_nan=True), min_size=3, max_size=3),
    narrow_first=st.booleans(),
)
def test_a_change_of_type_is_none(values: list[float], narrow_first: bool):
    given = torch.tensor(values, dtype=torch.float64)
    state = init([], 3, 1, dtype=torch.float64)
    read = given.float()
    if narrow_first:
        given, read = read, read.double()
    # An overflow of float32 is a change.
    if (read.isfinite() == given.isfinite()).all():
        verify(read, state, sealed(given, state), **NAMES)
    state = init([], 3, 1)
    verify(read, state, sealed(given, state), **NAMES)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_changes_of_the_observation_are_noticed(batch, dtype):
    observation, state = example(batch, dtype)
    seal = sealed(observation, state)
    assert verify(observation, state, seal, **NAMES) is observation
    for change in (
        lambda x: x + 1e-4,
        lambda x: x.flip(-1),
        lambda x: x * 1.001,
        lambda x: torch.full_like(x, torch.nan),
        lambda x: x.to(torch.bfloat16),
        torch.zeros_like,
    ):
        with pytest.raises(ValueError, match="L1: 'observation' is not what the environment gave"):
            verify(change(observation), state, seal, **NAMES)


def test_the_environment_and_entry_are_named():
    observation, state = example((2, 3))
    changed = observation.clone()
    changed[1, 2, 1] = 5.0
    was = f"{observation[1, 2, 1]:.6g}"
    with pytest.raises(ValueError, match=rf"environment \[1, 2\], entry 1 was {was} and is 5 now"):
        verify(changed, state, sealed(observation, state), **NAMES)


@pytest.mark.parametrize("name", ["x_hat", "u_bar", "q", "sigma_m", "n_switch", "started"])
@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_each_lost_entry_is_named(name, scale):
    observation, state = example((4,))
    observation, state = observation * scale, state._replace(x_hat=state.x_hat * scale)
    seal = sealed(observation, state)
    emitted = Emitted.of(observation, state, seal)
    lost = state._replace(**{name: torch.zeros_like(getattr(state, name))})
    with pytest.raises(ValueError, match=rf"the entries \['{name}'\] under 'l1' are not those"):
        verify(observation, lost, seal, emitted=emitted, **NAMES)
    with pytest.raises(ValueError, match=rf"the entries \['{name}'\] under 'l1' are not those"):
        verify(observation, lost, seal, **NAMES)  # in another process


def test_an_old_state_is_no_changed_observation():
    before, old = example()
    observation = before + 1.0
    state = old._replace(x_hat=old.x_hat + 1.0)
    emitted = Emitted.of(observation, state, sealed(observation, state))
    with pytest.raises(ValueError, match=r"the entries \['x_hat'\] under 'l1' are not those"):
        verify(observation, old, sealed(before, old), emitted=emitted, **NAMES)


def test_the_very_tensors_need_no_comparison(monkeypatch):
    observation, state = example()
    seal = sealed(observation, state)
    emitted = Emitted.of(observation, state, seal)
    monkeypatch.setattr("torchrl_l1.control.seal.sealed", None)
    verify(observation, state, seal, emitted=emitted, **NAMES)
    monkeypatch.undo()
    observation.add_(1.0)
    with pytest.raises(ValueError, match="is not what the environment gave"):
        verify(observation, state, seal, emitted=emitted, **NAMES)


def test_a_row_of_zeros_can_mean_no_seal():
    observation, state = example((2,))
    seal = sealed(observation, state)
    seal[0] = 0.0
    verify(observation, state, seal, zero_is_none=True, **NAMES)
    with pytest.raises(ValueError, match=r"environment \[0\]"):
        verify(observation, state, seal, **NAMES)
    with pytest.raises(ValueError, match=r"environment \[1\]"):
        verify(observation + 1.0, state, seal, zero_is_none=True, **NAMES)


def test_the_memory_of_the_kalman_filter_counts():
    config = L1Config.robust(0.1)
    state = init([], 3, 1, config)
    observation = torch.ones(3)
    seal = sealed(observation, state)
    with pytest.raises(ValueError, match="'covariance'"):
        lost = state._replace(covariance=torch.ones(1))
        verify(observation, lost, seal, emitted=Emitted.of(observation, state, seal), **NAMES)


def test_the_memory_of_any_law_counts():
    observation, state = example()
    state = state._replace(noise=torch.ones(3))
    seal = sealed(observation, state)
    assert seal.shape == (seal_width(3, 2, True),)
    with pytest.raises(ValueError, match="'noise'"):
        verify(observation, state._replace(noise=torch.zeros(3)), seal, **NAMES)


def test_it_compiles_as_one_graph():
    def check(observation: Tensor, other: Tensor, *entries: Tensor) -> Tensor:
        state = L1State(*entries)
        return verify(other, state, sealed(observation, state), **NAMES) + 1.0

    compiled = torch.compile(check, fullgraph=True, backend="aot_eager")
    observation, state = example((2,))
    entries = list(state.entries().values())
    torch.testing.assert_close(
        compiled(observation, observation.clone(), *entries), observation + 1
    )
    with pytest.raises(ValueError, match=r"L1: 'observation' is not what the environment gave"):
        compiled(observation, observation + 0.1, *entries)


def test_a_change_of_type_is_none_with_a_kalman_filter():
    # Entries of the Jacobian cancel in a sum, whose rounding is theirs.
    config = L1Config.robust(0.05, action_low=-1.0, action_high=1.0)
    fresh = init([], 3, 1, config, dtype=torch.float64)
    jacobian = torch.tensor([10.1, -7.03, -3.06], dtype=torch.float64)
    x = 1e-3 * torch.ones(3, dtype=torch.float64)
    state = fresh._replace(x_hat=x, jacobian=jacobian, started=torch.tensor([True]))
    seal = sealed(x, state)
    entries = {
        name: value.float().double() if value.is_floating_point() else value
        for name, value in state.entries().items()
    }
    rounded = L1State(**entries)
    verify(x, rounded, seal.float().double(), owner="L1", observation_key="observation", key="l1")
    lost = rounded._replace(jacobian=torch.zeros_like(jacobian))
    with pytest.raises(ValueError, match="jacobian"):
        verify(x, lost, seal, owner="L1", observation_key="observation", key="l1")
