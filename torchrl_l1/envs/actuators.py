"""Disturbances of the action on its way to the actuators.

They are transforms for any TorchRL environment, batched or not. Each keeps a separate state for
every environment (drawn values, steps since the reset, recent inputs), which a reset of that
environment renews. *Matched* says whether an input within the bounds of the actuators could cancel
the disturbance if its value were known; ``compensate`` gives that input.
"""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_l1.envs.disturbances import DelayLine, HeldDisturbance, Value


class _Actuator(HeldDisturbance):
    """A transform of the action on its way to the base environment."""

    reason = "it changes what an environment executes"
    what = disturbs = "action"
    matched: ClassVar[bool]

    def _disturb(self, action: Tensor, value: Tensor) -> Tensor:
        """What the environment executes, given the current state."""
        raise NotImplementedError

    def _advance(self, action: Tensor, executed: Tensor) -> dict[str, Tensor]:
        """The state after this step."""
        return {}

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._environment()  # refuses replay buffers
        action = tensordict.get(self.key)
        self._started(action)
        self._check_shape(action)
        executed = self._disturb(action, self._current(action))
        self._following = self._advance(action, executed)
        return tensordict.set(self.key, executed)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # Not before: a transform nearer to the plant may have skipped the step.
        if self._following:
            self._check_batch(self._following, tensordict.batch_size)
            self._keep(self._following, tensordict.get("_step", None), tensordict.batch_size)
            self._following = {}
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        parent = self.parent
        if parent is not None:
            spec = parent.full_action_spec[self.key]
            # An environment that is not batch-locked may add dimensions at reset.
            extra = tensordict_reset.batch_size[: tensordict_reset.ndim - len(parent.batch_size)]
            action = spec.zero(extra)
            self._restart(action, self.resets(tensordict))
            self.check_order(bool(self._state))
        return tensordict_reset

    _reset_on_native_autoreset = _reset


class _Matched(_Actuator):
    """A disturbance that an input can cancel."""

    matched = True

    def _undo(self, action: Tensor, value: Tensor) -> Tensor:
        raise NotImplementedError

    def compensate(self, action: Tensor) -> Tensor:
        """The action that, sent through this step's disturbance, makes the plant receive another.

        Call it before the step: it reads the current state (drawn value, time, walk) without
        changing it.

        Args:
            action: what the plant should receive ``(*batch, m)``.

        Returns:
            What to send, of the same shape; it may lie beyond the bounds of the actuators.
        """
        self._started(action)
        self._check_shape(action)
        return self._undo(action, self._current(action))


class ActuatorBias(_Matched):
    """A constant added to every action that the environment executes: ``u + bias``.

    The textbook matched disturbance: L1 estimates and cancels it. The action in the rollout is
    unchanged.

    Args:
        bias: raw action units; one number, one for each action entry, one row for each environment,
            or drawn at resets, for example by :class:`RandomSigns`.
        action_key: key of the action.

    Raises:
        ValueError: if the bias is not finite or, at the first step, has the wrong shape.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_l1.envs import BatchedMujocoEnv
        >>> base = BatchedMujocoEnv("half_cheetah", num_envs=2, seed=0)
        >>> env = TransformedEnv(base, ActuatorBias([0.2, 0, 0, 0, 0, 0]))
        >>> env.rollout(3)["action"].shape
        torch.Size([2, 3, 6])
    """

    def __init__(self, bias: Value, action_key: NestedKey = "action") -> None:
        super().__init__(bias, action_key)

    def _disturb(self, action: Tensor, value: Tensor) -> Tensor:
        return action + value

    def _undo(self, action: Tensor, value: Tensor) -> Tensor:
        return action - value


class _VaryingBias(_Matched):
    """A bias that changes from step to step."""

    def _bias(self, value: Tensor) -> Tensor:
        raise NotImplementedError

    def _disturb(self, action: Tensor, value: Tensor) -> Tensor:
        return action + self._bias(value)

    def _undo(self, action: Tensor, value: Tensor) -> Tensor:
        return action - self._bias(value)


