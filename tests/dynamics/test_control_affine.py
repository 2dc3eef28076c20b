from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_l1.control import ActionJacobian, L1Config, augment, init
from torchrl_l1.dynamics import (
    ControlAffineDynamics,
    EnsembleDynamics,
    EnsembleDynamicsLoss,
    FitConfig,
    evaluate_members,
    fit_ensemble,
    imagine,
    make_dynamics,
)

ACTIVATIONS = {"relu": torch.relu, "tanh": torch.tanh, "silu": torch.nn.functional.silu}


def make(
    n: int = 3, m: int = 2, dtype: torch.dtype = torch.float64, **options: object
) -> ControlAffineDynamics:
    """A model with statistics of data whose columns differ in scale, and random biases."""
    options = {"members": 3, "hidden": (8, 6), "activation": "tanh"} | options
    model = ControlAffineDynamics(n, m, **options).to(dtype)  # type: ignore[arg-type]
    for bias in model.network.biases:
        torch.nn.init.normal_(bias)
    data = torch.randn(50, 2 * n + m, dtype=dtype) * torch.logspace(-2, 2, 2 * n + m, dtype=dtype)
    data[:, 0] = 1.0  # a constant observation: the floor of the normaliser is in play
    model.fit_statistics(data[:, :n], data[:, n : n + m] + 3, data[:, n + m :])
    return model


