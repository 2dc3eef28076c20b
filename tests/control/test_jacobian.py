from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import nn
from torch.distributions import Normal
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_l1.control import (
    ActionJacobian,
    Affinizer,
    DynamicsModel,
    L1Config,
    L1Controller,
    L1Transform,
    augment,
    init,
)
from torchrl_l1.control.affine import make_step
from torchrl_l1.dynamics import EnsembleDynamics

N, M = 5, 3


class Net(nn.Module):
    """Observation and action to n numbers, with an operation between actions."""

    def __init__(self, members: int | None = None) -> None:
        super().__init__()
        self.members = members
        self.layers = nn.Sequential(nn.Linear(N + M, 16), nn.Tanh(), nn.Linear(16, N)).double()

    def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        y = self.layers(torch.cat([observation, action], -1)) * (1 + action.prod(-1, True))
        if self.members is None:
            return y
        return torch.stack([y * (1 + 0.1 * k) for k in range(self.members)])


@pytest.fixture
def net() -> Net:
    torch.manual_seed(0)
    return Net()


def data(*batch: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return (
        torch.randn(*batch, N, generator=generator, dtype=torch.float64),
        torch.randn(*batch, M, generator=generator, dtype=torch.float64),
    )


def by_reverse_mode(change, observation, action):
    flat = zip(observation.reshape(-1, N), action.reshape(-1, M), strict=True)
    rows = [torch.func.jacrev(lambda u, x=x: change(x[None], u[None])[0])(u) for x, u in flat]
    return torch.stack(rows).reshape(*observation.shape, M)


@pytest.mark.parametrize("batch", [(), (1,), (7,), (2, 3)])
def test_forward_mode_agrees_with_reverse_mode(net, batch):
    observation, action = data(*batch)
    value, jacobian = ActionJacobian(net).value_and_jacobian(observation, action)
    torch.testing.assert_close(value, net(observation, action))
    torch.testing.assert_close(jacobian, by_reverse_mode(net, observation, action))
    assert not jacobian.isnan().any() and jacobian.shape == (*batch, N, M)


def test_forward_mode_agrees_with_finite_differences(net):
    observation, action = data(4)
    _, jacobian = ActionJacobian(net)(observation, action)
    for column, e in enumerate(torch.eye(M, dtype=torch.float64) * 1e-6):
        change = (net(observation, action + e) - net(observation, action - e)) / 2e-6
        torch.testing.assert_close(jacobian[..., column], change, atol=1e-8, rtol=1e-6)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_forward_mode_works_without_gradients(net, mode):
    observation, action = data(4)
    expected = by_reverse_mode(net, observation, action)
    with mode():
        _, jacobian = ActionJacobian(net)(observation, action)
    assert not jacobian.requires_grad
    torch.testing.assert_close(jacobian.clone(), expected)


def test_analytic_path_agrees_with_forward_mode_of_the_same_model():
    torch.manual_seed(0)
    model = EnsembleDynamics(N, M, members=3, hidden=(32, 32), activation="tanh").double()
    observation, action = data(50)
    model.fit_statistics(3 + 2 * observation, 0.3 * action, 0.1 * observation)
    analytic = ActionJacobian(model)
    generic = ActionJacobian(lambda x, u: model.mean_change(x, u))
    assert analytic.analytic and not generic.analytic
    for a, b in zip(analytic(observation, action), generic(observation, action), strict=True):
        torch.testing.assert_close(a, b)


def test_taylor_remainder_is_what_the_tangent_misses(net):
    """By forward mode, by a model's Jacobian, and by a model's own remainder."""
    torch.manual_seed(0)
    ensemble = EnsembleDynamics(N, M, members=3, hidden=(32, 32), activation="tanh").double()
    observation, u_bar = data(50)
    ensemble.fit_statistics(3 + 2 * observation, 0.3 * u_bar, 0.1 * observation)

    class JacobianOnly:
        mean_change = staticmethod(ensemble.mean_change)
        value_and_jacobian = staticmethod(ensemble.value_and_jacobian)

    action = u_bar + torch.randn_like(u_bar)
    for dynamics in (net, ensemble, JacobianOnly()):
        model = ActionJacobian(dynamics)
        value, jacobian = model.value_and_jacobian(observation, u_bar)
        tangent = value + (jacobian @ (action - u_bar).unsqueeze(-1)).squeeze(-1)
        expected = model.value(observation, action) - tangent
        torch.testing.assert_close(model.taylor_remainder(observation, u_bar, action), expected)


def test_model_with_mean_change_only_is_differentiated(net):
    class Model:
        def mean_change(self, observation, action):
            return net(observation, action)

    assert isinstance(Model(), DynamicsModel)
    observation, action = data(4)
    model = ActionJacobian(Model())
    torch.testing.assert_close(model.value(observation, action), net(observation, action))
    torch.testing.assert_close(
        model(observation, action)[1], by_reverse_mode(net, observation, action)
    )


def test_tensordict_modules_of_the_change_and_of_the_next_observation(net):
    observation, action = data(6)
    expected = by_reverse_mode(net, observation, action)
    change = ActionJacobian(TensorDictModule(net, ["observation", "action"], ["change"]))
    value, jacobian = change(observation, action)
    torch.testing.assert_close(value, net(observation, action))
    torch.testing.assert_close(jacobian, expected)
    following = ActionJacobian(
        TensorDictModule(
            lambda x, u: x + net(x, u),
            [("agent", "pose"), "torque"],
            [("next", "pose"), "other"][:1],
        ),
        observation_key=("agent", "pose"),
        action_key="torque",
        predicts="next_observation",
    )
    value, jacobian = following(observation, action)
    torch.testing.assert_close(value, net(observation, action))
    torch.testing.assert_close(jacobian, expected)


def test_mean_over_an_ensemble_dimension(net):
    members = Net(members=3)
    members.load_state_dict(net.state_dict())
    observation, action = data(6)
    value, jacobian = ActionJacobian(members, ensemble_dim=0)(observation, action)
    torch.testing.assert_close(value, 1.1 * net(observation, action))
    torch.testing.assert_close(jacobian, 1.1 * by_reverse_mode(net, observation, action))
    with pytest.raises(ValueError, match="give ensemble_dim"):
        ActionJacobian(members).value(observation, action)


def test_the_model_is_shared_and_left_as_it_is(net):
    net.train()
    model = ActionJacobian(net)
    observation, action = data(4)
    before = model.value(observation, action)
    with torch.no_grad():
        net.layers[2].bias += 1.0
    assert not torch.allclose(model.value(observation, action), before)
    assert net.training and model.dtype == torch.float64
    assert ActionJacobian(lambda x, u: x).dtype is None


def test_models_that_do_not_fit_are_refused(net):
    with pytest.raises(TypeError, match="dynamics must have a mean_change"):
        ActionJacobian(3)
    with pytest.raises(ValueError, match="predicts must be"):
        ActionJacobian(net, predicts="delta")
    with pytest.raises(ValueError, match="do not apply"):
        ActionJacobian(EnsembleDynamics(N, M, hidden=(4,)), predicts="next_observation")
    with pytest.raises(ValueError, match="must read exactly 'observation' and 'action'"):
        ActionJacobian(TensorDictModule(net, ["observation", "u"], ["change"]))
    two = TensorDictModule(net, ["observation", "action"], ["change", "reward"])
    with pytest.raises(ValueError, match="name its prediction with out_key"):
        ActionJacobian(two)
    with pytest.raises(ValueError, match="not out_key='delta'"):
        ActionJacobian(two, out_key="delta")
    with pytest.raises(ValueError, match="out_key applies to TensorDictModules"):
        ActionJacobian(net, out_key="change")

    class OnlyJacobian:
        def value_and_jacobian(self, observation, action):
            return observation, action

    with pytest.raises(TypeError, match="no mean_change"):
        ActionJacobian(OnlyJacobian())


def test_wrong_widths_are_named():
    model = EnsembleDynamics(N, M, hidden=(4,))
    with pytest.raises(ValueError, match="observation_dim=5, but the data have width 4"):
        ActionJacobian(model).check_dimensions(4, M)
    with pytest.raises(ValueError, match="action_dim=3, but the data have width 1"):
        ActionJacobian(model).check_dimensions(N, 1)

    class Transposed(nn.Module):
        def mean_change(self, observation, action):
            return observation

        def value_and_jacobian(self, observation, action):
            return observation, torch.zeros(*observation.shape[:-1], M, N)

    with pytest.raises(ValueError, match=r"Jacobian of shape \(2, 3, 5\), expected \(2, 5, 3\)"):
        ActionJacobian(Transposed())(torch.zeros(2, N), torch.zeros(2, M))


@pytest.mark.parametrize(
    ("observation_key", "out_key", "predicts"),
    [
        ("observation", ("next", "observation"), "next_observation"),
        ("observation", "observation", "next_observation"),
        (("agent", "pose"), ("next", "agent", "pose"), "next_observation"),
        ("observation", "change", "change"),
        ("observation", ("next", "change"), "change"),
    ],
)
def test_the_out_key_tells_what_a_module_predicts(net, observation_key, out_key, predicts):
    following = predicts == "next_observation"
    module = TensorDictModule(
        lambda x, u: net(x, u) + (x if following else 0), [observation_key, "action"], [out_key]
    )
    observation, action = data(4)
    model = ActionJacobian(module, observation_key=observation_key)
    assert model.predicts == predicts
    torch.testing.assert_close(model.value(observation, action), net(observation, action))
    # What is said counts more than what is inferred.
    other = "change" if following else "next_observation"
    assert ActionJacobian(module, observation_key=observation_key, predicts=other).predicts == other
    assert ActionJacobian(net).predicts == "change"


def test_the_named_one_of_several_out_keys_tells_too(net):
    module = TensorDictModule(
        lambda x, u: (x + net(x, u), x.sum(-1, True)),
        ["observation", "action"],
        [("next", "observation"), "reward"],
    )
    observation, action = data(4)
    model = ActionJacobian(module, out_key=("next", "observation"))
    torch.testing.assert_close(model.value(observation, action), net(observation, action))


def test_every_face_takes_what_the_model_predicts(net):
    def following(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return x + net(x, u)

    observation, action = data(4)
    config = L1Config(0.1)
    faces = (
        L1Transform(following, config, predicts="next_observation"),
        L1Controller(following, config, predicts="next_observation"),
        Affinizer(following, predicts="next_observation"),
    )
    for face in faces:
        torch.testing.assert_close(face.model.value(observation, action), net(observation, action))
    with pytest.raises(ValueError, match="ActionJacobian has predicts='change'"):
        L1Transform(ActionJacobian(net), config, predicts="next_observation")


@pytest.mark.parametrize("preset", [L1Config.paper, L1Config.robust])
@pytest.mark.filterwarnings("ignore:.* finds no covariance")
def test_a_batch_without_rows_is_no_first_step(net: Net, preset: Callable[..., L1Config]) -> None:
    """Nothing can be told of a model by it; the first one with rows is looked at."""
    jacobian, config = ActionJacobian(net), preset(0.05, action_low=-1.0, action_high=1.0)
    for size in (0, 2, 0):
        observation, action = data(size)
        action = action.clamp(-1, 1)
        state = init([size], N, M, config, dtype=torch.float64)
        executed, state, _ = augment(config, jacobian, state, observation, action)
        torch.testing.assert_close(executed, action)  # nothing to counteract at a first step
        assert jacobian.ready == (size == 2 or jacobian.ready)
    assert jacobian.ready


def test_an_ensemble_of_another_type_is_named() -> None:
    model = ActionJacobian(EnsembleDynamics(N, M, members=2, hidden=(8,)))
    with pytest.raises(
        ValueError, match=r"EnsembleDynamics failed .* both torch\.float64"
    ) as caught:
        model.prepare(*data(2))
    assert "\n" not in str(caught.value)


GLOBAL = nn.Sequential(nn.Linear(4, 8), nn.Dropout(0.5), nn.Linear(8, 3)).eval()


class Wrapper(nn.Module):
    """A model around another one, with a mode of its own."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net
        self.eval()

    def forward(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return self.net(torch.cat([x, u], -1))

    mean_change = forward


class Analytic(Wrapper):
    def value_and_jacobian(self, x: torch.Tensor, u: torch.Tensor):
        return self(x, u), torch.ones(*x.shape, u.shape[-1])


@pytest.mark.parametrize(
    "wrapped",
    [
        Wrapper,
        Analytic,
        lambda net: Wrapper(net).mean_change,
        lambda net: lambda x, u: net(torch.cat([x, u], -1)),
        lambda _: lambda x, u: GLOBAL(torch.cat([x, u], -1)),
    ],
)
def test_train_mode_behind_another_layer_is_noticed(wrapped):
    jacobian = ActionJacobian(wrapped(GLOBAL))
    step = make_step(L1Config(0.05, epsilon=1.0), jacobian, False)
    x, u = torch.ones(2, 3), torch.ones(2, 1)
    _, state, _ = step(init([2], 3, 1), x, u)
    GLOBAL.train()
    with pytest.raises(ValueError, match=r"is in train mode, in which its layer .*Dropout"):
        step(state, x, u)
    GLOBAL.eval()
    step(state, x, u)


def test_a_model_predicts_by_its_own_default_whatever_is_explored():
    class Gaussian(nn.Linear):
        def forward(self, x: torch.Tensor, u: torch.Tensor):
            return super().forward(torch.cat([x, u], -1)), torch.ones_like(x)

    model = ProbabilisticTensorDictSequential(
        TensorDictModule(Gaussian(4, 3), ["observation", "action"], ["loc", "scale"]),
        ProbabilisticTensorDictModule(["loc", "scale"], ["delta"], distribution_class=Normal),
    )
    jacobian = ActionJacobian(model, out_key="delta")
    x, u = torch.ones(2, 3), torch.ones(2, 1)
    jacobian.prepare(x, u)
    with set_exploration_type(ExplorationType.RANDOM):
        value, matrix = jacobian(x, u)
    expected = model.module[0].module(x, u)[0]
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(matrix[0, :, 0], model.module[0].module.weight[:, 3])
