from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from torchrl_l1.dynamics import EnsembleDynamics, EnsembleMLP
from torchrl_l1.dynamics.ensemble import ACTIVATIONS

LAYERS = {"relu": nn.ReLU, "tanh": nn.Tanh, "silu": nn.SiLU}


def as_sequential(ensemble: EnsembleMLP, member: int) -> nn.Sequential:
    """The same member built from torch's own layers."""
    layers: list[nn.Module] = []
    for weight, bias in zip(ensemble.weights, ensemble.biases, strict=True):
        linear = nn.Linear(weight.shape[1], weight.shape[2])
        linear.weight.data = weight[member].T.detach().clone()
        linear.bias.data = bias[member, 0].detach().clone()
        layers += [linear, LAYERS[ensemble.activation]()]
    return nn.Sequential(*layers[:-1])


@pytest.mark.parametrize("activation", LAYERS)
def test_members_agree_with_torch_layers(activation: str) -> None:
    torch.manual_seed(0)
    ensemble = EnsembleMLP(4, 3, (8, 6), members=3, activation=activation)
    for bias in ensemble.biases:
        nn.init.normal_(bias)
    x = torch.randn(5, 4)
    own = torch.randn(3, 5, 4)
    for member in range(3):
        network = as_sequential(ensemble, member)
        torch.testing.assert_close(ensemble(x)[member], network(x))
        torch.testing.assert_close(ensemble(own)[member], network(own[member]))
        torch.testing.assert_close(ensemble.forward_member(x, member), network(x))


@given(
    n=st.integers(1, 6),
    m=st.integers(1, 4),
    batch=st.integers(1, 4),
    hidden=st.lists(st.integers(1, 9), min_size=0, max_size=3),
    activation=st.sampled_from(sorted(ACTIVATIONS)),
    seed=st.integers(0, 1000),
)
@settings(max_examples=20, deadline=None)
def test_jacobian_agrees_with_autograd_through_the_normalisers(
    n: int, m: int, batch: int, hidden: list[int], activation: str, seed: int
) -> None:
    torch.manual_seed(seed)
    model = EnsembleDynamics(n, m, members=3, hidden=hidden, activation=activation).double()
    data = torch.randn(50, 2 * n + m).double() * torch.logspace(-2, 2, 2 * n + m).double()
    data[:, 0] = 1.0  # a constant observation: the floor is in the chain
    model.fit_statistics(data[:, :n], data[:, n : n + m], data[:, n + m :])
    x, u = data[:batch, :n], data[:batch, n : n + m]
    value, jacobian = model.value_and_jacobian(x, u)
    torch.testing.assert_close(value, model.mean_change(x, u))
    for i in range(batch):
        expected = torch.autograd.functional.jacobian(
            lambda action, i=i: model.mean_change(x[i : i + 1], action[None])[0], u[i]
        )
        torch.testing.assert_close(jacobian[i], expected, rtol=1e-8, atol=1e-10)
    other = u + torch.randn(batch, m).double()
    tangent = value + (jacobian @ (other - u).unsqueeze(-1)).squeeze(-1)
    remainder = model.taylor_remainder(x, u, other)
    scale = value.abs().max().item()
    torch.testing.assert_close(
        remainder, model.mean_change(x, other) - tangent, rtol=1e-8, atol=1e-12 * scale
    )


def test_jacobian_agrees_with_finite_differences() -> None:
    torch.manual_seed(0)
    model = EnsembleDynamics(3, 2, members=4, hidden=(16, 16), activation="tanh").double()
    data = torch.randn(40, 8).double()
    model.fit_statistics(data[:, :3], data[:, 3:5], data[:, 5:])
    x, u, h = data[:6, :3], data[:6, 3:5], 1e-6
    _, jacobian = model.value_and_jacobian(x, u)
    for column in range(2):
        shift = torch.zeros(2).double()
        shift[column] = h
        slope = (model.mean_change(x, u + shift) - model.mean_change(x, u - shift)) / (2 * h)
        torch.testing.assert_close(jacobian[..., column], slope, rtol=1e-6, atol=1e-8)


def test_any_batch_shape() -> None:
    model = EnsembleDynamics(3, 2, members=2, hidden=(4,))
    for shape in [(), (5,), (2, 5)]:
        x, u = torch.randn(*shape, 3), torch.randn(*shape, 2)
        value, jacobian = model.value_and_jacobian(x, u)
        assert value.shape == (*shape, 3)
        assert jacobian.shape == (*shape, 3, 2)
        assert model.taylor_remainder(x, u, u).shape == (*shape, 3)
        assert model.member_changes(x, u).shape == (2, *shape, 3)


def test_members_start_different() -> None:
    model = EnsembleDynamics(3, 2, members=2, hidden=(4,))
    first, second = model.member_changes(torch.randn(5, 3), torch.randn(5, 2))
    assert not torch.allclose(first, second)


def test_wrong_settings_and_shapes_are_named() -> None:
    with pytest.raises(ValueError, match="gelu"):
        EnsembleMLP(1, 1, (2,), 1, activation="gelu")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="positive"):
        EnsembleMLP(1, 1, (0,), 1)
    model = EnsembleDynamics(3, 2, members=2, hidden=(4,))
    with pytest.raises(ValueError, match="actions of width 2, got 3 and 1"):
        model.mean_change(torch.zeros(1, 3), torch.zeros(1, 1))


@pytest.mark.parametrize("name", sorted(ACTIVATIONS))
def test_all_that_is_computed_with_an_activation_is_that_activation(name: str) -> None:
    activation = ACTIVATIONS[name]
    z = torch.linspace(-4, 4, 90, dtype=torch.float64, requires_grad=True)
    expected, gradient = LAYERS[name]()(z), torch.linspace(1, 2, 90, dtype=torch.float64)
    (by_z,) = torch.autograd.grad(expected, z, gradient)
    x = z.detach()
    torch.testing.assert_close(activation.value(x), expected.detach())
    value, derivative = activation.value_and_derivative(x)
    torch.testing.assert_close(value, expected.detach())
    torch.testing.assert_close(derivative * gradient, by_z)
    torch.testing.assert_close(activation.backward(gradient, x, value), by_z)
    written = x.clone()
    assert activation.in_place(written) is written
    torch.testing.assert_close(written, value)
    for dtype in (torch.float32, torch.bfloat16):
        one = torch.full((1,), activation.one, dtype=dtype)
        assert activation.value(one).item() == pytest.approx(1, abs=1e-7)
