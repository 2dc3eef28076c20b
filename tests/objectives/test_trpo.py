from __future__ import annotations

import math
from copy import deepcopy

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.distributions import Normal, kl_divergence
from torch.nn.utils import parameters_to_vector
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor

from torchrl_l1.algorithms.policy import GaussianPolicy, make_actor
from torchrl_l1.objectives import TRPOConfig, conjugate_gradient, gaussian_trpo_step, trpo_step
from torchrl_l1.objectives.gaussian_trpo import _GaussianProblem
from torchrl_l1.objectives.trpo import _AutogradProblem, take_step


@given(size=st.integers(1, 12), seed=st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_conjugate_gradient_solves_positive_definite_systems(size: int, seed: int) -> None:
    torch.manual_seed(seed)
    root = torch.randn(size, size).double()
    matrix = root @ root.T + torch.eye(size).double()
    b = torch.randn(size).double()
    solution = conjugate_gradient(lambda v: matrix @ v, b, iterations=3 * size, tolerance=1e-24)
    torch.testing.assert_close(solution, torch.linalg.solve(matrix, b), rtol=1e-6, atol=1e-8)


def batch(actor: torch.nn.Module, size: int = 400) -> TensorDict:
    data = TensorDict({"observation": torch.randn(size, 3)}, batch_size=[size])
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        data = actor(data)
    # Acting along the first observation pays.
    data["advantage"] = data["action"][:, :1] * data["observation"][:, :1]
    return data.select("observation", "action", "advantage")


def test_fisher_product_is_that_of_a_gaussian() -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (), std=0.5).double()
    actor = make_actor(policy)
    data = batch(actor.float(), 50)
    policy.double()
    data = data.double()
    product = _AutogradProblem(actor, data, TRPOConfig(fisher_fraction=1.0)).fisher_product
    # Mean linear in x: the block of each output's weights is E[x x^T] / std^2, bias included.
    x = torch.cat([data["observation"], torch.ones(50, 1).double()], dim=1)
    second_moment = x.T @ x / 50 / 0.25
    names = [name for name, _ in policy.named_parameters()]
    sizes = {name: p.numel() for name, p in policy.named_parameters()}
    offsets = {n: sum(sizes[k] for k in names[:i]) for i, n in enumerate(names)}
    weight, bias, log_std = offsets["mean.0.weight"], offsets["mean.0.bias"], offsets["log_std"]
    dense = torch.stack([product(row) for row in torch.eye(sum(sizes.values())).double()])
    first_output = [weight, weight + 1, weight + 2, bias]
    torch.testing.assert_close(dense[first_output][:, first_output], second_moment)
    torch.testing.assert_close(dense[log_std, log_std], torch.tensor(2.0).double())


def test_step_improves_the_surrogate_within_the_trust_region() -> None:
    torch.manual_seed(0)
    actor = make_actor(GaussianPolicy(3, 2, (16,), std=0.7))
    data = batch(actor)
    with torch.no_grad():
        before = actor.get_dist(data)
        log_prob = before.log_prob(data["action"])
    report = trpo_step(actor, data, TRPOConfig(max_kl=0.02, fisher_fraction=1.0))
    with torch.no_grad():
        after = actor.get_dist(data)
        gain = ((after.log_prob(data["action"]) - log_prob).exp() - 1) * data["advantage"][:, 0]
    assert report.accepted
    assert gain.mean().item() == pytest.approx(report.improvement, rel=1e-3)
    assert gain.mean() > 0
    assert kl_divergence(before, after).mean().item() == pytest.approx(report.kl, rel=1e-3)
    assert 0.005 < report.kl <= 0.02


def test_repeated_steps_find_the_rewarded_action() -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (16,), std=0.5)
    actor = make_actor(policy)
    for _ in range(30):
        assert trpo_step(actor, batch(actor), TRPOConfig(max_kl=0.05)).kl <= 0.05
    probe = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    first_action = policy(probe)[0][:, 0]
    assert first_action[0] > 0.3
    assert first_action[1] < -0.3


def test_rejected_step_leaves_the_parameters_alone() -> None:
    torch.manual_seed(0)
    actor = make_actor(GaussianPolicy(3, 2, (8,)))
    data = batch(actor)
    before = parameters_to_vector(actor.parameters()).clone()
    report = trpo_step(actor, data, TRPOConfig(accept_ratio=1e6))
    assert not report.accepted
    assert torch.equal(parameters_to_vector(actor.parameters()), before)


