"""What every algorithm logs."""

from __future__ import annotations

from torchrl_l1.dynamics import FitReport

COMMON: dict[str, str] = {
    "iteration": "Outer iteration, from 0.",
    "real_steps": "Real environment steps so far, the initial random ones included.",
    "return_mean": "Mean return of full real episodes, with L1 if it is on.",
    "return_std": "Standard deviation over these episodes.",
    "return_min": "Lowest return among them.",
    "return_max": "Highest return among them.",
    "return_deterministic": "Mean return of full real episodes with mean actions.",
    "episodes": "Number of episodes behind `return_mean`.",
    "non_finite_steps": "Real steps on which the simulator's state became non-finite; they end "
    "the episode and are kept out of the data.",
    "model/train_loss": "Mean training loss of a member in the last epoch, normalised units.",
    "model/validation_loss": "Mean over members of the lowest validation loss, the weights kept.",
    "model/epochs": "Passes over the training data.",
    "model/gradient_steps": "Adam steps.",
}
"""Runs of every algorithm."""

L1: dict[str, str] = {
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
"""The adaptive controller; only with L1 on."""


def fit_metrics(fit: FitReport) -> dict[str, float]:
    """Metrics of the fit of the ensemble."""
    return {
        "model/train_loss": fit.train_loss,
        "model/validation_loss": fit.validation_loss,
        "model/epochs": fit.epochs,
        "model/gradient_steps": fit.gradient_steps,
    }
