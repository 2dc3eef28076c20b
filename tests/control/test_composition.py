"""L1 in pipelines of others: each situation is either right, or an error says what is wrong.

Right means: what the environment receives is what the pure core sends, computed anew from what was
recorded on both sides of L1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.envs import (
    ActionScaling,
    CatFrames,
    ClipTransform,
    Compose,
    DoubleToFloat,
    DTypeCastTransform,
    EnvBase,
    ExcludeTransform,
    FrameSkipTransform,
    GymEnv,
    ObservationNorm,
    RenameTransform,
    RewardSum,
    SelectTransform,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
    VecNormV2,
)
from torchrl.envs.utils import step_mdp

from torchrl_l1.control import ActionJacobian, L1Config, L1Controller, L1Transform, augment, init
from torchrl_l1.envs import (
    ActionNoise,
    ActuatorBias,
    ActuatorGain,
    ObservationNoise,
    SensorBias,
    Stiction,
)

Make = Callable[[], Any]
STEPS, EPSILON = 8, 0.5


def model(observation: Tensor, action: Tensor) -> Tensor:
    return 0.01 * observation + 0.1 * action.sin().expand_as(observation)


def act(observation: Tensor) -> Tensor:
    return 0.4 + 0.05 * observation[..., :1].float().clamp(-2.0, 2.0)


def actor(key: str = "observation") -> TensorDictModule:
    return TensorDictModule(act, [key], ["action"])


class Record(Transform):
    """What passes here: observations on their way out, actions on their way in."""

    def __init__(self, events: list[tuple[str, Tensor]]) -> None:
        super().__init__()
        self.events = events

    def _note(self, what: str, data: TensorDictBase, key: str = "observation") -> TensorDictBase:
        self.events.append((what, data[key].detach().clone()))
        return data

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._note("action", tensordict, "action")

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._note("step", next_tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._note("reset", tensordict_reset)


def assert_is_the_core(
    inner: Sequence[tuple[str, Tensor]], asked: Sequence[Tensor], dt: float, reads: Make = lambda: 0
) -> int:
    """What came in at ``inner`` is what the core makes of ``asked``; returns how much was added."""
    config = L1Config(dt, epsilon=EPSILON, action_low=-2.0, action_high=2.0)
    jacobian, state, added = ActionJacobian(model), init([], 3, 1), []
    asked, observation = list(asked), torch.zeros(3)
    for what, value in inner:
        if what != "action":
            observation = value.float()
            state = init([], 3, 1) if what == "reset" else state
            continue
        u_rl = asked.pop(0)
        with torch.no_grad():
            u, state, _ = augment(config, jacobian, state, observation, u_rl)
        torch.testing.assert_close(value, u, atol=1e-5, rtol=1e-5)
        added.append((u - u_rl).abs())
    assert not asked and torch.stack(added).max() > 0.05
    return len(added)


pendulum = partial(GymEnv, "Pendulum-v1")


class Pipeline:
    """``Compose(*before, L1, *after)`` around an environment, or in workers, inside ``outside``."""

    def __init__(
        self,
        face: str = "transform",
        before: Sequence[Make] = (),
        after: Sequence[Make] = (),
        outside: Sequence[Make] = (),
        module: TensorDictModuleBase | None = None,
        policy: TensorDictModuleBase | None = None,
        workers: int = 0,
        base: Callable[[], EnvBase] = pendulum,
        **settings: Any,
    ) -> None:
        self.events: list[tuple[list, list]] = []
        self.face, self.before, self.after, self.base = face, before, after, base
        self.settings = {"epsilon": EPSILON, **settings}
        modules = [policy or actor()] if module is None else [module, policy or actor()]
        if face == "controller":
            dims = {"observation_dim": 3, "action_dim": 1}
            self.controller = L1Controller(model, **dims, **self.settings)
            modules.append(self.controller)
        self.policy = TensorDictSequential(*modules)
        env = SerialEnv(workers, self.make) if workers else self.make()
        if outside:
            env = TransformedEnv(env, Compose(*(make() for make in outside)), auto_unwrap=False)
        env.set_seed(0)
        self.env = env

    def make(self) -> TransformedEnv:
        inner: list = []
        outer: list = []
        self.events.append((inner, outer))
        before, after = ([make() for make in makes] for makes in (self.before, self.after))
        if self.face == "controller":
            chain = [*before, self.controller.make_primer(), *after, Record(inner)]
        else:
            l1 = L1Transform(model, **self.settings)
            chain = [*before, Record(inner), l1, Record(outer), *after]
        return TransformedEnv(self.base(), Compose(*chain))

    def collect(self, how: str) -> TensorDictBase:
        if how == "rollout":
            return self.env.rollout(STEPS, self.policy, break_when_any_done=False)
        if how == "collector":
            options = {"frames_per_batch": STEPS // 2, "total_frames": STEPS}
            collector = Collector(
                self.env, self.policy, **options, auto_register_policy_transforms=False
            )
            data = torch.cat(list(collector), -1)
            collector.shutdown()
            return data
        steps, data = [], self.env.reset()
        for _ in range(STEPS):
            data = self.env.step(self.policy(data))
            steps.append(data.clone())
            data = self.env.step_mdp(data) if how == "env.step_mdp" else step_mdp(data)
        return torch.stack(steps, steps[0].ndim)

    def check(self, data: TensorDictBase, dt: float = 0.05) -> None:
        self.events = [pair for pair in self.events if pair[0]]
        assert self.events
        for row, (inner, outer) in enumerate(self.events):
            asked = [value for what, value in outer if what == "action"]
            if self.face == "controller":
                u_rl = data["l1", "u_rl"]
                asked = list(u_rl if u_rl.ndim == 2 else u_rl[row])
            assert_is_the_core(inner, asked, dt)


def normaliser(**keys: Any) -> ObservationNorm:
    return ObservationNorm(5.0, 0.1, in_keys=["observation"], **keys)


def scaled_actor() -> TensorDictModule:
    return TensorDictModule(lambda x: act(x) / 2, ["observation"], ["action"])


class Double(Transform):
    """A pendulum that measures in float64."""

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("observation", next_tensordict["observation"].double())

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec):
        observation_spec["observation"] = observation_spec["observation"].to(torch.float64)
        return observation_spec


class Identity(nn.Module):
    """A policy's own layer that writes to its own key."""

    def forward(self, observation: Tensor) -> Tensor:
        return (observation - 5.0) / 0.1


