"""The oracle: what the plant receives, whatever stands between it and the policy."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Composite, LazyTensorStorage, ReplayBuffer
from torchrl.envs import (
    ActionScaling,
    Compose,
    DoubleToFloat,
    GymEnv,
    RenameTransform,
    SerialEnv,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_l1.control import L1Transform, OracleTransform
from torchrl_l1.envs import ActionNoise, ActuatorBias, BatchedMujocoEnv, make_env

ONES = torch.ones(3, 1)


class Disturbed(Transform):
    """An invertible map of the action, and its inverse."""

    def __init__(
        self, disturb: Callable[[Tensor], Tensor], undo: Callable[[Tensor], Tensor]
    ) -> None:
        super().__init__()
        self.disturb, self.compensate = disturb, undo

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", self.disturb(tensordict["action"]))


class Received(Transform):
    """Remembers what the plant receives."""

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.last = tensordict["action"].clone()
        return tensordict


class Lift(Transform):
    """A disturbance that the oracle cannot undo."""

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", tensordict["action"] + 0.125)


def scaled(factor: float) -> Disturbed:
    return Disturbed(lambda u: factor * u, lambda u: u / factor)


def shifted(offset: float) -> Disturbed:
    return Disturbed(lambda u: u + offset, lambda u: u - offset)


def environment(*transforms: Transform) -> tuple[TransformedEnv, Received]:
    received = Received()
    base = BatchedMujocoEnv("inverted_pendulum", 3, seed=0)
    return TransformedEnv(base, Compose(received, *transforms)), received


def stepped(env: TransformedEnv, action: float) -> TensorDictBase:
    return env.step(env.reset().set("action", torch.full((3, 1), action)))


@given(st.floats(0.2, 5.0), st.floats(-2.0, 2.0), st.floats(0.2, 5.0), st.floats(-4.0, 4.0))
def test_the_whole_chain_is_undone_and_clipped_once(
    first: float, offset: float, last: float, action: float
) -> None:
    env, received = environment(scaled(first), shifted(offset), scaled(last), OracleTransform())
    data = stepped(env, action)
    # By hand: the plant receives first * (last * u + offset), and u lies within -3 and 3.
    sent = min(max((action / first - offset) / last, -3.0), 3.0)
    assert data["next", "l1", "u_exec"].tolist() == [[pytest.approx(sent, abs=1e-5)]] * 3
    reached = first * (last * sent + offset)
    assert received.last.tolist() == [[pytest.approx(reached, abs=1e-4)]] * 3
    assert data["action"].tolist() == [[pytest.approx(action)]] * 3
    # Clipping in between would have been felt.
    if abs((action / first - offset) / last) < 2.99:
        assert reached == pytest.approx(action, abs=1e-4)


def test_order_in_the_chain_matters() -> None:
    for chain, sent in (((scaled(2.0), shifted(1.0)), -0.5), ((shifted(1.0), scaled(2.0)), 0.0)):
        env, received = environment(*chain, OracleTransform())
        assert stepped(env, 1.0)["next", "l1", "u_exec"].unique().tolist() == [sent]
        assert received.last.unique().tolist() == [1.0]


def test_what_it_is_not_told_it_leaves_alone() -> None:
    env, received = environment(shifted(1.0), Lift(), OracleTransform(), shifted(0.25))
    # The last one stands between the policy and the oracle: it changes what the policy asks for.
    assert stepped(env, 1.0)["next", "l1", "u_exec"].unique().tolist() == [0.25]
    assert received.last.unique().tolist() == [1.375]


def test_nested_chains_are_searched_too() -> None:
    env, received = environment(Compose(shifted(0.5), Compose(scaled(2.0))), OracleTransform())
    stepped(env, 1.0)
    assert received.last.unique().tolist() == [1.0]


def test_environments_inside_are_searched_too() -> None:
    inner, received = environment(shifted(0.5))
    middle = TransformedEnv(inner, scaled(2.0), auto_unwrap=False)
    env = TransformedEnv(middle, OracleTransform(), auto_unwrap=False)
    assert stepped(env, 1.0)["next", "l1", "u_exec"].unique().tolist() == [0.25]
    assert received.last.unique().tolist() == [1.0]


def test_other_units_between_a_disturbance_and_the_oracle_are_refused() -> None:
    env, _ = environment(shifted(0.5), ActionScaling(), OracleTransform())
    with pytest.raises(ValueError, match="ActionScaling stands between Disturbed and Oracle"):
        env.reset()
    inside = environment(shifted(0.5), ActionScaling())[0]
    with pytest.raises(ValueError, match="put ActionScaling after OracleTransform"):
        TransformedEnv(inside, OracleTransform(), auto_unwrap=False).reset()
    # A change of type is none of units, and before the disturbance or after the oracle all is well.
    double = BatchedMujocoEnv("inverted_pendulum", 3, seed=0, dtype=torch.float64)
    cast = DoubleToFloat(in_keys=["observation"], in_keys_inv=["action"])
    TransformedEnv(double, Compose(shifted(0.5), cast, OracleTransform())).reset()
    env, received = environment(shifted(0.5), OracleTransform(), ActionScaling())
    env.step(env.reset().set("action", torch.full((3, 1), 0.25)))
    assert received.last.unique().tolist() == [0.75]
    environment(ActionScaling(), shifted(0.5), OracleTransform())[0].reset()


def test_episodes_of_a_cancelled_bias_are_those_without_it() -> None:
    def feedback(observation: Tensor) -> Tensor:
        return 8.0 * observation[..., 1:2]

    def episodes(*controller: Transform, **bias: float) -> TensorDictBase:
        env = make_env(
            "inverted_pendulum", 4, seed=3, dtype=torch.float64, extra_transforms=controller, **bias
        )
        policy = TensorDictModule(feedback, in_keys=["observation"], out_keys=["action"])
        return env.rollout(40, policy)

    undisturbed = episodes()
    lost = episodes(actuator_bias=0.7)
    kept = episodes(OracleTransform(), actuator_bias=0.7)
    torch.testing.assert_close(kept["observation"], undisturbed["observation"])
    assert (lost["observation"] - undisturbed["observation"]).abs().max() > 0.01


def test_specs_hold_on_batched_and_single_environments() -> None:
    check_env_specs(environment(shifted(0.5), ActionNoise(0.1), OracleTransform())[0])
    check_env_specs(TransformedEnv(GymEnv("Pendulum-v1"), Compose(scaled(2.0), OracleTransform())))
    many = SerialEnv(2, lambda: GymEnv("Pendulum-v1"))
    check_env_specs(TransformedEnv(many, Compose(scaled(2.0), OracleTransform())))


def test_environments_that_do_not_step_keep_what_they_had() -> None:
    env, _ = environment(shifted(1.0), OracleTransform())
    data = env.step(env.reset().set("action", torch.ones(3, 1)))
    following = env.step_mdp(data).set("action", torch.full((3, 1), 2.0))
    following["_step"] = torch.tensor([True, False, True]).unsqueeze(-1)
    executed = env.step(following)["next", "l1", "u_exec"]
    assert executed.flatten().tolist() == [1.0, 0.0, 1.0]


def test_stored_data_are_refused() -> None:
    buffer = ReplayBuffer(storage=LazyTensorStorage(4), batch_size=2, transform=OracleTransform())
    data = TensorDict({"action": torch.zeros(2, 1)}, batch_size=[2])
    with pytest.raises(RuntimeError, match="not to a replay buffer"):
        buffer.extend(data)
    with pytest.raises(RuntimeError, match="'u_exec'"):
        OracleTransform()(data)


@pytest.mark.parametrize("outside", [False, True])
def test_another_controller_beside_it_is_refused(outside: bool) -> None:
    def push(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([u, -u, u, -u], -1)

    for other in (OracleTransform(key="first"), L1Transform(push, dt=0.04, key="first")):
        env, _ = environment(shifted(0.5), other)
        if outside:
            env = TransformedEnv(env, OracleTransform(), auto_unwrap=False)
        else:
            env.append_transform(OracleTransform())
        name = type(other).__name__
        with pytest.raises(ValueError, match=f"(?=.*{name}).*is there beside"):
            env.reset()


def test_disturbances_within_the_members_of_a_batch_are_out_of_reach() -> None:
    def member() -> TransformedEnv:
        return TransformedEnv(GymEnv("InvertedPendulum-v5"), shifted(0.5))

    env = TransformedEnv(SerialEnv(2, member), OracleTransform())
    with pytest.raises(ValueError, match=r"Disturbed is within the members of a SerialEnv.*write"):
        env.reset()


def test_a_disturbance_of_another_action_is_none_of_its_business() -> None:
    plain = BatchedMujocoEnv("inverted_pendulum", 3, seed=0)
    actuator = plain.action_spec.clone()
    plain.action_spec = Composite(action=actuator, other=actuator.clone(), shape=[3])
    chain = ActuatorBias(0.5, "other"), ActuatorBias(0.25), OracleTransform()
    env = TransformedEnv(plain, Compose(*chain))
    env.append_transform(OracleTransform("other", key="beside"))
    after = env.step(env.reset().update({"action": ONES, "other": 2 * ONES}))["next"]
    assert after["l1", "u_exec"].unique().tolist() == [0.75]
    assert after["beside", "u_exec"].unique().tolist() == [1.5]


def test_a_disturbance_of_the_action_under_another_name_is_undone_too() -> None:
    renamed = RenameTransform([], [], ["action"], ["torque"])
    env, received = environment(ActuatorBias(0.5), renamed, OracleTransform("torque"))
    data = env.step(env.reset().set("torque", ONES))
    assert data["next", "l1", "u_exec"].unique().tolist() == [0.5]
    assert received.last.unique().tolist() == [1.0]


def test_bounds_are_those_where_it_stands() -> None:
    scaling, received = ActionScaling(), Received()
    base = BatchedMujocoEnv("inverted_pendulum", 3, seed=0)  # which takes three to either side
    env = TransformedEnv(base, Compose(received, scaling, shifted(0.9), OracleTransform()))
    assert stepped(env, -0.8)["next", "l1", "u_exec"].unique().tolist() == [-1.0]
    torch.testing.assert_close(received.last, torch.full((3, 1), 3 * (-1.0 + 0.9)))
    renamed = RenameTransform([], [], ["action"], ["torque"])
    env = TransformedEnv(base, Compose(renamed, OracleTransform("torque")))
    data = env.step(env.reset().set("torque", 5 * ONES))
    assert data["next", "l1", "u_exec"].unique().tolist() == [3.0]
