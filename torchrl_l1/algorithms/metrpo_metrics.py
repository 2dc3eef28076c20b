"""What METRPO logs, and how it is computed from the parts of an outer iteration."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import fmean

from torchrl_l1.dynamics import FitReport
from torchrl_l1.objectives import TRPOReport

METRICS: dict[str, str] = {
    "iteration": "Outer iteration, from 0.",
    "real_steps": "Real environment steps so far, the initial random ones included.",
    "return_mean": "Mean return of real episodes of the stochastic policy, with L1 if it is on; "
    "the paper's figure of merit. They are the episodes that join the data, unless `episode_steps` "
    "makes those shorter than the task or one of them ended early; then they are "
    "`evaluation_episodes` full ones beside the data.",
    "return_std": "Standard deviation over these episodes.",
    "return_min": "Lowest return among them.",
    "return_max": "Highest return among them.",
    "return_deterministic": "Mean return of `evaluation_episodes` full episodes with the policy's "
    "mean action (and L1 if it is on). They do not join the data and are not counted as real "
    "steps.",
    "episodes": "Number of episodes behind `return_mean`.",
    "non_finite_steps": "Real steps on which the simulator's state became non-finite; they end "
    "the episode and are kept out of the data.",
    "model/train_loss": "Mean training loss of a member in the last epoch, normalised units.",
    "model/validation_loss": "Mean over members of the lowest validation loss, the weights kept.",
    "model/epochs": "Passes over the training data.",
    "model/gradient_steps": "Adam steps.",
    "imagined/return_first": "Mean imagined return before the first TRPO step.",
    "imagined/return_last": "Mean imagined return before the last TRPO step.",
    "imagined/left_box": "Share of imagined trajectories that left the box around the data, in "
    "the last TRPO step. High values mean that the policy exploits the model.",
    "trpo/kl": "Mean KL divergence per TRPO step, nats.",
    "trpo/improvement": "Mean gain of the surrogate per TRPO step.",
    "trpo/accepted": "Share of TRPO steps whose line search succeeded.",
    "policy/std": "Mean standard deviation of the policy at collection, action units.",
    "l1/switch_rate": "Switches of the operating point per real step.",
    "l1/affinization_error": "Mean distance between model and affine model at the tested input, "
    "raw state units, before switching.",
    "l1/affinization_error_max": "Largest such distance.",
    "l1/prediction_error": "Mean norm of the predictor's error x_hat - x, raw state units.",
    "l1/prediction_error_max": "Largest such norm.",
    "l1/matched": "Mean norm of the matched part of the estimate, state units per second.",
    "l1/matched_max": "Largest such norm.",
    "l1/unmatched": "Mean norm of the unmatched estimate, state units per second. It is "
    "estimated, not cancelled.",
    "l1/unmatched_max": "Largest such norm.",
    "l1/u_a": "Mean norm of the adaptive input, action units.",
    "l1/u_a_max": "Largest such norm.",
    "l1/saturation": "Share of action entries that a bound cut.",
    "l1/ill_conditioned": "Share of steps with a rank-deficient or ill-conditioned Jacobian.",
    "l1/non_finite": "Steps on which an input of L1 was not finite and it stood aside.",
}
"""Every metric of :class:`~torchrl_l1.algorithms.METRPO`; ``l1/...`` only with L1 on."""


@dataclass
class PolicyStep:
    """One TRPO step: its report, and what the trajectories that it learnt from were like."""

    report: TRPOReport
    imagined_return: float
    left_box: float


def fit_metrics(fit: FitReport) -> dict[str, float]:
    """Metrics of the fit of the ensemble."""
    return {
        "model/train_loss": fit.train_loss,
        "model/validation_loss": fit.validation_loss,
        "model/epochs": fit.epochs,
        "model/gradient_steps": fit.gradient_steps,
    }


def policy_metrics(steps: list[PolicyStep]) -> dict[str, float]:
    """Metrics of the policy's improvement: all TRPO steps of an outer iteration."""
    reports = [step.report for step in steps]
    return {
        "imagined/return_first": steps[0].imagined_return,
        "imagined/return_last": steps[-1].imagined_return,
        "imagined/left_box": steps[-1].left_box,
        "trpo/kl": fmean(report.kl for report in reports),
        "trpo/improvement": fmean(report.improvement for report in reports),
        "trpo/accepted": fmean(report.accepted for report in reports),
    }