BOTH = ("transform", "controller")
two = {"workers": 2}
to_double = partial(DTypeCastTransform, torch.float32, torch.float64, in_keys=["observation"])
RIGHT: dict[str, tuple[Sequence[str], dict[str, Any]]] = {
    "alone": (BOTH, {}),
    "dt given": (BOTH, {"dt": 0.05}),
    "two environments": (BOTH, two),
    "counters after": (BOTH, {"after": [partial(StepCounter, 3), RewardSum]}),
    "counters after, two": (BOTH, {"after": [partial(StepCounter, 3)], **two}),
    "normaliser before": (BOTH, {"before": [partial(ObservationNorm, 0.1, 2.0, ["observation"])]}),
    "normaliser with its own key": (BOTH, {"after": [partial(normaliser, out_keys=["normal"])]}),
    "normaliser outside with its own key": (
        BOTH,
        {"outside": [partial(normaliser, out_keys=["normal"])], **two},
    ),
    "policy normalises to its own key": (
        BOTH,
        {
            "module": TensorDictModule(Identity(), ["observation"], ["normal"]),
            "policy": actor("normal"),
        },
    ),
    "frames skipped before": (BOTH, {"before": [partial(FrameSkipTransform, 3)]}),
    "frames skipped by the wrapper": (
        BOTH,
        {"base": partial(GymEnv, "Pendulum-v1", frame_skip=3)},
    ),
    "frames skipped after the primer": (
        ("controller",),
        {"after": [partial(FrameSkipTransform, 3)]},
    ),
    "bias before": (BOTH, {"before": [partial(ActuatorBias, 0.5)]}),
    "bias after the primer": (("controller",), {"after": [partial(ActuatorBias, 0.5)]}),
    "action scaled after": (("transform",), {"after": [ActionScaling], "policy": scaled_actor()}),
    "action clipped after": (
        ("transform",),
        {"after": [partial(ClipTransform, in_keys_inv=["action"], low=-2.0, high=2.0)]},
    ),
    "float64 sensors": (BOTH, {"before": [Double]}),
    "float64 sensors, float32 after": (BOTH, {"before": [Double], "after": [DoubleToFloat]}),
    "float64 sensors, float32 outside": (
        BOTH,
        {"before": [Double], "outside": [DoubleToFloat], **two},
    ),
    "float64 outside": (BOTH, {"outside": [to_double], **two}),
    "state selected": (BOTH, {"after": [partial(SelectTransform, "observation", "l1")]}),
    "state selected, two": (
        BOTH,
        {"after": [partial(SelectTransform, "observation", "l1")], **two},
    ),
    "diagnostics excluded": (BOTH, {"after": [partial(ExcludeTransform, ("l1", "switch"))]}),
}


