"""The stages of an algorithm that has several: what each has reached, as rows of values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchrl_l1.report.algorithms import StageFacts
from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.runs import Run
from torchrl_l1.report.statistics import difference_summary, mean_summary
from torchrl_l1.report.study import Study, place_columns, with_baselines

_SIGNALS = {"switches_per_1000": ("l1/switch_rate", 1000), "u_a": ("l1/u_a", 1)}


def stage_rows(study: Study) -> list[dict[str, Any]]:
    """The return at the end of each stage of each cell, and L1 less the baseline of the same seed.

    There is a row for each kind of policy whose returns are known in the stage; a planner has no
    ``policy``. ``std`` is the population standard deviation over seeds and ``real_steps`` counts
    from the start of the training. What L1 did, as in the table of the training, is there where it
    acts in the stage. Only finished runs count.
    """
    rows = []
    for cell, runs in study.cells.items():
        for position, stage in enumerate(study.facts.stages):
            done = [run for run in runs if run.finished and run.during(position).any()]
            for policy in stage.policies if done else ():
                returns = [stage_return(run, position, stage, policy) for run in done]
                rows.append(
                    {
                        **place_columns(cell),
                        "stage": stage.name,
                        "policy": "" if stage.is_planner else policy,
                        "seeds": len(done),
                        **mean_summary("return", returns),
                        "std": float(np.std(returns)),
                        "return_values": " ".join(f"{value:.6g}" for value in returns),
                        "real_steps": round(float(np.mean([_steps(r, position) for r in done]))),
                        **_signals(done, position, stage),
                        **_differences(study, runs, position, stage, policy),
                    }
                )
    return rows


def stage_return(run: Run, position: int, stage: StageFacts, policy: str) -> float:
    """Mean return over the last outer iterations of a stage that the run has."""
    returns = run.returns if policy == "stochastic" else run.deterministic
    return float(returns[run.end_of(position, stage.window)].mean())


def _differences(
    study: Study, runs: Sequence[Run], position: int, stage: StageFacts, policy: str
) -> dict[str, Any]:
    if runs[0].identity.arm == BASELINE:
        return {}
    pairs, single = with_baselines(study, runs)
    differences = [
        stage_return(run, position, stage, policy) - stage_return(base, position, stage, policy)
        for run, base in pairs
    ]
    return {
        "pairs": len(pairs),
        **difference_summary(differences),
        "without_pair": " ".join(single),
    }


def _steps(run: Run, position: int) -> float:
    return float(run.real_steps[run.end_of(position, 1)].item())


def _signals(runs: Sequence[Run], position: int, stage: StageFacts) -> dict[str, float]:
    found = {}
    for name, (signal, factor) in _SIGNALS.items():
        values = [run.signals[signal][run.end_of(position, stage.window)].mean() for run in runs]
        mean = factor * float(np.mean(values))
        if np.isfinite(mean):
            found[name] = mean
    return found
