"""State of algorithms around a learned model: their data, the model and its optimizer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_l1.algorithms.config import LABELS
from torchrl_l1.dynamics import EnsembleDynamics, FitConfig, FitReport, fit_ensemble
from torchrl_l1.dynamics.fit import check_fit

FIT_METRICS: dict[str, str] = {
    "model/train_loss": "Mean training loss of a member in the last epoch, normalised units.",
    "model/validation_loss": "Mean over members of the lowest validation loss, the weights kept.",
    "model/epochs": "Passes over the training data.",
    "model/gradient_steps": "Adam steps.",
}
"""Metrics of a fit of the model."""


class TrainingData:
    """All data so far, of which a fixed share is permanently held out of training.

    :func:`~torchrl_l1.dynamics.transitions.split_validation` separates the two parts.

    Args:
        capacity: maximum number of items.
        batch_size: number of items that the buffer samples at once.
        validation_fraction: the share held out.

    Attributes:
        buffer: the items, with the flag ``validation``.
    """

    def __init__(self, capacity: int, batch_size: int, validation_fraction: float) -> None:
        self.capacity, self.validation_fraction = capacity, validation_fraction
        self.buffer = ReplayBuffer(storage=LazyTensorStorage(capacity), batch_size=batch_size)

    def extend(self, items: TensorDictBase) -> None:
        """Add items ``[N]``, drawing for each whether it is held out.

        Raises:
            ValueError: if there is no room for them: a buffer would drop the oldest ones.
        """
        count = len(self.buffer) + items.shape[0]
        if count > self.capacity:
            raise ValueError(
                f"there is room for {self.capacity} items, not for {count}: if outer_iterations "
                "was raised, make a new algorithm with it and load this one's state_dict()"
            )
        items["validation"] = torch.rand(items.shape[0]) < self.validation_fraction
        if items.shape[0]:
            self.buffer.extend(items)

    def state(self) -> dict[str, Any]:
        """The items, as plain tensors."""
        return self.buffer[:].to_dict() if len(self.buffer) else {}

    def load(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state`."""
        self.buffer.empty()
        if state:
            self.buffer.extend(TensorDict(state).auto_batch_size_(1))


class ModelLearning:
    """A model, the real transitions seen so far, and the fits of one to the other.

    Args:
        dynamics: the model; changed in place by :meth:`fit`.
        config: how it is fitted.
        label: ``nominal`` fits it to the policy's action, ``executed`` to what L1 sent to the
            actuators.
        capacity: maximum number of real transitions.
        terminations: whether to store which transitions terminated an episode.

    Raises:
        ValueError: if the settings do not fit the model, before any data are collected.
    """

    def __init__(
        self,
        dynamics: EnsembleDynamics,
        config: FitConfig,
        label: str,
        capacity: int,
        terminations: bool = False,
    ) -> None:
        check_fit(config, dynamics)
        self.dynamics, self.config = dynamics, config
        self.action_key = LABELS[label]
        self.optimizer = torch.optim.Adam(
            dynamics.parameters(), lr=config.learning_rate, fused=True
        )
        self.data = TrainingData(capacity, config.batch_size, config.validation_fraction)
        self.buffer = self.data.buffer
        self._kept: list[NestedKey] = ["observation", "action", "executed"]
        self._kept += [("next", "observation"), ("next", "reward")]
        self._kept += [("next", "terminated")] * terminations

    def reserve(self, capacity: int) -> None:
        """Drop all transitions and set a new capacity."""
        config = self.config
        self.data = TrainingData(capacity, config.batch_size, config.validation_fraction)
        self.buffer = self.data.buffer

    def store(self, data: TensorDictBase) -> None:
        """Add real transitions ``[N, T]``, a fixed share of them marked for validation."""
        flat = data.reshape(-1)
        flat = flat[~flat["next", "non_finite"].squeeze(-1)]
        self.data.extend(flat.select(*self._kept))

    def fit(self, on_epoch: Callable[[int], None] | None = None) -> FitReport:
        """Fit the model to all data, starting from its current weights."""
        return fit_ensemble(
            self.dynamics,
            self.buffer,
            self.config,
            self.optimizer,
            action_key=self.action_key,
            on_epoch=on_epoch,
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue, as plain tensors and numbers."""
        return {
            "dynamics": self.dynamics.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "buffer": self.data.state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`; other entries of ``state`` are ignored."""
        self.dynamics.load_state_dict(state["dynamics"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.data.load(state["buffer"])


def fit_metrics(fit: FitReport) -> dict[str, float]:
    """Metrics of the fit of the ensemble."""
    return {
        "model/train_loss": fit.train_loss,
        "model/validation_loss": fit.validation_loss,
        "model/epochs": fit.epochs,
        "model/gradient_steps": fit.gradient_steps,
    }
