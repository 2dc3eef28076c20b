from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_l1.dynamics import EnsembleDynamics, EnsembleDynamicsLoss, FitConfig, fit_ensemble


def transitions(count: int, noise: float = 0.0) -> TensorDict:
    """A known plant: x' = x + A x + B u, with constants in raw units of different scale."""
    x = torch.randn(count, 2) * torch.tensor([1.0, 100.0])
    u = torch.randn(count, 1)
    change = x @ torch.tensor([[-0.1, 3.0], [0.001, -0.05]]) + u @ torch.tensor([[0.5, 20.0]])
    change = change + noise * torch.randn_like(change)
    held_out = torch.arange(count) % 5 == 0
    return TensorDict(
        {
            "observation": x,
            "action": u,
            "executed": 2 * u,
            "next": {"observation": x + change},
            "validation": held_out,
        },
        batch_size=[count],
    )


def fitted(action_key: str, config: FitConfig, data: TensorDict) -> EnsembleDynamics:
    buffer = ReplayBuffer(storage=LazyTensorStorage(len(data)))
    buffer.extend(data)
    model = EnsembleDynamics(2, 1, members=2, hidden=(32,), activation="tanh")
    optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate)
    fit_ensemble(model, buffer, config, optimizer, action_key=action_key)
    return model


@pytest.mark.parametrize(("label", "gain"), [("action", 1.0), ("executed", 0.5)])
def test_learns_a_known_plant_and_the_label_that_is_asked_for(label: str, gain: float) -> None:
    torch.manual_seed(0)
    config = FitConfig(learning_rate=3e-3, batch_size=100, max_epochs=120, max_gradient_steps=2000)
    model = fitted(label, config, transitions(1000))
    _, jacobian = model.value_and_jacobian(torch.zeros(1, 2), torch.zeros(1, 1))
    expected = gain * torch.tensor([[[0.5], [20.0]]])
    torch.testing.assert_close(jacobian, expected, rtol=0.1, atol=0.02)


def test_loss_is_the_normalised_mean_squared_error_of_each_member() -> None:
    torch.manual_seed(0)
    data = transitions(30)
    model = EnsembleDynamics(2, 1, members=3, hidden=(8,))
    change = data["next", "observation"] - data["observation"]
    model.fit_statistics(data["observation"], data["action"], change)
    out = EnsembleDynamicsLoss(model)(data)
    predicted = model.member_changes(data["observation"], data["action"])
    std = model.change_normalizer.std
    expected = (((predicted - change) / std) ** 2).mean((1, 2))
    torch.testing.assert_close(out["member_loss"], expected, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(out["loss_dynamics"], expected.sum(), rtol=1e-4, atol=1e-6)


def test_members_do_not_share_gradients() -> None:
    model = EnsembleDynamics(2, 1, members=2, hidden=(8,))
    data = transitions(20)
    per_member = torch.stack([data, data.clone()])
    per_member["next", "observation"][1] = per_member["observation"][1]
    model.fit_statistics(data["observation"], data["action"], torch.randn(20, 2))
    loss = EnsembleDynamicsLoss(model)
    loss(data)["loss_dynamics"].backward()
    first_alone = model.network.weights[0].grad[0].clone()
    model.zero_grad()
    loss(per_member)["loss_dynamics"].backward()
    torch.testing.assert_close(model.network.weights[0].grad[0], first_alone)


def test_each_member_sees_its_own_shuffle() -> None:
    torch.manual_seed(0)
    data = transitions(200)
    buffer = ReplayBuffer(storage=LazyTensorStorage(len(data)))
    buffer.extend(data)

    def difference(batch_size: int) -> float:
        model = EnsembleDynamics(2, 1, members=2, hidden=(8,), activation="tanh")
        with torch.no_grad():
            for parameter in model.parameters():
                parameter[1] = parameter[0]
        optimizer = torch.optim.Adam(model.parameters())
        fit_ensemble(model, buffer, FitConfig(batch_size=batch_size, max_epochs=3), optimizer)
        first, second = model.network.weights[0]
        return (first - second).abs().max().item()

    assert difference(20) > 1e-4
    assert difference(160) < 1e-5  # all the training data in each batch


class GaussianHead(nn.Module):
    """Mean and logarithm of the variance."""

    def out_features(self, dim: int) -> int:
        return 2 * dim

    def loss(self, raw: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        mean, log_variance = raw.chunk(2, -1)
        return ((mean - target).square() * (-log_variance).exp() + log_variance).sum(-1)


def test_another_head_sets_width_and_loss() -> None:
    torch.manual_seed(0)
    model = EnsembleDynamics(2, 1, members=3, hidden=(8,), activation="tanh", head=GaussianHead())
    assert model.network.weights[-1].shape == (3, 8, 4)
    data = transitions(30)
    change = data["next", "observation"] - data["observation"]
    model.fit_statistics(data["observation"], data["action"], change)
    raw = model.network(model.normalize_inputs(data["observation"], data["action"]))
    target = model.change_normalizer.normalize(change)
    # Twice torch's own negative log-likelihood, which leaves out the same constant.
    expected = 2 * nn.functional.gaussian_nll_loss(
        raw[..., :2], target.expand(3, -1, -1), raw[..., 2:].exp(), reduction="none"
    ).sum(-1).mean(-1)
    out = EnsembleDynamicsLoss(model)(data)
    torch.testing.assert_close(out["member_loss"], expected, rtol=1e-4, atol=1e-5)
    mean = model.change_normalizer.denormalize(raw[..., :2])
    torch.testing.assert_close(model.member_changes(data["observation"], data["action"]), mean)
    _, jacobian = model.value_and_jacobian(data["observation"], data["action"])
    assert jacobian.shape == (30, 2, 1)


@pytest.mark.parametrize("fraction", [0.0, 1.5])
def test_the_learning_rate_never_rises(fraction: float) -> None:
    with pytest.raises(ValueError, match="final_learning_rate_fraction must be positive and at"):
        FitConfig(final_learning_rate_fraction=fraction)


def test_loss_keys_can_be_renamed_and_missing_ones_are_named() -> None:
    model = EnsembleDynamics(2, 1, members=2, hidden=(8,))
    loss = EnsembleDynamicsLoss(model)
    loss.set_keys(action="executed")
    data = transitions(5)
    assert torch.isfinite(loss(data)["loss_dynamics"])
    with pytest.raises(KeyError, match="executed"):
        loss(data.exclude("executed"))


def test_gradient_steps_are_bounded_and_best_weights_are_kept() -> None:
    torch.manual_seed(0)
    data = transitions(200, noise=5.0)
    buffer = ReplayBuffer(storage=LazyTensorStorage(len(data)))
    buffer.extend(data)
    model = EnsembleDynamics(2, 1, members=2, hidden=(64,))
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    report = fit_ensemble(
        model, buffer, FitConfig(batch_size=50, max_epochs=200, patience=10), optimizer
    )
    assert report.epochs < 200
    assert report.gradient_steps == 3 * report.epochs
    validation = data[data["validation"]]
    kept = EnsembleDynamicsLoss(model)(validation)["member_loss"].mean().item()
    assert kept == pytest.approx(report.validation_loss, rel=1e-4)
    bounded = fit_ensemble(model, buffer, FitConfig(batch_size=50, max_gradient_steps=7), optimizer)
    assert bounded.gradient_steps == 7


def test_nothing_to_validate_on_is_an_error() -> None:
    data = transitions(10)
    data["validation"][:] = False
    with pytest.raises(ValueError, match="0 validation"):
        fitted("action", FitConfig(), data)
