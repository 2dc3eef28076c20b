"""Disturbances of the observation on its way from the sensors.

They are transforms for any TorchRL environment, batched or not. Each keeps a separate state for
every environment, which a reset of that environment renews. None is matched: no input changes a
sensor's error. Reward and termination come from the clean state.
"""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_l1.envs.disturbances import DelayLine, HeldDisturbance, Value, where_stepped


class _Sensor(HeldDisturbance):
    """A transform of the observation, including that of resets."""

    reason = "it must enter the data once, while they are collected"
    what = disturbs = "observation"
    matched = False

    def _first(self, reading: Tensor) -> Tensor:
        """The reading at a reset."""
        return reading

    def _read(self, reading: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The reading after a step, and the new state."""
        raise NotImplementedError

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        reading = next_tensordict.get(self.key)
        self._started(reading)
        self._check_shape(reading)
        seen, following = self._read(reading)
        if following:
            self._keep(following, tensordict.get("_step", None), reading.shape[:-1])
        begun = self.begun(next_tensordict)
        if begun is not None:
            self._restart(reading, begun)
            seen = torch.where(begun, self._first(reading), seen)
        return next_tensordict.set(self.key, where_stepped(tensordict, self.key, seen))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        reading, reset = tensordict_reset.get(self.key), self.resets(tensordict)
        self._restart(reading, reset)
        self.check_order(bool(self._state))
        seen = self._first(reading)
        if reset is not None:
            # The others keep their previous entries, which are disturbed already.
            seen = torch.where(reset, seen, reading)
        return tensordict_reset.set(self.key, seen)


class SensorBias(_Sensor):
    """A constant added to every observation.

    Not matched.

    Args:
        bias: raw observation units; one number, one for each entry, one row for each environment
            ``(*batch, 1 or entries)``, or drawn at resets.
        observation_key: key of the observation.

    Raises:
        ValueError: if the bias is not finite or, at the first reset, has the wrong shape.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("InvertedPendulum-v5"), SensorBias([0.0, 0.05, 0.0, 0.0]))
        >>> bool((env.reset()["observation"][1] > 0.03).all())  # within 0.01 of zero without it
        True
    """

    def __init__(self, bias: Value, observation_key: NestedKey = "observation") -> None:
        super().__init__(bias, observation_key)

    def _first(self, reading: Tensor) -> Tensor:
        return reading + self._current(reading)

    def _read(self, reading: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        return self._first(reading), {}


class SensorDelay(DelayLine, _Sensor):
    """The observation from some steps ago; that of the reset before there was one.

    Not matched.

    Args:
        steps: a whole number; one, one for each entry, one row for each environment, or drawn at
            resets and rounded down.
        observation_key: key of the observation.

    Raises:
        ValueError: if the steps are negative or not whole.
    """

    def __init__(self, steps: Value, observation_key: NestedKey = "observation") -> None:
        super().__init__(steps, observation_key)

    def _begin(self, entry: Tensor) -> dict[str, Tensor]:
        return {"line": self._line(entry)}

    def _read(self, reading: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        return self._pass(reading)


class SensorDropout(_Sensor):
    """Readings are lost at random and replaced by the last reading.

    Not matched. Draws come from torch's global generator.

    Args:
        probability: probability for each entry at each step, in ``[0, 1]``; as for
            :class:`SensorBias`.
        whole: whether all entries of an observation are lost together.
        observation_key: key of the observation.

    Raises:
        ValueError: if the probability is not between 0 and 1.
    """

    def __init__(
        self,
        probability: Value,
        whole: bool = False,
        observation_key: NestedKey = "observation",
    ) -> None:
        super().__init__(probability, observation_key)
        self.whole = whole

    def _check(self, value: Tensor) -> None:
        inside = (value >= 0) & (value <= 1)
        self._require(bool(inside.all()), "a probability must be between 0 and 1", value)

    def _begin(self, entry: Tensor) -> dict[str, Tensor]:
        return {"last": entry.clone()}

    def _read(self, reading: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        shape = (*reading.shape[:-1], 1) if self.whole else reading.shape
        lost = torch.rand(shape, device=reading.device) < self._current(reading)
        seen = torch.where(lost, self._state["last"].to(reading), reading)
        return seen, {"last": seen}
