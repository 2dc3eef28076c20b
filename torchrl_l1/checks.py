"""Checks of settings: each refuses a value that makes no sense, not a number included.

The errors name the setting as the user writes it, with its prefix, and what it may be. All
comparisons are written so that NaN, which fails every one, is refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

LARGEST_BOUND = 1e9
"""Beyond it a bound of the action is none: some packages write the largest float for infinity."""


def check_within(name: str, value: float, interval: str) -> None:
    """Refuse a number outside an interval.

    Args:
        name: of the setting.
        value: what it is set to.
        interval: ends and whether they belong to it, as in ``"(0, 1]"`` or ``"[0, inf)"``.

    Raises:
        ValueError: for any other number.

    Examples:
        >>> check_within("trpo.fisher_fraction", float("nan"), "(0, 1]")
        Traceback (most recent call last):
            ...
        ValueError: trpo.fisher_fraction must be in (0, 1], got nan
    """
    low, high = map(float, interval[1:-1].split(","))
    above = value >= low if interval[0] == "[" else value > low
    below = value <= high if interval[-1] == "]" else value < high
    if not (above and below):
        raise ValueError(f"{name} must be in {interval}, got {value}")


def check_positive(name: str, value: float) -> None:
    """Refuse a value that is not finite and positive, with a ``ValueError``."""
    if not 0 < value < math.inf:
        raise ValueError(f"{name} must be finite and positive, got {value}")


def check_not_negative(name: str, value: float) -> None:
    """Refuse a value that is not finite, or negative, with a ``ValueError``."""
    if not 0 <= value < math.inf:
        raise ValueError(f"{name} must be finite and not negative, got {value}")


def check_count(name: str, value: int) -> None:
    """Refuse a count below one, or one that is no integer, with a ``ValueError``."""
    if not 1 <= value < math.inf:
        raise ValueError(f"{name} must be at least 1, got {value}")
    if isinstance(value, float):  # such as 1e3
        raise ValueError(f"{name} must be an integer, got {value}")


def check_counts(settings: object, *names: str, prefix: str = "") -> None:
    """Refuse counts below one, with a ``ValueError``."""
    for name in names:
        check_count(f"{prefix}{name}", getattr(settings, name))


def check_optional_count(name: str, value: int | None) -> None:
    """Refuse a count that is neither null nor an integer of at least one: a ``ValueError``."""
    if value is not None and not 1 <= value < math.inf:
        raise ValueError(f"{name} must be at least 1 or null, got {value}")
    if isinstance(value, float):
        raise ValueError(f"{name} must be an integer or null, got {value}")


def check_widths(name: str, widths: Sequence[int]) -> None:
    """Refuse widths below one, with a ``ValueError``."""
    if not all(1 <= width < math.inf for width in widths):
        raise ValueError(f"{name} must hold widths of at least 1, got {list(widths)}")


def check_choice(name: str, value: str, allowed: Sequence[str]) -> None:
    """Refuse a value that is none of those allowed, with a ``ValueError``."""
    if value not in allowed:
        raise ValueError(f"{name} must be {' or '.join(map(repr, allowed))}, got {value!r}")
