"""The algorithms of a report, by the names that runs are told apart by."""

from __future__ import annotations

from collections.abc import Mapping

from torchrl_l1.algorithms import MBMF, METRPO, PETS
from torchrl_l1.algorithms.facts import AlgorithmFacts
from torchrl_l1.algorithms.pets import DETS

ALGORITHMS: Mapping[str, AlgorithmFacts] = {
    "metrpo": METRPO.facts,
    "mbmf": MBMF.facts,
    "pets": PETS.facts,
    "dets": DETS,
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
