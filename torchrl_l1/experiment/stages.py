"""What of a run can be evaluated: the policies of its stages, by the names that users type."""

from __future__ import annotations

from collections.abc import Mapping

from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModuleBase

from torchrl_l1.algorithms import MBMF, METRPO, PETS
from torchrl_l1.algorithms.facts import KINDS

STAGES: Mapping[str, tuple[str, ...]] = {
    "metrpo": METRPO.facts.stage_names,
    "pets": PETS.facts.stage_names,
    "mbmf": MBMF.facts.stage_names,
}
"""Stages in turn of each algorithm of the recipes."""


def find_stage(policies: Mapping[str, TensorDictModuleBase], stage: str | None) -> str:
    """The name of a stage that a run has reached.

    Args:
        policies: of an algorithm, see :class:`~torchrl_l1.algorithms.algorithm.Algorithm`.
        stage: a name; ``None`` for the last one.

    Raises:
        ValueError: if there is no such stage, or not yet; the message lists those that there are.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> policies = {"shooting": TensorDictModule(lambda x: x, ["observation"], ["action"])}
        >>> find_stage(policies, None)
        'shooting'
        >>> find_stage(policies, "fine_tuning")
        Traceback (most recent call last):
            ...
        ValueError: no stage 'fine_tuning', or not yet; there is shooting
    """
    if stage is None:
        return list(policies)[-1]
    if stage not in policies:
        there = "there are" if len(policies) > 1 else "there is"
        raise ValueError(f"no stage {stage!r}, or not yet; {there} {', '.join(policies)}")
    return stage


def kinds_of(policy: TensorDictModuleBase) -> tuple[str, ...]:
    """The ways to act that differ: both for a distribution over actions, else ``stochastic``.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> kinds_of(TensorDictModule(lambda x: x, ["observation"], ["action"]))
        ('stochastic',)
    """
    samples = any(isinstance(part, ProbabilisticTensorDictModule) for part in policy.modules())
    return KINDS if samples else KINDS[:1]
