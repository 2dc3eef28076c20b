"""Noise and disturbances: effects of a real environment that the model is not told about."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from torchrl_l1.envs.actuators import (
    ActuatorBias,
    ActuatorDelay,
    ActuatorGain,
    DeadZone,
    FailingMotor,
    SineBias,
    StepBias,
    Stiction,
    WalkBias,
)
from torchrl_l1.envs.disturbances import (
    EnvironmentTransform,
    RandomSigns,
    Value,
    where_stepped,
)
from torchrl_l1.envs.plant import check_plant
from torchrl_l1.envs.sensors import SensorBias, SensorDelay, SensorDropout


class _UniformNoise(EnvironmentTransform):
    """Uniform noise of a given half-width, drawn from torch's global generator."""

    reason = "noise must enter the data once, while they are collected"

    def __init__(self, half_width: float, key: NestedKey) -> None:
        super().__init__()
        if not (half_width >= 0 and math.isfinite(half_width)):
            raise ValueError(
                f"{type(self).__name__}: half_width must be finite and not negative, "
                f"got {half_width}"
            )
        self.half_width = float(half_width)
        self.key = key

    def _noisy(self, value: Tensor) -> Tensor:
        return value + torch.empty_like(value).uniform_(-self.half_width, self.half_width)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(half_width={self.half_width}, key={self.key!r})"


class ActionNoise(_UniformNoise):
    r"""Noise :math:`\xi \sim U(-w, w)` on the action, independent per entry and step.

    The action in the rollout stays noise-free; only the action passed on to the base environment
    changes. The sum is not clipped again (MuJoCo clamps limited actuators), and the reward's
    control cost sees the noisy action, as in the authors' released code.

    Place it *before* a controller such as ``L1Transform`` in ``Compose``: actions pass from the
    last transform to the first, so the noise then acts on what the controller sends to the
    actuators.

    Args:
        half_width: half-width ``w`` in raw action units; the standard deviation is
            ``w / sqrt(3)``. The paper's "0.1" is such a half-width.
        action_key: key of the action.

    Raises:
        ValueError: if ``half_width`` is negative or not finite.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_l1.envs import BatchedMujocoEnv
        >>> base = BatchedMujocoEnv("inverted_pendulum", num_envs=2, seed=0)
        >>> env = TransformedEnv(base, ActionNoise(0.1))
        >>> env.rollout(3)["action"].shape
        torch.Size([2, 3, 1])
    """

    disturbs = "action"

    def __init__(self, half_width: float, action_key: NestedKey = "action") -> None:
        super().__init__(half_width, action_key)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._environment()  # refuses replay buffers
        return tensordict.set(self.key, self._noisy(tensordict.get(self.key)))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self.check_order(remembers=False)
        return tensordict_reset


class ObservationNoise(_UniformNoise):
    r"""Noise :math:`U(-w, w)` on the observation after a step, independent per entry and step.

    The observation of a reset stays clean; reward and termination are computed from the clean
    state. Everything downstream (policy, L1, data set) sees the noisy observation. All of this is
    as in the authors' released code.

    Args:
        half_width: half-width ``w`` in raw observation units, the same for every entry.
        observation_key: key of the observation.

    Raises:
        ValueError: if ``half_width`` is negative or not finite.
    """

    disturbs = "observation"

    def __init__(self, half_width: float, observation_key: NestedKey = "observation") -> None:
        super().__init__(half_width, observation_key)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        clean = next_tensordict.get(self.key)
        noisy, begun = self._noisy(clean), self.begun(next_tensordict)
        if begun is not None:
            noisy = torch.where(begun, clean, noisy)
        return next_tensordict.set(self.key, where_stepped(tensordict, self.key, noisy))


# Metadata key of a field.
_DISTURBANCE = "disturbance"

SUITES = ("quick", "full")
"""Selections of values of the disturbances, see :func:`suite`."""


