"""What a report has to know of each algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

__all__ = ["ALGORITHMS", "MEASURING", "AlgorithmFacts", "facts"]

MEASURING = "evaluate"
"""The phase that only measures returns: no part of the training."""


@dataclass(frozen=True)
class AlgorithmFacts:
    """An algorithm as a report shows it.

    Attributes:
        name: in headings and tables.
        phases: columns of its ``timing.csv``, in the order in which an outer iteration goes
            through them.
        policies: the ways to act whose returns differ, as ``torchrl-l1 evaluate`` names them, and
            in words; a single one without words if there is no choice.
        published: whether the published tables and curves that a report shows are of it.
    """

    name: str
    phases: tuple[str, ...]
    policies: Mapping[str, str]
    published: bool = False

    @property
    def samples(self) -> bool:
        """Whether acting with sampled actions and with mean actions differ."""
        return len(self.policies) > 1


_SAMPLES = {"stochastic": "sampled actions", "deterministic": "mean action"}
_PLANS = {"stochastic": ""}
_PLANNER_PHASES = ("random", "fit", "collect", MEASURING)

ALGORITHMS: Mapping[str, AlgorithmFacts] = {
    "metrpo": AlgorithmFacts(
        "METRPO", ("random", "fit", "trpo", "collect", MEASURING), _SAMPLES, published=True
    ),
    "pets": AlgorithmFacts("PETS", _PLANNER_PHASES, _PLANS),
    "dets": AlgorithmFacts("DETS", _PLANNER_PHASES, _PLANS),
}
"""By name, see ``Identity.algorithm``, in the order in which a report shows them."""


def facts(algorithm: str) -> AlgorithmFacts:
    """What is known of an algorithm.

    Raises:
        ValueError: if nothing is.

    Examples:
        >>> facts("dets").samples
        False
    """
    if algorithm not in ALGORITHMS:
        raise ValueError(f"no report of algorithm {algorithm!r}; there are {', '.join(ALGORITHMS)}")
    return ALGORITHMS[algorithm]
