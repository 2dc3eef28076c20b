from __future__ import annotations

import copy
import pickle
import threading
import warnings

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.modules import MLP

from torchrl_l1.control import ActionJacobian, L1Config, L1Transform, init
from torchrl_l1.control.affine import make_step
from torchrl_l1.dynamics import EnsembleDynamics

N, M = 3, 1


class Model(nn.Module):
    """A network between two linear layers, on a sequence of the four inputs."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.embed, self.net, self.out = nn.Linear(1, 8), net, nn.Linear(32, N)

    def forward(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        h = self.net(self.embed(torch.cat([x, u], -1).reshape(-1, 4, 1)))
        h = h[0] if isinstance(h, tuple) else h
        return self.out(h.flatten(1)).reshape(x.shape)


class Joined(nn.Module):
    """A layer on observation and action side by side."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(N + M, N)

    def forward(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return self.layer(torch.cat([x, u], -1)).tanh()


def attention(**settings) -> nn.Module:
    return nn.TransformerEncoderLayer(8, 2, 16, **{"dropout": 0.0, "batch_first": True, **settings})


def data(*batch: int, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return (
        torch.randn(*batch, N, generator=generator, dtype=dtype),
        torch.randn(*batch, M, generator=generator, dtype=dtype),
    )


def by_differences(model, x, u) -> torch.Tensor:
    step = 1e-6 if u.dtype == torch.float64 else 1e-2
    with torch.no_grad():
        return ((model(x, u + step) - model(x, u - step)) / (2 * step)).unsqueeze(-1)


def pendulum(model, **settings) -> TransformedEnv:
    env = TransformedEnv(GymEnv("Pendulum-v1"), L1Transform(model, dt=0.05, **settings))
    env.set_seed(0)
    return env


@pytest.mark.parametrize("wrap", [False, True])
def test_lazy_layers_get_their_weights_before_they_are_differentiated(wrap):
    lazy = MLP(out_features=N, num_cells=[16])
    torch.manual_seed(3)
    before = torch.random.get_rng_state()
    x, u = data(5)
    if wrap:  # hidden in a function
        model = ActionJacobian(lambda x, u: lazy(torch.cat([x, u], -1)))
    else:
        model = ActionJacobian(TensorDictModule(lazy, ["observation", "action"], ["delta"]))
    value, jacobian = model(x, u)
    assert torch.equal(torch.random.get_rng_state(), before)
    torch.testing.assert_close(value, lazy(torch.cat([x, u], -1)))
    double = copy.deepcopy(lazy).double()
    expected = by_differences(lambda x, u: double(torch.cat([x, u], -1)), x.double(), u.double())
    torch.testing.assert_close(jacobian.double(), expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ("net", "layer", "dtype"),
    [
        (nn.LSTM(8, 8, batch_first=True), r"net \(LSTM\)", torch.float32),
        (attention(), r"net.self_attn \(MultiheadAttention\)", torch.float64),
        (attention().eval(), r"net \(TransformerEncoderLayer\)", torch.float64),
        (attention().requires_grad_(False).eval(), r"net \(Transf[a-zA-Z]*\)", torch.float64),
    ],
    ids=["lstm", "attention", "attention eval", "attention frozen"],
)
def test_layers_without_forward_mode_are_differentiated_backwards(net, layer, dtype):
    model = Model(net).to(dtype)
    x, u = data(5, dtype=dtype)
    jacobian = ActionJacobian(model)
    with pytest.warns(UserWarning, match=f"reverse mode, since {layer} has no forward mode"):
        value, matrix = jacobian(x, u)
    torch.testing.assert_close(value, model(x, u))
    close = {"atol": 1e-8, "rtol": 1e-6} if dtype == torch.float64 else {"atol": 1e-3, "rtol": 0}
    torch.testing.assert_close(matrix, by_differences(model, x, u), **close)
    assert not matrix.requires_grad and all(p.grad is None for p in model.parameters())
    # The remainder and the expansion agree, whichever rows move; inference tensors are taken too.
    other = u + torch.linspace(-1, 1, 5, dtype=u.dtype)[:, None]
    remainder = jacobian.taylor_remainder(x, u, other)
    slope = (matrix @ (other - u).unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(remainder, model(x, other) - value - slope)
    for moved in (torch.zeros(5, 1, dtype=torch.bool), torch.arange(5)[:, None] > 2):
        with torch.inference_mode():
            found, at = jacobian.expansion(x + 0, u, other, other)
            tangent = at(moved)
        torch.testing.assert_close(found.clone(), remainder)
        where = torch.where(moved, other, u)
        torch.testing.assert_close(tangent[0].clone(), model(x, where))
        torch.testing.assert_close(tangent[1].clone(), by_differences(model, x, where), **close)


def test_reverse_mode_in_an_environment_warns_once():
    env = pendulum(Model(nn.LSTM(8, 8, batch_first=True)))
    with pytest.warns(UserWarning, match="3 backward passes in place of 1") as caught:
        found = env.rollout(6)
    assert len(caught) == 1 and found["next", "l1", "u_exec"].isfinite().all()


@pytest.mark.parametrize(
    ("net", "layer"),
    [
        (nn.Sequential(nn.Linear(8, 8), nn.Dropout(0.1)), r"net.1 \(Dropout\)"),
        (nn.RReLU(), r"net \(RReLU\)"),
        (nn.LSTM(8, 8, 2, dropout=0.1, batch_first=True), r"net \(LSTM\)"),
        (attention(dropout=0.1), r"net.self_attn \(MultiheadAttention\)"),
        (nn.Sequential(nn.Flatten(1), nn.BatchNorm1d(32)), r"net.1 \(BatchNorm1d\)"),
        (nn.InstanceNorm1d(4, track_running_stats=True), r"net \(InstanceNorm1d\)"),
    ],
    ids=["dropout", "rrelu", "lstm", "attention", "batch norm", "instance norm"],
)
def test_train_mode_is_refused_where_it_matters(net, layer):
    model = Model(net)
    buffers = {name: value.clone() for name, value in model.named_buffers()}
    for dynamics in (model, model.forward, lambda x, u: model(x, u)):
        with pytest.raises(ValueError, match=f"train mode, in which its layer {layer}.*eval"):
            pendulum(dynamics).rollout(2)
    for name, value in model.named_buffers():
        assert torch.equal(value, buffers[name])
    model.eval()
    env = pendulum(model)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*reverse mode")
        env.rollout(2)
        # A fit puts it back into train mode.
        model.train()
        with pytest.raises(ValueError, match="train mode"):
            env.rollout(2)


def test_batch_norm_takes_a_single_environment():
    norm = nn.BatchNorm1d(N + M)
    norm.running_mean = torch.arange(4.0)
    layer = nn.Sequential(norm, nn.Linear(N + M, N)).eval()

    def model(x, u):
        return layer(torch.cat([x, u], -1))

    x, u = data()
    value, jacobian = ActionJacobian(model)(x, u)
    torch.testing.assert_close(value, model(x[None], u[None])[0])
    assert jacobian.shape == (N, M)


def mean_over_the_batch(x, u):
    return x * 0.1 + (u - u.mean(0, keepdim=True)).expand_as(x)


@pytest.mark.parametrize("batch", [(2,), (5,), (300,), (1,)])
def test_models_that_mix_the_rows_of_a_batch_are_refused(batch):
    models = [Model(attention(batch_first=False)).eval()]
    models += [mean_over_the_batch] if batch != (1,) else []
    for model in models:
        with pytest.raises(ValueError, match="mixes the rows of a batch"):
            ActionJacobian(model)(*data(*batch))


def test_functions_of_vectors_serve_a_single_environment():
    def model(x, u):
        return torch.stack([x[1], u[0], x[0] * u[0]])

    x, u = data()
    _, jacobian = ActionJacobian(model)(x, u)
    torch.testing.assert_close(jacobian[:, 0], torch.stack([0 * x[0], 1 + 0 * x[0], x[0]]))


def test_what_is_no_prediction_is_named():
    class Nothing(nn.Module):
        def forward(self, x, u):
            return None

    def integer(x, u):
        return 0

    def integers(x, u):
        return torch.zeros(x.shape, dtype=torch.int64)

    def double(x, u):
        return x.double() + u

    class Jacobian:
        def mean_change(self, x, u):
            return x

        def value_and_jacobian(self, x, u):
            return x, None

    for model, message in (
        (Nothing(), "model Nothing returned NoneType, expected a tensor of torch.float32"),
        (integer, "integer returned int"),
        (integers, r"integers returned torch.int64 for observations of torch.float32"),
        (double, r"double returned torch.float64"),
        (Jacobian(), "Jacobian returned NoneType"),
    ):
        with pytest.raises(TypeError, match=message):
            pendulum(model).rollout(2)
    with pytest.raises(ValueError, match=r"returned shape \(2, 1\) for observations"):
        ActionJacobian(lambda x, u: u)(*data(2))
    with pytest.raises(ValueError, match="gives a prediction that is not finite at the first"):
        pendulum(lambda x, u: x + u.sum() / 0.0).rollout(2)


def test_a_prediction_that_changes_from_call_to_call_is_refused():
    def sampled(x, u):
        return x + u + 0.01 * torch.randn_like(x)

    torch.manual_seed(0)
    before = torch.random.get_rng_state()
    with pytest.raises(ValueError, match="another prediction at each call"):
        ActionJacobian(sampled)(*data(4))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_a_model_that_does_not_use_the_action_is_flagged():
    for model in (lambda x, u: -0.1 * x, lambda x, u: torch.zeros_like(x)):
        with pytest.warns(UserWarning, match="does not depend on the action"):
            found = pendulum(model).rollout(5, lambda td: td.set("action", torch.ones(1)))
        assert found["next", "l1", "ill_conditioned"].all()
        assert (found["next", "l1", "u_exec"] == 1).all()
    with pytest.warns(UserWarning, match="does not depend"):
        _, jacobian = ActionJacobian(lambda x, u: x)(torch.ones(5, 3), torch.ones(5, 2))
    assert jacobian.shape == (5, 3, 2) and not jacobian.any()


def test_a_model_without_derivative_is_refused():
    weight = torch.ones(N + M, N)
    with pytest.raises(ValueError, match="with respect to the action is zero: it is detached"):
        ActionJacobian(lambda x, u: x + u.detach())(*data(4))
    with pytest.raises(ValueError, match="piecewise constant"):
        ActionJacobian(lambda x, u: x + (10 * u).round())(*data(4))
    with pytest.raises(
        RuntimeError, match=r"cannot be differentiated at .*numpy_model.*value_and_j"
    ):

        def numpy_model(x, u):
            return torch.from_numpy(torch.cat([x, u], -1).numpy() @ weight.numpy())

        ActionJacobian(numpy_model)(*data(4))
    # A network that is dead at the first action is honest.
    _, jacobian = ActionJacobian(lambda x, u: x + u.clamp_min(0.6))(*data(4))
    assert not jacobian.any()


def test_the_probe_runs_once_and_draws_nothing():
    calls = []

    def model(x, u):
        calls.append(x.shape)
        return x.sin() * 0.1 + u.sin()

    jacobian = ActionJacobian(model)
    step = make_step(L1Config(0.05), jacobian, False)
    state, (x, u) = init([4], N, M), data(4)
    assert not jacobian.ready
    _, state, _ = step(state, x, u)
    first = len(calls)
    assert jacobian.ready
    calls.clear()
    step(state, x, u)
    assert len(calls) < first
    expected = len(calls)
    for twin in (copy.deepcopy(jacobian), jacobian):
        calls.clear()
        make_step(L1Config(0.05), twin, False)(state, x, u)
        assert len(calls) == expected
    known = ActionJacobian(EnsembleDynamics(N, M, hidden=(4,)))
    known.prepare(x, u)
    assert pickle.loads(pickle.dumps(known)).ready


def test_an_unfit_first_observation_does_not_speak_against_the_model():
    for bad in (torch.nan, torch.inf, 1e30):
        x, u = data(4)
        x[0], x[2] = bad, bad
        ActionJacobian(lambda x, u: x.square() + u).prepare(x, u)


@pytest.mark.parametrize("kind", ["forward", "reverse"])
def test_the_probe_comes_before_the_compiler(kind):
    """The traced step takes the mode that the probe chose."""
    model = Model(nn.Tanh() if kind == "forward" else attention()).double()
    jacobian = ActionJacobian(model)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*reverse mode")
        jacobian.prepare(*data(4, dtype=torch.float64))
    x, u = data(4, dtype=torch.float64)
    torch.compiler.reset()
    captured = torch.compile(jacobian.value_and_jacobian, fullgraph=True, backend="eager")
    with torch.no_grad():
        for found, expected in zip(captured(x, u), jacobian(x, u), strict=True):
            torch.testing.assert_close(found, expected)


def test_threads_get_what_one_thread_gets():
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(N + M, 8), nn.Tanh(), nn.Linear(8, N))

    def model(x, u):
        return network(torch.cat([x, u], -1))

    lazy = MLP(out_features=N, num_cells=[4])
    config = L1Config(0.05, epsilon=0.01, action_low=-1.0, action_high=1.0)
    inputs = [data(3) for _ in range(40)]

    def loop() -> list[torch.Tensor]:
        step, state, found = make_step(config, ActionJacobian(model), False), init([3], N, M), []
        ActionJacobian(TensorDictModule(lazy, ["observation", "action"], ["delta"])).prepare(
            *inputs[0]
        )
        with torch.no_grad():
            for k, (x, u) in enumerate(inputs):
                executed, state, _ = step(state, x + 0.01 * k, u)
                found += [executed, state.x_hat]
        return found

    expected, results = None, {}

    def work(name: int) -> None:
        try:
            results[name] = loop()
        except Exception as error:
            results[name] = error

    threads = [threading.Thread(target=work, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    expected = loop()
    for found in results.values():
        assert not isinstance(found, Exception), found
        assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    assert len(results) == 8


class WithCovariance:
    """A linear model that says what it thinks of its residuals."""

    def __init__(self, covariance):
        self.covariance = covariance

    def mean_change(self, observation, action):
        return 0.1 * observation + 0.2 * action

    def residual_covariance(self, observation, action):
        return self.covariance(observation)


ROBUST = L1Config.robust(0.05)
WEIGHTED = L1Config(0.05, estimator="weighted")


@pytest.mark.parametrize("config", [ROBUST, WEIGHTED])
@pytest.mark.parametrize(
    ("covariance", "error", "words"),
    [
        (lambda x: torch.diag(torch.tensor([1.0, 1.0, 0.0])), ValueError, "positive definite"),
        (lambda x: torch.full((3, 3), torch.nan), ValueError, "not finite"),
        (lambda x: torch.ones(3), ValueError, r"shape \(3,\), expected \(3, 3\) or \(5, 3, 3\)"),
        (lambda x: torch.eye(3).double(), TypeError, "is torch.float64, expected a tensor of"),
        (lambda x: 0.1, TypeError, "is float, expected a tensor"),
    ],
)
def test_a_residual_covariance_that_is_none_is_named(config, covariance, error, words):
    step = make_step(config, ActionJacobian(WithCovariance(covariance)), False)
    x, u = torch.randn(5, 3), torch.randn(5, 3)
    with pytest.raises(error, match=f"residual covariance of the model WithCovariance .*{words}"):
        step(init([5], 3, 3, config), x, u)


def test_a_residual_covariance_that_varies_needs_to_be_remembered():
    def varying(x):
        return torch.diag_embed(0.1 + x.square())

    x, u = torch.randn(5, 3), torch.randn(5, 3)
    model = ActionJacobian(WithCovariance(varying))
    with pytest.warns(UserWarning, match="depends on the state.*give covariance='sum'"):
        make_step(ROBUST, model, False)(init([5], 3, 3, ROBUST), x, u)
    remembering = L1Config.robust(0.05, covariance="sum")
    for config in (remembering, WEIGHTED):
        step = make_step(config, ActionJacobian(WithCovariance(varying)), False)
        step(init([5], 3, 3, config), x, u)
    same = ActionJacobian(WithCovariance(lambda x: torch.eye(3).expand(*x.shape, 3)))
    make_step(ROBUST, same, False)(init([5], 3, 3, ROBUST), x, u)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (nn.Sequential(nn.Linear(4, 3)), "model Sequential failed .* two arguments.*TypeError"),
        (nn.ModuleList([nn.Linear(4, 3)]), "model ModuleList failed .*NotImplementedError"),
        (nn.Bilinear(3, 2, 3), r"observation of shape \(3,\) .* action of shape \(1,\)"),
        (lambda both: both, "lambda> failed at its first call"),
        (nn.Bilinear(3, 1, 3).double(), "both torch.float32: .*RuntimeError"),
    ],
)
def test_a_model_that_cannot_be_called_is_named(model, message):
    with pytest.raises(ValueError, match=message) as caught:
        pendulum(model, dtype=torch.float32).rollout(2)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_a_model_that_writes_to_its_inputs_is_named(mode):
    def clips(x, u):
        return 0.1 * x.clamp_(-9.0, 9.0) + u

    def centres(x, u):
        u -= 0.5
        return 0.1 * x + u

    with mode():
        # In inference mode nothing counts writes that change nothing.
        for model, name in ((clips, "observation"), (centres, "action"))[
            mode is not torch.no_grad :
        ]:
            with pytest.raises(ValueError, match=f"{model.__name__} writes to its {name} in place"):
                pendulum(model).rollout(2)


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_a_frozen_module_of_torchscript_has_no_mode_and_is_taken():
    plain = Joined()
    frozen = torch.jit.freeze(torch.jit.script(plain).eval())
    x, u = data(4)
    for ours, theirs in zip(ActionJacobian(frozen)(x, u), ActionJacobian(plain)(x, u), strict=True):
        torch.testing.assert_close(ours, theirs)
