"""A probabilistic ensemble for HalfCheetah, its data, and the reward to plan with."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer

from torchrl_l1.dynamics import EnsembleDynamics, FitConfig, GaussianHead, fit_ensemble
from torchrl_l1.envs import get_task, make_env

HIDDEN = (200, 200, 200)
MEMBERS = 5
SPEED, COST = 8, 0.1
"""Column of the observation that is rewarded, and cost of the squared actions."""


def reward(observation: Tensor, action: Tensor, successor: Tensor) -> Tensor:
    """Speed after the step less the control cost."""
    return successor[..., SPEED] - COST * action.square().sum(-1)


def transitions(train: int, validation: int) -> ReplayBuffer:
    """Transitions under random actions, from 25 environments, the last ones for validation."""
    size = train + validation
    task = get_task("half_cheetah")
    torch.manual_seed(0)
    data = make_env(task, 25, seed=0).rollout(-(-size // 25), break_when_any_done=False)
    items = data.reshape(-1)[:size].select("observation", "action", ("next", "observation"))
    items["validation"] = torch.arange(size) >= train
    buffer = ReplayBuffer(storage=LazyTensorStorage(size), batch_size=256)
    buffer.extend(items)
    return buffer


def new_model() -> EnsembleDynamics:
    """The model before it has seen anything."""
    task = get_task("half_cheetah")
    torch.manual_seed(1)
    return EnsembleDynamics(
        task.observation_dim,
        task.action_dim,
        members=MEMBERS,
        hidden=HIDDEN,
        activation="silu",
        head=GaussianHead(task.observation_dim),
    )


def new_point_model(members: int, hidden: tuple[int, ...]) -> EnsembleDynamics:
    """A deterministic model of ReLU units before it has seen anything."""
    task = get_task("half_cheetah")
    torch.manual_seed(1)
    return EnsembleDynamics(
        task.observation_dim, task.action_dim, members=members, hidden=hidden, activation="relu"
    )


def fitted_model(
    buffer: ReplayBuffer, gradient_steps: int, model: EnsembleDynamics | None = None
) -> EnsembleDynamics:
    """A model, by default the new one, after some gradient steps."""
    model = model or new_model()
    config = FitConfig(batch_size=256, max_epochs=10**6, max_gradient_steps=gradient_steps)
    optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate, fused=True)
    fit_ensemble(model, buffer, config, optimizer)
    return model


@torch.no_grad()
def save_for_mbrl(model: EnsembleDynamics, path: Path) -> None:
    """Write the same function as a network that takes and gives no normalised targets."""
    network, change, head = model.network, model.change_normalizer, model.head
    assert isinstance(head, GaussianHead)
    scale = torch.cat([change.std, torch.ones_like(change.std)])
    # The logarithm of the variance moves by that of the squared unit, and its bounds with it.
    unit = 2 * change.std.log()
    torch.save(
        {
            "weights": [*map(Tensor.detach, network.weights[:-1]), network.weights[-1] * scale],
            "biases": [
                *map(Tensor.detach, network.biases[:-1]),
                network.biases[-1] * scale + torch.cat([change.mean, unit]),
            ],
            "min_logvar": head.min_log_variance + unit,
            "max_logvar": head.max_log_variance + unit,
            "input_mean": _joined(model.observation_normalizer.mean, model.action_normalizer.mean),
            "input_std": _joined(model.observation_normalizer.std, model.action_normalizer.std),
        },
        path,
    )


def save_transitions(buffer: ReplayBuffer, path: Path) -> None:
    """Write observations, actions and next observations, to train and to validate on."""
    data: TensorDict = buffer[:]
    held_out = data["validation"]
    columns = data["observation"], data["action"], data["next", "observation"]
    torch.save(
        {
            "train": [column[~held_out] for column in columns],
            "validation": [column[held_out] for column in columns],
        },
        path,
    )


def flops_per_prediction(model: EnsembleDynamics) -> int:
    """Multiplications and additions in the products of one member for one input."""
    return 2 * sum(weight[0].numel() for weight in model.network.weights)


def _joined(observation: Tensor, action: Tensor) -> Tensor:
    return torch.cat([observation, action])[None]
