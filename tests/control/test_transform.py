from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from functools import partial

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl import set_auto_unwrap_transformed_env
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import (
    ActionScaling,
    Compose,
    DoubleToFloat,
    EnvBase,
    GymEnv,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.transforms import Transform
from torchrl.envs.utils import check_env_specs

from torchrl_l1.control import (
    ActionJacobian,
    L1Config,
    L1Diagnostics,
    L1Transform,
    augment,
    init,
)
from torchrl_l1.control.state import state_names
from torchrl_l1.dynamics import EnsembleDynamics, EnsembleModelEnv
from torchrl_l1.envs import TASKS, BatchedMujocoEnv


def make_model(n: int = 3, m: int = 1) -> EnsembleDynamics:
    torch.manual_seed(0)
    return EnsembleDynamics(n, m, members=2, hidden=(16,), activation="tanh")


def make_actor(n: int = 3, m: int = 1) -> TensorDictModule:
    torch.manual_seed(1)
    return TensorDictModule(nn.Linear(n, m), ["observation"], ["action"])


def make_env(transform: Transform, *others: Transform) -> TransformedEnv:
    env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(transform, *others))
    env.set_seed(0)
    return env


def test_settings_come_from_a_config_or_from_keywords():
    assert L1Transform(make_model(), dt=0.1, epsilon=0.3).config == L1Config(0.1, epsilon=0.3)
    config = L1Config.reference(0.1)
    assert L1Transform(make_model(), config).config is config
    with pytest.raises(ValueError, match=r"give config or \['dt', 'alpha'\], not both"):
        L1Transform(make_model(), config, dt=0.1, alpha=0.2)
    with pytest.raises(ValueError, match="dt must be a positive time"):
        L1Transform(make_model(), dt=0.0)
    with pytest.raises(TypeError, match=r"unknown settings \['epsilonn'\]"):
        L1Transform(make_model(), dt=0.1, epsilonn=0.3)


def test_the_policy_action_stays_and_the_environment_gets_the_executed_input():
    received = []

    class Recorder(Transform):
        def _inv_call(self, tensordict):
            received.append(tensordict["action"].clone())
            return tensordict

    env = make_env(Recorder(), L1Transform(make_model(), dt=0.05))
    data = env.rollout(12, make_actor())
    executed = data["next", "l1", "u_exec"]
    torch.testing.assert_close(torch.stack(received[-12:]), executed, atol=0, rtol=0)
    torch.testing.assert_close(data["action"], make_actor()(data.clone())["action"])
    # The filter takes the previous estimate, and the first is zero.
    assert (executed[2:] != data["action"][2:]).all()
    assert "_l1_pending" not in data.keys(True)
    # The state is carried on.
    torch.testing.assert_close(
        data["l1", "x_hat"][1:], data["next", "l1", "x_hat"][:-1], atol=0, rtol=0
    )


def test_bounds_are_the_action_specs_unless_given():
    def executed(transform: L1Transform, *before: Transform) -> torch.Tensor:
        env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(*before, transform))
        actor = TensorDictModule(lambda x: 5 + 0 * x[..., :1], ["observation"], ["action"])
        return env.rollout(3, actor)["next", "l1", "u_exec"]

    assert executed(L1Transform(make_model(), dt=0.05)).max() == 2.0
    assert executed(L1Transform(make_model(), dt=0.05, action_high=0.5)).max() == 0.5
    inf = float("inf")
    assert executed(L1Transform(make_model(), dt=0.05, action_high=inf)).max() >= 5.0
    # The spec that counts is the one at L1's place in the chain, also when that changes.
    assert executed(L1Transform(make_model(), dt=0.05), ActionScaling()).max() == 1.0
    env = TransformedEnv(GymEnv("Pendulum-v1"), L1Transform(make_model(), dt=0.05))
    actor = TensorDictModule(lambda x: 5 + 0 * x[..., :1], ["observation"], ["action"])
    assert env.rollout(3, actor)["next", "l1", "u_exec"].max() == 2.0
    env.insert_transform(0, ActionScaling())
    assert env.rollout(3, actor)["next", "l1", "u_exec"].max() == 1.0


