from __future__ import annotations

import math
from copy import deepcopy

import pytest
import torch
from scipy.special import expit
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from torchrl_l1.dynamics import (
    BernoulliHead,
    FitConfig,
    RewardModel,
    TerminationModel,
    fit_reward,
    fit_termination,
)

FIT = FitConfig(learning_rate=5e-3, batch_size=200, max_gradient_steps=300)


def transitions(count: int = 2400, seed: int = 0) -> TensorDict:
    """Of a made-up system whose reward is a known function and which ends where x[0] > 2."""
    generator = torch.Generator().manual_seed(seed)
    x = 3.0 + torch.randn(count, 3, generator=generator)
    u = torch.rand(count, 2, generator=generator) * 2 - 1
    successor = x + 0.01 * torch.randn(count, 3, generator=generator)
    data = TensorDict({"observation": x, "action": u}, batch_size=[count])
    data["next"] = {
        "observation": successor,
        "reward": known_reward(x, u, successor)[:, None],
        "terminated": successor[:, :1] > 5.0,
    }
    return data


def known_reward(x: Tensor, u: Tensor, successor: Tensor) -> Tensor:
    """Speed, a quadratic cost and a product: what tasks are made of."""
    return 40 * (successor - x)[..., 0] - u.square().sum(-1) + 0.5 * x[..., 1] * u[..., 0]


def fused(model: torch.nn.Module) -> torch.optim.Adam:
    return torch.optim.Adam(model.parameters(), lr=FIT.learning_rate, fused=True)


def test_a_known_reward_is_learned() -> None:
    torch.manual_seed(0)
    model = RewardModel(3, 2, hidden=(64, 64))
    data = transitions()
    report = fit_reward(model, data[:2000], data[2000:], FIT, fused(model))
    assert report.explained_variance > 0.95
    fresh = transitions(500, seed=1)
    with torch.no_grad():
        found = model(fresh["observation"], fresh["action"], fresh["next", "observation"])
    wanted = fresh["next", "reward"][:, 0]
    assert 1 - (found - wanted).square().mean() / wanted.var() > 0.95
    # What the report says is the share on the data that it was given.
    held_out = data[2000:]
    with torch.no_grad():
        found = model(held_out["observation"], held_out["action"], held_out["next", "observation"])
    wanted = held_out["next", "reward"][:, 0]
    share = 1 - (found - wanted).square().mean() / wanted.var(correction=0)
    assert report.explained_variance == pytest.approx(share.item(), abs=1e-3)


def test_a_reward_is_the_members_mean_in_raw_units_whatever_the_batch() -> None:
    torch.manual_seed(0)
    model = RewardModel(3, 2, members=2, hidden=(5,), activation="tanh")
    model.input_normalizer.mean.copy_(torch.arange(8.0))
    model.input_normalizer.std.copy_(torch.arange(1.0, 9.0))
    model.reward_normalizer.mean.fill_(3.0)
    model.reward_normalizer.std.fill_(2.0)
    x, u, successor = torch.randn(4, 3), torch.randn(4, 2), torch.randn(4, 3)
    rows = torch.cat([x, u, successor - x], 1).double().numpy()
    rows = (rows - range(8)) / range(1, 9)
    w, v = (weight.detach().double().numpy() for weight in model.network.weights)
    wanted = 3 + 2 * sum(2 * expit(2 * rows @ w[k]) @ v[k] - v[k].sum(0) for k in (0, 1)) / 2
    with torch.no_grad():
        found = model(x, u, successor)
        shaped = model(*(part.reshape(2, 2, -1) for part in (x, u, successor)))
    torch.testing.assert_close(found.double(), torch.from_numpy(wanted[:, 0]))
    assert torch.equal(shaped.reshape(-1), found)


def test_a_reward_goes_little_beyond_those_seen() -> None:
    torch.manual_seed(0)
    model = RewardModel(3, 2, hidden=(16,), margin=0.5)
    data = transitions()
    fit_reward(model, data[:2000], data[2000:], FIT, fused(model))
    seen = data[:2000]["next", "reward"]
    slack = 0.5 * (seen.max() - seen.min())
    far = torch.randn(500, 3) * 1e3
    with torch.no_grad():
        found = model(far, torch.zeros(500, 2), -far)
    torch.testing.assert_close(found.max(), seen.max() + slack)
    torch.testing.assert_close(found.min(), seen.min() - slack)


def test_a_reward_that_never_changes_is_that_reward() -> None:
    torch.manual_seed(0)
    data = transitions(400)
    data["next", "reward"] = torch.ones(400, 1)
    model = RewardModel(3, 2, hidden=(16,))
    report = fit_reward(model, data[:300], data[300:], FIT, fused(model))
    with torch.no_grad():
        found = model(data["observation"], data["action"], data["next", "observation"])
    torch.testing.assert_close(found, torch.ones(400), atol=1e-4, rtol=0)
    assert math.isfinite(report.explained_variance)