@dataclass(frozen=True)
class Disturbance:
    """A disturbance as recipes, evaluations and reports know it.

    Attributes:
        setting: key of ``perturbation`` in recipes, and argument of :func:`make_env`.
        name: option of ``torchrl-l1 evaluate``, key of a campaign's evaluations, column of their
            tables, and also an argument of :func:`make_env`.
        transform: makes the transform that applies a given value; ``None`` if the disturbance acts
            on the plant, see :func:`disturbed_model`.
        neutral: the value that changes nothing.
        units: units of its values, in words.
        help: description of its values, in words.
        matched: whether an input within the bounds of the actuators could cancel it.
        acts_on: where it enters: ``"action"``, ``"observation"`` or ``"plant"``.
        levels: by suite, the values to test.
    """

    setting: str
    name: str
    transform: Callable[[Any], Transform] | None
    neutral: float
    units: str
    help: str
    matched: bool = False
    acts_on: Literal["action", "observation", "plant"] = "action"
    levels: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    @property
    def words(self) -> str:
        """Its name in sentences and on axes, such as ``actuator bias``."""
        return self.setting.replace("_", " ")

    @property
    def of_plant(self) -> bool:
        """Whether it changes the plant, see :func:`disturbed_model`."""
        return self.acts_on == "plant"

    def begins(self, value: Any) -> int:
        """The first step of an episode that a given value disturbs."""
        return 0 if self.transform is None else getattr(self.transform(value), "at", 0)

    def check(self, value: float) -> None:
        """Reject a value that it cannot have.

        Raises:
            ValueError: naming the value.
        """
        if self.of_plant:
            check_plant(self.name, value)
        if self.transform is not None and value != self.neutral:
            self.transform(value)


def disturbance(
    name: str,
    transform: Callable[[Any], Transform] | None,
    *,
    neutral: float,
    units: str,
    help: str,
    matched: bool = False,
    acts_on: Literal["action", "observation", "plant"] = "action",
    quick: tuple[float, ...] = (),
    full: tuple[float, ...] = (),
) -> Any:
    """A field of :class:`Perturbation` that is a :class:`Disturbance`, neutral by default."""
    described: dict[str, Any] = {"name": name, "transform": transform, "neutral": neutral}
    described |= {"units": units, "help": help, "matched": matched, "acts_on": acts_on}
    described["levels"] = {"quick": quick, "full": full}
    return field(default=neutral, metadata={_DISTURBANCE: described})


def _sensor(name: str, transform: Callable[[Any], Transform], **described: Any) -> Any:
    return disturbance(name, transform, acts_on="observation", neutral=0.0, **described)


def _plant(name: str, **described: Any) -> Any:
    return disturbance(name, None, acts_on="plant", **described)


def _signs(magnitude: Value) -> ActuatorBias:
    return ActuatorBias(RandomSigns(magnitude))


def disturbances_of(settings: type[Perturbation]) -> dict[str, Disturbance]:
    """The disturbances among the fields of :class:`Perturbation`, by name."""
    found = [
        Disturbance(setting=part.name, **part.metadata[_DISTURBANCE])
        for part in fields(settings)
        if _DISTURBANCE in part.metadata
    ]
    return {entry.name: entry for entry in found}


