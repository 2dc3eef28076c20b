"""Where the wall-clock time of the training goes."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_l1.report.tables import markdown, number
from torchrl_l1.report.variants import Study

__all__ = ["time_rows", "time_table"]

_WORDS = {"fit": "fit", "trpo": "TRPO", "collect": "collection", "evaluate": "measuring returns"}


def time_rows(study: Study) -> list[dict[str, Any]]:
    """Seconds per outer iteration in each phase, for each main cell whose times are known.

    ``fit``, ``trpo`` (if the algorithm has it), ``collect`` and ``evaluate`` are medians over all
    outer iterations of all finished runs, and ``ms_per_step`` is the training time per real step of
    whole runs, random data included and ``evaluate`` left out.
    """
    rows = []
    phases = [phase for phase in study.facts.phases if phase in _WORDS]
    for cell, runs in study.cells.items():
        timed = [run for run in runs if run.finished and np.isfinite(run.milliseconds_per_step)]
        if cell.variant or not timed:
            continue
        seconds = {k: np.concatenate([run.seconds[k] for run in timed]) for k in phases}
        rows.append(
            {
                "task": cell.task,
                "noise": cell.noise,
                "l1": cell.arm,
                "runs": len(timed),
                **{phase: float(np.median(seconds[phase])) for phase in phases},
                "ms_per_step": float(np.mean([run.milliseconds_per_step for run in timed])),
            }
        )
    return rows


def time_table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    return markdown(
        [
            {
                "task": row["task"],
                "noise": row["noise"],
                "L1": row["l1"],
                "runs": str(row["runs"]),
                **{f"{w}, s": number(row[phase]) for phase, w in _WORDS.items() if phase in row},
                "training, ms per real step": number(row["ms_per_step"]),
            }
            for row in rows
        ]
    )
