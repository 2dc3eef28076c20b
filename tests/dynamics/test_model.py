from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_l1.dynamics import (
    ControlAffineDynamics,
    EnsembleDynamics,
    EnsembleModelEnv,
    GaussianHead,
    imagine,
    make_dynamics,
)
from torchrl_l1.dynamics.ensemble import ACTIVATIONS

FORMS = ["nonlinear", "affine"]


def make(
    form: str = "nonlinear", members: int = 5, head: str = "deterministic"
) -> EnsembleDynamics:
    options = {"members": members, "hidden": (8, 6), "activation": "tanh", "head": head}
    model = make_dynamics(3, 2, form, **options).double()
    data = torch.randn(50, 8).double()
    model.fit_statistics(data[:, :3], data[:, 3:5], data[:, 5:])
    return model


@pytest.mark.parametrize("form", FORMS)
@given(chosen=st.sets(st.integers(0, 4), min_size=1), seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_means_are_over_the_elites(form: str, chosen: set[int], seed: int) -> None:
    torch.manual_seed(seed)
    model = make(form, head="gaussian")
    order = torch.tensor(sorted(chosen))[torch.randperm(len(chosen))]
    model.set_elites(order)
    assert model.elites.tolist() == sorted(chosen)
    x, u, other = torch.randn(4, 3).double(), torch.randn(4, 2).double(), torch.randn(4, 2).double()

    def mean(action: torch.Tensor) -> torch.Tensor:
        return sum(model.member_change(x, action, member) for member in chosen) / len(chosen)

    torch.testing.assert_close(model.mean_change(x, u), mean(u))
    value, jacobian = model.value_and_jacobian(x, u)
    torch.testing.assert_close(value, mean(u))
    expected = torch.autograd.functional.jacobian(lambda a: mean(a).sum(0), u).permute(1, 0, 2)
    torch.testing.assert_close(jacobian, expected)
    tangent = value + (jacobian @ (other - u)[..., None])[..., 0]
    torch.testing.assert_close(model.taylor_remainder(x, u, other), mean(other) - tangent)
    assert model.member_changes(x, u).shape[0] == 5


@pytest.mark.parametrize("form", FORMS)
def test_all_as_elites_changes_no_bit(form: str) -> None:
    torch.manual_seed(0)
    model = make(form).float()
    named = deepcopy(model)
    named.set_elites([4, 2, 0, 1, 3])
    x, u = torch.randn(20, 3), torch.randn(20, 2)
    expected = model.member_changes(x, u).mean(0)
    for one in (model, named):
        assert torch.equal(one.mean_change(x, u), expected)
        value, jacobian = one.value_and_jacobian(x, u)
        assert torch.equal(value, model.value_and_jacobian(x, u)[0])
        assert torch.equal(jacobian, model.value_and_jacobian(x, u)[1])


@pytest.mark.parametrize(
    ("chosen", "message"),
    [([], "one or more members"), ([1, 1], "each once"), ([5], "0 to 4"), ([-1, 2], "0 to 4")],
)
def test_impossible_elites_are_named(chosen: list[int], message: str) -> None:
    model = make()
    with pytest.raises(ValueError, match=message):
        model.set_elites(chosen)
    assert model.elites.tolist() == [0, 1, 2, 3, 4]


def test_elites_survive_a_checkpoint_and_older_ones_have_all() -> None:
    torch.manual_seed(0)
    model, other = make(), make()
    model.set_elites([3, 1])
    other.set_elites([0, 2, 4])
    state = model.state_dict()
    other.load_state_dict(state)
    x, u = torch.randn(4, 3).double(), torch.randn(4, 2).double()
    assert other.elites.tolist() == [1, 3]
    assert torch.equal(other.mean_change(x, u), model.mean_change(x, u))
    other.set_elites([0])
    assert model.elites.tolist() == state["elites"].tolist() == [1, 3]
    del state["elites"]
    nested = torch.nn.ModuleDict({"inner": other})
    nested.load_state_dict({f"inner.{name}": value for name, value in state.items()})
    assert other.elites.tolist() == [0, 1, 2, 3, 4]
    assert "elites" not in state


@pytest.mark.parametrize("elites", [[0, 1, 2, 3, 4], [1, 3]])
def test_imagination_draws_from_the_elites(elites: list[int]) -> None:
    torch.manual_seed(0)
    model = EnsembleDynamics(1, 1, members=5, hidden=())
    with torch.no_grad():
        model.network.weights[0].zero_()
        model.network.biases[0][:, 0, 0] = torch.arange(5.0)  # each member adds its index
    model.set_elites(elites)
    model.box.fit(torch.tensor([[-1e3], [1e3]]))
    bound = torch.ones(1)
    start = torch.zeros(1, 1)
    path = imagine(model, lambda x: x, lambda x, u, y: y[:, 0], start, 60, -bound, bound)
    steps = path["next", "observation"] - path["observation"]
    assert set(steps.flatten().int().tolist()) == set(elites)
    env = EnsembleModelEnv(
        model,
        lambda x, u, y: y[..., 0],
        lambda count: torch.zeros(count, 1),
        -1.0,
        1.0,
        (1,),
        "random_member",
    )
    path = env.rollout(60)
    steps = path["next", "observation"] - path["observation"]
    assert set(steps.flatten().int().tolist()) == set(elites)


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
@pytest.mark.parametrize("hidden", [(), (9,), (9, 8, 7)])
@pytest.mark.parametrize("form", ["nonlinear", "affine"])
@torch.no_grad()
def test_the_expansion_is_remainder_and_tangent_of_either_point(
    form: str, hidden: tuple[int, ...], activation: str
) -> None:
    torch.manual_seed(0)
    kind = EnsembleDynamics if form == "nonlinear" else ControlAffineDynamics
    model = kind(3, 2, 4, hidden, activation, head=GaussianHead(3)).double()
    data = torch.randn(3, 50, 3, dtype=torch.float64)
    model.fit_statistics(data[0] + 1, 2 * data[1, :, :2] - 0.5, 0.3 * data[2])
    model.set_elites([0, 2, 3])
    observation = torch.randn(2, 5, 3, dtype=torch.float64)
    u_bar, candidate, tested = torch.randn(3, 2, 5, 2, dtype=torch.float64)
    moved = torch.tensor([[0, 1, 0, 0, 1], [1, 1, 0, 0, 0]]).bool().unsqueeze(-1)
    remainder, tangent_at = model.expansion(observation, u_bar, candidate, tested)
    found = (remainder, *tangent_at(moved), *tangent_at(~moved))
    expected = [
        model.taylor_remainder(observation, u_bar, tested),
        *model.value_and_jacobian(observation, torch.where(moved, candidate, u_bar)),
        *model.value_and_jacobian(observation, torch.where(moved, u_bar, candidate)),
    ]
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-13, rtol=1e-12)


