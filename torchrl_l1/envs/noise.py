"""Zero-mean measurement and actuation noise, as in the experiments of arXiv 2403.14860."""

from __future__ import annotations

import math

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

__all__ = ["ActionNoise", "ObservationNoise"]


class _UniformNoise(Transform):
    """Uniform noise of a given half-width, drawn from torch's global generator."""

    def __init__(self, half_width: float, key: NestedKey) -> None:
        super().__init__()
        if not (half_width >= 0 and math.isfinite(half_width)):
            raise ValueError(
                f"{type(self).__name__}: half_width must be finite and not negative, "
                f"got {half_width}."
            )
        self.half_width = float(half_width)
        self.key = key

    def _noisy(self, value: Tensor) -> Tensor:
        return value + torch.empty_like(value).uniform_(-self.half_width, self.half_width)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuses to work on stored data.

        Raises:
            RuntimeError: always.
        """
        raise RuntimeError(
            f"{type(self).__name__} belongs to an environment (TransformedEnv), not to a replay "
            "buffer or a policy: noise must enter the data once, while they are collected."
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}(half_width={self.half_width}, key={self.key!r})"


class ActionNoise(_UniformNoise):
    r"""Adds :math:`\xi \sim U(-w, w)`, independent per entry and step, to the action.

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
    r"""Adds :math:`U(-w, w)`, independent per entry and step, to the observation after a step.

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