def test_no_gradient_no_step() -> None:
    actor = make_actor(GaussianPolicy(3, 2, (8,)))
    data = batch(actor)
    data["advantage"] = torch.zeros(400, 1)
    before = parameters_to_vector(actor.parameters()).clone()
    assert not trpo_step(actor, data, TRPOConfig()).accepted
    assert torch.equal(parameters_to_vector(actor.parameters()), before)


def test_broken_advantages_are_refused() -> None:
    actor = make_actor(GaussianPolicy(3, 2, (8,)))
    data = batch(actor)
    data["advantage"][3] = float("nan")
    with pytest.raises(ValueError, match="non-finite advantages"):
        trpo_step(actor, data, TRPOConfig())


@pytest.mark.parametrize("closed_form", [False, True])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_curvature_of_no_number_is_no_step_and_is_told(
    closed_form: bool, value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (4,), std=0.7)
    data = batch(make_actor(policy))
    before = parameters_to_vector(policy.parameters()).clone()
    problem = _GaussianProblem if closed_form else _AutogradProblem
    monkeypatch.setattr(problem, "fisher_product", lambda self, v: torch.full_like(v, value))
    if closed_form:
        columns = (data[name] for name in ("observation", "action", "advantage"))
        report = gaussian_trpo_step(policy.mean, policy.log_std, *columns, TRPOConfig())
    else:
        report = trpo_step(make_actor(policy), data, TRPOConfig())
    assert not report.accepted and math.isnan(report.kl)
    assert torch.equal(parameters_to_vector(policy.parameters()), before)


def test_a_step_all_of_whose_candidates_are_no_numbers_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (4,), std=0.7)
    actor = make_actor(policy)
    data = batch(actor)
    before = parameters_to_vector(policy.parameters()).clone()
    nothing = torch.tensor(math.nan)
    monkeypatch.setattr(_AutogradProblem, "evaluate", lambda self: (nothing, nothing))
    report = trpo_step(actor, data, TRPOConfig())
    assert not report.accepted and math.isnan(report.kl)
    assert torch.equal(parameters_to_vector(policy.parameters()), before)


def test_a_density_per_entry_of_the_action_is_refused() -> None:
    # Rows of densities and rows of advantages would make a table, and a step on its mean.
    actor = ProbabilisticActor(
        TensorDictModule(GaussianPolicy(3, 1, (4,)), ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=Normal,
    )
    data = batch(make_actor(GaussianPolicy(3, 1, (4,))))
    before = parameters_to_vector(actor.parameters()).clone()
    with pytest.raises(ValueError, match=r"Normal gives .* \(400, 1\) .* IndependentNormal"):
        trpo_step(actor, data, TRPOConfig())
    assert torch.equal(parameters_to_vector(actor.parameters()), before)


def test_samples_that_carry_a_graph_are_samples_all_the_same() -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (4,), std=0.7)
    data = TensorDict({"observation": torch.randn(400, 3)}, batch_size=[400])
    with set_exploration_type(ExplorationType.RANDOM):
        data = make_actor(policy)(data)  # drawn by reparametrisation
    data["advantage"] = data["action"][:, :1] * data["observation"][:, :1]
    assert data["action"].requires_grad
    copy = deepcopy(policy)
    expected = trpo_step(make_actor(copy), data.detach(), TRPOConfig())
    assert trpo_step(make_actor(policy), data, TRPOConfig()) == expected
    found, other = (parameters_to_vector(one.parameters()) for one in (policy, copy))
    assert torch.equal(found, other)


@pytest.mark.parametrize("closed_form", [False, True])
def test_the_scale_of_the_advantages_does_not_matter(closed_form: bool) -> None:
    torch.manual_seed(0)
    start = GaussianPolicy(3, 2, (4,), std=0.7).double()
    data = batch(make_actor(start.float())).double()
    steps = []
    for scale in (1.0, 1e-2, 1e-4, 1e-8, 1e-180):
        policy, own = deepcopy(start).double(), data.clone()
        own["advantage"] *= scale
        if closed_form:
            columns = (own[name] for name in ("observation", "action", "advantage"))
            report = gaussian_trpo_step(policy.mean, policy.log_std, *columns, TRPOConfig())
        else:
            report = trpo_step(make_actor(policy), own, TRPOConfig())
        assert report.accepted
        steps.append(parameters_to_vector(policy.parameters()))
    for step in steps[1:]:
        torch.testing.assert_close(step, steps[0], rtol=1e-6, atol=1e-8)