def test_diagnostics_can_be_left_out():
    env = make_env(L1Transform(make_model(), dt=0.05, diagnostics=False))
    data = env.rollout(3, make_actor())
    assert set(data["next", "l1"].keys()) == {
        "x_hat", "u_bar", "q", "sigma_m", "n_switch", "started", "seal", "u_exec",
    }  # fmt: skip
    full = make_env(L1Transform(make_model(), dt=0.05)).observation_spec["l1"]
    assert set(L1Diagnostics._fields) < set(full.keys())


def test_the_model_keeps_its_mode_and_is_shared_not_registered():
    model = make_model()
    model.train()
    env = make_env(L1Transform(model, dt=0.05, epsilon=1e6))
    assert model.training
    env.eval()
    assert model.training
    assert not list(env.parameters()) and not env.state_dict()
    actor = make_actor()
    env.set_seed(0)
    first = env.rollout(3, actor)
    with torch.no_grad():
        model.network.biases[-1].add_(1.0)
    env.set_seed(0)
    second = env.rollout(3, actor)
    assert not torch.allclose(first["next", "l1", "x_hat"], second["next", "l1", "x_hat"])


def test_refused_in_a_replay_buffer():
    data = make_env(L1Transform(make_model(), dt=0.05)).rollout(3, make_actor())
    for transform in (
        L1Transform(make_model(), dt=0.05),
        Compose(L1Transform(make_model(), dt=0.05)),
    ):
        buffer = ReplayBuffer(storage=LazyTensorStorage(10), batch_size=2, transform=transform)
        with pytest.raises(RuntimeError, match="append it to a TransformedEnv, not to a replay"):
            buffer.extend(data)
    buffer = ReplayBuffer(storage=LazyTensorStorage(10), batch_size=2)
    buffer.extend(data)
    buffer.append_transform(L1Transform(make_model(), dt=0.05))
    with pytest.raises(RuntimeError, match="append it to a TransformedEnv, not to a replay"):
        buffer.sample()


def test_widths_and_keys_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match="observation_dim=4, but the data have width 3"):
        make_env(L1Transform(make_model(4), dt=0.05)).reset()
    with pytest.raises(ValueError, match="a_s has 2 entries, expected one number or 3"):
        make_env(L1Transform(make_model(), dt=0.05, a_s=(-1.0, -1.0))).reset()
    with pytest.raises(KeyError, match=r"no observation 'state', only \['observation'\]"):
        make_env(L1Transform(make_model(), dt=0.05, observation_key="state")).reset()
    with pytest.raises(ValueError, match="vector of floating-point numbers as action"):
        TransformedEnv(GymEnv("CartPole-v1"), L1Transform(make_model(4), dt=0.05)).reset()


def test_a_step_without_its_inputs_is_named():
    env = make_env(L1Transform(make_model(), dt=0.05))
    data = env.rand_action(env.reset())
    with pytest.raises(KeyError, match="no state under 'l1': reset the environment first"):
        env.step(data.exclude("l1"))
    with pytest.raises(KeyError, match=r"found no .*observation"):
        env.step(data.exclude("observation"))
    with pytest.raises(RuntimeError, match="belongs to no environment"):
        L1Transform(make_model(), dt=0.05)._reset(TensorDict(), TensorDict())


class Spoil(Transform):
    """Makes the observation of one environment not finite, at a step or at reset."""

    def __init__(self, at: int) -> None:
        super().__init__()
        self.at, self.count = at, 0

    def _step(self, tensordict, next_tensordict):
        self.count += 1
        return self._spoil(next_tensordict)

    def _reset(self, tensordict, tensordict_reset):
        return self._spoil(tensordict_reset)

    def _spoil(self, tensordict):
        if self.count == self.at:
            observation = tensordict["observation"].clone()
            observation[1, 0] = torch.nan
            tensordict["observation"] = observation
        return tensordict


def test_a_reset_to_an_observation_that_is_not_finite_is_an_error():
    base = SerialEnv(2, lambda: GymEnv("Pendulum-v1"))
    env = TransformedEnv(base, Compose(Spoil(0), L1Transform(make_model(), dt=0.05)))
    with pytest.raises(ValueError, match=r"not finite \(environments \[\[1\]\]\)"):
        env.reset()
    env.close()


