"""The objective in fitting an ensemble, as a loss module of TorchRL."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.common import LossModule

from torchrl_l1.dynamics.model import EnsembleDynamics


class EnsembleDynamicsLoss(LossModule):
    """Loss of every member of an :class:`EnsembleDynamics` on its own batch of transitions.

    The target is the normalised change of state. The head determines the loss per sample: the mean
    squared error for a :class:`DeterministicHead` (arXiv 2403.14860, section 3.1), the negative
    log-likelihood for a :class:`GaussianHead` (arXiv 1805.12114). The members' losses are summed,
    so each member's gradient is what it would be alone; the head's penalty is added to the sum
    once.

    Args:
        dynamics: the model to be trained.

    Input keys (see :meth:`set_keys`): ``observation``, ``action`` and ``next_observation`` with
    batch size ``[B]`` (all members see the same batch) or ``[E, B]`` (a batch per member). Output:
    ``loss_dynamics`` (scalar), to be minimised, and ``member_loss`` ``(E,)``, detached and without
    the penalty, for comparing members and fits.

    Raises:
        KeyError: if an input key is missing.
        ValueError: for observations of different shapes, an invalid batch size, or numbers of
            another type than the model's.

    Examples:
        >>> import torch
        >>> model = EnsembleDynamics(3, 1, members=2, hidden=(8,))
        >>> loss = EnsembleDynamicsLoss(model)
        >>> data = TensorDict(
        ...     {"observation": torch.zeros(5, 3), "action": torch.zeros(5, 1)}, batch_size=[5]
        ... )
        >>> data["next", "observation"] = torch.ones(5, 3)
        >>> loss(data)["member_loss"].shape
        torch.Size([2])
    """

    @dataclass
    class _AcceptedKeys:
        observation: NestedKey = "observation"
        action: NestedKey = "action"
        next_observation: NestedKey = ("next", "observation")

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_dynamics", "member_loss"]  # noqa: RUF012

    def __init__(self, dynamics: EnsembleDynamics) -> None:
        super().__init__()
        self.dynamics = dynamics

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys read from the input."""
        keys = self.tensor_keys
        return [keys.observation, keys.action, keys.next_observation]

    @in_keys.setter
    def in_keys(self, value: list[NestedKey]) -> None:
        raise AttributeError("use set_keys(observation=..., action=..., next_observation=...)")

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        pass

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Compute the loss of every member, see the class."""
        observation, action, next_observation = (tensordict.get(key) for key in self.in_keys)
        for key, value in zip(self.in_keys, (observation, action, next_observation), strict=True):
            if value is None:
                raise KeyError(
                    f"EnsembleDynamicsLoss: {key!r} is not among {tensordict.keys(True, True)}"
                )
        model = self.dynamics
        if next_observation.shape != observation.shape:
            raise ValueError(
                f"EnsembleDynamicsLoss: {self.in_keys[2]!r} has shape "
                f"{tuple(next_observation.shape)}, {self.in_keys[0]!r} {tuple(observation.shape)}"
            )
        members, batch = model.members, tuple(observation.shape[:-1])
        if not (len(batch) == 1 or (len(batch) == 2 and batch[0] == members)):
            raise ValueError(
                f"EnsembleDynamicsLoss: data have batch size {batch}, expected [B] for all "
                f"members or [{members}, B] with a batch for each: reshape them with reshape(-1)"
            )
        expected = model.change_normalizer.mean.dtype
        for key, value in zip(self.in_keys, (observation, action, next_observation), strict=True):
            if value.dtype != expected:
                raise ValueError(
                    f"EnsembleDynamicsLoss: {key!r} is {value.dtype}, the model {expected}: "
                    "convert one of them"
                )
        inputs = model.normalize_inputs(observation, action)
        target = model.change_normalizer.normalize(next_observation - observation)
        per_member = model.head.loss(model.raw(inputs), target).mean(-1)
        objective = per_member.sum() + model.head.penalty()
        return TensorDict(
            {"loss_dynamics": objective, "member_loss": per_member.detach()}, batch_size=[]
        )


@torch.no_grad()
def evaluate_members(
    loss: EnsembleDynamicsLoss, data: TensorDictBase, chunk: int = 20_000
) -> Tensor:
    """Mean loss of every member on the same data ``[N]``: ``(E,)``.

    Raises:
        ValueError: if there are no data.
    """
    if data.shape[0] == 0:
        raise ValueError("evaluate_members: there are no data")
    total = torch.zeros(loss.dynamics.members)
    for part in data.split(chunk):
        total = total.to(part.device) + loss(part)["member_loss"] * part.shape[0]
    return total / data.shape[0]
