from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_l1.dynamics import EnsembleDynamics, EnsembleDynamicsLoss, Head, make_dynamics
from torchrl_l1.dynamics.ensemble import ACTIVATIONS
from torchrl_l1.dynamics.training_step import TrainingStep


class AbsoluteError(Head):
    """A user's own head, with a parameter and a penalty, left to autograd."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = torch.nn.Parameter(torch.tensor(0.7))

    def out_features(self, dim: int) -> int:
        return dim + 1

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        return (self.scale * raw[..., :-1] - target).abs().sum(-1)

    def standard_deviation(self, raw: Tensor) -> Tensor:
        return torch.zeros_like(raw[..., :-1])

    def penalty(self) -> Tensor:
        return 0.1 * self.scale.square()


def model(form: str, head: str | Head, activation: str, hidden: tuple[int, ...] = (9, 7)):
    torch.manual_seed(0)
    return make_dynamics(3, 2, form, hidden=hidden, members=4, activation=activation, head=head)


def batch(rows: int = 11) -> tuple[Tensor, Tensor]:
    return torch.randn(4, rows, 5), torch.randn(4, rows, 3)


def by_autograd(dynamics: EnsembleDynamics, inputs: Tensor, target: Tensor, decay: list[float]):
    """Losses and gradients of what a fit minimises, from the definition."""
    head, weights = dynamics.head, dynamics.network.weights
    losses = head.loss(dynamics.raw(inputs), target).mean(-1)
    squares = [0.5 * c * w.square().sum() for c, w in zip(decay, weights, strict=True)]
    objective = losses.sum() + head.penalty() + sum(squares)
    return losses, torch.autograd.grad(objective, list(dynamics.parameters()))


@pytest.mark.parametrize("form", ["nonlinear", "affine"])
@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
@pytest.mark.parametrize("head", ["deterministic", "gaussian", "own"])
def test_losses_and_gradients_are_those_of_autograd(head: str, activation: str, form: str) -> None:
    dynamics = model(form, AbsoluteError() if head == "own" else head, activation).double()
    decay = [0.3, 0.0, 0.7]
    step = TrainingStep(dynamics, decay=decay)
    for _ in range(2):  # nothing of a batch is left in the next
        inputs, target = (part.double() for part in batch())
        losses = step(inputs, target)
        expected, gradients = by_autograd(dynamics, inputs, target, decay)
        torch.testing.assert_close(losses, expected.detach())
        for parameter, gradient in zip(dynamics.parameters(), gradients, strict=True):
            torch.testing.assert_close(parameter.grad, gradient)


@pytest.mark.parametrize("form", ["nonlinear", "affine"])
@pytest.mark.parametrize("head", ["deterministic", "gaussian", "own"])
def test_the_objective_is_that_of_the_loss(head: str, form: str) -> None:
    dynamics = model(form, AbsoluteError() if head == "own" else head, "silu").double()
    x, u, change = (torch.randn(4, 11, width).double() for width in (3, 2, 3))
    dynamics.fit_statistics(*(part.flatten(0, 1) for part in (x, u, change)))
    data = TensorDict({"observation": x, "action": u, "next": {"observation": x + change}})
    loss = EnsembleDynamicsLoss(dynamics)(data.auto_batch_size_(2))
    gradients = torch.autograd.grad(loss["loss_dynamics"], list(dynamics.parameters()))
    target = dynamics.change_normalizer.normalize(change)
    losses = TrainingStep(dynamics)(dynamics.normalize_inputs(x, u), target)
    torch.testing.assert_close(losses, loss["member_loss"])
    for parameter, gradient in zip(dynamics.parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)


def test_a_network_without_hidden_layers() -> None:
    dynamics = model("nonlinear", "deterministic", "relu", hidden=())
    inputs, target = batch()
    losses = TrainingStep(dynamics, "bfloat16")(inputs, target)
    expected, gradients = by_autograd(dynamics, inputs, target, [0.0])
    torch.testing.assert_close(losses, expected.detach())
    for parameter, gradient in zip(dynamics.parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
@pytest.mark.parametrize("head", ["deterministic", "gaussian"])
def test_gradients_in_bfloat16_stay_close_and_float32(head: str, activation: str) -> None:
    dynamics = model("nonlinear", head, activation, hidden=(64, 64))
    for bias in dynamics.network.biases:
        torch.nn.init.uniform_(bias, -1, 1)
    step = TrainingStep(dynamics, "bfloat16")
    for rows in (200, 200, 150):
        inputs, target = batch(rows)
        losses = step(inputs, target)
        expected, gradients = by_autograd(dynamics, inputs, target, [0.0] * 3)
        torch.testing.assert_close(losses, expected.detach(), rtol=5e-3, atol=0)
        for parameter, gradient in zip(dynamics.parameters(), gradients, strict=True):
            assert parameter.grad is not None
            assert parameter.grad.dtype == parameter.dtype == torch.float32
            assert 0 < (parameter.grad - gradient).norm() < 0.03 * gradient.norm()


def test_frozen_parameters_get_no_gradient() -> None:
    dynamics = model("nonlinear", "gaussian", "relu")
    frozen = [dynamics.network.weights[0], dynamics.head.max_log_variance]
    for parameter in frozen:
        parameter.requires_grad_(False)
    TrainingStep(dynamics)(*batch())
    assert all((p.grad is None) == (not p.requires_grad) for p in dynamics.parameters())
