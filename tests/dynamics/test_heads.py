from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_l1.control import ActionJacobian
from torchrl_l1.dynamics import (
    DeterministicHead,
    EnsembleDynamics,
    EnsembleDynamicsLoss,
    FitConfig,
    GaussianHead,
    Head,
    fit_ensemble,
    make_dynamics,
    make_head,
)


def bounded(raw: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """The log-variance by another formula: smooth minimum with the one, maximum with the other."""
    return torch.logaddexp(low, -torch.logaddexp(-high, -raw))


@given(seed=st.integers(0, 2**16), dim=st.integers(1, 4), scale=st.floats(0.1, 5.0))
@settings(max_examples=20, deadline=None)
def test_loss_and_gradients_are_those_of_a_normal_distribution(
    seed: int, dim: int, scale: float
) -> None:
    torch.manual_seed(seed)
    head = GaussianHead(dim, -4.0, 2.0).double()
    with torch.no_grad():
        for bound in head.parameters():
            bound += 0.5 * torch.randn(dim).double()
    raw = (scale * torch.randn(3, 5, 2 * dim).double()).requires_grad_()
    target = torch.randn(5, dim).double().requires_grad_()
    variables = [raw, head.min_log_variance, head.max_log_variance, target]
    log_variance = bounded(raw[..., dim:], *variables[1:3])
    torch.testing.assert_close(head.log_variance(raw), log_variance, rtol=1e-7, atol=1e-7)
    normal = torch.distributions.Normal(raw[..., :dim], (0.5 * log_variance).exp())
    torch.testing.assert_close(head.standard_deviation(raw), normal.stddev, rtol=1e-7, atol=1e-7)
    expected = -normal.log_prob(target).mean(-1)
    loss = head.loss(raw, target)
    torch.testing.assert_close(loss, expected, rtol=1e-7, atol=1e-7)
    weights = torch.randn(3, 5).double()
    gradients = torch.autograd.grad((weights * loss).sum(), variables)
    for gradient, other in zip(
        gradients, torch.autograd.grad((weights * expected).sum(), variables), strict=True
    ):
        torch.testing.assert_close(gradient, other, rtol=1e-6, atol=1e-6)


def test_gradients_under_transforms_are_the_same() -> None:
    head = GaussianHead(2)
    raw, target = torch.randn(6, 4), torch.randn(6, 2)

    def loss(raw: Tensor, target: Tensor) -> Tensor:
        return head.loss(raw, target).sum()

    leaf = raw.clone().requires_grad_()
    (expected,) = torch.autograd.grad(loss(leaf, target), leaf)
    torch.testing.assert_close(torch.func.grad(loss)(raw, target), expected)
    each = torch.func.vmap(torch.func.grad(loss))(raw, target)
    torch.testing.assert_close(each, expected)


class Loss(nn.Module):
    """A head's loss as a module, to be called with other parameters."""

    def __init__(self, head: Head) -> None:
        super().__init__()
        self.head = head

    def forward(self, raw: Tensor, target: Tensor) -> Tensor:
        return self.head.loss(raw, target)


def test_first_and_second_derivatives_agree_with_finite_differences() -> None:
    module = Loss(GaussianHead(2).double())
    raw = torch.randn(3, 2, 4, dtype=torch.float64, requires_grad=True)
    target = torch.randn(2, 2, dtype=torch.float64, requires_grad=True)
    names = [name for name, _ in module.named_parameters()]

    def loss(raw: Tensor, target: Tensor, *bounds: Tensor) -> Tensor:
        given = dict(zip(names, bounds, strict=True))
        return torch.func.functional_call(module, given, (raw, target))

    inputs = (raw, target, *module.parameters())
    assert torch.autograd.gradcheck(loss, inputs)
    assert torch.autograd.gradgradcheck(loss, inputs)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("head", ["deterministic", "gaussian"])
@given(seed=st.integers(0, 2**16), dim=st.integers(1, 4), rows=st.integers(1, 9))
@settings(max_examples=20, deadline=None)
def test_what_a_fit_needs_is_what_autograd_says(
    head: str, dtype: torch.dtype, seed: int, dim: int, rows: int
) -> None:
    torch.manual_seed(seed)
    one = make_head(head, dim).to(dtype)
    raw = 2 * torch.randn(3, rows, one.out_features(dim), dtype=dtype)
    target = torch.randn(3, rows, dim, dtype=dtype)
    losses, gradient = one.loss_and_gradient(raw.clone(), target)
    own = [parameter.grad.clone() for parameter in one.parameters()]
    expected_losses, expected = Head.loss_and_gradient(one, raw, target)
    tolerance = {"rtol": 1e-4, "atol": 1e-5} if dtype == torch.float32 else {}
    torch.testing.assert_close(losses, expected_losses, **tolerance)
    torch.testing.assert_close(gradient, expected, **tolerance)
    for parameter, found in zip(one.parameters(), own, strict=True):
        torch.testing.assert_close(found, parameter.grad, **tolerance)


@given(
    raw=st.lists(st.floats(-1e6, 1e6, width=32), min_size=2, max_size=8),
    low=st.floats(-12, -1),
    gap=st.floats(0.5, 8),
)
@settings(max_examples=25, deadline=None)
def test_the_variance_is_bounded_whatever_the_network_says(
    raw: list[float], low: float, gap: float
) -> None:
    head = GaussianHead(1, low, low + gap)
    column = torch.tensor(sorted(raw))[:, None]
    log_variance = head.log_variance(torch.cat([torch.zeros_like(column), column], 1))
    assert log_variance.min() >= low - 1e-5
    assert log_variance.max() <= low + gap + math.log1p(math.exp(-gap)) + 1e-5
    assert (log_variance.diff(dim=0) >= -1e-5).all()
    assert torch.isfinite(head.loss(torch.cat([column, column], 1), torch.zeros(len(raw), 1))).all()


def test_wrong_settings_are_named() -> None:
    with pytest.raises(ValueError, match="min_log_variance must be below"):
        GaussianHead(2, 1.0, 0.0)
    with pytest.raises(ValueError, match="both finite"):
        GaussianHead(2, -math.inf, 0.0)
    with pytest.raises(ValueError, match="bound_penalty"):
        GaussianHead(2, bound_penalty=-1.0)
    with pytest.raises(ValueError, match="dim"):
        GaussianHead(0)
    with pytest.raises(ValueError, match="of width 3, the model's have 2"):
        EnsembleDynamics(2, 1, head=GaussianHead(3))
    for make in (lambda: make_head("student", 2), lambda: make_dynamics(2, 1, head="student")):
        with pytest.raises(ValueError, match="head must be 'deterministic' or 'gaussian'"):
            make()


def test_a_name_makes_a_head() -> None:
    assert isinstance(make_head("deterministic", 2), DeterministicHead)
    head = make_head("gaussian", 2)
    assert isinstance(head, GaussianHead)
    assert make_dynamics(2, 1, head=head).head is head
    assert isinstance(make_dynamics(2, 1).head, DeterministicHead)


def test_the_penalty_joins_the_objective_once_and_no_members_loss() -> None:
    torch.manual_seed(0)
    head = GaussianHead(2, -3.0, 1.0, bound_penalty=0.25)
    model = EnsembleDynamics(2, 1, members=3, hidden=(4,), head=head)
    out = EnsembleDynamicsLoss(model)(transitions(20))
    assert head.penalty().item() == pytest.approx(0.25 * 2 * 4)
    difference = out["loss_dynamics"] - out["member_loss"].sum()
    assert difference.item() == pytest.approx(2.0, rel=1e-5)
    head.penalty().backward()
    assert head.max_log_variance.grad is not None
    assert head.min_log_variance.grad is not None
    assert head.max_log_variance.grad.tolist() == [0.25, 0.25]
    assert head.min_log_variance.grad.tolist() == [-0.25, -0.25]
    assert DeterministicHead().penalty() == 0


@pytest.mark.parametrize("form", ["nonlinear", "affine"])
def test_the_jacobian_is_that_of_the_mean(form: str) -> None:
    torch.manual_seed(0)
    options = {"members": 4, "hidden": (8, 8), "activation": "tanh", "head": "gaussian"}
    model = make_dynamics(3, 2, form, **options).double()
    data = torch.randn(40, 8).double() * torch.logspace(-1, 1, 8).double()
    model.fit_statistics(data[:, :3], data[:, 3:5] + 1, data[:, 5:])
    x, u, h = data[:6, :3], data[:6, 3:5], 1e-6
    mean, _ = model.member_distribution(x, u)
    value, jacobian = model.value_and_jacobian(x, u)
    torch.testing.assert_close(value, mean.mean(0))
    for column in range(2):
        shift = h * torch.eye(2).double()[column]
        high, low = (model.member_distribution(x, u + s)[0].mean(0) for s in (shift, -shift))
        torch.testing.assert_close(jacobian[..., column], (high - low) / (2 * h))
    other = u + 0.5
    tangent = value + (jacobian @ (other - u)[..., None])[..., 0]
    remainder = model.member_distribution(x, other)[0].mean(0) - tangent
    torch.testing.assert_close(
        model.taylor_remainder(x, u, other), remainder, rtol=1e-7, atol=1e-10
    )
    assert ActionJacobian(model).analytic


@pytest.mark.parametrize("head", ["deterministic", "gaussian"])
@pytest.mark.parametrize("form", ["nonlinear", "affine"])
def test_what_each_member_predicts(form: str, head: str) -> None:
    torch.manual_seed(0)
    model = make_dynamics(3, 2, form, hidden=(8,), members=4, head=head)
    data = torch.randn(50, 8) * torch.logspace(-2, 2, 8)
    model.fit_statistics(data[:, :3], data[:, 3:5], data[:, 5:])
    for shape in [(), (5,), (2, 5)]:
        x, u = torch.randn(*shape, 3), torch.randn(*shape, 2)
        mean, std = model.member_distribution(x, u)
        assert mean.shape == std.shape == (4, *shape, 3)
        torch.testing.assert_close(mean, model.member_changes(x, u))
        if head == "deterministic":
            assert (std == 0).all()
            continue
        inputs = model.normalize_inputs(x, u).reshape(-1, 5)
        low, high = model.head.min_log_variance, model.head.max_log_variance
        for member in range(4):
            raw = model.raw_member(inputs, member)[:, 3:]
            scale = data[:, 5:].std(0, correction=0)
            expected = (0.5 * bounded(raw, low, high)).exp() * scale
            torch.testing.assert_close(std[member].reshape(-1, 3), expected, rtol=1e-4, atol=0)


def transitions(count: int, noisy: bool = False) -> TensorDict:
    """x' = x + 0.4 u - 0.2 x, with noise that grows with x from 0.04 to 0.4."""
    x, u = 4 * torch.rand(count, 2) - 2, torch.randn(count, 1)
    change = 0.4 * u - 0.2 * x
    if noisy:
        change = change + true_std(x) * torch.randn_like(x)
    return TensorDict(
        {
            "observation": x,
            "action": u,
            "next": {"observation": x + change},
            "validation": torch.arange(count) % 5 == 0,
        },
        batch_size=[count],
    )


def true_std(x: Tensor) -> Tensor:
    return (0.04 * 10 ** ((x + 2) / 4)).expand_as(x)


def fitted(data: TensorDict, head: GaussianHead, config: FitConfig) -> EnsembleDynamics:
    buffer = ReplayBuffer(storage=LazyTensorStorage(len(data)))
    buffer.extend(data)
    model = EnsembleDynamics(2, 1, members=2, hidden=(32,), activation="tanh", head=head)
    optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate)
    fit_ensemble(model, buffer, config, optimizer)
    return model