def test_an_observation_that_is_not_finite_in_a_run_is_flagged():
    base = SerialEnv(2, lambda: GymEnv("Pendulum-v1"))
    env = TransformedEnv(base, Compose(Spoil(3), L1Transform(make_model(), dt=0.05)))
    actor = TensorDictModule(
        lambda x: 0.1 + 0 * x[..., :1].nan_to_num(), ["observation"], ["action"]
    )
    data = env.rollout(8, actor)
    env.close()
    flagged = data["next", "l1", "non_finite"].squeeze(-1)
    assert flagged.nonzero().tolist() == [[1, 3]]
    torch.testing.assert_close(data["next", "l1", "u_exec"][1, 3], data["action"][1, 3])
    assert data["l1", "started"].squeeze(-1)[1].tolist() == [0, 1, 1, 1, 0, 1, 1, 1]
    for value in data["next", "l1"].values():
        assert value.isfinite().all()


def test_float64_environment_and_a_model_without_parameters():
    env = TransformedEnv(
        GymEnv("InvertedPendulum-v5"),
        L1Transform(ActionJacobian(lambda x, u: 0.1 * u.expand_as(x)), dt=0.04),
    )
    data = env.rollout(3)
    assert data["next", "l1", "x_hat"].dtype == torch.float64
    assert data["next", "l1", "u_exec"].dtype == data["action"].dtype == torch.float32
    env = TransformedEnv(GymEnv("InvertedPendulum-v5"), L1Transform(make_model(4, 1), dt=0.04))
    assert env.rollout(3)["next", "l1", "x_hat"].dtype == torch.float32


def test_survives_pickling_and_cloning():
    transform = L1Transform(make_model(), dt=0.05)
    actor = make_actor()
    expected = make_env(transform).rollout(5, actor)["next", "l1", "x_hat"]
    for twin in (pickle.loads(pickle.dumps(transform.clone())), transform.clone()):
        data = make_env(twin).rollout(5, actor)
        torch.testing.assert_close(data["next", "l1", "x_hat"], expected, atol=0, rtol=0)
    assert transform.clone().model is transform.model


def test_a_copied_environment_goes_on_without_a_reset():
    # Built of parts that can be pickled.
    base = EnsembleModelEnv(make_model(), cost, start, -2.0, 2.0)
    env = TransformedEnv(base, Compose(L1Transform(make_model(), dt=0.05)))
    actor = make_actor()
    data = env.step(actor(env.reset()))["next"].exclude("reward")
    for twin in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        following = twin.step(actor(data.clone()))
        expected = env.step(actor(data.clone()))
        assert following["next", "l1", "started"].all()
        for name, value in expected["next", "l1"].items():
            torch.testing.assert_close(following["next", "l1", name], value, atol=0, rtol=0)


def cost(observation: torch.Tensor, action: torch.Tensor, successor: torch.Tensor) -> torch.Tensor:
    return successor.square().sum(-1)


def start(count: int) -> torch.Tensor:
    return torch.full((count, 3), 0.5)


def test_a_transform_inserted_between_steps_counts_at_once():
    env = TransformedEnv(GymEnv("Pendulum-v1"), L1Transform(make_model(), dt=0.05))
    data = env.reset().set("action", torch.full((1,), 5.0))
    assert env.step(data.clone())["next", "l1", "u_exec"].item() == 2.0
    env.insert_transform(0, ActionScaling())
    assert env.step(data.clone())["next", "l1", "u_exec"].item() == 1.0


def test_native_autoreset_restarts_the_environments_that_ended():
    env = make_env(L1Transform(make_model(), dt=0.05))
    data = env.rollout(3, make_actor())["next"][-2:].clone()
    transform = env.transform[0]
    transform._layout = transform._layout.__class__(
        **{**transform._layout.__dict__, "batch_size": torch.Size([2])}
    )
    mask = torch.tensor([[False], [True]])
    out = transform._reset_on_native_autoreset(
        TensorDict(_reset=mask, batch_size=[2]), data.clone()
    )
    assert out["l1", "started"].squeeze(-1).tolist() == [True, False]
    torch.testing.assert_close(out["l1", "x_hat"][0], data["l1", "x_hat"][0])
    assert out["l1", "x_hat"][1].abs().max() == 0