@pytest.mark.parametrize(
    ("name", "face"), [(name, face) for name, (faces, _) in RIGHT.items() for face in faces]
)
def test_right(name: str, face: str) -> None:
    pipeline = Pipeline(face, **RIGHT[name][1])
    pipeline.check(pipeline.collect("rollout"), 0.15 if "frames" in name else 0.05)
    pipeline.env.close(raise_if_closed=False)


@pytest.mark.parametrize("how", ["collector", "env.step_mdp", "step_mdp"])
@pytest.mark.parametrize("name", ["alone", "two environments", "state selected, two"])
@pytest.mark.parametrize("face", BOTH)
def test_right_in_other_loops(face: str, name: str, how: str) -> None:
    pipeline = Pipeline(face, **RIGHT[name][1])
    pipeline.check(pipeline.collect(how))
    pipeline.env.close(raise_if_closed=False)


@pytest.mark.parametrize("face", BOTH)
@pytest.mark.parametrize("how", ["rollout", "collector"])
def test_a_selection_without_the_state_keeps_it_where_torchrl_does(face: str, how: str) -> None:
    pipeline = Pipeline(face, after=[partial(SelectTransform, "observation")])
    pipeline.check(pipeline.collect(how))


def test_the_raw_observation_under_a_key_of_its_own() -> None:
    copied = partial(RenameTransform, ["observation"], ["raw"], create_copy=True)
    pipeline = Pipeline(before=[copied, normaliser], observation_key="raw", policy=actor("raw"))
    data = pipeline.collect("rollout")
    inner, outer = pipeline.events[0]
    raw = [("reset", data["raw"][0])]
    for step in range(STEPS):
        raw += [("action", inner[2 * step + 1][1]), ("step", data["next", "raw"][step])]
    assert_is_the_core(raw, [value for what, value in outer if what == "action"], 0.05)


class Overwrites(Transform):
    """A transform of a user's, which declares nothing."""

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        observation = (next_tensordict["observation"] - 5.0) / 0.1
        return next_tensordict.set("observation", observation)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)


class OverwritesAfterSteps(Overwrites):
    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset


class WritesInPlace(nn.Module):
    def forward(self, observation: Tensor) -> Tensor:
        return observation.mul_(0.999)


class Repeats(Transform):
    """A frame skip of a user's."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.parent._step(tensordict)


class Compensated(Transform):
    """A disturbance of a user's, which the oracle would know."""

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", tensordict["action"] + 0.3)

    def compensate(self, action: Tensor) -> Tensor:
        return action - 0.3


def dropping(*keys: Any) -> TensorDictModule:
    """A module of a policy after which keys are gone, as of one that copies what it knows."""
    return Dropping(keys)


class Dropping(TensorDictModuleBase):
    in_keys = ["observation"]
    out_keys = ["observation"]

    def __init__(self, keys: Sequence[Any]) -> None:
        super().__init__()
        self.keys = keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        for key in self.keys:
            tensordict.pop(key, None)
        return tensordict