def explicit_change(model: ControlAffineDynamics, x: Tensor, u: Tensor, member: int) -> Tensor:
    """One member at one sample, weight by weight, from the definition."""
    n, m = model.observation_dim, model.action_dim
    hidden = (x - model.observation_normalizer.mean) / model.observation_normalizer.std
    scaled = (u - model.action_normalizer.mean) / model.action_normalizer.std
    layers = list(zip(model.network.weights, model.network.biases, strict=True))
    for weight, bias in layers[:-1]:
        hidden = ACTIVATIONS[model.network.activation](weight[member].T @ hidden + bias[member, 0])
    weight, bias = layers[-1]
    raw = weight[member].T @ hidden + bias[member, 0]
    change = torch.empty_like(x)
    for row in range(n):
        total = raw[row]
        for column in range(m):
            total = total + raw[(1 + column) * n + row] * scaled[column]
        change[row] = total * model.change_normalizer.std[row] + model.change_normalizer.mean[row]
    return change


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("hidden", [(), (8,), (8, 6)])
def test_agrees_with_an_explicit_loop(activation: str, hidden: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    model = make(activation=activation, hidden=hidden)
    x, u = torch.randn(4, 3).double(), torch.randn(4, 2).double()
    expected = torch.stack(
        [
            torch.stack([explicit_change(model, x[i], u[i], member) for i in range(4)])
            for member in range(3)
        ]
    )
    torch.testing.assert_close(model.member_changes(x, u), expected)
    torch.testing.assert_close(model.mean_change(x, u), expected.mean(0))
    torch.testing.assert_close(model.value_and_jacobian(x, u)[0], expected.mean(0))
    for member in range(3):
        torch.testing.assert_close(model.member_change(x, u, member), expected[member])
    # Each member on its own batch, as in a fit.
    inputs = model.normalize_inputs(x, u)
    own = torch.stack([inputs.roll(member, 0) for member in range(3)])
    for member in range(3):
        torch.testing.assert_close(
            model.raw(own)[member], model.raw(inputs)[member].roll(member, 0)
        )


@given(
    n=st.integers(1, 6),
    m=st.integers(1, 4),
    batch=st.integers(1, 4),
    hidden=st.lists(st.integers(1, 9), min_size=0, max_size=3),
    activation=st.sampled_from(sorted(ACTIVATIONS)),
    seed=st.integers(0, 1000),
)
@settings(max_examples=15, deadline=None)
def test_derivatives_agree_with_forward_mode(
    n: int, m: int, batch: int, hidden: list[int], activation: str, seed: int
) -> None:
    torch.manual_seed(seed)
    model = make(n, m, hidden=hidden, activation=activation)
    x, u, other = (torch.randn(batch, width).double() for width in (n, m, m))
    expected = torch.func.vmap(torch.func.jacfwd(model.mean_change, argnums=1))(x, u)
    value, jacobian = model.value_and_jacobian(x, u)
    torch.testing.assert_close(value, model.mean_change(x, u), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(jacobian, expected, rtol=1e-10, atol=1e-10)
    step = (expected @ (other - u)[..., None])[..., 0]
    remainder = model.mean_change(x, other) - value - step
    # A difference of numbers that the floored statistics may have made large.
    atol = 1e-13 * max(1.0, value.abs().max().item(), step.abs().max().item())
    torch.testing.assert_close(model.taylor_remainder(x, u, other), remainder, rtol=0, atol=atol)


@given(
    n=st.integers(1, 5),
    m=st.integers(1, 4),
    seed=st.integers(0, 1000),
    weights=st.lists(st.floats(-5, 5), min_size=1, max_size=4),
    scale=st.floats(1e-3, 1e3),
)
@settings(max_examples=15, deadline=None)
def test_affine_in_the_action_however_far(
    n: int, m: int, seed: int, weights: list[float], scale: float
) -> None:
    torch.manual_seed(seed)
    model = make(n, m)
    x, actions = torch.randn(n).double(), scale * torch.randn(len(weights) + 1, m).double()
    # An affine map commutes with affine combinations, whose weights sum to one.
    share = torch.tensor([*weights, 1 - sum(weights)], dtype=torch.float64)
    combined = model.member_changes(x, share @ actions)
    separate = model.member_changes(x.expand(len(share), n), actions)
    size = max(1.0, separate.abs().max().item() * share.abs().sum().item())
    torch.testing.assert_close(
        combined, (share[:, None] * separate).sum(1), rtol=0, atol=1e-11 * size
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_batch_shape_and_type(dtype: torch.dtype) -> None:
    model = make(dtype=dtype)
    for shape in [(), (5,), (2, 5)]:
        x, u = torch.randn(*shape, 3, dtype=dtype), torch.randn(*shape, 2, dtype=dtype)
        value, jacobian = model.value_and_jacobian(x, u)
        assert (value.shape, jacobian.shape) == ((*shape, 3), (*shape, 3, 2))
        assert model.taylor_remainder(x, u, u).shape == (*shape, 3)
        assert model.member_changes(x, u).shape == (3, *shape, 3)
        assert value.dtype == jacobian.dtype == dtype


def test_wrong_settings_and_shapes_are_named() -> None:
    with pytest.raises(ValueError, match="gelu"):
        make(activation="gelu")
    with pytest.raises(ValueError, match="actions of width 2, got 3 and 1"):
        make().mean_change(torch.zeros(1, 3), torch.zeros(1, 1))


def test_imagined_in_like_any_ensemble() -> None:
    torch.manual_seed(0)
    model = make(2, 1, torch.float32)
    model.box.fit(torch.tensor([[-1e3, -1e3], [1e3, 1e3]]))
    start, bound = torch.randn(4, 2), torch.ones(1)
    trajectories = imagine(
        model, lambda x: 3 * x[:, :1], lambda x, u, y: u[:, 0], start, 3, -bound, bound
    )
    assert trajectories["valid"].all()
    following = trajectories["next", "observation"][:, 0]
    candidates = start + model.member_changes(start, (3 * start[:, :1]).clamp(-1, 1))
    # One member for the whole batch, and the members differ.
    distances = (candidates - following).abs().amax((1, 2))
    assert distances.min() < 1e-6 * following.abs().max()
    assert distances.max() > 1e-2


def pendulum(count: int, square: float = 0.0) -> TensorDict:
    """Damped pendulum with torque, in which gravity and the gain depend on the angle."""
    x = torch.stack([6.0 * torch.rand(count) - 3.0, 4.0 * torch.randn(count)], dim=1)
    u = 2.0 * torch.rand(count, 1) + 1.0  # in [1, 3]: not centred
    angle, speed = x.unbind(1)
    gain = 1.0 + 0.5 * angle.cos()
    acceleration = 9.8 * angle.sin() - 0.3 * speed + gain * u[:, 0] + square * u[:, 0].square()
    change = 0.05 * torch.stack([speed, acceleration], dim=1)
    return TensorDict(
        {
            "observation": x,
            "action": u,
            "next": {"observation": x + change},
            "validation": torch.arange(count) % 5 == 0,
        },
        batch_size=[count],
    )


def fit(model: EnsembleDynamics, data: TensorDict) -> None:
    buffer = ReplayBuffer(storage=LazyTensorStorage(len(data)))
    buffer.extend(data)
    config = FitConfig(
        learning_rate=5e-3, batch_size=200, max_epochs=200, max_gradient_steps=2000, patience=50
    )
    optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate)
    fit_ensemble(model, buffer, config, optimizer)


def test_learns_a_control_affine_plant_and_its_gain() -> None:
    torch.manual_seed(0)
    model = ControlAffineDynamics(2, 1, members=2, hidden=(32, 32), activation="tanh")
    fit(model, pendulum(2000))
    loss = evaluate_members(EnsembleDynamicsLoss(model), pendulum(1000))
    assert loss.max() < 2e-3  # normalised: 1 is the loss of the mean
    angle = torch.linspace(-2.5, 2.5, 21)
    x = torch.stack([angle, torch.zeros(21)], dim=1)
    for torque in (1.0, 3.0):
        _, jacobian = model.value_and_jacobian(x, torch.full((21, 1), torque))
        expected = 0.05 * torch.stack([torch.zeros(21), 1.0 + 0.5 * angle.cos()], dim=1)
        torch.testing.assert_close(jacobian[..., 0], expected, rtol=0, atol=0.012)


def test_cannot_learn_what_is_not_affine_where_a_nonlinear_model_can() -> None:
    torch.manual_seed(0)
    square = 10.0
    train, test = pendulum(2000, square), pendulum(1000, square)
    # With u uniform in [1, 3], the best affine approximation of u^2 leaves a variance of 4/45
    # in the acceleration, whatever the state.
    residual = (0.05 * square) ** 2 * 4 / 45
    errors = {}
    for form in ("affine", "nonlinear"):
        model = make_dynamics(2, 1, form, hidden=(32, 32), members=2, activation="tanh")
        fit(model, train)
        x, u = test["observation"], test["action"]
        error = x + model.member_changes(x, u) - test["next", "observation"]
        errors[form] = error[..., 1].square().mean(-1)
    assert errors["affine"].min() > 0.9 * residual
    assert errors["affine"].max() < 1.5 * residual
    assert errors["nonlinear"].max() < 0.25 * residual


@pytest.mark.parametrize("switch_on", ["policy", "executed"])
@pytest.mark.parametrize("filter_input", ["previous", "current"])
@pytest.mark.parametrize("form", ["affine", "nonlinear"])
def test_the_switching_law_never_fires(switch_on: str, filter_input: str, form: str) -> None:
    torch.manual_seed(0)
    n, m, envs = 3, 2, 4
    model = make(n, m) if form == "affine" else EnsembleDynamics(n, m, members=3, hidden=(8,))
    model = model.double()
    data = torch.randn(200, 2 * n + m).double()
    model.fit_statistics(data[:, :n], data[:, n : n + m], data[:, n + m :])
    jacobian = ActionJacobian(model)
    assert jacobian.analytic
    config = L1Config(
        0.05,
        epsilon=1e-9,
        switch_on=switch_on,
        filter_input=filter_input,
        action_low=-2.0,
        action_high=2.0,
    )
    state = init([envs], n, m, dtype=torch.float64)
    largest, switches = 0.0, 0
    with torch.no_grad():
        for _ in range(30):
            x, u_rl = torch.randn(envs, n).double(), 2 * torch.randn(envs, m).double()
            _, state, diagnostics = augment(config, jacobian, state, x, u_rl)
            largest = max(largest, diagnostics.affinization_error.max().item())
            switches += int(diagnostics.switch.sum())
    if form == "affine":
        assert largest < 1e-12
        assert switches == int(state.n_switch.sum()) == 0
    else:  # the same test must be able to fail
        assert switches > 0


def test_state_survives_a_checkpoint() -> None:
    torch.manual_seed(0)
    model = make()
    copy = ControlAffineDynamics(3, 2, members=3, hidden=(8, 6), activation="tanh").double()
    copy.load_state_dict(model.state_dict())
    x, u = torch.randn(5, 3).double(), torch.randn(5, 2).double()
    assert torch.equal(copy.member_changes(x, u), model.member_changes(x, u))
