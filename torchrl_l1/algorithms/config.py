"""Settings shared by algorithms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from torchrl_l1.algorithms.outcomes import Outcomes
from torchrl_l1.checks import (
    check_choice,
    check_count,
    check_counts,
    check_not_negative,
    check_positive,
    check_widths,
)
from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import HEADS, MODEL_FORMS, EnsembleDynamics
from torchrl_l1.dynamics.ensemble import ACTIVATIONS
from torchrl_l1.planning import TrajectorySampler, check_sampling, resolve_compilation

LABELS: Mapping[str, str] = {"nominal": "action", "executed": "executed"}
"""Values of ``label``, with the key of the action that the model is fitted to."""


class PlanSettings(Protocol):
    """Settings common to algorithms that plan."""

    particles: int
    propagation: str
    precision: str
    compile_plans: bool | str
    replan_every: int


def make_sampler(
    settings: PlanSettings,
    dynamics: EnsembleDynamics,
    outcomes: Outcomes,
    **more: Any,
) -> TrajectorySampler:
    """The evaluator of plans according to an algorithm's settings.

    Args:
        settings: settings of the algorithm.
        dynamics: the model.
        outcomes: reward and termination.
        **more: arguments of :class:`~torchrl_l1.planning.TrajectorySampler` that only some
            algorithms set.
    """
    return TrajectorySampler(
        dynamics,
        outcomes.reward,
        outcomes.termination(),
        settings.particles,
        settings.propagation,  # type: ignore[arg-type]
        settings.precision,  # type: ignore[arg-type]
        compile=settings.compile_plans,  # type: ignore[arg-type]
        **more,
    )


def check_planning(settings: PlanSettings, optimizer: str, horizon: int) -> None:
    """Refuse invalid settings of a planner with a ``ValueError``.

    Args:
        settings: settings of the algorithm.
        optimizer: name of the settings that hold the horizon.
        horizon: number of actions in a plan.
    """
    check_sampling(settings.particles, settings.propagation, settings.precision)
    check_count("replan_every", settings.replan_every)
    if not settings.replan_every <= horizon:
        raise ValueError(
            f"replan_every must be between 1 and {optimizer}.horizon ({horizon}), got "
            f"{settings.replan_every}"
        )
    resolve_compilation(
        settings.compile_plans, propagation=settings.propagation, name="compile_plans"
    )


def check_covariance(l1: L1Config | None, model: ModelConfig, elites: int | None) -> None:
    """Refuse a covariance of residuals that a model does not provide.

    Args:
        l1: the controller; ``None`` for none.
        model: settings of the model.
        elites: number of members used; all if ``None``.

    Raises:
        ValueError: naming the setting of the model.
    """
    if l1 is None or not l1.needs_covariance:
        return
    if l1.covariance == "heads" and model.head != "gaussian":
        raise ValueError(
            "l1.covariance=heads needs members that predict a distribution: set "
            "model.head=gaussian, or l1.covariance=residuals"
        )
    counts = {"model.members": model.members, "fit.elites": elites or model.members}
    for name, count in counts.items():
        if l1.covariance == "disagreement" and count < 2:
            raise ValueError(
                f"l1.covariance=disagreement needs two members or more, {name} is {count}; raise "
                "it, or set l1.covariance=residuals"
            )


def episode_length(asked: int | None, horizon: int) -> int:
    """Steps of an episode: as requested, but at most those of a full one.

    Examples:
        >>> episode_length(None, 100), episode_length(30, 100), episode_length(300, 100)
        (100, 30, 100)
    """
    return min(asked or horizon, horizon)


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
        std_floor: smallest standard deviation of the normalisers, in raw units.
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
        check_choice("model.form", self.form, MODEL_FORMS)
        check_choice("model.head", self.head, HEADS)
        check_choice("model.activation", self.activation, tuple(ACTIVATIONS))
        check_counts(self, "members", prefix="model.")
        check_widths("model.hidden", self.hidden)
        check_positive("model.std_floor", self.std_floor)
        check_not_negative("model.box_margin", self.box_margin)