@dataclass
class Perturbation:
    """Effects of a real environment that the model is not told about.

    A further disturbance is a :class:`~torchrl.envs.Transform` and a field here: options, keys,
    columns, tables and figures follow from the field. If several are active, the first acts first
    on the action that a controller sends, or on the observation that the environment makes.

    Attributes:
        action_noise: half-width of uniform noise on the executed action, action units.
        observation_noise: half-width of uniform noise on the observation, raw state units.
        actuator_bias: constant added to the executed action, action units.
        actuator_gain: factor on the executed action.
        random_signs_bias: magnitude of a constant bias whose signs are drawn for every episode
            and action entry, action units.
        sine_bias: amplitude of a bias with a period of 50 steps, action units.
        step_bias: bias that sets in at the 50th step of an episode, action units.
        random_walk_bias: standard deviation of a bias's change per step, action units.
        motor_gain: factor on the first entry of the action only.
        dead_zone: width up to which the action does nothing, action units.
        stiction: band within which an actuator holds its output, action units.
        actuator_delay: steps by which the action is delayed.
        sensor_bias: constant added to the observation, raw state units.
        sensor_delay: steps by which the observation is delayed.
        sensor_dropout: probability that an entry of the observation repeats its last reading.
        payload: extra mass on the first moving body, as a fraction of the model's mass.
        body_mass: factor on mass and inertia of all bodies.
        contact_friction: factor on the friction of all contacts.
        joint_damping: factor on the damping of all joints.
        joint_armature: factor on the rotor inertia of all joints.
        ground_slope: degrees by which gravity is tilted; uphill is along x.
        wind_force: force along x on the first moving body, as a fraction of the weight.
        contact_softness: factor on the time constant of all contacts.
    """

    action_noise: float = 0.0
    observation_noise: float = 0.0
    actuator_bias: float = disturbance(
        "bias", ActuatorBias, neutral=0.0, units="action units", matched=True,
        help="actuator biases, action units", quick=(0.3,), full=(-0.5, -0.2, 0.2, 0.5),
    )  # fmt: skip
    actuator_gain: float = disturbance(
        "gain", ActuatorGain, neutral=1.0, units="factor", matched=True,
        help="actuator gains", quick=(0.6,), full=(0.4, 0.6, 0.8, 1.2),
    )  # fmt: skip
    random_signs_bias: float = disturbance(
        "signs", _signs, neutral=0.0, units="action units", matched=True,
        help="magnitudes of biases with random signs, action units",
        quick=(0.3,), full=(0.1, 0.3, 0.5),
    )  # fmt: skip
    sine_bias: float = disturbance(
        "sine", SineBias, neutral=0.0, units="action units", matched=True,
        help="amplitudes of a sinusoidal bias, action units", quick=(0.3,), full=(0.1, 0.3, 0.5),
    )  # fmt: skip
    step_bias: float = disturbance(
        "step", StepBias, neutral=0.0, units="action units", matched=True,
        help="biases that set in at step 50, action units", quick=(0.3,), full=(0.1, 0.3, 0.5),
    )  # fmt: skip
    random_walk_bias: float = disturbance(
        "walk", WalkBias, neutral=0.0, units="action units", matched=True,
        help="step deviations of a random-walk bias, action units",
        quick=(0.03,), full=(0.01, 0.03, 0.05),
    )  # fmt: skip
    motor_gain: float = disturbance(
        "motor", FailingMotor, neutral=1.0, units="factor",
        help="gains of the first motor", quick=(0.0,), full=(0.0, 0.25, 0.5),
    )  # fmt: skip
    dead_zone: float = disturbance(
        "deadzone", DeadZone, neutral=0.0, units="action units", matched=True,
        help="widths of a dead zone, action units", quick=(0.2,), full=(0.1, 0.2, 0.4),
    )  # fmt: skip
    stiction: float = disturbance(
        "stiction", Stiction, neutral=0.0, units="action units",
        help="bands of stiction, action units", quick=(0.2,), full=(0.1, 0.2, 0.4),
    )  # fmt: skip
    actuator_delay: float = disturbance(
        "delay", ActuatorDelay, neutral=0.0, units="steps",
        help="delays of the action, steps", quick=(1.0,), full=(1.0, 2.0, 3.0),
    )  # fmt: skip
    sensor_bias: float = _sensor(
        "sensor_bias", SensorBias, units="state units",
        help="biases of all sensors, state units", quick=(0.05,), full=(0.02, 0.05, 0.1),
    )  # fmt: skip
    sensor_delay: float = _sensor(
        "sensor_delay", SensorDelay, units="steps",
        help="delays of the observation, steps", quick=(1.0,), full=(1.0, 2.0, 3.0),
    )  # fmt: skip
    sensor_dropout: float = _sensor(
        "dropout", SensorDropout, units="probability",
        help="probabilities that a reading is lost", quick=(0.2,), full=(0.1, 0.2, 0.4),
    )  # fmt: skip
    payload: float = _plant(
        "payload", neutral=0.0, units="fraction of the mass",
        help="payloads, fractions of the mass", quick=(0.3,), full=(0.1, 0.3, 0.5),
    )  # fmt: skip
    body_mass: float = _plant(
        "mass", neutral=1.0, units="factor",
        help="factors on all masses", quick=(1.5,), full=(0.5, 0.75, 1.5, 2.0),
    )  # fmt: skip
    contact_friction: float = _plant(
        "friction", neutral=1.0, units="factor",
        help="factors on the friction of contacts", quick=(0.5,), full=(0.25, 0.5, 2.0),
    )  # fmt: skip
    joint_damping: float = _plant(
        "damping", neutral=1.0, units="factor",
        help="factors on the damping of joints", quick=(2.0,), full=(0.5, 2.0, 4.0),
    )  # fmt: skip
    joint_armature: float = _plant(
        "armature", neutral=1.0, units="factor",
        help="factors on the inertia of rotors", quick=(2.0,), full=(0.5, 2.0, 4.0),
    )  # fmt: skip
    ground_slope: float = _plant(
        "slope", neutral=0.0, units="degrees",
        help="slopes of the ground, degrees", quick=(5.0,), full=(-10.0, -5.0, 5.0, 10.0),
    )  # fmt: skip
    wind_force: float = _plant(
        "wind", neutral=0.0, units="fraction of the weight",
        help="forces of wind, fractions of the weight", quick=(-0.1,), full=(-0.2, -0.1, 0.1, 0.2),
    )  # fmt: skip
    contact_softness: float = _plant(
        "softness", neutral=1.0, units="factor",
        help="factors on the time constant of contacts", quick=(2.0,), full=(2.0, 4.0),
    )  # fmt: skip

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not math.isfinite(value):
                raise ValueError(f"perturbation.{name} must be finite, got {value}")
            if name.endswith("_noise") and value < 0:
                raise ValueError(f"perturbation.{name} must not be negative, got {value}")
        for entry in disturbances_of(type(self)).values():
            try:
                entry.check(getattr(self, entry.setting))
            except ValueError as error:
                raise ValueError(f"perturbation.{entry.setting}: {error}") from None


