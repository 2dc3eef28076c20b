"""Fine-tuning of a policy on real data with TorchRL's own PPO."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_l1.algorithms.mbmf_config import FineTuningConfig
from torchrl_l1.algorithms.policy import GaussianPolicy, make_actor
from torchrl_l1.dynamics import Normalizer
from torchrl_l1.envs import AnyTask, action_bounds

_SAMPLED = "sampled"
_LOG_PROB = "sampled_log_prob"

FINE_TUNING_METRICS: dict[str, str] = {
    "ppo/kl": "Stage 3: estimate of the KL divergence from the collecting policy, the mean "
    "difference of log-densities, last pass, nats. It may be slightly negative.",
    "ppo/clip_fraction": "Stage 3: share of likelihood ratios beyond the bound, last pass.",
    "ppo/value_loss": "Stage 3: squared error of the value network, last pass.",
    "ppo/explained_variance": "Stage 3: share of the variance of the value targets that the "
    "network explains, last pass.",
}
"""Metrics of a round of fine-tuning."""


@dataclass
class FineTuningReport:
    """Outcome of a round: means over the last pass of each network.

    Attributes:
        kl: estimate of the KL divergence from the collecting policy, in nats.
        clip_fraction: share of samples whose likelihood ratio is beyond the bound.
        value_loss: squared error of the value network, reward units squared.
        explained_variance: share of the variance of the value targets that it explains.
    """

    kl: float
    clip_fraction: float
    value_loss: float
    explained_variance: float

    def metrics(self) -> dict[str, float]:
        """Metrics of a round."""
        return {
            "ppo/kl": self.kl,
            "ppo/clip_fraction": self.clip_fraction,
            "ppo/value_loss": self.value_loss,
            "ppo/explained_variance": self.explained_variance,
        }


class FineTuning:
    """PPO with a clipped objective (arXiv 1707.06347) around a policy and a value network.

    Args:
        policy: changed in place; its normaliser stays as it is.
        config: settings.
    """

    def __init__(self, policy: GaussianPolicy, config: FineTuningConfig) -> None:
        self.policy, self.config = policy, config
        width = policy.normalizer.mean.shape[0]
        self.value = _Value(policy.normalizer, MLP(width, 1, num_cells=config.value_hidden))
        critic = ValueOperator(self.value, in_keys=["observation"])
        self.advantage = GAE(
            gamma=config.discount,
            lmbda=config.gae_lambda,
            value_network=critic,
            average_gae=True,
            vectorized=False,
        )
        self.loss = ClipPPOLoss(
            make_actor(policy, _SAMPLED, _LOG_PROB),
            critic,
            clip_epsilon=config.clip_epsilon,
            entropy_bonus=config.entropy_coefficient > 0,
            entropy_coeff=config.entropy_coefficient,
            loss_critic_type="l2",
            functional=False,
        )
        self.loss.set_keys(action=_SAMPLED, sample_log_prob=_LOG_PROB)
        self.optimizers = {
            "policy": torch.optim.Adam(
                [*policy.mean.parameters(), policy.log_std], lr=config.learning_rate
            ),
            "value": torch.optim.Adam(
                self.value.network.parameters(), lr=config.value_learning_rate
            ),
        }

    def step(self, data: TensorDictBase, progress: float = 0.0) -> FineTuningReport:
        """One round of PPO on episodes ``[N, T]`` collected by :func:`exploring`.

        Args:
            data: the episodes; values and advantages are written to them.
            progress: completed share of the annealing, from 0 to 1.

        Raises:
            ValueError: if advantages are not finite; nothing is learned from them.
        """
        config = self.config
        rates = (config.learning_rate, config.value_learning_rate)
        for optimizer, rate in zip(self.optimizers.values(), rates, strict=True):
            optimizer.param_groups[0]["lr"] = rate * (1 - progress)
        with torch.no_grad():
            self.advantage(data)
        if not torch.isfinite(data["advantage"]).all():
            raise ValueError("PPO: non-finite advantages; check rewards and value estimates")
        keys = ("observation", _SAMPLED, _LOG_PROB, "advantage", "value_target")
        # Steps that the simulator could not take do not count.
        happened = ~data["next", "non_finite"].squeeze(-1)
        samples = data.select(*keys)[happened]
        reports: list[TensorDictBase] = []
        for epoch in range(max(config.epochs, config.value_epochs)):
            order = torch.randperm(samples.shape[0], device=samples.device)
            reports.clear()
            for index in order.tensor_split(min(config.minibatches, len(order))):
                report = self.loss(samples[index])
                self._descend(report, epoch)
                reports.append(report.detach())
        names = ("kl_approx", "clip_fraction", "loss_critic", "explained_variance")
        kl, clip_fraction, value_loss, explained = (
            torch.stack([report[name] for report in reports]).mean().item() for name in names
        )
        return FineTuningReport(kl, clip_fraction, value_loss, explained)

    def _descend(self, report: TensorDictBase, epoch: int) -> None:
        """A gradient step of the networks with passes left."""
        objective = report["loss_objective"] + report.get("loss_entropy", 0.0)
        turns = {
            "policy": (objective, self.config.epochs),
            "value": (report["loss_critic"], self.config.value_epochs),
        }
        for name, (loss, passes) in turns.items():
            if epoch < passes:
                optimizer = self.optimizers[name]
                parameters = optimizer.param_groups[0]["params"]
                optimizer.zero_grad(set_to_none=True)
                loss.backward(inputs=parameters)
                nn.utils.clip_grad_norm_(parameters, self.config.max_gradient_norm)
                optimizer.step()

    def state_dict(self) -> dict[str, Any]:
        """The state that a round leaves besides the policy."""
        return {
            "value": self.value.network.state_dict(),
            "optimizers": {name: o.state_dict() for name, o in self.optimizers.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        self.value.network.load_state_dict(state["value"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])


class _Value(nn.Module):
    """Values ``(..., 1)`` of observations ``(..., n)``, normalised by the policy's normaliser."""

    def __init__(self, normalizer: Normalizer, network: nn.Module) -> None:
        super().__init__()
        self.normalizer, self.network = normalizer, network

    def forward(self, observation: Tensor) -> Tensor:
        value: Tensor = self.network(self.normalizer.normalize(observation))
        return value


def exploring(policy: GaussianPolicy, task: AnyTask) -> TensorDictModuleBase:
    """The collecting policy for :class:`FineTuning`: ``action`` is clipped to the task's bounds.

    The action before clipping and the logarithm of its density are stored beside it: PPO's
    likelihood ratios are those of the drawn actions.
    """
    low, high = action_bounds(task)
    clip = TensorDictModule(
        lambda sampled: sampled.clamp(low, high), in_keys=[_SAMPLED], out_keys=["action"]
    )
    return TensorDictSequential(make_actor(policy, _SAMPLED, _LOG_PROB), clip)
