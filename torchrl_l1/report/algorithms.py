"""What a report has to know of each algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torchrl_l1.report.statistics import WINDOW

__all__ = ["ALGORITHMS", "MEASURING", "AlgorithmFacts", "StageFacts", "facts"]

MEASURING = "evaluate"
"""The phase that only measures returns: no part of the training."""


@dataclass(frozen=True)
class StageFacts:
    """A stage of an algorithm.

    Attributes:
        name: as ``torchrl-l1 evaluate`` names it.
        words: in headings.
        window: outer iterations at its end that its return is the mean of.
        policies: kinds of policies that it knows the returns of.
        plans: whether what acts is a planner, whose sampled and mean actions are the same.
    """

    name: str
    words: str
    window: int = WINDOW
    policies: tuple[str, ...] = ("stochastic", "deterministic")
    plans: bool = False


@dataclass(frozen=True)
class AlgorithmFacts:
    """An algorithm as a report shows it.

    Attributes:
        name: in headings and tables.
        phases: columns of its ``timing.csv``, in the order in which an outer iteration goes
            through them.
        policies: the ways to act whose returns differ, as ``torchrl-l1 evaluate`` names them, and
            in words; a single one without words if there is no choice.
        stages: in turn, where there are several; ``stage`` in ``metrics.csv`` counts them from 1.
        table: number of the paper's table of its returns; empty if there is none.
        released: whether the authors have released logs of it. Only of this algorithm does the
            paper test frozen policies (Tables 2 and 5) and compare models (Figure 2).
    """

    name: str
    phases: tuple[str, ...]
    policies: Mapping[str, str]
    stages: tuple[StageFacts, ...] = ()
    table: str = ""
    released: bool = False

    @property
    def samples(self) -> bool:
        """Whether acting with sampled actions and with mean actions differ."""
        return len(self.policies) > 1

    def plans(self, stage: str) -> bool:
        """Whether a planner acts in a stage; any name may be asked for."""
        return any(one.plans for one in self.stages if one.name == stage)

    def position(self, stage: str) -> int:
        """Place of a stage, from 0; -1 for any other name."""
        return next((i for i, one in enumerate(self.stages) if one.name == stage), -1)

    def acting(self, policy: str, stage: str = "") -> str:
        """What acts, in words.

        Examples:
            >>> facts("mbmf").acting("stochastic", "fine_tuning")
            'fine-tuning, sampled actions'
            >>> facts("mbmf").acting("stochastic", "shooting"), facts("pets").acting("stochastic")
            ('random shooting', '')
        """
        actions = "" if self.plans(stage) else self.policies[policy]
        words = [one.words for one in self.stages if one.name == stage]
        return ", ".join(filter(None, [*words, actions]))


_SAMPLES = {"stochastic": "sampled actions", "deterministic": "mean action"}
_PLANS = {"stochastic": ""}
_PLANNER_PHASES = ("random", "fit", "collect", MEASURING)

ALGORITHMS: Mapping[str, AlgorithmFacts] = {
    "metrpo": AlgorithmFacts(
        "METRPO",
        ("random", "fit", "trpo", "collect", MEASURING),
        _SAMPLES,
        table="1",
        released=True,
    ),
    "mbmf": AlgorithmFacts(
        "MBMF",
        ("random", "fit", "clone", "tune", "collect", MEASURING),
        _SAMPLES,
        stages=(
            StageFacts("shooting", "random shooting", policies=("stochastic",), plans=True),
            # Each of its rounds fits the policy anew to all that is known by then.
            StageFacts("cloning", "cloning", window=1, policies=("deterministic",)),
            StageFacts("fine_tuning", "fine-tuning"),
        ),
        table="4",
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
