"""What a real environment does that the model is not told: noise and disturbances."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform


class _EnvironmentOnly(Transform):
    """A transform of environments, with the reason why stored data must not pass it."""

    reason: ClassVar[str]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuse to work on stored data.

        Raises:
            RuntimeError: always.
        """
        raise RuntimeError(
            f"{type(self).__name__} belongs to an environment (TransformedEnv), not to a replay "
            f"buffer or a policy: {self.reason}"
        )


class _UniformNoise(_EnvironmentOnly):
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

    The action in the rollout stays noise-free: only what travels on to the base environment
    changes. The sum is not clipped again (MuJoCo clamps limited actuators), and the reward's
    control cost sees the noisy action, as in the authors' released code.

    Place it *before* a controller such as ``L1Transform`` in ``Compose``: actions travel from the
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

    def __init__(self, half_width: float, action_key: NestedKey = "action") -> None:
        super().__init__(half_width, action_key)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(self.key, self._noisy(tensordict.get(self.key)))


class ObservationNoise(_UniformNoise):
    r"""Noise :math:`U(-w, w)` on the observation after a step, independent per entry and step.

    The observation of a reset stays clean; reward and termination were computed from the clean
    state. Everything downstream (policy, L1, data set) sees the noisy observation. All of this is
    as in the authors' released code.

    Args:
        half_width: half-width ``w`` in raw observation units, the same for every entry.
        observation_key: key of the observation.

    Raises:
        ValueError: if ``half_width`` is negative or not finite.
    """

    def __init__(self, half_width: float, observation_key: NestedKey = "observation") -> None:
        super().__init__(half_width, observation_key)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(self.key, self._noisy(next_tensordict.get(self.key)))


class _ActuatorDisturbance(_EnvironmentOnly):
    """An elementwise map of the action on its way to the base environment."""

    reason = "it changes what an environment executes"

    value: Tensor

    def __init__(
        self,
        disturb: Callable[[Tensor, Tensor], Tensor],
        value: float | Sequence[float],
        action_key: NestedKey,
    ) -> None:
        super().__init__()
        tensor = torch.as_tensor(value, dtype=torch.float64)
        if tensor.ndim > 1 or not tensor.isfinite().all():
            raise ValueError(
                f"{type(self).__name__} needs a finite number, or one for each action entry, "
                f"got {value!r}"
            )
        self.register_buffer("value", tensor)
        self.action_key = action_key
        self._disturb = disturb

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key)
        if self.value.ndim and self.value.shape[-1] != action.shape[-1]:
            raise ValueError(
                f"{type(self).__name__} has {self.value.shape[-1]} values, but the action "
                f"{self.action_key!r} has {action.shape[-1]} entries"
            )
        return tensordict.set(self.action_key, self._disturb(action, self.value.to(action)))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.value.tolist()}, key={self.action_key!r})"


class ActuatorBias(_ActuatorDisturbance):
    """A constant on top of every action that the environment executes: ``u + bias``.

    The textbook matched disturbance: L1 estimates and cancels it. The action in the rollout is
    unchanged.

    Args:
        bias: raw action units; one number, or one for each action entry.
        action_key: key of the action.

    Raises:
        ValueError: if the bias is not finite or, at the first step, has the wrong length.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_l1.envs import BatchedMujocoEnv
        >>> base = BatchedMujocoEnv("half_cheetah", num_envs=2, seed=0)
        >>> env = TransformedEnv(base, ActuatorBias([0.2, 0, 0, 0, 0, 0]))
        >>> env.rollout(3)["action"].shape
        torch.Size([2, 3, 6])
    """

    def __init__(self, bias: float | Sequence[float], action_key: NestedKey = "action") -> None:
        super().__init__(torch.add, bias, action_key)


class ActuatorGain(_ActuatorDisturbance):
    """A factor on every action that the environment executes: ``gain * u``.

    A weakened (or overdriven) actuator. The action in the rollout is unchanged.

    Args:
        gain: one number, or one for each action entry; 1 is the nominal actuator.
        action_key: key of the action.

    Raises:
        ValueError: if the gain is not finite or, at the first step, has the wrong length.
    """

    def __init__(self, gain: float | Sequence[float], action_key: NestedKey = "action") -> None:
        super().__init__(torch.mul, gain, action_key)


# Key of the metadata of a field.
_DISTURBANCE = "disturbance"


@dataclass(frozen=True)
class Disturbance:
    """A disturbance as recipes, evaluations and reports know it.

    Attributes:
        setting: key of ``perturbation`` in recipes, and argument of :func:`make_env`.
        name: option of ``torchrl-l1 evaluate``, key of a campaign's evaluations, and column of
            their tables.
        transform: makes the transform that applies a value of it.
        neutral: the value that changes nothing.
        units: of its values, in words.
        help: what its values are, in words.
    """

    setting: str
    name: str
    transform: Callable[[float | Sequence[float]], Transform]
    neutral: float
    units: str
    help: str

    @property
    def words(self) -> str:
        """Its name in sentences and at axes, such as ``actuator bias``."""
        return self.setting.replace("_", " ")


def disturbance(
    name: str,
    transform: Callable[[float | Sequence[float]], Transform],
    *,
    neutral: float,
    units: str,
    help: str,
) -> Any:
    """A field of :class:`Perturbation` that is a :class:`Disturbance`, neutral by default."""
    described = {"name": name, "transform": transform, "neutral": neutral}
    described |= {"units": units, "help": help}
    return field(default=neutral, metadata={_DISTURBANCE: described})


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
    """What the real environment does that the model is not told.

    A further disturbance is a :class:`~torchrl.envs.Transform` and a field here: options, keys,
    columns, tables and figures follow from the field. Of several the first acts first on the
    action that a controller sends.

    Attributes:
        action_noise: half-width of uniform noise on the executed action, action units.
        observation_noise: half-width of uniform noise on the observation, raw state units.
        actuator_bias: constant added to the executed action, action units.
        actuator_gain: factor on the executed action.
    """

    action_noise: float = 0.0
    observation_noise: float = 0.0
    actuator_bias: float = disturbance(
        "bias", ActuatorBias, neutral=0.0, units="action units",
        help="actuator biases, action units",
    )  # fmt: skip
    actuator_gain: float = disturbance(
        "gain", ActuatorGain, neutral=1.0, units="factor", help="actuator gains"
    )

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not math.isfinite(value):
                raise ValueError(f"perturbation.{name} must be finite, got {value}")
            if name.endswith("_noise") and value < 0:
                raise ValueError(f"perturbation.{name} must not be negative, got {value}")


DISTURBANCES: Mapping[str, Disturbance] = disturbances_of(Perturbation)
"""By name: what evaluations vary, and training too where a recipe says so."""
