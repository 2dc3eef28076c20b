"""Checks of settings, shared by the algorithms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

from torchrl_l1.planning import check_sampling, resolve_compilation


class PlanSettings(Protocol):
    """What the settings of algorithms that plan have in common."""

    particles: int
    propagation: str
    precision: str
    compile_plans: bool | str
    replan_every: int


def check_plans(settings: PlanSettings, optimizer: str, horizon: int) -> None:
    """Refuse settings of a planner that make no sense, with a ``ValueError``.

    Args:
        settings: those of the algorithm.
        optimizer: name of the settings that hold the horizon.
        horizon: actions in a plan.
    """
    check_sampling(settings.particles, settings.propagation, settings.precision)
    if not 1 <= settings.replan_every <= horizon:
        raise ValueError(
            f"replan_every must be between 1 and {optimizer}.horizon ({horizon}), got "
            f"{settings.replan_every}"
        )
    resolve_compilation(
        settings.compile_plans, propagation=settings.propagation, name="compile_plans"
    )


def check_counts(settings: object, *names: str, prefix: str = "") -> None:
    """Refuse counts below one, with a ``ValueError``."""
    for name in names:
        if getattr(settings, name) < 1:
            raise ValueError(f"{prefix}{name} must be at least 1, got {getattr(settings, name)}")


def check_steps(name: str, value: int | None) -> None:
    """Refuse a number of steps that is neither null nor at least one, with a ``ValueError``."""
    if value is not None and value < 1:
        raise ValueError(f"{name} must be at least 1 or null, got {value}")


def check_choice(name: str, value: str, allowed: Sequence[str]) -> None:
    """Refuse a value that is none of those allowed, with a ``ValueError``."""
    if value not in allowed:
        raise ValueError(f"{name} must be {' or '.join(map(repr, allowed))}, got {value!r}")


def check_positive(name: str, value: float) -> None:
    """Refuse a value that is not finite and positive, with a ``ValueError``."""
    if not (value > 0 and math.isfinite(value)):
        raise ValueError(f"{name} must be finite and positive, got {value}")


def check_widths(name: str, widths: Sequence[int]) -> None:
    """Refuse widths below one, with a ``ValueError``."""
    if any(width < 1 for width in widths):
        raise ValueError(f"{name} must hold widths of at least 1, got {list(widths)}")
