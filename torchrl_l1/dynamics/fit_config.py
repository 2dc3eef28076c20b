"""Settings of the fit of an ensemble."""

from __future__ import annotations

import math
from dataclasses import dataclass, field


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
        weight_decay: coefficients of half the squared weights, one per layer from input to
            output, biases excepted; none if empty. The authors of PETS write theirs beside
            twice the negative log-likelihood, or half the squared error: half of each does the
            same here with a Gaussian head, twice with a deterministic one.
        bootstrap: whether each member trains on its own resample of the training transitions,
            as many drawn with replacement, anew at each fit. They are validated on the same.
        elites: number of members kept as the model's elites after the fit, those of the lowest
            validation loss; if null the model's elites stay as they are.
    """

    learning_rate: float = 1e-3
    final_learning_rate_fraction: float = 0.1
    batch_size: int = 500
    max_epochs: int = 50
    max_gradient_steps: int = 800
    patience: int = 5
    validation_fraction: float = 0.1
    weight_penalty: float = 0.0
    weight_decay: list[float] = field(default_factory=list)
    bootstrap: bool = False
    elites: int | None = None

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
        if not all(0 <= coefficient < math.inf for coefficient in self.weight_decay):
            raise ValueError(
                "fit.weight_decay must hold finite coefficients, none negative, got "
                f"{list(self.weight_decay)}"
            )
        if self.elites is not None and self.elites < 1:
            raise ValueError(f"fit.elites must be at least 1 or null, got {self.elites}")