class _TimedBias(_VaryingBias):
    """A bias that is a function of the steps since the reset."""

    def _begin(self, entry: Tensor) -> dict[str, Tensor]:
        return {"time": torch.zeros(*entry.shape[:-1], 1, dtype=torch.long, device=entry.device)}

    def _advance(self, action: Tensor, executed: Tensor) -> dict[str, Tensor]:
        return {"time": self._state["time"] + 1}


class SineBias(_TimedBias):
    r"""A sinusoidal bias: :math:`u + A \sin(2 \pi t / T)`, with t the steps since the reset.

    Matched.

    Args:
        amplitude: :math:`A`, raw action units; as for :class:`ActuatorBias`.
        period: :math:`T`, steps.
        action_key: key of the action.

    Raises:
        ValueError: if the amplitude is not finite, or the period not positive.
    """

    def __init__(
        self, amplitude: Value, period: float = 50.0, action_key: NestedKey = "action"
    ) -> None:
        super().__init__(amplitude, action_key)
        if not (period > 0 and math.isfinite(period)):
            raise ValueError(f"SineBias: period must be positive and finite, got {period}")
        self.period = float(period)

    def _bias(self, value: Tensor) -> Tensor:
        turns = self._state["time"].double() / self.period
        return value * (2 * math.pi * turns).sin().to(value)


class StepBias(_TimedBias):
    """A bias that sets in at a given step of the episode and stays.

    Matched.

    Args:
        bias: raw action units; as for :class:`ActuatorBias`.
        at: the first step with the bias; the first step of an episode is 0.
        action_key: key of the action.

    Raises:
        ValueError: if the bias is not finite, or the step negative.
    """

    def __init__(self, bias: Value, at: int = 50, action_key: NestedKey = "action") -> None:
        super().__init__(bias, action_key)
        if at < 0:
            raise ValueError(f"StepBias: at must not be negative, got {at}")
        self.at = at

    def _bias(self, value: Tensor) -> Tensor:
        return value * (self._state["time"] >= self.at).to(value)


class WalkBias(_VaryingBias):
    """A random-walk bias: zero at a reset, changed by a normal random number at every step.

    Matched as long as it has not walked beyond the bounds of the actuators.

    Args:
        deviation: standard deviation of the change per step, raw action units; as for
            :class:`ActuatorBias`. After k steps the bias has ``sqrt(k)`` times this deviation.
        action_key: key of the action.

    Raises:
        ValueError: if the deviation is negative or not finite.
    """

    def __init__(self, deviation: Value, action_key: NestedKey = "action") -> None:
        super().__init__(deviation, action_key)

    def _check(self, value: Tensor) -> None:
        self._require(bool((value >= 0).all()), "the deviation must not be negative", value)

    def _begin(self, entry: Tensor) -> dict[str, Tensor]:
        return {"bias": torch.zeros_like(entry)}

    def _bias(self, value: Tensor) -> Tensor:
        return self._state["bias"].to(value)

    def _advance(self, action: Tensor, executed: Tensor) -> dict[str, Tensor]:
        change = self._current(action) * torch.randn_like(action)
        return {"bias": self._state["bias"] + change}


class ActuatorGain(_Matched):
    """A factor on every action that the environment executes: ``gain * u``.

    A weakened (or overdriven) actuator. The action in the rollout is unchanged. Matched, except for
    entries with a gain of zero: nothing gets through these, and ``compensate`` leaves them
    unchanged.

    Args:
        gain: one number, one for each action entry, one row for each environment, or drawn at
            resets; 1 is the nominal actuator.
        action_key: key of the action.

    Raises:
        ValueError: if the gain is not finite or, at the first step, has the wrong shape.
    """

    def __init__(self, gain: Value, action_key: NestedKey = "action") -> None:
        super().__init__(gain, action_key)

    def _disturb(self, action: Tensor, value: Tensor) -> Tensor:
        return action * value

    def _undo(self, action: Tensor, value: Tensor) -> Tensor:
        return action / torch.where(value == 0, torch.ones_like(value), value)