def test_double_to_float_before_l1():
    env = TransformedEnv(
        GymEnv("InvertedPendulum-v5"),
        Compose(DoubleToFloat(), L1Transform(make_model(4, 1), dt=0.04)),
    )
    assert env.rollout(3)["observation"].dtype == torch.float32


CONFIG = L1Config(0.04, epsilon=0.003, action_low=-3.0, action_high=3.0)
pendulum = partial(GymEnv, "InvertedPendulum-v5")


@pytest.fixture(scope="module")
def model() -> EnsembleDynamics:
    torch.manual_seed(0)
    return EnsembleDynamics(4, 1, members=2, hidden=(16,), activation="tanh")


@pytest.fixture
def actor() -> TensorDictModule:
    torch.manual_seed(1)
    return TensorDictModule(nn.Linear(4, 1), ["observation"], ["action"])


def with_l1(base: EnvBase, model: EnsembleDynamics, max_steps: int | None = 7) -> TransformedEnv:
    limit = [] if max_steps is None else [StepCounter(max_steps)]
    transform = Compose(DoubleToFloat(), L1Transform(model, CONFIG), *limit)
    return TransformedEnv(base, transform, auto_unwrap=True)


def assert_l1_is_right(data: TensorDictBase, model: EnsembleDynamics) -> None:
    """Recompute every environment's controller by itself from the recorded inputs."""
    data = data.reshape(-1, data.shape[-1])
    jacobian = ActionJacobian(model)
    resets = 0
    for trajectory in data.unbind(0):
        state = init([1], 4, 1)
        for t, item in enumerate(trajectory.unbind(0)):
            if t > 0 and trajectory["next", "done"][t - 1]:
                state = init([1], 4, 1)
                resets += 1
            assert item["l1", "started"].item() == state.started.item()
            with torch.no_grad():
                u, state, _ = augment(
                    CONFIG, jacobian, state, item["observation"][None], item["action"][None]
                )
            torch.testing.assert_close(item["next", "l1", "u_exec"], u[0], atol=1e-5, rtol=1e-5)
            for name, value in state.entries().items():
                torch.testing.assert_close(item["next", "l1", name], value[0], atol=1e-5, rtol=1e-5)
    assert resets > 0
    assert data["next", "l1", "n_switch"].max() > 0


BASES = {
    "one": pendulum,
    "own": lambda: BatchedMujocoEnv("inverted_pendulum", num_envs=2),
    "serial": lambda: SerialEnv(2, pendulum),
    "parallel": lambda: ParallelEnv(2, pendulum),
}


@pytest.mark.usefixtures("forked_processes")
@pytest.mark.parametrize("kind", BASES)
def test_around_an_environment(kind, model, actor):
    env = with_l1(BASES[kind](), model)
    check_env_specs(env)
    env.set_seed(0)
    assert_l1_is_right(env.rollout(20, actor, break_when_any_done=False), model)
    env.close()


def test_around_a_vectorised_gym_environment(model):
    # Gymnasium resets its own environments when the pole falls, which a constant push ensures.
    env = with_l1(pendulum(num_envs=2), model, max_steps=None)
    check_env_specs(env)
    env.set_seed(0)
    push = torch.tensor([[0.3], [1.0]])
    actor = TensorDictModule(lambda x: push + 0.1 * x[..., :1], ["observation"], ["action"])
    data = env.rollout(40, actor, break_when_any_done=False)
    first, second = (row.nonzero().flatten().tolist() for row in data["next", "done"].squeeze(-1))
    assert first != second
    assert_l1_is_right(data, model)
    env.close()


@pytest.mark.usefixtures("forked_processes")
@pytest.mark.parametrize("kind", ["serial", "processes"])
def test_inside_a_batched_environment(kind, model, actor):
    def make():
        l1 = L1Transform(model, CONFIG)
        return TransformedEnv(
            GymEnv("InvertedPendulum-v5"), Compose(DoubleToFloat(), l1, StepCounter(7))
        )

    env = SerialEnv(2, make) if kind == "serial" else ParallelEnv(2, make)
    check_env_specs(env)
    env.set_seed(0)
    assert_l1_is_right(env.rollout(20, actor, break_when_any_done=False), model)
    env.close()


