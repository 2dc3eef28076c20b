from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    InteractionType,
    NormalParamExtractor,
    TensorDictModule,
    TensorDictSequential,
)
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Composite, LazyTensorStorage, ReplayBuffer
from torchrl.envs import (
    ActionScaling,
    Compose,
    DoubleToFloat,
    GymEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.modules.utils import get_primers_from_module
from torchrl.objectives import ClipPPOLoss, DDPGLoss, SACLoss, TD3Loss

from torchrl_l1.control import ActionJacobian, L1Config, L1Controller, L1Transform, init, step
from torchrl_l1.control.state import state_names
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import BatchedMujocoEnv

CONFIG = L1Config(0.04, epsilon=0.02, action_low=-3.0, action_high=3.0)


def make_model(n: int = 4, m: int = 1) -> EnsembleDynamics:
    torch.manual_seed(0)
    return EnsembleDynamics(n, m, members=2, hidden=(16,), activation="tanh")


def make_actor() -> TensorDictModule:
    torch.manual_seed(1)
    return TensorDictModule(nn.Linear(4, 1), ["observation"], ["action"])


def make_env(num_envs: int, *transforms) -> TransformedEnv:
    base = SerialEnv(num_envs, lambda: GymEnv("InvertedPendulum-v5"))
    env = TransformedEnv(base, Compose(DoubleToFloat(), *transforms, StepCounter(7)))
    env.set_seed(0)
    return env


@pytest.mark.parametrize("config", [CONFIG, L1Config.reference(0.04, epsilon=0.02)])
def test_controller_and_transform_give_the_same_trajectory(config):
    model, actor = make_model(), make_actor()
    controller = L1Controller(model, config)
    inside = make_env(3, L1Transform(model, config)).rollout(25, actor, break_when_any_done=False)
    outside = make_env(3, controller.make_primer()).rollout(
        25, TensorDictSequential(actor, controller), break_when_any_done=False
    )
    torch.testing.assert_close(outside["observation"], inside["observation"], atol=0, rtol=0)
    torch.testing.assert_close(outside["l1", "u_rl"], inside["action"], atol=0, rtol=0)
    torch.testing.assert_close(outside["action"], inside["next", "l1", "u_exec"], atol=0, rtol=0)
    assert outside["next", "done"].sum() >= 6
    for name in ("x_hat", "u_bar", "q", "sigma_m", "n_switch", "started", "switch", "unmatched"):
        torch.testing.assert_close(
            outside["next", "l1", name], inside["next", "l1", name], atol=0, rtol=0
        )
    assert (outside["action"] != outside["l1", "u_rl"]).any()


@pytest.mark.parametrize("preset", ["paper", "robust"])
def test_environments_that_a_mask_leaves_out_keep_their_state(preset):
    config = getattr(L1Config, preset)(0.04)
    model = make_model()
    model.residuals.calibrated.fill_(True)
    controller = L1Controller(model, config)
    base = BatchedMujocoEnv("inverted_pendulum", 3, seed=0)
    env = TransformedEnv(base, controller.make_primer())
    torch.manual_seed(2)
    data = env.reset()
    for t in range(5):
        before = data["l1"].clone()
        data["action"] = torch.rand(3, 1)
        if t in (2, 3):
            data["_step"] = torch.tensor([[True], [False], [True]])
        data = env.step_mdp(env.step(controller(data))).exclude("_step")
        for name in (*state_names(config), "u_exec", "prediction_error"):
            same = (data["l1", name] == before[name]).flatten(1).all(-1)
            if t in (2, 3):
                assert same[1], name
            if name == "x_hat":
                assert same.tolist() == [False, t in (2, 3), False]


def test_steps_of_another_policy_keep_the_state_that_a_mask_leaves_out():
    controller = L1Controller(make_model(), CONFIG)
    base = BatchedMujocoEnv("inverted_pendulum", 2, seed=0)
    env = TransformedEnv(base, controller.make_primer())
    data = env.step_mdp(env.step(controller(env.rand_action(env.reset()))))
    x_hat = data["l1", "x_hat"].clone()
    data = env.rand_action(data.exclude(("l1", "u_rl")))
    data["_step"] = torch.tensor([[False], [True]])
    data = env.step_mdp(env.step(data))
    assert torch.equal(data["l1", "x_hat"][0], x_hat[0])
    assert data["l1", "started"].flatten().tolist() == [True, False]


@pytest.mark.parametrize("has_weights", [False, True])
def test_types_are_those_of_the_transform(has_weights):
    def change(observation, action):
        effect = torch.tensor([[0.0, 0.1, 0.2, 0.3]], dtype=torch.float64)
        return 0.1 * observation + action.sin() @ effect

    model = make_model() if has_weights else change
    controller = L1Controller(model, CONFIG, observation_dim=4, action_dim=1)
    actor = TensorDictModule(lambda x: x[..., :1] - x[..., 1:2], ["observation"], ["action"])

    def environment(transform):
        base = BatchedMujocoEnv("inverted_pendulum", 2, seed=0, dtype=torch.float64)
        return TransformedEnv(base, transform)

    env = environment(controller.make_primer())
    outside = env.rollout(5, TensorDictSequential(actor, controller))
    inside = environment(L1Transform(model, CONFIG)).rollout(5, actor)
    assert torch.equal(outside["action"], inside["next", "l1", "u_exec"])
    for where in ("l1", ("next", "l1")):
        for name, spec in env.observation_spec["l1"].items():
            assert spec.dtype == outside[where][name].dtype == inside[where][name].dtype


def test_state_restarts_with_its_environment():
    controller = L1Controller(make_model(), CONFIG)
    data = make_env(3, controller.make_primer()).rollout(
        25, TensorDictSequential(make_actor(), controller), break_when_any_done=False
    )
    started = data["l1", "started"]
    # Not started exactly at the first step and after each reset.
    expected = torch.ones_like(started)
    expected[:, 0] = False
    expected[:, 1:] = ~data["next", "done"][:, :-1]
    assert torch.equal(started, expected)


def tensordict(controller: L1Controller, **changes) -> TensorDict:
    data = TensorDict(observation=torch.zeros(2, 4), action=torch.zeros(2, 1), batch_size=[2])
    data["l1"] = controller.make_primer().primers["l1"].zero([2])
    return data.update(changes)


def test_missing_entries_are_named():
    controller = L1Controller(make_model(), CONFIG)
    data = tensordict(controller)
    with pytest.raises(KeyError, match=r"no state under 'l1': append the primer"):
        controller(data.exclude("l1"))
    with pytest.raises(KeyError, match=r"found no \['q'\] under 'l1'"):
        controller(data.exclude(("l1", "q")))
    with pytest.raises(KeyError, match=r"found no .*action.* only .*l1.*observation"):
        controller(data.exclude("action"))


def test_wrong_widths_are_named():
    controller = L1Controller(make_model(), CONFIG)
    with pytest.raises(ValueError, match=r"'observation' has shape \(2, 5\), expected \(2, 4\)"):
        controller(tensordict(controller, observation=torch.zeros(2, 5)))
    with pytest.raises(ValueError, match=r"'action' has shape \(2, 2\), expected \(2, 1\)"):
        controller(tensordict(controller, action=torch.zeros(2, 2)))
    with pytest.raises(ValueError, match="observation_dim=3 was given, but the model has"):
        L1Controller(make_model(), CONFIG, observation_dim=3)
    with pytest.raises(ValueError, match="a_s has 2 entries"):
        L1Controller(make_model(), L1Config(0.1, a_s=(-1.0, -1.0))).make_primer()
    with pytest.raises(ValueError, match="give L1Controller observation_dim and action_dim"):
        L1Controller(lambda x, u: x, CONFIG).make_primer()


def test_other_keys_and_models_without_declared_widths():
    model = TensorDictModule(
        lambda x, u: x + 0.1 * u, in_keys=["pose", "torque"], out_keys=["next_pose"]
    )
    jacobian = ActionJacobian(
        model, observation_key="pose", action_key="torque", predicts="next_observation"
    )
    controller = L1Controller(
        jacobian,
        CONFIG,
        observation_key="pose",
        action_key="torque",
        key="adaptive",
        observation_dim=4,
        action_dim=1,
        diagnostics=False,
    )
    data = TensorDict(pose=torch.ones(2, 4), torque=torch.full((2, 1), 0.5), batch_size=[2])
    data["adaptive"] = controller.make_primer().primers["adaptive"].zero([2])
    out = controller(data)
    torch.testing.assert_close(out["next", "adaptive", "x_hat"], torch.full((2, 4), 1.05))
    torch.testing.assert_close(out["adaptive", "u_rl"], torch.full((2, 1), 0.5))
    assert ("next", "adaptive", "switch") not in out
    assert set(controller.out_keys) <= set(out.keys(True, True))


def test_the_model_is_not_among_the_parameters_and_is_shared():
    model = make_model()
    model.train()
    controller = L1Controller(model, CONFIG)
    assert not list(controller.parameters()) and not controller.state_dict()
    controller.eval()
    assert model.training
    first = controller(tensordict(controller))["next", "l1", "x_hat"]
    with torch.no_grad():
        model.network.biases[-1].add_(1.0)
    second = controller(tensordict(controller))["next", "l1", "x_hat"]
    assert not torch.allclose(first, second)


def test_torchrl_finds_the_primer():
    policy = TensorDictSequential(make_actor(), L1Controller(make_model(), CONFIG))
    env = make_env(2, get_primers_from_module(policy))
    assert env.rollout(3, policy)["next", "l1", "started"].all()


def test_survives_pickling():
    controller = L1Controller(make_model(), CONFIG)
    copy = pickle.loads(pickle.dumps(controller))
    expected = controller(tensordict(controller))["next", "l1", "x_hat"]
    torch.testing.assert_close(copy(tensordict(controller))["next", "l1", "x_hat"], expected)


STABLE = np.array([[-0.5, 1.0, 0.0], [0.0, -1.0, 0.5], [0.2, 0.0, -0.8]])
H = np.array([[0.3], [1.0], [-0.4]])


def simulate(
    config: L1Config,
    disturbance: Callable[[float], np.ndarray],
    steps: int,
    u_rl: float = 0.2,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Plant x' = x + T (A x + h u) + T d(t), known to the controller but for d (units / s).

    Returns the adaptive input, the matched estimate and norms of the unmatched and matched
    estimates, one row per step.
    """
    dt = config.dt
    jac = torch.as_tensor(dt * H)
    state = init([], 3, 1, dtype=torch.float64)
    x = torch.zeros(3, dtype=torch.float64)
    rows = []
    for t in range(steps):
        drift = torch.as_tensor(dt * STABLE @ x.numpy())
        action = torch.tensor([u_rl], dtype=torch.float64)
        u, state, diagnostics = step(config, state, x, action, drift, jac)
        rows.append(
            [
                u.item() - u_rl,
                state.sigma_m.item(),
                diagnostics.unmatched.item(),
                diagnostics.matched.item(),
            ]
        )
        x = x + drift + jac @ u + dt * torch.as_tensor(disturbance(t * dt))
    return tuple(np.array(rows).T)


@pytest.mark.parametrize(("dt", "share"), [(0.04, 0.961), (0.008, 0.992), (0.05, 0.951)])
@pytest.mark.parametrize("preset", [L1Config.paper, L1Config.reference])
def test_constant_matched_disturbance_is_cancelled(preset, dt, share):
    d = 0.7
    u_a, sigma_m, unmatched, _ = simulate(preset(dt), lambda t: d * H[:, 0], steps=120)
    assert u_a[-1] == pytest.approx(-share * d, abs=5e-4 * d)
    assert sigma_m[-1] == pytest.approx(share * d, abs=5e-4 * d)
    assert unmatched[-1] < 1e-9


def test_unmatched_disturbance_is_estimated_and_not_acted_on():
    direction = np.array([1.0, 0.1, 1.0])
    direction -= H[:, 0] * (direction @ H[:, 0]) / (H[:, 0] @ H[:, 0])
    u_a, sigma_m, unmatched, matched = simulate(L1Config(0.04), lambda t: direction, steps=120)
    assert np.abs(u_a).max() < 1e-12 and np.abs(sigma_m).max() < 1e-12
    assert unmatched[-1] == pytest.approx(0.961 * np.linalg.norm(direction), rel=1e-3)
    assert matched[-1] < 1e-12


def test_residual_of_a_slow_disturbance_is_of_the_order_of_the_sampling_time():
    """Theorem 1: O(T_s). The cutoff 0.35 / dt makes the filter's lag of that order too."""

    def residuals(dt: float) -> tuple[float, float]:
        def d(t: float) -> float:
            return 0.5 + 0.3 * np.sin(0.8 * t)

        steps = round(16 / dt)
        u_a, sigma_m, _, _ = simulate(L1Config(dt), lambda t: d(t) * H[:, 0], steps)
        truth = np.array([d(t * dt) for t in range(steps)])
        settled = slice(steps // 2, None)
        return np.abs(sigma_m - truth)[settled].max(), np.abs(u_a + truth)[settled].max()

    errors = np.array([residuals(dt) for dt in (0.08, 0.04, 0.02, 0.01)])
    ratios = errors[:-1] / errors[1:]
    assert (ratios > 1.8).all() and (ratios < 2.2).all(), errors


def test_without_disturbance_nothing_happens():
    u_a, sigma_m, unmatched, matched = simulate(L1Config(0.04), lambda t: np.zeros(3), steps=50)
    assert max(np.abs(v).max() for v in (u_a, sigma_m, unmatched, matched)) < 1e-12


def test_bounds_and_time_step_come_from_the_environment_or_its_spec():
    def pushes(controller: L1Controller) -> tuple[torch.Tensor, torch.Tensor]:
        env = make_env(2, controller.make_primer())
        strong = TensorDictModule(lambda x: 5.0 + 0 * x[..., :1], ["observation"], ["action"])
        data = env.rollout(6, TensorDictSequential(strong, controller), break_when_any_done=False)
        env.close()
        return data["action"], data["l1", "q"]

    expected = L1Config(0.04, epsilon=0.02, action_low=-3.0, action_high=3.0)
    spec = GymEnv("InvertedPendulum-v5").action_spec
    results = []
    for settings in (
        {"config": expected},
        {"dt": 0.04, "epsilon": 0.02},
        {"epsilon": 0.02},
        {"config": L1Config(0.04, epsilon=0.02), "action_spec": spec},
        {"dt": 0.04, "epsilon": 0.02, "action_spec": Composite(action=spec)},
        {"epsilon": 0.02, "action_low": -3.0},
    ):
        controller = L1Controller(make_model(), **settings)
        results.append(pushes(controller))
        assert controller.config == expected
    for action, q in results[1:]:
        assert torch.equal(action, results[0][0]) and torch.equal(q, results[0][1])
    assert results[0][0].max() == 3.0
    free = L1Controller(make_model(), dt=0.04, action_low=-torch.inf, action_high=torch.inf)
    pushes(free)
    assert free.config.action_high == torch.inf


def test_what_is_not_known_is_asked_for():
    unknown = L1Controller(make_model())
    with pytest.raises(ValueError, match="knows dt only once an environment with its primer"):
        unknown(tensordict(unknown))
    unbounded = L1Controller(make_model(), dt=0.04)
    data = tensordict(unbounded)
    with pytest.warns(
        UserWarning, match="no action bounds, .* give it action_spec=env.action_spec"
    ):
        unbounded(data)
    with pytest.raises(ValueError, match=r"give config or \['dt', 'epsilon'\], not both"):
        L1Controller(make_model(), CONFIG, dt=0.04, epsilon=0.1)
    with pytest.raises(TypeError, match=r"L1Controller got unknown settings \['epsilonn'\]"):
        L1Controller(make_model(), dt=0.04, epsilonn=0.1)
    with pytest.raises(ValueError, match="action_spec has several entries"):
        spec = GymEnv("InvertedPendulum-v5").action_spec
        L1Controller(make_model(), dt=0.04, action_spec=Composite(one=spec, other=spec.clone()))


def test_one_controller_in_environments_with_different_bounds_is_refused():
    controller = L1Controller(lambda x, u: 0.1 * u.expand_as(x), observation_dim=3, action_dim=1)
    env = TransformedEnv(GymEnv("Pendulum-v1"), controller.make_primer())
    env.reset()
    scaled = TransformedEnv(
        GymEnv("Pendulum-v1"), Compose(controller.make_primer(), ActionScaling())
    )
    with pytest.raises(ValueError, match="environments with different action bounds"):
        scaled.reset()


def test_random_frames_first():
    controller = L1Controller(make_model(), epsilon=0.02)
    env = make_env(2, controller.make_primer())
    collector = Collector(
        env,
        TensorDictSequential(make_actor(), controller),
        frames_per_batch=12,
        total_frames=24,
        init_random_frames=12,
        auto_register_policy_transforms=False,
    )
    first, second = list(collector)
    collector.shutdown()
    # L1 starts where the policy does, within an episode.
    assert not first["l1", "started"].any() and not first["next", "l1", "u_exec"].any()
    assert second["l1", "started"].any() and not second["l1", "started"][:, 0].any()


def test_predictions_of_several_members_under_a_name():
    module = TensorDictModule(
        lambda x, u: (torch.stack([0.1 * x + u, 0.3 * x + u]), x),
        ["observation", "action"],
        ["members", "other"],
    )
    options = {"out_key": "members", "ensemble_dim": 0, "predicts": "change"}
    controller = L1Controller(module, CONFIG, observation_dim=4, action_dim=1, **options)
    data = tensordict(controller, observation=torch.ones(2, 4), action=torch.ones(2, 1))
    torch.testing.assert_close(controller(data)["next", "l1", "x_hat"], torch.full((2, 4), 2.2))
    env = make_env(2, L1Transform(module, dt=0.04, **options))
    assert env.rollout(3)["next", "l1", "started"].all()
    with pytest.raises(ValueError, match="out_key and ensemble_dim to the ActionJacobian"):
        L1Transform(ActionJacobian(make_model()), dt=0.04, ensemble_dim=0)


def push(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    return 0.01 * x + 0.1 * u.expand_as(x)


def collected(kind: str) -> tuple[L1Controller | None, ProbabilisticActor, TensorDict]:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 2), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -2.0, "high": 2.0},
        return_log_prob=True,
        default_interaction_type=InteractionType.RANDOM,
    )
    with torch.no_grad():
        if kind == "transform":
            env = TransformedEnv(GymEnv("Pendulum-v1"), L1Transform(push, epsilon=10.0))
            return None, actor, env.rollout(32, actor)
        controller = L1Controller(push, epsilon=10.0, observation_dim=3, action_dim=1)
        env = TransformedEnv(GymEnv("Pendulum-v1"), controller.make_primer())
        return controller, actor, env.rollout(32, TensorDictSequential(actor, controller))


@pytest.mark.parametrize("kind", ["controller", "transform"])
def test_ppo_has_a_ratio_of_one_for_an_unchanged_policy(kind):
    controller, actor, data = collected(kind)
    critic = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    loss = ClipPPOLoss(actor, critic)
    loss.make_value_estimator(gamma=0.99, lmbda=0.95)
    if controller is not None:
        assert loss(data.clone())["kl_approx"].abs() > 0.01
        loss.set_keys(action=controller.policy_action_key)
    loss.value_estimator(data)
    result = loss(data)
    assert result["kl_approx"].abs() < 1e-5 and result["clip_fraction"] == 0
    # All ratios are one: the objective is the mean advantage.
    expected = -data["advantage"].mean()
    torch.testing.assert_close(result["loss_objective"], expected, atol=1e-5, rtol=1e-4)


@pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")
@pytest.mark.parametrize("kind", ["controller", "transform"])
def test_sac_replays_what_the_policy_chose(kind):
    controller, actor, data = collected(kind)
    key = "action" if controller is None else controller.policy_action_key
    seen = []

    class Critic(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.linear = nn.Linear(4, 1)

        def forward(self, observation, action):
            seen.append(action.detach())
            return self.linear(torch.cat([observation, action], -1))

    loss = SACLoss(
        actor,
        ValueOperator(Critic(), in_keys=["observation", key], out_keys=["state_action_value"]),
        num_qvalue_nets=1,
        action_spec=GymEnv("Pendulum-v1").action_spec,
    )
    loss.make_value_estimator(gamma=0.99)
    if controller is not None:
        loss.set_keys(action=controller.policy_action_key)
    buffer = ReplayBuffer(storage=LazyTensorStorage(32), batch_size=32)
    buffer.extend(data)
    sample = buffer[:]
    result = loss(sample)
    sum(value for name, value in result.items() if name.startswith("loss_")).backward()
    chosen = data[key]
    executed = data["next", "l1", "u_exec"]
    assert not torch.equal(chosen, executed)
    found = [action.reshape(chosen.shape) for action in seen if action.numel() == chosen.numel()]
    assert any(torch.equal(action, chosen) for action in found)
    assert not any(torch.equal(action, executed) for action in found)


@pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")
@pytest.mark.parametrize("kind", [DDPGLoss, TD3Loss])
def test_a_loss_is_given_the_actor_alone(kind):
    controller = L1Controller(make_model(), CONFIG)
    policy = TensorDictSequential(make_actor(), controller)
    env = make_env(2, controller.make_primer())
    data = env.rollout(3, policy).detach()
    critic = ValueOperator(MLP(5, 1, num_cells=[4]), in_keys=["observation", "action"])
    options = {} if kind is DDPGLoss else {"action_spec": env.action_spec}
    with pytest.raises(ValueError, match="give a loss the actor alone"):
        kind(policy, critic, **options)(data)