class FailingMotor(ActuatorGain):
    """A factor on one motor only; the others are nominal.

    Not matched once the motor is dead (a gain of zero); ``compensate`` does what is possible.

    Args:
        gain: factor on the motor's input: 1 is healthy, 0 is dead; one number, one for each
            environment ``(*batch, 1)``, or drawn at resets.
        motor: index of the motor; drawn for each environment at every reset if ``None``.
        action_key: key of the action.

    Raises:
        ValueError: if the gain is not finite or, at the first step, there is no such motor.
    """

    matched = False

    def __init__(
        self, gain: Value, motor: int | None = 0, action_key: NestedKey = "action"
    ) -> None:
        super().__init__(gain, action_key)
        self.motor = motor

    def _begin(self, entry: Tensor) -> dict[str, Tensor]:
        motors, batch = entry.shape[-1], entry.shape[:-1]
        if self.motor is not None and not 0 <= self.motor < motors:
            raise ValueError(f"FailingMotor: there is no motor {self.motor} among {motors}")
        chosen = (
            torch.randint(motors, (*batch, 1))
            if self.motor is None
            else torch.full((*batch, 1), self.motor)
        )
        return {"fails": (torch.arange(motors) == chosen).to(entry.device)}

    def _current(self, entry: Tensor) -> Tensor:
        value = super()._current(entry)
        return torch.where(self._state["fails"], value, torch.ones_like(value))


class DeadZone(_Matched):
    """Small inputs do nothing, larger ones lose the width: ``sign(u) * max(|u| - width, 0)``.

    Play in a gear or a valve. Matched: its inverse adds the width.

    Args:
        width: raw action units, not negative; as for :class:`ActuatorBias`.
        action_key: key of the action.

    Raises:
        ValueError: if the width is negative or not finite.
    """

    def __init__(self, width: Value, action_key: NestedKey = "action") -> None:
        super().__init__(width, action_key)

    def _check(self, value: Tensor) -> None:
        self._require(bool((value >= 0).all()), "the width must not be negative", value)

    def _disturb(self, action: Tensor, value: Tensor) -> Tensor:
        return action.sign() * (action.abs() - value).clamp(min=0)

    def _undo(self, action: Tensor, value: Tensor) -> Tensor:
        return action + action.sign() * value


class Stiction(_Actuator):
    """The actuator holds its last output until the input differs from it by more than a band.

    The one-parameter model of a sticking valve (Stenman, Gustafsson and Forsman 2003): it holds its
    output, zero at a reset, while ``|u - output| <= band``, and otherwise follows the input at
    once. Not matched: values within the band cannot be reached in one step.

    Args:
        band: raw action units, not negative; as for :class:`ActuatorBias`.
        action_key: key of the action.

    Raises:
        ValueError: if the band is negative or not finite.
    """

    matched = False

    def __init__(self, band: Value, action_key: NestedKey = "action") -> None:
        super().__init__(band, action_key)

    def _check(self, value: Tensor) -> None:
        self._require(bool((value >= 0).all()), "the band must not be negative", value)

    def _begin(self, entry: Tensor) -> dict[str, Tensor]:
        return {"output": torch.zeros_like(entry)}

    def _disturb(self, action: Tensor, value: Tensor) -> Tensor:
        output = self._state["output"].to(action)
        return torch.where((action - output).abs() <= value, output, action)

    def _advance(self, action: Tensor, executed: Tensor) -> dict[str, Tensor]:
        return {"output": executed}


class ActuatorDelay(DelayLine, _Actuator):
    """The environment executes the action from some steps ago; zero before there was one.

    Not matched: what was sent late cannot be sent earlier.

    Args:
        steps: a whole number; one, one for each action entry, one row for each environment, or
            drawn at resets and rounded down.
        action_key: key of the action.

    Raises:
        ValueError: if the steps are negative or not whole.
    """

    matched = False

    def __init__(self, steps: Value, action_key: NestedKey = "action") -> None:
        super().__init__(steps, action_key)

    def _begin(self, entry: Tensor) -> dict[str, Tensor]:
        return {"line": self._line(torch.zeros_like(entry))}

    def _disturb(self, action: Tensor, value: Tensor) -> Tensor:
        return self._pass(action)[0]

    def _advance(self, action: Tensor, executed: Tensor) -> dict[str, Tensor]:
        return self._pass(action)[1]
