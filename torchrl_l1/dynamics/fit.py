"""Fitting an ensemble to the transitions in a replay buffer, with early stopping."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer

from torchrl_l1.dynamics.loss import EnsembleDynamicsLoss
from torchrl_l1.dynamics.model import EnsembleDynamics


@dataclass
class FitConfig:
    """How an ensemble is fitted.

    Attributes:
        learning_rate: Adam's step size at the start of a fit.
        final_learning_rate_fraction: the step size at the end as a fraction of that at the
            start, reached linearly over the gradient steps that a fit may take.
        batch_size: transitions per member and gradient step.
        max_epochs: passes over the training data.
        max_gradient_steps: bound on gradient steps, whatever the number of epochs.
        patience: epochs without a lower validation loss of any member before stopping.
        validation_fraction: share of new transitions kept out of training for good.
        weight_penalty: coefficient of half the squared hidden weights, divided by the number
            of training transitions.
    """

    learning_rate: float = 1e-3
    final_learning_rate_fraction: float = 0.1
    batch_size: int = 500
    max_epochs: int = 50
    max_gradient_steps: int = 800
    patience: int = 5
    validation_fraction: float = 0.1
    weight_penalty: float = 0.0

    def __post_init__(self) -> None:
        """Refuse settings that could only fail later.

        Raises:
            ValueError: naming the setting.
        """
        for name in ("batch_size", "max_epochs", "max_gradient_steps", "patience"):
            if getattr(self, name) < 1:
                raise ValueError(f"fit.{name} must be at least 1, got {getattr(self, name)}")
        if not 0 < self.validation_fraction < 1:
            raise ValueError(
                f"fit.validation_fraction must be between 0 and 1, got {self.validation_fraction}"
            )
        if self.learning_rate <= 0:
            raise ValueError(f"fit.learning_rate must be positive, got {self.learning_rate}")
        if not 0 < self.final_learning_rate_fraction <= 1:
            raise ValueError(
                "fit.final_learning_rate_fraction must be positive and at most 1, got "
                f"{self.final_learning_rate_fraction}"
            )


@dataclass
class FitReport:
    """Outcome of a fit, averaged over the members.

    Attributes:
        train_loss: running mean of the loss over the last epoch, while its weights changed.
        validation_loss: loss of the weights that were kept.
        epochs: passes over the training data.
        gradient_steps: gradient steps taken.
    """

    train_loss: float
    validation_loss: float
    epochs: int
    gradient_steps: int


@torch.no_grad()
def evaluate_members(
    loss: EnsembleDynamicsLoss, data: TensorDictBase, chunk: int = 20_000
) -> Tensor:
    """Mean loss of every member on the same data ``[N]``: ``(E,)``."""
    total = torch.zeros(loss.dynamics.members)
    for part in data.split(chunk):
        total = total.to(part.device) + loss(part)["member_loss"] * part.shape[0]
    return total / data.shape[0]


def fit_ensemble(
    dynamics: EnsembleDynamics,
    buffer: ReplayBuffer,
    config: FitConfig,
    optimizer: torch.optim.Optimizer,
    action_key: str = "action",
    on_epoch: Callable[[int], None] | None = None,
) -> FitReport:
    """Fit all members at once, each on its own shuffle of the training data.

    Normalisers and the data box are set from the training data first. The weights are warm:
    they continue from where they are. Every member keeps the weights of the epoch with its
    lowest validation loss.

    Args:
        dynamics: the model, changed in place.
        buffer: transitions with ``observation``, ``action_key``, ``("next", "observation")``
            and the flag ``validation`` ``(N,)``.
        config: see :class:`FitConfig`.
        optimizer: over ``dynamics.parameters()``; its moments persist between fits.
        action_key: ``"action"`` for the nominal label, ``"executed"`` for the executed one.
        on_epoch: called with the number of the finished epoch, for progress bars.

    Raises:
        ValueError: if there is nothing to train or to validate on.
    """
    device = next(dynamics.parameters()).device
    train, validation = (part.to(device) for part in _split(buffer, action_key))
    dynamics.train()
    dynamics.fit_statistics(
        train["observation"], train["action"], train["next", "observation"] - train["observation"]
    )
    loss = EnsembleDynamicsLoss(dynamics)
    members, size = dynamics.members, train.shape[0]
    batch_size = min(config.batch_size, size)
    batches = size // batch_size
    best_loss = torch.full((members,), torch.inf, device=device)
    best_weights = [parameter.detach().clone() for parameter in dynamics.parameters()]
    planned = min(config.max_epochs * batches, config.max_gradient_steps)
    stale = epoch = steps = 0
    while epoch < config.max_epochs and steps < config.max_gradient_steps:
        order = torch.stack([torch.randperm(size) for _ in range(members)]).to(device)
        running = torch.zeros((), device=device)
        for batch in range(batches):
            index = order[:, batch * batch_size : (batch + 1) * batch_size]
            objective = loss(train[index])["loss_dynamics"]
            running += objective.detach()
            if config.weight_penalty:
                objective = objective + config.weight_penalty * _penalty(dynamics) / size
            decay = 1 - (1 - config.final_learning_rate_fraction) * steps / planned
            for group in optimizer.param_groups:
                group["lr"] = config.learning_rate * decay
            optimizer.zero_grad(set_to_none=True)
            objective.backward()
            optimizer.step()
            steps += 1
            if steps == config.max_gradient_steps:
                break
        epoch += 1
        current = evaluate_members(loss, validation)
        better = current < best_loss
        best_loss = torch.where(better, current, best_loss)
        for kept, parameter in zip(best_weights, dynamics.parameters(), strict=True):
            kept[better] = parameter.detach()[better]
        if on_epoch is not None:
            on_epoch(epoch)
        stale = 0 if better.any() else stale + 1
        if stale >= config.patience:
            break
    with torch.no_grad():
        for kept, parameter in zip(best_weights, dynamics.parameters(), strict=True):
            parameter.copy_(kept)
    return FitReport(
        train_loss=running.item() / (members * (batch + 1)),
        validation_loss=best_loss.mean().item(),
        epochs=epoch,
        gradient_steps=steps,
    )


def _penalty(dynamics: EnsembleDynamics) -> Tensor:
    return 0.5 * torch.stack([w.square().sum() for w in dynamics.network.weights[:-1]]).sum()


def _split(buffer: ReplayBuffer, action_key: str) -> tuple[TensorDict, TensorDict]:
    data = buffer[:]
    transitions = TensorDict(
        {
            "observation": data["observation"],
            "action": data[action_key],
            "next": {"observation": data["next", "observation"]},
        },
        batch_size=[data.shape[0]],
    )
    held_out = data["validation"].reshape(-1)
    train, validation = transitions[~held_out], transitions[held_out]
    if train.shape[0] == 0 or validation.shape[0] == 0:
        raise ValueError(
            f"cannot fit: {train.shape[0]} training and {validation.shape[0]} validation "
            "transitions; collect more data or change validation_fraction"
        )
    return train, validation
