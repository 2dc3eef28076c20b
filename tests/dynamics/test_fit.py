from __future__ import annotations

import warnings
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_l1.dynamics import (
    EnsembleDynamics,
    EnsembleDynamicsLoss,
    FitConfig,
    Head,
    Transitions,
    evaluate_members,
    fit_dynamics,
    fit_ensemble,
    make_dynamics,
)
from torchrl_l1.dynamics.fit import fit_to_transitions

from .conftest import transitions


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


@pytest.mark.parametrize("fraction", [0.0, 1.5])
def test_the_learning_rate_never_rises(fraction: float) -> None:
    with pytest.raises(ValueError, match=r"final_learning_rate_fraction must be in \(0, 1\]"):
        FitConfig(final_learning_rate_fraction=fraction)


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
    with pytest.raises(ValueError, match="1 training and 0 validation"):
        fitted("action", FitConfig(), transitions(10)[1:2])
    data = transitions(10)
    data["validation"][:] = True
    with pytest.raises(ValueError, match="0 training and 10 validation"):
        fitted("action", FitConfig(), data)


class RecordingHead(Head):
    """Keeps the targets ``(E, B, dim)`` of each gradient step."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[torch.Tensor] = []

    def out_features(self, dim: int) -> int:
        return dim

    def loss(self, raw: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        if raw.requires_grad:
            self.seen.append(target)
        return (raw - target).square().mean(-1)

    def standard_deviation(self, raw: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(raw)


def fit_once(
    model: EnsembleDynamics, data: TensorDict, config: FitConfig, sgd: bool = False
) -> float:
    buffer = ReplayBuffer(storage=LazyTensorStorage(len(data)))
    buffer.extend(data)
    kind = torch.optim.SGD if sgd else torch.optim.Adam
    optimizer = kind(model.parameters(), lr=config.learning_rate)
    return fit_ensemble(model, buffer, config, optimizer).validation_loss


@pytest.mark.parametrize(("bootstrap", "share"), [(True, 0.632), (False, 1.0)])
def test_a_bootstrapped_member_trains_on_two_thirds(bootstrap: bool, share: float) -> None:
    torch.manual_seed(0)
    head = RecordingHead()
    model = EnsembleDynamics(2, 1, members=3, hidden=(4,), head=head)
    data = transitions(2500)
    config = FitConfig(batch_size=100, max_epochs=2, bootstrap=bootstrap)

    def samples() -> list[set[float]]:
        head.seen.clear()
        fit_once(model, data, config)
        steps = torch.cat(head.seen, 1)
        assert steps.shape[1] == 2 * 2000
        first, second = (steps[:, :2000], steps[:, 2000:])
        # Both epochs go through the same resample, repetitions included.
        assert torch.equal(first.sort(1).values, second.sort(1).values)
        return [set(member[:, 0].tolist()) for member in first]

    members, again = samples(), samples()
    for member, other in zip(members + again, members[1:] + again + members[:1], strict=True):
        assert len(member) / 2000 == pytest.approx(share, abs=0.03)
        # Resamples are independent, of members and of fits.
        assert len(member & other) / 2000 == pytest.approx(share**2, abs=0.04)


@pytest.mark.parametrize("form", ["nonlinear", "affine"])
def test_weight_decay_pulls_each_layer_by_its_coefficient(form: str) -> None:
    data = transitions(50)
    coefficients = [0.3, 0.0, 0.7]
    fits = []
    for weight_decay in ([], coefficients):
        torch.manual_seed(0)
        model = make_dynamics(2, 1, form, hidden=(5, 4), members=2, activation="tanh")
        before = [weight.detach().clone() for weight in model.network.weights]
        config = FitConfig(0.1, max_gradient_steps=1, weight_decay=weight_decay)
        fit_once(model, data, config, sgd=True)
        fits.append([*model.network.weights, *model.network.biases])
    pulls = [0.1 * c * weight for c, weight in zip(coefficients, before, strict=True)]
    for without, decayed, pull in zip(*fits, [*pulls, 0, 0, 0], strict=True):
        torch.testing.assert_close(decayed, without - pull)


def test_the_weight_penalty_is_that_of_the_whole_data_in_hidden_layers() -> None:
    weights = []
    for penalty in (0.0, 6.0):
        torch.manual_seed(0)
        model = EnsembleDynamics(2, 1, members=2, hidden=(5, 4))
        before = [weight.detach().clone() for weight in model.network.weights]
        config = FitConfig(0.1, batch_size=10, max_gradient_steps=1, weight_penalty=penalty)
        fit_once(model, transitions(50), config, sgd=True)  # 40 of them to train on
        weights.append(list(model.network.weights))
    pulls = [0.1 * 6.0 / 40 * weight for weight in before[:-1]] + [torch.zeros(())]
    for without, penalised, pull in zip(*weights, pulls, strict=True):
        torch.testing.assert_close(penalised, without - pull)


class RecordingSGD(torch.optim.SGD):
    """Keeps the learning rate of each step."""

    def __init__(self, model: EnsembleDynamics) -> None:
        super().__init__(model.parameters(), lr=1.0)
        self.rates: list[float] = []

    def step(self, closure: None = None) -> None:  # type: ignore[override]
        self.rates += [group["lr"] for group in self.param_groups]
        super().step(closure)


@pytest.mark.parametrize(("most", "steps"), [(100, 6), (4, 4)])
def test_the_learning_rate_falls_in_a_line_over_the_steps_of_a_fit(most: int, steps: int) -> None:
    model = EnsembleDynamics(2, 1, members=2, hidden=(4,))
    optimizer = RecordingSGD(model)
    config = FitConfig(1e-3, 0.4, batch_size=20, max_epochs=3, patience=9, max_gradient_steps=most)
    data = transitions(50)  # 40 of them to train on, two batches
    for _ in range(2):
        fit_ensemble(model, data, config, optimizer)
    expected = [1e-3 * (1 - 0.6 * step / steps) for step in range(steps)]
    assert optimizer.rates == pytest.approx(2 * expected)


def test_the_best_members_are_kept_as_elites() -> None:
    torch.manual_seed(0)
    data = transitions(200)
    for head in ("deterministic", "gaussian"):
        model = make_dynamics(2, 1, hidden=(8,), members=5, head=head)
        reported = fit_once(model, data, FitConfig(max_epochs=3, batch_size=40, elites=2))
        losses = evaluate_members(EnsembleDynamicsLoss(model), data[data["validation"]])
        assert model.elites.tolist() == sorted(losses.argsort()[:2].tolist())
        assert reported == pytest.approx(losses.mean().item(), rel=1e-5)
        kept = model.elites.clone()
        fit_once(model, data, FitConfig(max_epochs=1))
        assert torch.equal(model.elites, kept)


def test_a_fit_by_default_draws_its_shuffles_and_nothing_else() -> None:
    data = transitions(100)
    model = EnsembleDynamics(2, 1, members=3, hidden=(4,))
    torch.manual_seed(1)
    fit_once(model, data, FitConfig(max_epochs=2))
    after = torch.get_rng_state()
    torch.manual_seed(1)
    for _ in range(2 * 3):
        torch.randperm(80)
    assert torch.equal(torch.get_rng_state(), after)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"weight_decay": [0.1]}, "each of the model's 2 layers, the output layer included, got 1"),
        ({"elites": 3}, "fit.elites is 3, but the model has 2 members"),
    ],
)
def test_settings_that_do_not_fit_the_model_leave_it_alone(
    settings: dict[str, object], message: str
) -> None:
    model = EnsembleDynamics(2, 1, members=2, hidden=(4,))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    with pytest.raises(ValueError, match=message):
        fit_once(model, transitions(50), FitConfig(**settings))  # type: ignore[arg-type]
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"weight_decay": [0.1, -1.0]}, r"fit.weight_decay\[1\] must be finite and not negative"),
        ({"weight_decay": [float("nan")]}, r"fit.weight_decay\[0\] must be finite"),
        ({"elites": 0}, "fit.elites must be at least 1"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FitConfig(**settings)  # type: ignore[arg-type]


def test_a_buffer_with_a_flag_is_fitted_as_ever() -> None:
    """What the algorithms do: reading the buffer changes neither rows nor random numbers."""
    data = transitions(200)
    mask = data["validation"]
    rows = data.select("observation", "action", ("next", "observation"))
    weights = []
    for read in (False, True):
        torch.manual_seed(0)
        model = EnsembleDynamics(2, 1, members=2, hidden=(8,))
        optimizer = torch.optim.Adam(model.parameters())
        config = FitConfig(max_epochs=3, batch_size=40)
        if read:
            buffer = ReplayBuffer(storage=LazyTensorStorage(len(data)))
            buffer.extend(data)
            fit_ensemble(model, buffer, config, optimizer)
        else:
            plain = Transitions(rows, mask, torch.zeros_like(mask), 0)
            fit_to_transitions(model, plain, config, optimizer)
        weights.append(torch.cat([value.flatten() for value in model.state_dict().values()]))
    assert torch.equal(*weights)


def test_a_model_of_ones_own_data() -> None:
    data = transitions(1000).double().exclude("validation")
    settings = {"hidden": (32,), "members": 3, "activation": "tanh", "max_gradient_steps": 600}
    state = torch.get_rng_state()
    model = fit_dynamics(data, **settings, validation_fraction=0.2, learning_rate=3e-3, seed=4)
    assert torch.equal(torch.get_rng_state(), state)
    assert not model.training and model.quality.validation == 200
    assert model.quality.warning == "" and min(model.quality.explained) > 0.98
    _, jacobian = model.value_and_jacobian(torch.zeros(1, 2), torch.zeros(1, 1))
    torch.testing.assert_close(jacobian, torch.tensor([[[0.5], [20.0]]]), rtol=0.15, atol=0.05)
    again = fit_dynamics(data, **settings, validation_fraction=0.2, learning_rate=3e-3, seed=4)
    for one, other in zip(model.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)


def test_actions_that_say_nothing_make_no_model_for_l1() -> None:
    torch.manual_seed(0)
    data = transitions(60, noise=50.0).exclude("validation")
    with pytest.warns(UserWarning, match="the model is too poor for L1: its members differ by"):
        model = fit_dynamics(data, hidden=(32,), max_epochs=3)
    assert model.quality.warning in str(model.quality)


def test_a_setting_that_does_not_exist_is_named() -> None:
    with pytest.raises(TypeError, match=r"no setting 'layers': those of the model .*hidden.*fit "):
        fit_dynamics(transitions(10), layers=3)
    with pytest.raises(ValueError, match="names must hold one for each of the observation's 2"):
        fit_dynamics(transitions(10), names=["x"])


def test_data_of_another_width_leave_the_model_alone() -> None:
    model = EnsembleDynamics(3, 1, members=2, hidden=(4,))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    with pytest.raises(ValueError, match=r"takes observations of width 3 .* the data have 2 and 1"):
        fit_once(model, transitions(50), FitConfig())
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def test_an_optimizer_of_another_model_is_refused() -> None:
    data, model = transitions(50), EnsembleDynamics(2, 1, members=2, hidden=(8,))
    copy, before = deepcopy(model), deepcopy(model.state_dict())
    # What an optimizer was made for is not what a copy of it consists of: it would learn nothing.
    with pytest.raises(ValueError, match="the optimizer holds no weights of this model"):
        fit_ensemble(copy, data, FitConfig(), torch.optim.Adam(model.parameters()))
    for name, value in copy.state_dict().items():
        assert torch.equal(value, before[name])


def test_a_seeded_fit_leaves_the_generators_of_other_devices_alone(monkeypatch) -> None:
    seeds: list[int] = []
    monkeypatch.setattr(torch.cuda, "manual_seed_all", seeds.append)
    settings = {"hidden": (4,), "members": 2, "max_epochs": 1}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the model is too poor")
        fit_dynamics(transitions(100), **settings)
    assert not seeds