def test_a_parameter_that_the_distribution_does_not_use_stays_as_it_is() -> None:
    torch.manual_seed(0)
    alone, beside = GaussianPolicy(3, 2, (4,), std=0.7), GaussianPolicy(3, 2, (4,), std=0.7)
    beside.load_state_dict(alone.state_dict())
    beside.value = torch.nn.Linear(3, 1)
    before = parameters_to_vector(beside.value.parameters()).clone()
    data = batch(make_actor(alone))
    assert trpo_step(make_actor(beside), data, TRPOConfig()).accepted
    trpo_step(make_actor(alone), data, TRPOConfig())
    for name, parameter in alone.named_parameters():
        torch.testing.assert_close(parameter, beside.get_parameter(name))
    assert torch.equal(parameters_to_vector(beside.value.parameters()), before)


def test_samples_in_rows_and_columns_are_those_in_one_row() -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (4,), std=0.7)
    data = batch(make_actor(policy))
    data["observation"][100:] *= 0.01  # the first row alone is not like the others
    with torch.no_grad():
        data["action"] = policy(data["observation"])[0] + 0.7 * torch.randn(400, 2)
    other = deepcopy(policy)
    expected = trpo_step(make_actor(policy), data, TRPOConfig())
    assert trpo_step(make_actor(other), data.reshape(4, 100), TRPOConfig()) == expected
    for name, parameter in policy.named_parameters():
        torch.testing.assert_close(parameter, other.get_parameter(name))


def test_a_step_needs_no_gradients_around_it() -> None:
    torch.manual_seed(0)
    policy = GaussianPolicy(3, 2, (4,), std=0.7)
    actor = make_actor(policy)
    data = batch(actor)
    with torch.no_grad():
        assert trpo_step(actor, data, TRPOConfig()).accepted
    policy.requires_grad_(False)
    with pytest.raises(ValueError, match="all parameters of the actor are frozen"):
        trpo_step(actor, data, TRPOConfig())
    with pytest.raises(KeyError, match=r"TRPO found no 'advantage' in the data, only .*action"):
        trpo_step(actor, data.exclude("advantage"), TRPOConfig())


class Parabola:
    """Surrogate ``g.x - cost |x|^2`` and divergence ``x'Fx / 2``, times a factor, around zero."""

    slope, fisher = torch.tensor([3.0, -1.0]).double(), torch.tensor([1.0, 4.0]).double()

    def __init__(self, cost: float, factor: float) -> None:
        self.parameters = [torch.zeros(2).double()]
        self.cost, self.factor = cost, factor

    def gradient(self) -> torch.Tensor:
        return self.slope

    def fisher_product(self, vector: torch.Tensor) -> torch.Tensor:
        return self.fisher * vector

    def evaluate(self) -> tuple[torch.Tensor, torch.Tensor]:
        (x,) = self.parameters
        gain = self.slope @ x - self.cost * x @ x
        return gain, self.factor * x @ self.fisher_product(x) / 2


@pytest.mark.parametrize("binding", ["surrogate", "divergence"])
@pytest.mark.parametrize("backtracks", [0, 1, 3])
def test_the_step_is_the_first_on_the_ray_that_keeps_both_conditions(
    binding: str, backtracks: int
) -> None:
    slope, fisher = Parabola.slope.numpy(), Parabola.fisher.numpy()
    max_kl, damping, accept_ratio = 0.02, 0.5, 0.3
    direction = slope / (fisher + damping)
    edge = np.sqrt(2 * max_kl / (direction @ ((fisher + damping) * direction))) * direction
    # Where candidate 0.81 times the edge would be the longest to pass, 0.8 is, and so on.
    longest = 1.01 * 0.8**backtracks
    cost = factor = 0.0
    if binding == "surrogate":
        cost = (1 - accept_ratio) * (slope @ edge) / (longest * edge @ edge)
    else:
        factor = max_kl / (longest**2 * edge @ (fisher * edge) / 2)
    problem = Parabola(cost, factor)
    config = TRPOConfig(max_kl=max_kl, damping=damping, accept_ratio=accept_ratio)
    report = take_step(problem, torch.ones(1), config)
    x = 0.8**backtracks * edge
    np.testing.assert_allclose(problem.parameters[0].numpy(), x, rtol=1e-9)
    assert report.accepted and report.backtracks == backtracks
    assert report.improvement == pytest.approx(slope @ x - cost * x @ x)
    assert report.kl == pytest.approx(factor * x @ (fisher * x) / 2)