class Zeroing(Dropping):
    """Fills the state with zeros, as buffers do that know only its specs."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        for key in self.keys:
            tensordict.set(key, torch.zeros_like(tensordict.get(key)))
        return tensordict


IS_NOT = r"'observation' is not what the environment gave: .* separate out_keys, .*observation_key"
OVERWRITES = r"comes after L1Transform and overwrites 'observation'.*separate out_keys"
DISTURBS = r"comes after L1Transform, so that it disturbs.*write Compose\(\.\.\., {}\(\.\.\.\), L1T"
LOST = r"\[{}\] under 'l1' are not those that followed from the last step: they were lost"
WRONG: dict[str, tuple[Sequence[str], dict[str, Any], type[Exception], str]] = {
    "normaliser after": (("transform",), {"after": [normaliser]}, ValueError, OVERWRITES),
    "normaliser after the primer": (("controller",), {"after": [normaliser]}, ValueError, IS_NOT),
    "normaliser outside": (BOTH, {"outside": [normaliser]}, ValueError, IS_NOT),
    "normaliser outside two": (BOTH, {"outside": [normaliser], **two}, ValueError, IS_NOT),
    "running normaliser outside two": (
        BOTH,
        {"outside": [partial(VecNormV2, in_keys=["observation"])], **two},
        ValueError,
        IS_NOT,
    ),
    "frames stacked after": (
        ("transform",),
        {"after": [partial(CatFrames, 2, -1, ["observation"])]},
        ValueError,
        OVERWRITES,
    ),
    "frames stacked outside two": (
        BOTH,
        {"outside": [partial(CatFrames, 2, -1, ["observation"])], **two},
        ValueError,
        r"'observation' has shape .*separate out_keys",
    ),
    "undeclared after": (BOTH, {"after": [Overwrites]}, ValueError, IS_NOT),
    "undeclared after, not at reset": (BOTH, {"after": [OverwritesAfterSteps]}, ValueError, IS_NOT),
    "policy overwrites": (
        BOTH,
        {"module": TensorDictModule(Identity(), ["observation"], ["observation"])},
        ValueError,
        IS_NOT,
    ),
    "policy writes in place": (
        BOTH,
        {"module": TensorDictModule(WritesInPlace(), ["observation"], ["other"])},
        ValueError,
        IS_NOT,
    ),
    "noise on the observation after": (
        ("transform",),
        {"after": [partial(ObservationNoise, 0.1)]},
        ValueError,
        OVERWRITES,
    ),
    "biased sensor after": (
        ("transform",),
        {"after": [partial(SensorBias, 0.1)]},
        ValueError,
        OVERWRITES,
    ),
    "rounded to bfloat16 outside": (
        BOTH,
        {
            "outside": [
                partial(DTypeCastTransform, torch.float32, torch.bfloat16, ["observation"])
            ],
            **two,
        },
        ValueError,
        IS_NOT,
    ),
    "frames skipped after": (
        ("transform",),
        {"after": [partial(FrameSkipTransform, 3)]},
        ValueError,
        r"would apply it again to its own output: write Compose\(\.\.\., FrameSkipTransform\(",
    ),
    "frames skipped outside": (
        ("transform",),
        {"outside": [partial(FrameSkipTransform, 3)]},
        ValueError,
        "stepped 3 times from one state before it came to the next",
    ),
    "frames skipped outside two": (
        ("transform",),
        {"outside": [partial(FrameSkipTransform, 3)], **two},
        ValueError,
        "stepped 3 times from one state before it came to the next",
    ),
    "undeclared frame skip after": (
        ("transform",),
        {"after": [Repeats]},
        ValueError,
        "applied again to its own output",
    ),
    **{
        f"{kind.__name__} after": (
            ("transform",),
            {"after": [partial(kind, *arguments)]},
            ValueError,
            DISTURBS.format(kind.__name__),
        )
        for kind, *arguments in (
            (ActionNoise, 0.1),
            (ActuatorBias, 0.5),
            (ActuatorGain, 0.6),
            (Stiction, 0.1),
            (Compensated,),
        )
    },
    "dt of one frame with three": (
        BOTH,
        {"before": [partial(FrameSkipTransform, 3)], "dt": 0.05},
        ValueError,
        "has dt=0.05, but a step of the environment takes 0.15 s",
    ),
    "another dt": (BOTH, {"dt": 0.04}, ValueError, "has dt=0.04, but a step of the env.* 0.05 s"),
    "another dt, two": (BOTH, {"dt": 0.04, **two}, ValueError, "but a step of the environment tak"),
    "two of them": (
        ("transform",),
        {"before": [partial(L1Transform, model, dt=0.05)]},
        ValueError,
        "has entries under 'l1' already",
    ),
    "state excluded": (
        ("transform",),
        {"after": [partial(ExcludeTransform, "l1")]},
        ValueError,
        r"takes away \['x_hat', .*'started', 'seal'\] under 'l1'",
    ),
    "part of the state excluded": (
        ("transform",),
        {"after": [partial(ExcludeTransform, ("l1", "q"))]},
        ValueError,
        r"takes away \['q'\] under 'l1'",
    ),
    "part of the state excluded outside": (
        BOTH,
        {"outside": [partial(ExcludeTransform, ("l1", "started"))], **two},
        KeyError,
        r"found no \['started'\] under 'l1': a transform, a module or a collector took it away",
    ),
    "seal excluded outside": (
        ("transform",),
        {"outside": [partial(ExcludeTransform, ("l1", "seal"))], **two},
        KeyError,
        r"found no \['seal'\] under 'l1'",
    ),
    "part of the state renamed": (
        BOTH,
        {"after": [partial(RenameTransform, [("l1", "q")], ["other"])]},
        KeyError,
        r"found no \['q'\] under 'l1'",
    ),
    "state not selected outside": (
        ("transform",),
        {"outside": [partial(SelectTransform, "observation")], **two},
        ValueError,
        LOST.format(".*'started'"),
    ),
    "state not selected in workers": (
        ("transform",),
        {"after": [partial(SelectTransform, "observation")], **two},
        ValueError,
        "a batched environment would lose",
    ),
    "state dropped by the policy": (BOTH, {"module": dropping("l1")}, KeyError, "no state under"),
    "part of it dropped by the policy": (
        BOTH,
        {"module": dropping(("l1", "sigma_m"))},
        KeyError,
        r"found no \['sigma_m'\] under 'l1'",
    ),
    "start forgotten by the policy": (
        BOTH,
        {"module": Zeroing([("l1", "started")])},
        ValueError,
        LOST.format("'started'"),
    ),
    "filter forgotten by the policy": (
        BOTH,
        {"module": Zeroing([("l1", "q"), ("l1", "sigma_m")])},
        ValueError,
        LOST.format(".*'sigma_m'"),
    ),
    "all forgotten by the policy": (
        ("transform",),
        {
            "module": Zeroing(
                [("l1", name) for name in ("x_hat", "u_bar", "q", "sigma_m", "started", "seal")]
            )
        },
        ValueError,
        LOST.format(".*"),
    ),
}


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers:UserWarning")
@pytest.mark.parametrize(
    ("name", "face"), [(name, face) for name, (faces, *_) in WRONG.items() for face in faces]
)
def test_wrong(name: str, face: str) -> None:
    _, settings, error, message = WRONG[name]
    with pytest.raises(error, match=message.replace("L1Transform", "L1(Transform|Controller)")):
        # At the second step at the latest.
        pipeline = Pipeline(face, **settings)
        pipeline.env.rollout(2 if "filter" not in name else 4, pipeline.policy)


def test_state_that_stays_behind_is_noticed() -> None:
    pipeline = Pipeline(after=[partial(SelectTransform, "observation")])
    with pytest.raises(ValueError, match=LOST.format("'x_hat', 'u_bar', 'started'")):
        pipeline.collect("env.step_mdp")


def test_checks_can_be_switched_off() -> None:
    pipeline = Pipeline(after=[Overwrites], check=False, check_dt=False, dt=0.04)
    pipeline.collect("rollout")


def test_without_a_seal_the_controller_trusts() -> None:
    controller = L1Controller(model, dt=0.05, action_low=-2.0, action_high=2.0)
    nested = TensorDict(**init([2], 3, 1).entries(), batch_size=[2])
    data = TensorDict(
        observation=torch.ones(2, 3), action=torch.ones(2, 1), l1=nested, batch_size=[2]
    )
    assert controller(data)["next", "l1", "started"].all()
