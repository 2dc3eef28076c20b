from __future__ import annotations

import math
from functools import partial
from typing import Any

import gymnasium
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.data import Binary, Bounded, Composite, OneHot, Unbounded
from torchrl.envs import (
    ActionScaling,
    ClipTransform,
    Compose,
    EnvBase,
    FrameSkipTransform,
    GymEnv,
    GymWrapper,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
    VecNorm,
    VecNormV2,
)

from torchrl_l1.control import L1Config, L1Controller, L1Transform
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import BatchedMujocoEnv

pendulum = partial(GymEnv, "Pendulum-v1")


def model(observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    return 0.1 * action.expand_as(observation)


def test_a_transform_appended_later_is_checked_at_the_next_reset():
    env = TransformedEnv(pendulum(), L1Transform(model))
    env.rollout(2)
    env.append_transform(FrameSkipTransform(2))
    with pytest.raises(ValueError, match="FrameSkipTransform comes after L1Transform"):
        env.reset()


def normalised(kind: type[VecNorm | VecNormV2], frozen: bool, outside: bool) -> TransformedEnv:
    """A pendulum behind a running normaliser, which has seen some steps."""
    env = TransformedEnv(pendulum(), kind(in_keys=["observation"]))
    env.rollout(5)
    if frozen:
        env.transform.freeze()
    return TransformedEnv(env, StepCounter(), auto_unwrap=False) if outside else env


def gymnasium_normalised(frozen: bool) -> GymWrapper:
    env = gymnasium.wrappers.NormalizeObservation(gymnasium.make("Pendulum-v1"))
    env.update_running_mean = not frozen
    return GymWrapper(env)


class Agents(EnvBase):
    """Two agents, each with a ``done`` of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_spec = Composite(observation=Unbounded((3,)))
        self.action_spec = Composite(action=Bounded(-1, 1, (1,)))
        done = Binary(shape=(2, 1), dtype=torch.bool)
        self.full_done_spec = Composite(agent=Composite(done=done, terminated=done.clone()))

    def _set_seed(self, seed: int | None) -> None:
        pass

    def _reset(self, tensordict: Any = None, **kwargs: Any) -> TensorDict:
        return self.full_observation_spec.zero().update(self.full_done_spec.zero())

    def _step(self, tensordict: TensorDict) -> TensorDict:
        return self._reset().update(self.full_reward_spec.zero())


def with_face(face: str, env: EnvBase, **settings: Any) -> EnvBase:
    if face == "transform":
        return TransformedEnv(env, L1Transform(model, **settings), auto_unwrap=False)
    controller = L1Controller(model, observation_dim=3, action_dim=1, **settings)
    return TransformedEnv(env, controller.make_primer(), auto_unwrap=False)


FACES = ("transform", "controller")
NORMALISED = {
    "VecNorm": partial(normalised, VecNorm),
    "VecNormV2": partial(normalised, VecNormV2),
    "NormalizeObservation": lambda frozen, outside: gymnasium_normalised(frozen),
}


@pytest.mark.filterwarnings("ignore:.*VecNorm:FutureWarning")
@pytest.mark.parametrize("face", FACES)
@pytest.mark.parametrize("outside", [False, True])
@pytest.mark.parametrize("name", NORMALISED)
def test_statistics_that_change_before_l1_are_noticed(face, outside, name):
    make = NORMALISED[name]
    with pytest.warns(UserWarning, match=f"{name} stands between .* keeps changing its statistics"):
        with_face(face, make(frozen=False, outside=outside)).reset()
    with_face(face, make(frozen=True, outside=outside)).reset()


def test_statistics_that_change_in_each_environment_are_noticed():
    base = SerialEnv(2, partial(gymnasium_normalised, False))
    with pytest.warns(UserWarning, match="NormalizeObservation stands between"):
        TransformedEnv(base, L1Transform(model, dt=0.05)).reset()


@pytest.mark.parametrize("face", FACES)
def test_resets_without_a_mask_at_the_root_are_refused(face):
    with pytest.raises(ValueError, match=r"L1\w+ restarts .* resets by \[\('agent', '_reset'\)"):
        with_face(face, Agents(), dt=0.05).reset()


def test_statistics_that_change_elsewhere_do_not_matter():
    own = VecNormV2(in_keys=["observation"], out_keys=["normal"])
    TransformedEnv(pendulum(), Compose(own, L1Transform(model))).reset()


@pytest.mark.filterwarnings("ignore:.*VecNorm:FutureWarning")
@pytest.mark.parametrize("face", FACES)
def test_bounds_beyond_those_of_the_environment_are_noticed(face):
    for bounds in ({"action_high": 3.0}, {"action_low": -3.0}, {"action_high": (2.5,)}):
        with pytest.warns(UserWarning, match="the environment's action ends at -?2.0"):
            with_face(face, pendulum(), **bounds).reset()
    # Less authority is a choice, and infinite bounds say that the spec is wrong.
    for bound in (1.0, 2.0, math.inf):
        with_face(face, pendulum(), action_low=-bound, action_high=bound).reset()


def test_actions_in_other_units_than_those_of_the_fit_are_noticed():
    torch.manual_seed(0)

    def wrapped(*transforms: Transform) -> TransformedEnv:
        scaled = ActionScaling(), L1Transform(ensemble, dt=0.04)
        base = BatchedMujocoEnv("inverted_pendulum", 2, seed=0)  # of actions within 3 either way
        return TransformedEnv(base, Compose(*(transforms or scaled)))

    ensemble = EnsembleDynamics(4, 1, members=2, hidden=(8,))
    wrapped().reset()  # nothing is known of a fit
    ensemble.fit_statistics(torch.randn(500, 4), 6 * torch.rand(500, 1) - 3, torch.randn(500, 4))
    with pytest.warns(
        UserWarning, match=r"actions far beyond .* entries \[0\]: other units\? Put A"
    ):
        wrapped().reset()
    controller = L1Controller(ensemble, dt=0.04)
    env = wrapped(ActionScaling(), controller.make_primer())
    policy = TensorDictModule(lambda x: x[..., :1], ["observation"], ["action"])
    with pytest.warns(UserWarning, match="other units"):
        env.rollout(1, TensorDictSequential(policy, controller))
    wrapped(L1Transform(ensemble, dt=0.04), ActionScaling()).reset()
    # A policy may send a little more than what arrives, but not by the units of a scaling.
    ensemble.fit_statistics(torch.randn(500, 4), 4 * torch.rand(500, 1) - 2, torch.randn(500, 4))
    with pytest.warns(UserWarning, match="other units"):
        wrapped().reset()
    wrapped(L1Transform(ensemble, dt=0.04, action_low=-1, action_high=1)).reset()
    # Of all actions within the bounds those at their ends have the largest deviation.
    ends = 1 - 2 * torch.randint(2, (500, 1)).float()
    ensemble.fit_statistics(torch.randn(500, 4), ends, torch.randn(500, 4))
    wrapped().reset()


def test_a_second_argument_of_another_type_is_named_and_not_printed():
    with pytest.raises(TypeError, match="L1Config as its second argument, got EnsembleDynamics:"):
        L1Transform(L1Config(0.04), EnsembleDynamics(4, 1, members=2, hidden=(8,)))


def controller(**settings: Any) -> L1Controller:
    return L1Controller(model, **{"observation_dim": 3, "action_dim": 1, **settings})


def test_two_controllers_of_one_action_are_refused():
    transform, other = partial(L1Transform, model), controller(key="other")
    twins = other.make_primer(), other.make_primer()
    for first, second, name in (
        (transform(), transform(key="second"), "L1Transform"),
        (other.make_primer(), transform(), "(?=.*L1Primer)L1Transform"),
        (other.make_primer(), controller(key="third").make_primer(), "L1Primer"),
    ):
        with pytest.raises(ValueError, match=rf"{name} is there beside .* leave one of them out"):
            TransformedEnv(pendulum(), Compose(first, second)).reset()
        outer = TransformedEnv(TransformedEnv(pendulum(), first.clone()), second, auto_unwrap=False)
        with pytest.raises(ValueError, match=r"is there beside .* leave one of them out"):
            outer.reset()
    for allowed in (transform(), Compose(*twins)):  # in another environment, and what one made
        TransformedEnv(pendulum(), allowed).reset()


class Plant(EnvBase):
    """A plant whose action is as asked."""

    dt = 0.05

    def __init__(self, action_key: str = "action", **keys: Any) -> None:
        super().__init__()
        self.observation_spec = Composite(observation=Unbounded((3,)))
        self.action_spec = Composite({action_key: keys.get("action", Bounded(-1.0, 1.0, (1,)))})
        self.reward_spec = Unbounded((1,))
        self.action = action_key

    def _reset(self, tensordict: TensorDict | None, **_: Any) -> TensorDict:
        return TensorDict(observation=torch.ones(3), done=torch.zeros(1, dtype=torch.bool))

    def _step(self, tensordict: TensorDict) -> TensorDict:
        observation = tensordict["observation"] + tensordict[self.action].float().sum()
        return self._reset(None).update({"observation": observation, "reward": torch.zeros(1)})

    def _set_seed(self, seed: int | None) -> None:
        pass


@pytest.mark.parametrize(
    ("environment", "widths", "message"),
    [
        ({"action": OneHot(2)}, {"action_dim": 2}, "vector of floating-point .* is OneHot"),
        ({"action_key": "act"}, {}, r"no action 'action', only \['act'\]: see action_key"),
        ({}, {"observation_dim": 2}, "has observation_dim=2, but the environment's has width 3"),
        ({}, {"action_dim": 2}, "has action_dim=2, but the environment's has width 1"),
        ({"action": Bounded(-1.0, 1.0, (0,))}, {}, r"of shape \(0,\)"),
        (
            {"action": Bounded(torch.tensor([-1.0, 1.0]), torch.ones(2))},
            {"action_dim": 2},
            r"low >= high in the entries \[1\].* leave locked actuators out",
        ),
    ],
)
def test_an_environment_that_does_not_fit_the_controller_is_refused(environment, widths, message):
    with pytest.raises((KeyError, ValueError), match=message):
        TransformedEnv(Plant(**environment), controller(**widths).make_primer()).reset()


@pytest.mark.parametrize(
    "make", [partial(L1Transform, model), lambda **settings: controller(**settings).make_primer()]
)
def test_a_clip_that_l1_does_not_know_is_warned_of(make):
    clip = partial(ClipTransform, in_keys=[], in_keys_inv=["action"])
    with pytest.warns(UserWarning, match=r"ClipTransform cuts off at 0\.6 .* action_high=0\.6"):
        TransformedEnv(pendulum(), Compose(clip(high=0.6), make())).reset()
    TransformedEnv(pendulum(), Compose(clip(high=0.6), make(action_high=0.6))).reset()
    TransformedEnv(pendulum(), Compose(clip(low=-2.0, high=2.0), make())).reset()
    TransformedEnv(
        pendulum(), Compose(clip(in_keys=["observation"], in_keys_inv=[], low=0), make())
    )


def test_a_time_step_left_out_is_each_environments_own():
    l1 = L1Transform(model)
    env = TransformedEnv(pendulum(), l1)
    env.reset()
    twin = l1.clone()
    TransformedEnv(pendulum(frame_skip=3), twin).reset()
    assert twin.config.dt == pytest.approx(0.15)
    env.insert_transform(0, FrameSkipTransform(2))
    env.reset()
    assert l1.config.dt == pytest.approx(0.1)


def test_one_controller_has_one_time_step():
    ours = controller()
    TransformedEnv(pendulum(), ours.make_primer()).reset()
    TransformedEnv(pendulum(), ours.make_primer()).reset()
    with pytest.raises(ValueError, match=r"took dt=0\.05 from an environment before, .* 0\.15 s: "):
        TransformedEnv(pendulum(frame_skip=3), ours.make_primer()).reset()


@pytest.mark.parametrize("face", ["transform", "controller"])
def test_bounds_hold_in_the_actions_type(face):
    plant = Plant(action=Bounded(-0.1, 0.1, (1,), dtype=torch.float64))
    ours = controller()
    transform = L1Transform(model) if face == "transform" else ours.make_primer()
    env = TransformedEnv(plant, transform)
    asked = TensorDictModule(
        lambda _: torch.full((1,), 0.3, dtype=torch.float64), ["observation"], ["action"]
    )
    policy = asked if face == "transform" else TensorDictSequential(asked, ours)
    executed = env.rollout(2, policy)["next", "l1", "u_exec"]
    assert executed.max() == 0.1 and env.action_spec.is_in(executed[0])