def test_learns_noise_that_depends_on_the_state() -> None:
    torch.manual_seed(0)
    config = FitConfig(5e-3, batch_size=1000, max_epochs=100, max_gradient_steps=1000, patience=30)
    model = fitted(transitions(20_000, noisy=True), GaussianHead(2), config)
    x = torch.linspace(-1.8, 1.8, 13)[:, None].expand(-1, 2)
    with torch.no_grad():
        mean, std = model.member_distribution(x, torch.zeros(13, 1))
    assert (std / true_std(x) - 1).abs().max() < 0.15
    assert ((mean + 0.2 * x) / true_std(x)).abs().max() < 0.3


def test_bounds_are_learned() -> None:
    torch.manual_seed(0)
    config = FitConfig(1e-2, batch_size=100, max_epochs=100, max_gradient_steps=300)
    # Without noise the lower bound is in the way of the likelihood, the upper one is not.
    model = fitted(transitions(1000), GaussianHead(2, -1.0, 1.0), config)
    assert (model.head.min_log_variance < -1.5).all()
    assert (model.head.max_log_variance < 1.0).all()


def test_members_share_the_bounds_of_a_fit_that_was_the_best() -> None:
    torch.manual_seed(0)
    data = transitions(60, noisy=True)
    buffer = ReplayBuffer(storage=LazyTensorStorage(len(data)))
    buffer.extend(data)
    head = GaussianHead(2)
    model = EnsembleDynamics(2, 1, members=2, hidden=(64,), head=head)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    history: list[Tensor] = []
    config = FitConfig(1e-2, batch_size=20, max_epochs=500, patience=7)
    report = fit_ensemble(
        model,
        buffer,
        config,
        optimizer,
        on_epoch=lambda epoch: history.append(head.min_log_variance.detach().clone()),
    )
    assert len(history) == report.epochs < 500
    # As many epochs as the fit was patient came after the last that was the best for a member.
    assert torch.equal(head.min_log_variance, history[-1 - config.patience])
    assert not torch.equal(history[-1], history[-1 - config.patience])
    loss = EnsembleDynamicsLoss(model)(data[data["validation"]])["member_loss"]
    assert report.validation_loss == pytest.approx(loss.mean().item(), rel=1e-5)
