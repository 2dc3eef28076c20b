"""Checks of settings, shared by the algorithms."""

from __future__ import annotations

import math
from collections.abc import Sequence


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
