from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn
from torch.nn.utils import parameters_to_vector

from torchrl_l1.algorithms.policy import GaussianPolicy, make_actor
from torchrl_l1.objectives import (
    TRPOConfig,
    TRPOReport,
    gaussian_trpo_step,
    is_tanh_network,
    trpo_step,
)
from torchrl_l1.objectives.gaussian_trpo import _GaussianProblem
from torchrl_l1.objectives.trpo import _AutogradProblem


def samples(policy: GaussianPolicy, size: int) -> TensorDict:
    n = policy.normalizer.mean.shape[0]
    dtype = policy.log_std.dtype
    data = TensorDict({"observation": 2 + torch.randn(size, n, dtype=dtype)}, batch_size=[size])
    data["action"] = policy.sample(data["observation"]).detach()
    data["advantage"] = data["action"][:, :1] * data["observation"][:, :1]
    data["advantage"] += torch.randn(size, 1, dtype=dtype)
    return data


def problem(policy: GaussianPolicy, data: TensorDict, config: TRPOConfig) -> _GaussianProblem:
    inputs = policy.normalizer.normalize(data["observation"])
    parts = (policy.mean, policy.log_std, inputs, data["action"], data["advantage"])
    return _GaussianProblem(*parts, config)


def some_policy(n: int, m: int, hidden: list[int]) -> GaussianPolicy:
    policy = GaussianPolicy(n, m, hidden, std=0.5).double()
    with torch.no_grad():
        policy.log_std += 0.3 * torch.randn(m)
        for parameter in policy.mean.parameters():  # biases and last layer are not small
            parameter += 0.3 * torch.randn_like(parameter)
    policy.normalizer.fit(3 * torch.randn(50, n) + 1)
    return policy


@given(
    n=st.integers(1, 5),
    m=st.integers(1, 4),
    hidden=st.lists(st.integers(1, 9), max_size=3),
    fraction=st.sampled_from([1.0, 0.3]),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=15, deadline=None)
def test_derivatives_are_those_of_autograd(
    n: int, m: int, hidden: list[int], fraction: float, seed: int
) -> None:
    torch.manual_seed(seed)
    policy = some_policy(n, m, hidden)
    data, config = samples(policy, 40), TRPOConfig(fisher_fraction=fraction)
    closed, oracle = (
        problem(policy, data, config),
        _AutogradProblem(make_actor(policy), data, config),
    )
    shapes = [[parameter.shape for parameter in p.parameters] for p in (closed, oracle)]
    assert shapes[0] == shapes[1]
    torch.testing.assert_close(closed.gradient(), oracle.gradient(), rtol=1e-9, atol=1e-11)
    vector = torch.randn(parameters_to_vector(closed.parameters).shape[0]).double()
    torch.testing.assert_close(
        closed.fisher_product(vector), oracle.fisher_product(vector), rtol=1e-9, atol=1e-11
    )
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
        pairs = zip(closed.evaluate(), oracle.evaluate(), strict=True)
    for one, other in pairs:
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11)


def closed_form_step(policy: GaussianPolicy, data: TensorDict, config: TRPOConfig) -> TRPOReport:
    inputs = policy.normalizer.normalize(data["observation"])
    parts = (policy.mean, policy.log_std, inputs, data["action"], data["advantage"])
    return gaussian_trpo_step(*parts, config)


def test_step_is_the_generic_one() -> None:
    torch.manual_seed(0)
    policy, config = some_policy(5, 3, [16, 16]), TRPOConfig(max_kl=0.02)
    start, data = parameters_to_vector(policy.parameters()), samples(policy, 2000)

    def step(single: bool, closed_form: bool) -> tuple[torch.Tensor, TRPOReport]:
        copy, own = (x.float() if single else x for x in (deepcopy(policy), data))
        if closed_form:
            report = closed_form_step(copy, own, config)
        else:
            report = trpo_step(make_actor(copy), own, config)
        assert report.accepted
        assert copy.log_std.requires_grad
        return parameters_to_vector(copy.parameters()).detach().double() - start, report

    expected, its = step(single=False, closed_form=False)
    found, report = step(single=False, closed_form=True)
    assert (found - expected).norm() < 1e-6 * expected.norm()
    assert report.backtracks == its.backtracks
    assert report.improvement == pytest.approx(its.improvement, rel=1e-6)
    assert report.kl == pytest.approx(its.kl, rel=1e-6)
    # Conjugate gradients amplify the rounding of float32, and here no more than there.
    errors = [(step(True, closed)[0] - expected).norm() for closed in (True, False)]
    assert errors[0] < 2 * errors[1]


def test_rejected_and_impossible_steps_leave_the_parameters_alone() -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (8,))
    data = samples(policy, 400)
    before = parameters_to_vector(policy.parameters()).clone()
    parts = (policy.mean, policy.log_std, data["observation"], data["action"])
    rejected = gaussian_trpo_step(*parts, data["advantage"], TRPOConfig(accept_ratio=1e6))
    impossible = gaussian_trpo_step(*parts, torch.zeros(400, 1), TRPOConfig())
    assert not rejected.accepted
    assert not impossible.accepted
    with pytest.raises(ValueError, match="non-finite advantages"):
        gaussian_trpo_step(*parts, torch.full((400, 1), torch.nan), TRPOConfig())
    assert torch.equal(parameters_to_vector(policy.parameters()), before)


def test_shapes_that_do_not_fit_are_named() -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (8,))
    data = samples(policy, 40)
    before = parameters_to_vector(policy.parameters()).clone()
    parts = {"log_std": policy.log_std, "inputs": data["observation"]}
    parts |= {"action": data["action"], "advantage": data["advantage"]}
    for name, wrong in (
        ("action", data["action"][:, :1]),
        ("advantage", data["advantage"][:1]),
        ("advantage", data["advantage"][:, 0]),
        ("inputs", data["observation"][None]),
        ("log_std", policy.log_std[:1]),
    ):
        with pytest.raises(ValueError, match=f"gaussian_trpo_step: {name} has shape .*, expected"):
            gaussian_trpo_step(policy.mean, config=TRPOConfig(), **{**parts, name: wrong})
    assert torch.equal(parameters_to_vector(policy.parameters()), before)


def test_other_networks_are_refused() -> None:
    linear = nn.Linear(3, 3)
    assert is_tanh_network(nn.Sequential(linear))
    assert is_tanh_network(nn.Sequential(linear, nn.Tanh(), linear))
    others = [
        linear,
        nn.Sequential(),
        nn.Sequential(linear, nn.Tanh()),
        nn.Sequential(linear, nn.ReLU(), linear),
        nn.Sequential(linear, linear, linear),
        nn.Sequential(nn.Linear(3, 3, bias=False)),
    ]
    for network in others:
        assert not is_tanh_network(network)
    x = torch.zeros(4, 3)
    with pytest.raises(ValueError, match="use trpo_step"):
        gaussian_trpo_step(nn.Sequential(linear, nn.ReLU(), linear), x[0], x, x, x, TRPOConfig())


@pytest.mark.parametrize("name", ["mean.0.weight", "log_std"])
def test_frozen_parameters_are_refused(name: str) -> None:
    policy = GaussianPolicy(3, 2, (8,))
    data = samples(policy, 40)
    policy.get_parameter(name).requires_grad_(False)
    before = parameters_to_vector(policy.parameters()).clone()
    with pytest.raises(ValueError, match=f"{name.removeprefix('mean.')} is frozen; use trpo_step"):
        closed_form_step(policy, data, TRPOConfig())
    assert torch.equal(parameters_to_vector(policy.parameters()), before)
