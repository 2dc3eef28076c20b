"""What MBMF logs."""

from __future__ import annotations

from torchrl_l1.algorithms.cloning import CloningReport
from torchrl_l1.algorithms.fine_tuning import FineTuningReport
from torchrl_l1.algorithms.metrics import COMMON, L1

STAGES = ("shooting", "cloning", "fine_tuning")
"""The stages in turn; ``stage`` in the metrics counts them from 1."""

METRICS: dict[str, str] = {
    **COMMON,
    "stage": "Stage of the iteration: 1 random shooting, 2 cloning (DAgger), 3 fine-tuning (PPO).",
    "return_mean": "Mean return of full real episodes. Stage 1: of the planner, with L1 if it is "
    "on; they join the data, unless `episode_steps` makes those shorter. Stage 2: of the cloned "
    "policy's mean action, without L1, on `evaluation_episodes` episodes beside the data. Stage 3: "
    "of sampled actions, without L1, in the episodes that PPO learns from, or in "
    "`evaluation_episodes` beside them if those are shorter or ended early.",
    "return_deterministic": "The same in stages 1 and 2; in stage 3 of the policy's mean action, "
    "on `evaluation_episodes` episodes beside the data.",
    "plan/promised_return": "Stages 1 and 2: mean imagined return of the best sequence of each "
    "plan, over collected steps or over the states that the planner labels.",
    "clone/train_loss": "Stage 2: mean squared difference between the policy's and the planner's "
    "actions in the last epoch, in halves of the action range.",
    "clone/validation_loss": "Stage 2: the same on the states kept out of training, for the "
    "weights kept. Random shooting is noisy: what its actions scatter is left here.",
    "clone/epochs": "Stage 2: passes over the labelled states.",
    "clone/states": "Stage 2: labelled states so far.",
    "ppo/kl": "Stage 3: estimate of the KL divergence from the policy that collected, the mean "
    "difference of log-densities, last pass, nats. It may be slightly negative.",
    "ppo/clip_fraction": "Stage 3: share of likelihood ratios beyond the bound, last pass.",
    "ppo/value_loss": "Stage 3: squared error of the value network, last pass.",
    "ppo/explained_variance": "Stage 3: share of the variance of the value targets that the "
    "network explains, last pass.",
    "policy/std": "Stage 3: mean standard deviation of the policy, action units.",
    **L1,
}
"""Every metric of :class:`~torchrl_l1.algorithms.MBMF`; ``l1/...`` only in stage 1 with L1 on."""


def cloning_metrics(report: CloningReport, states: int) -> dict[str, float]:
    """Metrics of a round of cloning on so many labelled states."""
    return {
        "clone/train_loss": report.train_loss,
        "clone/validation_loss": report.validation_loss,
        "clone/epochs": report.epochs,
        "clone/states": states,
    }


def fine_tuning_metrics(report: FineTuningReport) -> dict[str, float]:
    """Metrics of a round of fine-tuning."""
    return {
        "ppo/kl": report.kl,
        "ppo/clip_fraction": report.clip_fraction,
        "ppo/value_loss": report.value_loss,
        "ppo/explained_variance": report.explained_variance,
    }
