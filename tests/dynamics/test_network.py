from __future__ import annotations

import pytest
import torch

from torchrl_l1.dynamics import (
    ControlAffineDynamics,
    EnsembleDynamics,
    make_dynamics,
    network,
)
from torchrl_l1.planning import PlanningNetwork, resolve_precision


def fitted(form: str = "nonlinear", head: str = "deterministic", hidden=(32, 24)):
    torch.manual_seed(0)
    model = make_dynamics(3, 2, form, hidden=hidden, members=4, activation="silu", head=head)
    model.fit_statistics(
        torch.randn(50, 3) * torch.tensor([1.0, 20.0, 0.01]) + torch.tensor([0.0, 5.0, 1.0]),
        torch.randn(50, 2) * 3 + 1,
        torch.randn(50, 3) - 0.5,
    )
    return model


def raw_inputs(model: EnsembleDynamics, rows: int = 9) -> tuple[torch.Tensor, torch.Tensor]:
    scale = torch.tensor([1.0, 20.0, 0.01])
    return torch.randn(rows, 3) * scale + torch.tensor([0.0, 5.0, 1.0]), torch.randn(rows, 2)


@pytest.mark.parametrize("form", ["nonlinear", "affine"])
@pytest.mark.parametrize("head", ["deterministic", "gaussian"])
@pytest.mark.parametrize("hidden", [(16,), (32, 24), (16, 16, 16)])
def test_is_the_ensemble_that_it_was_copied_from(form, head, hidden):
    model = fitted(form, head, hidden)
    model.set_elites([3, 1])
    network = PlanningNetwork.from_dynamics(model)
    assert network.members == 2
    x, u = raw_inputs(model)
    with torch.no_grad():
        mean, std = model.member_distribution(x, u)
        inputs = torch.cat([x, u], -1)
        for place, member in enumerate((1, 3)):
            change = network.change(inputs, place) * network.change_std + network.change_mean
            torch.testing.assert_close(change, mean[member], rtol=1e-4, atol=1e-4)
            if head == "gaussian":
                spread = network.standard_deviation(network.raw(inputs, place))
                torch.testing.assert_close(
                    spread * network.change_std, std[member], rtol=1e-4, atol=1e-4
                )


@pytest.mark.parametrize("form", ["nonlinear", "affine"])
def test_an_entry_that_never_varied_costs_no_digits(form):
    model = fitted(form)
    x, u = raw_inputs(model)
    x[:, 1] = 1e5
    model.fit_statistics(x, u, torch.randn_like(x))
    network = PlanningNetwork.from_dynamics(model)
    with torch.no_grad():
        mean, _ = model.member_distribution(x, u)
    change = network.change(torch.cat([x, u], -1), 2) * network.change_std + network.change_mean
    torch.testing.assert_close(change, mean[2], rtol=1e-4, atol=1e-4)


def test_does_not_follow_its_model():
    model = fitted()
    network = PlanningNetwork.from_dynamics(model)
    inputs = torch.cat(raw_inputs(model), -1)
    before = network.change(inputs, 0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(2)
        model.change_normalizer.std.mul_(3)
    torch.testing.assert_close(network.change(inputs, 0), before, rtol=0, atol=0)
    assert not torch.equal(network.change_std, model.change_normalizer.std)
    assert not before.requires_grad


@pytest.mark.parametrize("form", ["nonlinear", "affine"])
def test_hidden_layers_in_bfloat16(form):
    model = fitted(form, hidden=(64, 64, 64))
    inputs = torch.cat(raw_inputs(model, 200), -1)
    exact = PlanningNetwork.from_dynamics(model).change(inputs, 0)
    network = PlanningNetwork.from_dynamics(model, "bfloat16")
    dtypes = [weight.dtype for weight in network.weights]
    output = torch.float32 if form == "affine" else torch.bfloat16
    assert dtypes == [torch.float32, torch.bfloat16, torch.bfloat16, output]
    rounded = network.change(inputs, 0)
    assert rounded.dtype == torch.float32
    error = (rounded - exact).square().mean().sqrt() / exact.std()
    assert 0 < error < 0.02


def test_precision_is_chosen_by_what_the_processor_can(monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict, raising=False)
    assert resolve_precision("auto") == "float32"
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": True})
    assert resolve_precision("auto") == "bfloat16"
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    for faster, chosen in ((True, "bfloat16"), (False, "float32")):
        monkeypatch.setattr(network, "_multiplies_bfloat16_faster", lambda faster=faster: faster)
        assert resolve_precision("auto") == chosen
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": True})
    assert resolve_precision("auto", "meta") == "float32"
    assert resolve_precision("auto", "cpu", 64) == "float32"
    assert resolve_precision("bfloat16", "cpu", 64) == "bfloat16"
    assert resolve_precision("float32") == "float32"
    with pytest.raises(ValueError, match=r"precision must be .* got 'float16'"):
        resolve_precision("float16")


def test_the_faster_product_is_found(monkeypatch):
    network._multiplies_bfloat16_faster.cache_clear()
    clock = iter(range(10**6))
    monkeypatch.setattr(network, "perf_counter", lambda: next(clock) * 1.0)
    assert not network._multiplies_bfloat16_faster()  # both take one tick
    network._multiplies_bfloat16_faster.cache_clear()


@pytest.mark.parametrize("form", [EnsembleDynamics, ControlAffineDynamics])
def test_a_class_that_predicts_in_another_way_is_refused(form: type[EnsembleDynamics]) -> None:
    class Periodic(form):  # type: ignore[misc, valid-type]
        def network_inputs(self, inputs: torch.Tensor) -> torch.Tensor:
            read: torch.Tensor = super().network_inputs(inputs)
            return read.sin()

    class Renamed(form):  # type: ignore[misc, valid-type]
        """The same in all that it predicts."""

    model = Renamed(3, 2, hidden=(4,))
    for same in (model, torch.compile(model, backend="eager")):
        assert PlanningNetwork.from_dynamics(same).members == 5
    with pytest.raises(TypeError, match="Periodic has a network_inputs of its own"):
        PlanningNetwork.from_dynamics(Periodic(3, 2, hidden=(4,)))
