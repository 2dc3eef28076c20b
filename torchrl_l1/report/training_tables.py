"""The training table (the paper's Table 1) and the paired differences, as rows of values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchrl_l1.report.algorithms import facts
from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.published import published_cell
from torchrl_l1.report.reference_curves import ReferenceCurves
from torchrl_l1.report.runs import Run
from torchrl_l1.report.statistics import (
    difference_summary,
    final_return,
    mean_summary,
    published_spread,
)
from torchrl_l1.report.study import Cell, Study, place_columns, with_baselines


def run_rows(study: Study) -> list[dict[str, Any]]:
    """One row per run, unfinished ones included."""
    return [
        {
            **place_columns(cell),
            "seed": run.identity.seed,
            "iterations": len(run.returns),
            "of": run.identity.outer_iterations,
            "real_steps": int(run.real_steps[-1]) if len(run.real_steps) else 0,
            "return": run.final if run.finished else None,
            **_deterministic(run, study),
            **(_signals([run]) if run.finished else {}),
            "path": str(run.path),
        }
        for cell, runs in study.cells.items()
        for run in runs
    ]


def training_row(
    cell: Cell, runs: Sequence[Run], reference: ReferenceCurves | None = None
) -> dict[str, Any]:
    """A cell: our returns over its finished runs, the paper's, the authors' logged ones.

    The return is the mean over seeds of the mean over :attr:`Run.ending`.
    """
    done = [run for run in runs if run.finished]
    place = (cell.task, cell.noise, cell.arm)
    row: dict[str, Any] = {**place_columns(cell), "seeds": len(done)}
    if done:
        row |= mean_summary("return", [run.final for run in done])
        if len(done) > 1:
            row["published_spread"] = published_spread(
                np.array([run.returns[run.ending] for run in done])
            )
        if facts(runs[0].identity.algorithm).samples:
            row |= mean_summary("deterministic", [run.final_deterministic for run in done])
        row["real_steps"] = round(float(np.mean([run.real_steps[-1] for run in done])))
        row |= _signals(done)
    row["unfinished"] = "; ".join(
        f"seed {run.identity.seed}: {run.progress} iterations" for run in runs if not run.finished
    )
    what = runs[0].identity
    affine = what.model_form == "affine"
    # The paper prints no returns with control-affine models; their curves are in its Figure 2.
    published = None
    if what.as_published:
        published = published_cell(*place, *place[1:], what.algorithm)
    if published is not None:
        row |= published.columns()
    curves = None
    if reference is not None and affine and cell.noise == "none" and cell.arm == BASELINE:
        curves = reference.model_form(cell.task, "affine")
    elif reference is not None and published is not None:
        curves = reference.training(*place)
    if curves is not None:
        row |= {
            "authors_mean": float(final_return(curves.returns).mean()),
            "authors_spread": published_spread(curves.returns),
            "authors_seeds": len(curves.returns),
        }
    return row


def paired_rows(study: Study) -> list[dict[str, Any]]:
    """L1 less the baseline over the seeds that both have, by stochastic and mean actions.

    Where there is one way to act only, a row has no ``policy``.
    """
    rows = []
    for cell, runs in study.cells.items():
        if cell.arm == BASELINE:
            continue
        pairs, single = with_baselines(study, runs)
        for policy in study.facts.policies:
            finals = [
                (l1.final, off.final)
                if policy == "stochastic"
                else (l1.final_deterministic, off.final_deterministic)
                for l1, off in pairs
            ]
            differences = [ours - base for ours, base in finals]
            rows.append(
                {
                    **place_columns(cell),
                    **({"policy": policy} if study.facts.samples else {}),
                    "pairs": len(pairs),
                    "seeds": " ".join(str(run.identity.seed) for run, _ in pairs),
                    **difference_summary(differences),
                    "without_pair": " ".join(single),
                }
            )
    return rows


def _signals(runs: Sequence[Run]) -> dict[str, float]:
    """What L1 did at the end of the training; what is known of it."""
    values = {
        "switches_per_1000": [1000 * run.final_signal("l1/switch_rate") for run in runs],
        "u_a": [run.final_signal("l1/u_a") for run in runs],
        "saturation": [run.final_signal("l1/saturation") for run in runs],
    }
    means = {name: float(np.mean(numbers)) for name, numbers in values.items()}
    return {name: mean for name, mean in means.items() if np.isfinite(mean)}


def _deterministic(run: Run, study: Study) -> dict[str, float | None]:
    """The return with mean actions, if it is another one."""
    if not study.facts.samples:
        return {}
    return {"return_deterministic": run.final_deterministic if run.finished else None}