DISTURBANCES: Mapping[str, Disturbance] = disturbances_of(Perturbation)
"""Disturbances by name: what evaluations vary, and training too if a recipe says so."""


def _differs(value: Any, neutral: float) -> bool:
    return callable(value) or bool((torch.as_tensor(value, dtype=torch.float64) != neutral).any())


def active_disturbances(given: Mapping[str, Any]) -> list[tuple[Disturbance, Any]]:
    """The active disturbances with their values, in the order of the registry.

    Raises:
        TypeError: for a disturbance that does not exist, or that is given twice.
    """
    known = {entry.setting: entry for entry in DISTURBANCES.values()}
    values: dict[str, Any] = {}
    for argument, value in given.items():
        setting = DISTURBANCES[argument].setting if argument in DISTURBANCES else argument
        if setting not in known:
            raise TypeError(
                f"make_env has no argument {argument!r}; its disturbances are {', '.join(known)}"
            )
        if setting in values:
            raise TypeError(f"make_env got {setting!r} twice, by its setting and by its name")
        values[setting] = value
    return [
        (entry, values[setting])
        for setting, entry in known.items()
        if setting in values and _differs(values[setting], entry.neutral)
    ]


def warn_of_late(active: list[tuple[Disturbance, Any]], horizon: float) -> None:
    """Warn about disturbances that begin only after the end of episodes of this many steps."""
    for entry, value in active:
        if (begins := entry.begins(value)) >= horizon:
            warnings.warn(
                f"{entry.name} does nothing here: it begins at step {begins}, and an episode has "
                f"{horizon:g} steps",
                stacklevel=3,
            )


def disturbance_transforms(**disturbances: Any) -> list[Transform]:
    """The transforms of disturbances, in the order in which :func:`make_env` uses them.

    Append them to any TorchRL environment that has ``action`` and ``observation``, before its
    controller.

    Args:
        **disturbances: as for :func:`make_env`; neutral ones are left out.

    Raises:
        TypeError: for a disturbance that does not exist, or that is given twice.
        ValueError: for a change of the plant, which no transform can make, or a value that a
            disturbance cannot have.

    Examples:
        >>> [type(transform).__name__ for transform in disturbance_transforms(gain=0.5, bias=0.3)]
        ['ActuatorGain', 'ActuatorBias']
    """
    active = active_disturbances(disturbances)
    if plant := plant_values(active):
        raise ValueError(
            f"{', '.join(plant)}: a change of the plant is not a transform, see make_env"
        )
    actuators, sensors = placed_transforms(active)
    return [*actuators, *sensors]


def plant_values(active: list[tuple[Disturbance, Any]]) -> dict[str, Any]:
    """The values of the disturbances that change the plant, by name."""
    return {entry.name: value for entry, value in active if entry.of_plant}


def placed_transforms(
    active: list[tuple[Disturbance, Any]],
) -> tuple[list[Transform], list[Transform]]:
    """Transforms of actions and of observations, such that the registry's first acts first."""
    placed: dict[str, list[Transform]] = {"action": [], "observation": []}
    for entry, value in active:
        if entry.transform is not None:
            placed[entry.acts_on].append(entry.transform(value))
    return placed["action"][::-1], placed["observation"]


def suite(name: str) -> list[dict[str, float]]:
    """The cells of a suite of disturbances: first none, then each value of each on its own.

    Args:
        name: one of :data:`SUITES`.

    Returns:
        Arguments of :func:`make_env` besides the task: ``{disturbance: value}``.

    Raises:
        ValueError: for an unknown name.

    Examples:
        >>> suite("quick")[:3]
        [{}, {'bias': 0.3}, {'gain': 0.6}]
    """
    if name not in SUITES:
        raise ValueError(f"unknown suite {name!r}; there are {', '.join(SUITES)}")
    return [
        {},
        *(
            {entry.name: value}
            for entry in DISTURBANCES.values()
            for value in entry.levels.get(name, ())
        ),
    ]