@torch.no_grad()
def test_the_expansion_is_blind_to_what_was_not_selected() -> None:
    torch.manual_seed(0)
    model = make("nonlinear")
    x, u = torch.randn(4, 3).double(), torch.randn(4, 2).double()
    remainder, tangent_at = model.expansion(x, u, torch.full_like(u, torch.nan), u)
    assert not remainder.any()
    for value in tangent_at(torch.zeros(4, 1, dtype=torch.bool)):
        assert value.isfinite().all()


@pytest.mark.parametrize("kind", [torch.bool, torch.float32])
def test_a_mask_of_elites_is_no_list_of_them(kind: torch.dtype) -> None:
    model = EnsembleDynamics(3, 2, members=2, hidden=(4,))
    for mask in (torch.tensor([1, 0]).to(kind), torch.tensor([1, 0]).to(kind).tolist()):
        with pytest.raises(ValueError, match="must be indices of members"):
            model.set_elites(mask)
    assert model.elites.tolist() == [0, 1]


def test_other_processes_see_new_elites() -> None:
    model = EnsembleDynamics(3, 2, members=3, hidden=(4,))
    model.set_elites([0, 1])
    shared = model.elites.share_memory_()
    model.set_elites([1, 2])
    assert shared.tolist() == [1, 2] and model.elites.is_shared()
