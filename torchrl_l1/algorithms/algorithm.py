"""What an outer iteration of any algorithm reports."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class IterationResult:
    """What an outer iteration reports: metrics, and wall-clock seconds by phase."""

    metrics: dict[str, float]
    seconds: dict[str, float]
