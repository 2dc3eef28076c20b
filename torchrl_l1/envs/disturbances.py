"""Matched disturbances: they act through the actuators, where L1 can cancel them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

__all__ = ["ActuatorBias", "ActuatorGain"]


class _ActuatorDisturbance(Transform):
    """An elementwise map of the action on its way to the base environment."""

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
                f"got {value!r}."
            )
        self.register_buffer("value", tensor)
        self.action_key = action_key
        self._disturb = disturb

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(self.action_key)
        if self.value.ndim and self.value.shape[-1] != action.shape[-1]:
            raise ValueError(
                f"{type(self).__name__} has {self.value.shape[-1]} values, but the action "
                f"{self.action_key!r} has {action.shape[-1]} entries."
            )
        return tensordict.set(self.action_key, self._disturb(action, self.value.to(action)))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuses to work on stored data.

        Raises:
            RuntimeError: always.
        """
        raise RuntimeError(
            f"{type(self).__name__} belongs to an environment (TransformedEnv), not to a replay "
            "buffer or a policy: it changes what an environment executes."
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.value.tolist()}, key={self.action_key!r})"


class ActuatorBias(_ActuatorDisturbance):
    """Adds a constant to every action that the environment executes: ``u + bias``.

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
    """Multiplies every action that the environment executes: ``gain * u``.

    A weakened (or overdriven) actuator. The action in the rollout is unchanged.

    Args:
        gain: one number, or one for each action entry; 1 is the nominal actuator.
        action_key: key of the action.

    Raises:
        ValueError: if the gain is not finite or, at the first step, has the wrong length.
    """

    def __init__(self, gain: float | Sequence[float], action_key: NestedKey = "action") -> None:
        super().__init__(torch.mul, gain, action_key)
