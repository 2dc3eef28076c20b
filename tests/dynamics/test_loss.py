from __future__ import annotations

import pytest
import torch

from torchrl_l1.dynamics import (
    EnsembleDynamics,
    EnsembleDynamicsLoss,
    Head,
)
from torchrl_l1.dynamics.loss import evaluate_members

from .conftest import transitions


class AbsoluteError(Head):
    """A user's own head: the mean, and a column that is not used."""

    def out_features(self, dim: int) -> int:
        return dim + 1

    def loss(self, raw: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return (raw[..., :-1] - target).abs().sum(-1)

    def standard_deviation(self, raw: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(raw[..., :-1])


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


def test_another_head_sets_width_and_loss() -> None:
    torch.manual_seed(0)
    model = EnsembleDynamics(2, 1, members=3, hidden=(8,), activation="tanh", head=AbsoluteError())
    assert model.network.weights[-1].shape == (3, 8, 3)
    data = transitions(30)
    change = data["next", "observation"] - data["observation"]
    model.fit_statistics(data["observation"], data["action"], change)
    raw = model.network(model.normalize_inputs(data["observation"], data["action"]))
    target = model.change_normalizer.normalize(change)
    expected = (raw[..., :2] - target).abs().sum(-1).mean(-1)
    out = EnsembleDynamicsLoss(model)(data)
    torch.testing.assert_close(out["member_loss"], expected)
    mean = model.change_normalizer.denormalize(raw[..., :2])
    torch.testing.assert_close(model.member_changes(data["observation"], data["action"]), mean)
    _, jacobian = model.value_and_jacobian(data["observation"], data["action"])
    assert jacobian.shape == (30, 2, 1)


def test_loss_keys_can_be_renamed_and_missing_ones_are_named() -> None:
    model = EnsembleDynamics(2, 1, members=2, hidden=(8,))
    loss = EnsembleDynamicsLoss(model)
    loss.set_keys(action="executed")
    data = transitions(5)
    assert torch.isfinite(loss(data)["loss_dynamics"])
    with pytest.raises(KeyError, match="executed"):
        loss(data.exclude("executed"))


def test_data_that_do_not_fit_the_model_are_named() -> None:
    loss, data = (
        EnsembleDynamicsLoss(EnsembleDynamics(2, 1, members=3, hidden=(8,))),
        transitions(8),
    )
    narrow = data.clone()
    narrow["next", "observation"] = narrow["next", "observation"][:, :1]
    with pytest.raises(ValueError, match=r"'next', 'observation'\) has shape \(8, 1\), 'observ"):
        loss(narrow)
    with pytest.raises(ValueError, match=r"'action' is torch.float64, the model torch.float32"):
        loss(data.clone().set("action", data["action"].double()))
    with pytest.raises(ValueError, match=r"batch size \(2, 4\), expected \[B\] .* \[3, B\]"):
        loss(data.reshape(2, 4))
    with pytest.raises(ValueError, match="there are no data"):
        evaluate_members(loss, data[:0])
