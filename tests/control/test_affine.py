from __future__ import annotations

import itertools
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrl_l1.control import (
    ActionJacobian,
    L1Config,
    L1State,
    affinize,
    augment,
    init,
    switching_law,
)
from torchrl_l1.control.affine import make_step
from torchrl_l1.dynamics import EnsembleDynamics


def quadratic(observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    return observation.sin() + (action.square() + action).sum(-1, keepdim=True)


MODEL = ActionJacobian(quadratic)


def point(*batch: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
    u = torch.randn(2, *batch, 2, generator=generator, dtype=torch.float64)
    return x, u[0], u[1]


def test_affine_model_is_the_tangent_at_the_operating_point():
    x, u_bar, u = point(4)
    affinization = affinize(MODEL, x, u_bar)
    drift, jacobian = affinization.affine()
    torch.testing.assert_close(jacobian, (2 * u_bar + 1).unsqueeze(-2).expand(4, 3, 2))
    tangent = quadratic(x, u_bar) + ((2 * u_bar + 1) * (u - u_bar)).sum(-1, keepdim=True)
    torch.testing.assert_close(affinization.change(u), tangent)
    torch.testing.assert_close(drift + (jacobian @ u.unsqueeze(-1)).squeeze(-1), tangent)


def test_switching_law_measures_the_error_of_the_affine_model():
    x, u_bar, u = point(6)
    # The remainder of a quadratic is exact: |u - u_bar|^2 in each of the three coordinates.
    expected = 3**0.5 * (u - u_bar).square().sum(-1, keepdim=True)
    switch, error = switching_law(MODEL, x, u_bar, u, expected.median().item())
    torch.testing.assert_close(error, expected)
    assert torch.equal(switch, error > expected.median().item())
    assert 0 < switch.sum() < 6
    # The same from the affine model itself.
    tangent = affinize(MODEL, x, u_bar).change(u)
    gap = torch.linalg.vector_norm(tangent - quadratic(x, u), dim=-1, keepdim=True)
    torch.testing.assert_close(error, gap)


def test_switching_is_strict_and_ignores_what_is_not_a_number():
    def model(observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        # Flat at zero action, and 5 away from that at an action of one.
        size = action.square()
        return observation * size + torch.cat([3 * size, 4 * size, 0 * size], dim=-1)

    x = torch.tensor([[0.0, 0.0, 0.0], [torch.nan, 0.0, 0.0]])
    u_bar, u = torch.zeros(2, 1), torch.ones(2, 1)
    assert switching_law(ActionJacobian(model), x, u_bar, u, 5.0)[0].tolist() == [[0], [0]]
    assert switching_law(ActionJacobian(model), x, u_bar, u, 4.9)[0].tolist() == [[1], [0]]


def test_switching_law_without_batch_dimensions():
    x, u_bar, u = point()
    switch, error = switching_law(MODEL, x, u_bar, u, 0.0)
    assert switch.shape == error.shape == (1,)
    assert switch.all()


N, M, DT = 4, 2, 0.05
RNG = np.random.default_rng(0)
A = 0.1 * RNG.normal(size=(N, N))
B = RNG.normal(size=(N, M))
C = 0.3 * RNG.normal(size=(N, M))
TENSORS = tuple(torch.as_tensor(matrix) for matrix in (A, B, C))


def numpy_model(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return A @ x + B @ np.tanh(u) + C @ u**2 * np.cos(x[0])


def numpy_gradient(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return B / np.cosh(u) ** 2 + 2 * C * u * np.cos(x[0])


def torch_model(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    a, b, c = (matrix.to(x.dtype) for matrix in TENSORS)
    return x @ a.T + u.tanh() @ b.T + u.square() @ c.T * x[..., :1].cos()


class Known:
    """The same, with its Jacobian in closed form."""

    def mean_change(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return torch_model(x, u)

    def value_and_jacobian(
        self, x: torch.Tensor, u: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        _, b, c = (matrix.to(x.dtype) for matrix in TENSORS)
        slopes = (1 - u.tanh().square()).unsqueeze(-2), (2 * u).unsqueeze(-2)
        jacobian = b * slopes[0] + c * slopes[1] * x[..., :1, None].cos()
        return torch_model(x, u), jacobian


CHOICES = list(
    itertools.product(["keep", "reset"], ["policy", "executed"], ["current", "previous"])
)


@pytest.mark.parametrize(("on_switch", "switch_on", "filter_input"), CHOICES)
def test_agrees_with_algorithm_2(numpy_l1, on_switch, switch_on, filter_input):
    epsilon, batch, bound, reset_at = 0.4, 4, 0.9, 9
    config = L1Config(
        DT,
        epsilon=epsilon,
        on_switch=on_switch,
        switch_on=switch_on,
        filter_input=filter_input,
        action_low=-bound,
        action_high=bound,
    )

    def controller():
        return numpy_l1(
            DT, 0.35 / DT, -np.ones(N), -bound, bound, epsilon, on_switch, switch_on, filter_input
        )

    oracles = [controller() for _ in range(batch)]
    state = init([batch], N, M, dtype=torch.float64)
    model = ActionJacobian(torch_model)
    rng = np.random.default_rng(1)
    x = rng.normal(size=(batch, N))
    switches = 0
    for t in range(20):
        u_rl = rng.uniform(-1.2, 1.2, size=(batch, M))
        if t == reset_at:  # one environment of N is reset
            oracles[2] = controller()
            x[2] = rng.normal(size=N)
            fresh = init([batch], N, M, dtype=torch.float64)
            mask = torch.arange(batch).unsqueeze(-1) == 2
            old = state.entries()
            state = type(state)(
                **{k: torch.where(mask, f, old[k]) for k, f in fresh.entries().items()}
            )
        u, state, diagnostics = augment(
            config, model, state, torch.as_tensor(x), torch.as_tensor(u_rl)
        )
        expected = np.stack(
            [o.augment(x[i], u_rl[i], numpy_model, numpy_gradient) for i, o in enumerate(oracles)]
        )
        np.testing.assert_allclose(u, expected, atol=1e-10)
        for name in ("x_hat", "u_bar", "q", "sigma_m"):
            want = np.stack([getattr(oracle, name) for oracle in oracles])
            np.testing.assert_allclose(getattr(state, name), want, atol=1e-10, err_msg=name)
        assert state.n_switch.squeeze(-1).tolist() == [oracle.n_switch for oracle in oracles]
        for i, oracle in enumerate(oracles):
            if "error" in oracle.log:
                assert diagnostics.affinization_error[i].item() == pytest.approx(
                    oracle.log["error"], abs=1e-10
                )
        switches += int(diagnostics.switch.sum())
        # The plant disagrees with the model.
        x = x + np.stack([numpy_model(a, b + 0.3) for a, b in zip(x, u.numpy(), strict=True)])
    assert 5 < switches < 20 * batch


class Weighed(Known):
    def residual_covariance(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return torch.diag(torch.tensor([1e-4, 1.0, 1e-2, 4.0], dtype=x.dtype))


@pytest.mark.parametrize("filter_input", ["current", "previous"])
def test_the_executed_input_is_tested_whatever_weighs_the_estimate(filter_input):
    # No switch, so that the input tested is the one executed.
    config = L1Config(
        DT, epsilon=1e9, estimator="weighted", filter_input=filter_input, action_low=-0.9
    )
    rng, model = np.random.default_rng(2), ActionJacobian(Weighed())
    x, state = torch.as_tensor(rng.normal(size=(3, N))), init([3], N, M, dtype=torch.float64)
    for t in range(5):
        u_rl = torch.as_tensor(rng.uniform(-0.8, 0.8, size=(3, M)))
        u, state, diagnostics = augment(config, model, state, x, u_rl)
        pairs = [[row.numpy() for row in rows] for rows in (x, u, state.u_bar)]
        errors = [
            np.linalg.norm(numpy_model(a, b) - numpy_model(a, c) - numpy_gradient(a, c) @ (b - c))
            for a, b, c in zip(*pairs, strict=True)
        ]
        if t:
            found = diagnostics.affinization_error.squeeze(-1)
            np.testing.assert_allclose(found, errors, rtol=1e-9, atol=1e-12)
        x = x + torch_model(x, u + 0.3) + 0.1 * torch.as_tensor(rng.normal(size=(3, N)))
    assert diagnostics.u_a.min() > 0.01


def test_first_step_is_no_switch_and_adds_nothing():
    for epsilon in (0.0, 1.0):
        config = L1Config(DT, epsilon=epsilon)
        x, u_rl = torch.randn(3, N), torch.randn(3, M)
        u, state, diagnostics = augment(
            config, ActionJacobian(torch_model), init([3], N, M), x, u_rl
        )
        torch.testing.assert_close(u, u_rl, atol=0, rtol=0)
        torch.testing.assert_close(state.u_bar, u_rl, atol=0, rtol=0)
        assert not diagnostics.switch.any() and not state.n_switch.any()
        assert diagnostics.affinization_error.abs().max() == 0
        assert state.started.all()
        # The remembered operating point is a copy.
        u_rl.zero_()
        assert state.u_bar.abs().max() > 0


def test_model_output_that_is_not_finite_ends_in_a_restart():
    def model(x, u):
        return torch.where(x[..., :1] > 5, torch.nan, torch_model(x, u))

    config = L1Config(DT, epsilon=0.4)
    jacobian = ActionJacobian(model)
    state = init([3], N, M, dtype=torch.float64)
    x = torch.zeros(3, N, dtype=torch.float64)
    u_rl = torch.full((3, M), 0.3, dtype=torch.float64)
    _, state, _ = augment(config, jacobian, state, x, u_rl)
    x[1, 0] = 6.0
    u, state, diagnostics = augment(config, jacobian, state, x, u_rl)
    assert diagnostics.non_finite.squeeze(-1).tolist() == [False, True, False]
    assert state.started.squeeze(-1).tolist() == [True, False, True]
    torch.testing.assert_close(u[1], u_rl[1], atol=0, rtol=0)
    assert all(entry.isfinite().all() for entry in (*state.entries().values(), *diagnostics, u))
    x[1, 0] = 0.0
    _, state, diagnostics = augment(config, jacobian, state, x, u_rl)
    assert state.started.all() and not diagnostics.non_finite.any()


@pytest.mark.parametrize(("on_switch", "switch_on", "filter_input"), CHOICES)
def test_captures_as_one_graph(on_switch, switch_on, filter_input):
    config = L1Config(
        DT, epsilon=0.4, on_switch=on_switch, switch_on=switch_on, filter_input=filter_input,
        a_s=(-1.0, -2.0, -1.0, -0.5), action_low=-1.0, action_high=1.0,
    )  # fmt: skip
    # Derivatives are the same for all; to capture them takes most of the time.
    derived = (on_switch, switch_on, filter_input) == CHOICES[0]
    model = ActionJacobian(torch_model if derived else Known())

    def run(step):
        torch.manual_seed(0)
        state, history = init([3], N, M), []
        for _ in range(6):
            x, u_rl = torch.randn(3, N), torch.randn(3, M)
            with torch.no_grad():
                u, state, diagnostics = step(state, x, u_rl)
            history += [u, state.x_hat, diagnostics.switch.float()]
        return history

    def step(state, x, u_rl):
        return augment(config, model, state, x, u_rl)

    torch.compiler.reset()
    captured = torch.compile(step, fullgraph=True, backend="eager")
    for a, b in zip(run(step), run(captured), strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)


class Counting(EnsembleDynamics):
    """Counts passes through the network."""

    def __init__(self, *args, **settings):
        super().__init__(*args, **settings)
        self.passes = []

    def expansion(self, *args):
        self.passes.append("expansion")
        return super().expansion(*args)

    def value_and_jacobian(self, *args):
        self.passes.append("value_and_jacobian")
        return super().value_and_jacobian(*args)

    def taylor_remainder(self, *args):
        self.passes.append("taylor_remainder")
        return super().taylor_remainder(*args)

    def mean_change(self, *args):
        self.passes.append("mean_change")
        return super().mean_change(*args)


@pytest.mark.parametrize(("on_switch", "switch_on", "filter_input"), CHOICES)
@torch.no_grad()
def test_an_ensemble_is_evaluated_once_and_as_any_other_model(on_switch, switch_on, filter_input):
    torch.manual_seed(0)
    model = Counting(N, M, members=3, hidden=(16, 16), activation="silu").double()
    config = L1Config(
        DT,
        epsilon=0.02,
        on_switch=on_switch,
        switch_on=switch_on,
        filter_input=filter_input,
        action_low=-1.0,
        action_high=1.0,
    )
    # As a function of the two tensors it is differentiated automatically, piece by piece.
    other = ActionJacobian(lambda x, u: EnsembleDynamics.mean_change(model, x, u))
    states = [init([5], N, M, dtype=torch.float64)] * 2
    for _ in range(30):
        x = torch.randn(5, N, dtype=torch.float64)
        u_rl = 2 * torch.randn(5, M, dtype=torch.float64)
        model.passes.clear()
        results = [
            augment(config, *both, x, u_rl)
            for both in zip((ActionJacobian(model), other), states, strict=True)
        ]
        # Where the tested input depends on the estimate, that takes a Jacobian first.
        depends = switch_on == "executed" and filter_input == "current"
        assert model.passes == ["value_and_jacobian"] * depends + ["expansion"]
        for found, expected in zip(
            *((u, *state.entries().values(), *signals) for u, state, signals in results),
            strict=True,
        ):
            torch.testing.assert_close(found, expected, atol=1e-11, rtol=1e-9)
        states = [state for _, state, _ in results]
    assert 0 < states[0].n_switch.sum() < 150


@pytest.mark.parametrize("kind", ["function", "analytic"])
@pytest.mark.parametrize("make", [L1Config.paper, L1Config.reference, L1Config.robust])
def test_one_step_of_each_environment_under_vmap(make, kind):
    torch.manual_seed(0)
    ensemble = EnsembleDynamics(3, 2, members=2, hidden=(8,))
    effect = torch.randn(2, 3)
    model = ActionJacobian(ensemble if kind == "analytic" else lambda x, u: u.sin() @ effect)
    config = make(0.05)
    state = init([5], 3, 2, config)

    def one(*entries):
        *remembered, x, u_rl = entries
        before = L1State(**dict(zip(state.entries(), remembered, strict=True)))
        u, following, _ = augment(config, model, before, x, u_rl)
        return u, *following.entries().values()

    for _ in range(3):
        x, u_rl = torch.randn(5, 3), torch.randn(5, 2)
        found = torch.func.vmap(one)(*state.entries().values(), x, u_rl)
        u, state, _ = augment(config, model, state, x, u_rl)
        for mapped, batched in zip(found, (u, *state.entries().values()), strict=True):
            torch.testing.assert_close(mapped, batched)


class WithoutVariance:
    """A model that takes its residuals for zero."""

    def mean_change(self, observation, action):
        return 0.1 * observation + 0.2 * action

    def residual_covariance(self, observation, action):
        return torch.zeros(3, 3)


PAPER, ROBUST = L1Config(0.05), L1Config.robust(0.05)
WEIGHTED = L1Config(0.05, estimator="weighted")


def test_each_controller_looks_at_the_covariance_that_it_takes():
    model, data = ActionJacobian(WithoutVariance()), (torch.zeros(5, 3), torch.zeros(5, 3))
    make_step(PAPER, model, False)(init([5], 3, 3, PAPER), *data)
    assert model.ready
    with pytest.raises(ValueError, match="positive definite"):
        make_step(ROBUST, model, False)(init([5], 3, 3, ROBUST), *data)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (ROBUST, ["estimator='weighted' finds no covariance of function"]),
        (WEIGHTED, ["estimator='weighted' finds no covariance of function"]),
        (L1Config(0.05, filter="kalman"), ["filter='kalman' finds no covariance of function"]),
        (PAPER, []),
    ],
)
def test_a_model_without_a_covariance_is_told_of_where_it_matters(config, words):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        make_step(config, ActionJacobian(quadratic), False)
    assert [str(each.message).partition("'s ")[0] for each in found] == words


@pytest.mark.parametrize("config", [replace(ROBUST, inflation=2.0), WEIGHTED])
def test_an_ensemble_whose_residuals_nobody_has_measured_is_told_of(config):
    model = EnsembleDynamics(3, 1, members=2, hidden=(8,))
    first = init([2], 3, 1, config), torch.zeros(2, 3), torch.zeros(2, 1)
    with pytest.warns(UserWarning, match="the residuals of the model .* have not been measured"):
        make_step(config, ActionJacobian(model), False)(*first)
    model.residuals.measure(torch.eye(3))
    make_step(config, ActionJacobian(model), False)(*first)