@pytest.mark.parametrize("max_frames", [None, 5])
def test_in_a_collector(model, actor, max_frames):
    env = with_l1(SerialEnv(2, pendulum), model, max_steps=7 if max_frames is None else None)
    with set_auto_unwrap_transformed_env(True):  # the collector wraps the environment again
        collector = Collector(
            env,
            actor,
            frames_per_batch=40,
            total_frames=80,
            max_frames_per_traj=max_frames or 0,
            auto_register_policy_transforms=False,
        )
    batches = list(collector)
    collector.shutdown()
    # The second batch goes on where the first ended.
    assert_l1_is_right(torch.cat(batches, dim=-1), model)
    assert batches[1]["l1", "started"][:, 0].all() or max_frames is not None


@pytest.mark.parametrize("in_collector", [False, True])
def test_own_environments_that_end_at_different_times(model, in_collector):
    falling = replace(TASKS["inverted_pendulum"], terminated=lambda o: o[..., 1].abs() > 0.2)
    env = with_l1(BatchedMujocoEnv(falling, num_envs=4, seed=0), model, max_steps=None)
    push = torch.tensor([[0.2], [0.5], [1.0], [-1.5]])
    actor = TensorDictModule(lambda x: push + 0.1 * x[..., :1], ["observation"], ["action"])
    if in_collector:
        with set_auto_unwrap_transformed_env(True):
            collector = Collector(
                env,
                actor,
                frames_per_batch=80,
                total_frames=160,
                auto_register_policy_transforms=False,
            )
        data = torch.cat(list(collector), dim=-1)
        collector.shutdown()
    else:
        data = env.rollout(40, actor, break_when_any_done=False)
        env.close()
    ends = data["next", "terminated"].squeeze(-1)
    assert ends.any(-1).all()
    assert (ends.any(0) & ~ends.all(0)).any()  # partial resets
    assert len({tuple(row.nonzero().flatten().tolist()) for row in ends}) == 4
    assert_l1_is_right(data, model)


def test_partial_reset_by_hand(model, actor):
    env = with_l1(SerialEnv(3, pendulum), model, max_steps=None)
    data = env.reset()
    for _ in range(4):
        _, data = env.step_and_maybe_reset(actor(data))
    before = data["l1"].clone()
    data["_reset"] = torch.tensor([[False], [True], [False]])
    after = env.reset(data)["l1"]
    assert after["started"].squeeze(-1).tolist() == [True, False, True]
    for name in state_names(CONFIG):
        torch.testing.assert_close(after[name][[0, 2]], before[name][[0, 2]], atol=0, rtol=0)
    assert after["n_switch"][1] == 0
    env.close()


def test_replay_data_hold_the_policys_action(model, actor):
    env = with_l1(SerialEnv(2, pendulum), model)
    data = env.rollout(10, actor, break_when_any_done=False)
    env.close()
    buffer = ReplayBuffer(storage=LazyTensorStorage(20), batch_size=20)
    buffer.extend(data.reshape(-1))
    stored = buffer[:]
    torch.testing.assert_close(stored["action"], actor(stored.clone())["action"])
    executed = stored["next", "l1", "u_exec"]
    assert not torch.allclose(executed, stored["action"])


def test_environments_that_are_done_wait_for_the_others(model):
    # The own environment goes on with all rows, whatever it is asked.
    falling = replace(TASKS["inverted_pendulum"], terminated=lambda o: o[..., 1].abs() > 0.2)
    env = with_l1(BatchedMujocoEnv(falling, num_envs=2, seed=0), model, max_steps=None)
    push = torch.tensor([[0.2], [1.5]])
    actor = TensorDictModule(lambda x: push + 0.1 * x[..., :1], ["observation"], ["action"])
    data = env.rollout(60, actor, break_when_any_done=False, break_when_all_done=True)
    first, second = (int(row.nonzero()[0]) for row in data["next", "done"].squeeze(-1))
    assert second < first == data.shape[1] - 1
    assert torch.equal(data["next", "l1", "q"][1, second], data["next", "l1", "q"][1, -1])


def test_resets_share_no_memory():
    env = make_env(L1Transform(make_model(), dt=0.05))
    first = env.reset()
    for value in first["l1"].values():
        value.fill_(1)
    second = env.reset()
    assert all((value == 0).all() for name, value in second["l1"].items() if name != "seal")
    assert second["l1"].keys() == first["l1"].keys()