def test_inputs_that_never_varied_make_no_reward() -> None:
    torch.manual_seed(0)
    model, data = RewardModel(3, 2, hidden=(16,)), transitions(400)
    for key in ("observation", ("next", "observation")):
        data[key][:, 2] = 1.5
    fit_reward(model, data[:300], data[300:], FIT, fused(model))
    x, u, after = (data[key][:50] for key in ("observation", "action", ("next", "observation")))
    moved = after + torch.tensor([0.0, 0.0, 0.2])
    torch.testing.assert_close(model(x, u, moved), model(x, u, after), rtol=0, atol=0)


def test_a_separable_termination_is_learned_though_it_is_rare() -> None:
    torch.manual_seed(0)
    data = transitions(6000)
    share = data["next", "terminated"].float().mean().item()
    assert share < 0.03
    model = TerminationModel(3, hidden=(32,))
    report = fit_termination(model, data[:5000], data[5000:], FIT, fused(model))
    assert report.terminal == pytest.approx(share, abs=0.01)
    assert report.missed < 0.15 and report.false_alarms < 0.005
    fresh = transitions(4000, seed=1)["next"]
    wrong = model(fresh["observation"]) != fresh["terminated"][:, 0]
    assert wrong.float().mean() < 0.005
    assert model(fresh["observation"].reshape(40, 100, 3)).shape == (40, 100)


def test_ends_that_are_a_matter_of_chance_come_as_often_as_in_the_data() -> None:
    torch.manual_seed(0)
    count, chance = 4000, 0.05
    data = TensorDict(batch_size=[count])
    data["next"] = {
        "observation": torch.randn(count, 1),
        "terminated": torch.rand(count, 1) < chance,
    }
    train = data[:3600]
    model = TerminationModel(1, hidden=(8,))
    report = fit_termination(model, train, data[3600:], FIT, fused(model))
    ended = train["next", "terminated"].sum().item()
    assert report.terminal == pytest.approx(ended / 3600)
    assert model.head.weight.item() == pytest.approx((3600 - ended) / ended)
    assert model(train["next", "observation"]).sum().item() == ended


def test_where_no_end_was_seen_none_is_predicted() -> None:
    torch.manual_seed(0)
    data = transitions(600)
    model = TerminationModel(3, hidden=(8,))
    optimizer = fused(model)
    fit_termination(model, data[:500], data[500:], FIT, optimizer)
    assert model.threshold.isfinite()
    data["next", "terminated"] = torch.zeros(600, 1, dtype=torch.bool)
    weights = [weight.clone() for weight in model.network.weights]
    report = fit_termination(model, data[:500], data[500:], FIT, optimizer)
    assert not model(1e3 * torch.randn(1000, 3)).any()
    assert (report.terminal, report.missed, report.false_alarms) == (0, 0, 0)
    assert all(map(torch.equal, weights, model.network.weights))


def test_the_loss_of_a_chance_is_the_weighted_cross_entropy() -> None:
    torch.manual_seed(0)
    head = BernoulliHead()
    head.weight.fill_(4.0)
    raw, target = torch.randn(2, 5, 1), (torch.rand(2, 5, 1) < 0.5).float()
    p = raw.double().sigmoid()
    wanted = -(4 * target * p.log() + (1 - target) * (1 - p).log())[..., 0]
    torch.testing.assert_close(head.loss(raw, target).double(), wanted)
    losses, gradient = head.loss_and_gradient(raw, target)
    torch.testing.assert_close(losses.double(), wanted.mean(1))
    leaf = raw.clone().requires_grad_()
    binary_cross_entropy_with_logits(
        leaf, target, pos_weight=torch.tensor(4.0), reduction="sum"
    ).div(5).backward()
    torch.testing.assert_close(gradient, leaf.grad)
    torch.testing.assert_close(head.standard_deviation(raw).double(), (p * (1 - p)).sqrt())


@pytest.mark.parametrize("which", [RewardModel, TerminationModel])
def test_what_does_not_fit_leaves_the_model_alone(
    which: type[RewardModel] | type[TerminationModel],
) -> None:
    data = transitions(60)
    widths = (3, 2) if which is RewardModel else (3,)
    model, other = (which(*widths, hidden=(4,)) for _ in range(2))
    before = deepcopy(model.state_dict())
    own = torch.optim.Adam(model.parameters())
    fit = fit_reward if which is RewardModel else fit_termination
    for train, validation, config, optimizer, message in (
        (data[:0], data[50:], FIT, own, "0 training and 10 validation"),
        (data[:50], data[50:50], FIT, own, "50 training and 0 validation"),
        (data[:50], data[50:], FitConfig(weight_decay=[1.0] * 5), own, "2 layers.* got 5"),
        (data[:50], data[50:], FIT, torch.optim.Adam(other.parameters()), "no weights of this"),
    ):
        with pytest.raises(ValueError, match=message):
            fit(model, train, validation, config, optimizer)  # type: ignore[operator]
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name])
