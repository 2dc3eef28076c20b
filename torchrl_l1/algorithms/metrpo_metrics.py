"""What METRPO logs, and how it is computed from the parts of an outer iteration."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import fmean

from torchrl_l1.algorithms.metrics import COMMON, L1
from torchrl_l1.objectives import TRPOReport

METRICS: dict[str, str] = {
    **COMMON,
    "return_mean": "Mean return of real episodes of the stochastic policy, with L1 if it is on; "
    "the paper's figure of merit. They are the episodes that join the data, unless `episode_steps` "
    "makes those shorter than the task or one of them ended early; then they are "
    "`evaluation_episodes` full ones beside the data.",
    "return_deterministic": "Mean return of `evaluation_episodes` full episodes with the policy's "
    "mean action (and L1 if it is on). They do not join the data and are not counted as real "
    "steps.",
    "imagined/return_first": "Mean imagined return before the first TRPO step.",
    "imagined/return_last": "Mean imagined return before the last TRPO step.",
    "imagined/left_box": "Share of imagined trajectories that left the box around the data, in "
    "the last TRPO step. High values mean that the policy exploits the model.",
    "trpo/kl": "Mean KL divergence per TRPO step, nats.",
    "trpo/improvement": "Mean gain of the surrogate per TRPO step.",
    "trpo/accepted": "Share of TRPO steps whose line search succeeded.",
    "policy/std": "Mean standard deviation of the policy at collection, action units.",
    **L1,
}
"""Every metric of :class:`~torchrl_l1.algorithms.METRPO`; ``l1/...`` only with L1 on."""


@dataclass
class PolicyStep:
    """One TRPO step: its report, and what the trajectories that it learnt from were like."""

    report: TRPOReport
    imagined_return: float
    left_box: float


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
