"""What a report has to know of each algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torchrl_l1.report.statistics import WINDOW

MEASURING = "evaluate"
"""The phase that only measures returns: no part of the training."""


@dataclass(frozen=True)
class StageFacts:
    """A stage of an algorithm.

    Attributes:
        name: as ``torchrl-l1 evaluate`` names it.
        words: in headings.
        window: outer iterations at its end that its return is the mean of.
        policies: kinds of policies whose returns a run logs in it.
        is_planner: whether what acts is a planner, whose sampled and mean actions are the same.
    """

    name: str
    words: str
    window: int = WINDOW
    policies: tuple[str, ...] = ("stochastic", "deterministic")
    is_planner: bool = False


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
        tables: numbers of the paper's tables of it: of the returns of the ``training``, and of the
            evaluations ``sim_to_real`` and ``ablation``.
        compares_models: whether the paper compares forms of the model with it (Figure 2).
        reference_logs: whether the authors have released logs of it.
    """

    name: str
    phases: tuple[str, ...]
    policies: Mapping[str, str]
    stages: tuple[StageFacts, ...] = ()
    tables: Mapping[str, str] = field(default_factory=dict)
    compares_models: bool = False
    reference_logs: bool = False

    @property
    def samples(self) -> bool:
        """Whether acting with sampled actions and with mean actions differ, at the end at least."""
        return len(self.policies) > 1

    @property
    def mean_action_stages(self) -> tuple[int, ...]:
        """Places of the stages in which a run logs the return of either way to act.

        Examples:
            >>> [facts(name).mean_action_stages for name in ("metrpo", "mbmf", "pets")]
            [(0,), (2,), ()]
        """
        logged = [stage.policies for stage in self.stages] or [tuple(self.policies)]
        return tuple(place for place, policies in enumerate(logged) if len(policies) > 1)

    def acts_in_one_way(self, stage: str = "") -> bool:
        """Whether sampled and mean actions are the same in a stage; any name may be asked for."""
        planned = any(one.is_planner for one in self.stages if one.name == stage)
        return planned or not self.samples

    def position(self, stage: str) -> int:
        """Place of a stage, from 0; -1 for any other name."""
        return next((i for i, one in enumerate(self.stages) if one.name == stage), -1)

    def actions(self, policy: str, stage: str = "") -> str:
        """How a kind of policy acts, in words; empty where there is no choice."""
        return "" if self.acts_in_one_way(stage) else self.policies[policy]

    def acting(self, policy: str, stage: str = "") -> str:
        """What acts, in words.

        Examples:
            >>> facts("mbmf").acting("stochastic", "fine_tuning")
            'fine-tuning, sampled actions'
            >>> facts("mbmf").acting("stochastic", "shooting"), facts("pets").acting("stochastic")
            ('random shooting', '')
        """
        words = [one.words for one in self.stages if one.name == stage]
        return ", ".join(filter(None, [*words, self.actions(policy, stage)]))


_SAMPLES = {"stochastic": "sampled actions", "deterministic": "mean action"}
_PLANS = {"stochastic": ""}
_PLANNER_PHASES = ("random", "fit", "collect", MEASURING)

ALGORITHMS: Mapping[str, AlgorithmFacts] = {
    "metrpo": AlgorithmFacts(
        "METRPO",
        ("random", "fit", "trpo", "collect", MEASURING),
        _SAMPLES,
        tables={"training": "1", "sim_to_real": "2", "ablation": "5"},
        compares_models=True,
        reference_logs=True,
    ),
    "mbmf": AlgorithmFacts(
        "MBMF",
        ("random", "fit", "clone", "tune", "collect", MEASURING),
        _SAMPLES,
        stages=(
            StageFacts("shooting", "random shooting", policies=("stochastic",), is_planner=True),
            # Each of its rounds fits the policy anew to all that is known by then.
            StageFacts("cloning", "cloning", window=1, policies=("deterministic",)),
            StageFacts("fine_tuning", "fine-tuning"),
        ),
        tables={"training": "4"},
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
