"""Behaviour cloning: a policy network learns to imitate a planner."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_l1.algorithms.model_learning import TrainingData
from torchrl_l1.algorithms.policy import GaussianPolicy
from torchrl_l1.dynamics.transitions import split_validation

CLONING_METRICS: dict[str, str] = {
    "clone/train_loss": "Stage 2: mean squared difference between the policy's and the planner's "
    "actions in the last epoch, in halves of the action range.",
    "clone/validation_loss": "Stage 2: the same on the states held out of training, for the "
    "weights kept. Random shooting is noisy: the scatter of its actions remains here.",
    "clone/epochs": "Stage 2: passes over the labelled states.",
    "clone/states": "Stage 2: labelled states so far.",
}
"""Metrics of a round of cloning."""


class CloningSettings(Protocol):
    """How a policy is fitted, see :class:`~torchrl_l1.algorithms.CloningConfig`."""

    learning_rate: float
    batch_size: int
    max_epochs: int
    patience: int
    validation_fraction: float


@dataclass
class CloningReport:
    """Outcome of a fit.

    Attributes:
        train_loss: mean loss over the last epoch, while the weights changed.
        validation_loss: loss of the weights that were kept.
        epochs: passes over the training data.
    """

    train_loss: float
    validation_loss: float
    epochs: int

    def metrics(self, states: int) -> dict[str, float]:
        """Metrics of a round on so many labelled states."""
        return {
            "clone/train_loss": self.train_loss,
            "clone/validation_loss": self.validation_loss,
            "clone/epochs": self.epochs,
            "clone/states": states,
        }


class Cloning:
    """States, an expert's actions in them, and the fits of a policy to both.

    The loss is the squared error of the policy's mean action, in halves of the action range,
    averaged over the entries of the action: that of DAgger (arXiv 1011.0686) for continuous
    actions, as in arXiv 1708.02596 (section V). The standard deviation is not fitted.

    Args:
        policy: changed in place.
        config: how it is fitted.
        half_range: half the range of the actions, one number or one for each entry.
        capacity: maximum number of states.
        normalize: whether each fit takes the statistics of the policy's inputs from the states
            that it trains on.
    """

    def __init__(
        self,
        policy: GaussianPolicy,
        config: CloningSettings,
        half_range: float | Tensor,
        capacity: int,
        normalize: bool = True,
    ) -> None:
        self.policy, self.config, self.half_range = policy, config, half_range
        self.normalize = normalize
        self.data = TrainingData(capacity, config.batch_size, config.validation_fraction)
        self.buffer = self.data.buffer

    def store(self, observation: Tensor, action: Tensor) -> None:
        """Add states ``(B, n)`` with the expert's actions ``(B, m)``, where both are finite.

        A fixed share of them is permanently held out of training.
        """
        finite = torch.isfinite(observation).all(-1) & torch.isfinite(action).all(-1)
        self.data.extend(
            TensorDict(
                {"observation": observation[finite], "action": action[finite]},
                batch_size=[int(finite.sum())],
            )
        )

    def fit(self, on_epoch: Callable[[int], None] | None = None) -> CloningReport:
        """Fit the policy to all pairs so far, starting from its current weights.

        The weights of the epoch with the lowest validation loss are kept.

        Raises:
            ValueError: if there is nothing to train or to validate on.
        """
        config, policy = self.config, self.policy
        device = next(policy.parameters()).device
        train, validation = (
            part.to(device)
            for part in split_validation(
                self.buffer, "clone", "states", "cloning.validation_fraction"
            )
        )
        if self.normalize:
            policy.normalizer.fit(train["observation"])
        optimizer = torch.optim.Adam(policy.mean.parameters(), lr=config.learning_rate, fused=True)
        best, best_loss, stale = deepcopy(policy.mean.state_dict()), torch.inf, 0
        epoch, running = 0, 0.0
        for epoch in range(1, config.max_epochs + 1):
            order = torch.randperm(train.shape[0], device=train.device)
            batches = order.split(config.batch_size)
            running = 0.0
            for index in batches:
                loss = self._loss(train[index])
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
                optimizer.step()
                running += loss.item() / len(batches)
            with torch.no_grad():
                current = self._loss(validation).item()
            stale += 1
            if current < best_loss:
                best, best_loss, stale = deepcopy(policy.mean.state_dict()), current, 0
            if on_epoch is not None:
                on_epoch(epoch)
            if stale >= config.patience:
                break
        policy.mean.load_state_dict(best)
        return CloningReport(running, best_loss, epoch)

    def _loss(self, data: TensorDictBase) -> Tensor:
        mean, _ = self.policy(data["observation"])
        half = self.half_range
        half = half.to(mean.device) if isinstance(half, Tensor) else half
        return ((mean - data["action"]) / half).square().mean()

    def state_dict(self) -> dict[str, Any]:
        """The pairs so far, as plain tensors."""
        return {"pairs": self.data.state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`; other entries of ``state`` are ignored."""
        self.data.load(state["pairs"])
