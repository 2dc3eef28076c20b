"""Settings of the ensemble that an algorithm learns."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import get_args

from torchrl_l1.algorithms.checks import check_choice, check_positive, check_widths
from torchrl_l1.dynamics import HEADS, MODEL_FORMS
from torchrl_l1.dynamics.ensemble import ActivationName


@dataclass
class ModelConfig:
    """The ensemble, see :func:`~torchrl_l1.dynamics.make_dynamics`.

    Attributes:
        form: ``nonlinear``, or ``affine`` in the action.
        head: what a member predicts: ``deterministic``, a point, or ``gaussian``, a distribution.
        members: number of networks.
        hidden: widths of a nonlinear network's hidden layers; for the control-affine form they
            are scaled to the same number of parameters.
        activation: ``relu``, ``tanh`` or ``silu``.
        std_floor: smallest standard deviation of the normalisers, raw units.
        box_margin: widening of the box around the data, see
            :class:`~torchrl_l1.dynamics.DataBox`.
    """

    form: str = "nonlinear"
    head: str = "deterministic"
    members: int = 5
    hidden: list[int] = field(default_factory=lambda: [256, 256])
    activation: str = "relu"
    std_floor: float = 1e-4
    box_margin: float = 0.5

    def __post_init__(self) -> None:
        """Refuse settings that could only fail later.

        Raises:
            ValueError: naming the setting.
        """
        check_choice("model.form", self.form, MODEL_FORMS)
        check_choice("model.head", self.head, HEADS)
        check_choice("model.activation", self.activation, get_args(ActivationName))
        if self.members < 1:
            raise ValueError(f"model.members must be at least 1, got {self.members}")
        check_widths("model.hidden", self.hidden)
        check_positive("model.std_floor", self.std_floor)
        if not (self.box_margin >= 0 and math.isfinite(self.box_margin)):
            raise ValueError(
                f"model.box_margin must be finite and not negative, got {self.box_margin}"
            )
