"""L1 in pipelines of others: the situations in which an error says what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import (
    CatFrames,
    Compose,
    ConditionalPolicySwitch,
    DTypeCastTransform,
    ExcludeTransform,
    FrameSkipTransform,
    RenameTransform,
    SelectTransform,
    Transform,
    TransformedEnv,
    VecNormV2,
)

from tests.control.compositions import (
    BOTH,
    Identity,
    Pipeline,
    actor,
    model,
    normaliser,
    pendulum,
    two,
)
from torchrl_l1.control import L1Config, L1Controller, L1Transform, OracleTransform, init
from torchrl_l1.envs import (
    ActionNoise,
    ActuatorBias,
    ActuatorGain,
    ObservationNoise,
    SensorBias,
    Stiction,
)


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


class WritesUncounted(Transform):
    """NumPy's writes, and those through ``data``, which torch does not count."""

    def __init__(self, view: Callable[[Tensor], Any]) -> None:
        super().__init__()
        self.view = view

    def forward(self, observation: Tensor) -> Tensor:
        written = self.view(observation)
        written -= 5.0
        return torch.as_tensor(written)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.forward(next_tensordict["observation"])
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)


def in_data(observation: Tensor) -> Tensor:
    return observation.data


class Pushes(nn.Linear):
    """A model that looks at the action only."""

    def forward(self, x: Tensor, u: Tensor) -> Tensor:
        return super().forward(u)


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
DISTURBS = r"comes after L1Transform and so disturbs.*write Compose\(\.\.\., {}\(\.\.\.\), L1T"
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
    **{
        f"{who} writes by {view.__name__}": (BOTH, {where: what}, ValueError, IS_NOT)
        for view in (Tensor.numpy, in_data)
        for who, where, what in (
            ("transform", "after", [partial(WritesUncounted, view)]),
            (
                "policy",
                "module",
                TensorDictModule(WritesUncounted(view), ["observation"], ["other"]),
            ),
        )
    },
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
    **{
        f"policy switched {where}": (
            ("transform",),
            {where: [partial(ConditionalPolicySwitch, actor(), lambda data: True)]},
            ValueError,
            "ConditionalPolicySwitch beside L1Transform lets its policy bypass it",
        )
        for where in ("before", "after")
    },
    "disturbed under another name after": (
        ("transform",),
        {
            "after": [
                partial(RenameTransform, [], [], ["action"], ["asked"]),
                partial(ActuatorBias, 0.5, "asked"),
            ]
        },
        ValueError,
        DISTURBS.format("ActuatorBias"),
    ),
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
        "already has entries under 'l1'",
    ),
    "state excluded": (
        ("transform",),
        {"after": [partial(ExcludeTransform, "l1")]},
        ValueError,
        r"removes \['x_hat', .*'started', 'seal'\] under 'l1'",
    ),
    "part of the state excluded": (
        ("transform",),
        {"after": [partial(ExcludeTransform, ("l1", "q"))]},
        ValueError,
        r"removes \['q'\] under 'l1'",
    ),
    "part of the state excluded outside": (
        BOTH,
        {"outside": [partial(ExcludeTransform, ("l1", "started"))], **two},
        KeyError,
        r"found no \['started'\] under 'l1': a transform, a module or a collector removed it",
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
        BOTH,
        {"module": Zeroing([("l1", name) for name in (*init([], 3, 1).entries(), "seal")])},
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


def test_a_later_transform_of_the_observation_is_refused() -> None:
    def make(*transforms: Transform) -> TransformedEnv:
        return TransformedEnv(pendulum(), Compose(*transforms))

    l1 = partial(L1Transform, model, dt=0.05)
    with pytest.raises(ValueError, match="ObservationNorm comes after L1Transform"):
        make(l1(), normaliser()).reset()
    nested = TransformedEnv(pendulum(), l1())
    nested.append_transform(Compose(normaliser()))
    with pytest.raises(ValueError, match="ObservationNorm comes after L1Transform"):
        nested.reset()
    make(normaliser(), l1()).rollout(2)
    make(l1(), normaliser(out_keys=["normalised"])).rollout(2)


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


@pytest.mark.parametrize("face", [L1Transform, L1Controller, OracleTransform])
def test_entries_are_under_one_name(face: type) -> None:
    settings = {} if face is OracleTransform else {"dynamics": model, "dt": 0.05}
    with pytest.raises(TypeError, match=rf"{face.__name__} keeps .* must be a str, got \('agen"):
        face(key=("agents", "l1"), **settings)


def test_a_model_converted_to_another_type_is_noticed() -> None:
    dynamics = Pushes(1, 3)
    l1 = L1Transform(dynamics, dt=0.05)
    dynamics.double()  # before the environment is there it is no matter
    env = TransformedEnv(pendulum(), l1)
    data = env.rollout(3)
    assert data["l1", "x_hat"].dtype == torch.float64
    dynamics.float()
    with pytest.raises(ValueError, match=r"model is of torch.float32 and was of torch.float64"):
        env.reset()


def controller(**settings: Any) -> L1Controller:
    dims = {"observation_dim": 3, "action_dim": 1}
    return L1Controller(model, **{"dt": 0.05, **dims, **settings})


def test_two_faces_under_one_name_are_refused() -> None:
    l1, ours = partial(L1Transform, model, dt=0.05), controller()
    for chain in ((l1(), ours.make_primer()), (controller().make_primer(), ours.make_primer())):
        with pytest.raises(
            ValueError,
            match=r"already has entries under 'l1', of another controller|is there beside",
        ):
            TransformedEnv(pendulum(), Compose(*chain)).reset()
    # Collectors may add a second primer of one controller.
    twice = TransformedEnv(pendulum(), Compose(ours.make_primer(), ours.make_primer()))
    policy = TensorDictSequential(actor(), ours)
    once = TransformedEnv(pendulum(), ours.make_primer())
    for env in (twice, once):
        env.set_seed(0)
    data, expected = (env.rollout(5, policy) for env in (twice, once))
    assert torch.equal(data["next", "l1", "x_hat"], expected["next", "l1", "x_hat"])


def test_a_controller_that_is_applied_twice_is_noticed() -> None:
    ours = controller()
    env = TransformedEnv(pendulum(), ours.make_primer())
    with pytest.raises(ValueError, match="applied again to 'action', its own output"):
        env.rollout(2, TensorDictSequential(actor(), ours, ours))


def test_the_primer_of_other_settings_is_told() -> None:
    other = controller(config=L1Config.robust(0.05), dt=None)
    env = TransformedEnv(pendulum(), other.make_primer())
    mine = controller(action_low=-2.0, action_high=2.0)
    with pytest.raises(ValueError, match="is that of an L1 with other settings or widths"):
        env.rollout(2, TensorDictSequential(actor(), mine))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: L1Transform(model, 0.05),
            r"L1Transform takes an L1Config .* got float: .* dt=0\.05",
        ),
        (lambda: controller(config={"dt": 0.05}, dt=None), "L1Controller takes an L1Config"),
        (
            lambda: L1Transform(Pushes, dt=0.05),
            r"is the class Pushes: give a model, Pushes\(\.\.\.\)",
        ),
    ],
)
def test_arguments_of_another_kind_are_named(make: Any, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        make()
