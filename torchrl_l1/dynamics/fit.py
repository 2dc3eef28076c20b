"""Fitting an ensemble to the transitions in a replay buffer, with early stopping."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ReplayBuffer

from torchrl_l1.dynamics.fit_config import FitConfig
from torchrl_l1.dynamics.loss import EnsembleDynamicsLoss
from torchrl_l1.dynamics.model import EnsembleDynamics


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
    lowest validation loss, parameters that the members share those of the last epoch that was the
    best for any of them.

    Args:
        dynamics: the model, changed in place.
        buffer: transitions with ``observation``, ``action_key``, ``("next", "observation")``
            and the flag ``validation`` ``(N,)``.
        config: see :class:`FitConfig`.
        optimizer: over ``dynamics.parameters()``; its moments persist between fits.
        action_key: ``"action"`` for the nominal label, ``"executed"`` for the executed one.
        on_epoch: called with the number of the finished epoch, for progress bars.

    Raises:
        ValueError: if there is nothing to train or to validate on, or if a setting does not fit
            the model. The model is as it was then.
    """
    _check(config, dynamics)
    device = next(dynamics.parameters()).device
    train, validation = (part.to(device) for part in _split(buffer, action_key))
    dynamics.train()
    change = train["next", "observation"] - train["observation"]
    dynamics.fit_statistics(train["observation"], train["action"], change)
    # Once for all batches: the statistics stay as they are.
    inputs = dynamics.normalize_inputs(train["observation"], train["action"])
    target = dynamics.change_normalizer.normalize(change)
    loss = EnsembleDynamicsLoss(dynamics)
    members, size = dynamics.members, train.shape[0]
    batch_size = min(config.batch_size, size)
    batches = size // batch_size
    best_loss = torch.full((members,), torch.inf, device=device)
    own, shared = list(dynamics.network.parameters()), list(dynamics.head.parameters())
    best_own, best_shared = _copy(own), _copy(shared)
    resample = torch.randint(size, (members, size)).to(device) if config.bootstrap else None
    planned = min(config.max_epochs * batches, config.max_gradient_steps)
    stale = epoch = steps = 0
    while epoch < config.max_epochs and steps < config.max_gradient_steps:
        order = torch.stack([torch.randperm(size) for _ in range(members)]).to(device)
        running = torch.zeros((), device=device)
        for batch in range(batches):
            index = order[:, batch * batch_size : (batch + 1) * batch_size]
            if resample is not None:
                index = resample.gather(1, index)
            objective, member_loss = loss.objective(_rows(inputs, index), _rows(target, index))
            running += member_loss.detach().sum()
            if config.weight_penalty:
                objective = objective + config.weight_penalty * _penalty(dynamics) / size
            decay = 1 - (1 - config.final_learning_rate_fraction) * steps / planned
            for group in optimizer.param_groups:
                group["lr"] = config.learning_rate * decay
            optimizer.zero_grad(set_to_none=True)
            objective.backward()
            _add_decay(dynamics, config.weight_decay)
            optimizer.step()
            steps += 1
            if steps == config.max_gradient_steps:
                break
        epoch += 1
        current = evaluate_members(loss, validation)
        better = current < best_loss
        best_loss = torch.where(better, current, best_loss)
        for kept, parameter in zip(best_own, own, strict=True):
            kept[better] = parameter.detach()[better]
        if on_epoch is not None:
            on_epoch(epoch)
        improved = bool(better.any())
        best_shared = _copy(shared) if improved else best_shared
        stale = 0 if improved else stale + 1
        if stale >= config.patience:
            break
    with torch.no_grad():
        for kept, parameter in zip(best_own + best_shared, own + shared, strict=True):
            parameter.copy_(kept)
    if shared:  # the best weights of each member now meet parameters of another epoch
        best_loss = evaluate_members(loss, validation)
    if config.elites is not None:
        dynamics.set_elites(best_loss.topk(config.elites, largest=False).indices)
    return FitReport(
        train_loss=running.item() / (members * (batch + 1)),
        validation_loss=best_loss.mean().item(),
        epochs=epoch,
        gradient_steps=steps,
    )


def _check(config: FitConfig, dynamics: EnsembleDynamics) -> None:
    layers, members = len(dynamics.network.weights), dynamics.members
    if config.weight_decay and len(config.weight_decay) != layers:
        raise ValueError(
            f"fit.weight_decay must hold a coefficient for each of the model's {layers} layers, "
            f"the output layer included, got {len(config.weight_decay)}"
        )
    if config.elites is not None and config.elites > members:
        raise ValueError(f"fit.elites is {config.elites}, but the model has {members} members")


def _rows(data: Tensor, index: Tensor) -> Tensor:
    """Rows ``(E, B, width)`` of ``(N, width)`` at index ``(E, B)``."""
    return data.index_select(0, index.flatten()).unflatten(0, index.shape)


def _copy(parameters: Sequence[Tensor]) -> list[Tensor]:
    return [parameter.detach().clone() for parameter in parameters]


@torch.no_grad()
def _add_decay(dynamics: EnsembleDynamics, coefficients: Sequence[float]) -> None:
    """Add the gradients of the squared weights, which are known without a backward pass."""
    if coefficients:
        for coefficient, weight in zip(coefficients, dynamics.network.weights, strict=True):
            if weight.grad is not None:
                weight.grad.add_(weight, alpha=coefficient)


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
