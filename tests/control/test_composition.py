"""L1 in pipelines of others: the situations that are right.

Right means: what the environment receives is what the pure core sends, computed anew from what was
recorded on both sides of L1.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.envs import (
    ActionScaling,
    ClipTransform,
    DoubleToFloat,
    DTypeCastTransform,
    ExcludeTransform,
    FrameSkipTransform,
    GymEnv,
    InitTracker,
    NextObservationDelta,
    ObservationNorm,
    RenameTransform,
    RewardSum,
    SelectTransform,
    StepCounter,
    TargetReturn,
    Transform,
)

from tests.control.compositions import (
    BOTH,
    STEPS,
    Identity,
    Pipeline,
    act,
    actor,
    assert_is_the_core,
    normaliser,
    two,
)
from torchrl_l1.envs import ActuatorBias


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


to_double = partial(DTypeCastTransform, torch.float32, torch.float64, in_keys=["observation"])
RIGHT: dict[str, tuple[Sequence[str], dict[str, Any]]] = {
    "alone": (BOTH, {}),
    "dt given": (BOTH, {"dt": 0.05}),
    "two environments": (BOTH, two),
    "counters after": (BOTH, {"after": [partial(StepCounter, 3), RewardSum]}),
    "counters after, two": (BOTH, {"after": [partial(StepCounter, 3)], **two}),
    "starts told after": (BOTH, {"after": [InitTracker]}),
    "starts told after, two": (BOTH, {"after": [InitTracker], **two}),
    "return to come after": (BOTH, {"after": [partial(TargetReturn, 10.0)]}),
    "all stored as changes": (BOTH, {"after": [NextObservationDelta]}),
    "observation stored as changes": (
        BOTH,
        {"after": [partial(NextObservationDelta, ["observation"])]},
    ),
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
