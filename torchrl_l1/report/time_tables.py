"""Where the wall-clock time of the training goes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from torchrl_l1.report.page import markdown, number
from torchrl_l1.report.runs import Run
from torchrl_l1.report.study import Study

_WORDS = {
    "fit": "fit",
    "trpo": "TRPO",
    "clone": "cloning",
    "tune": "PPO",
    "collect": "collection",
    "evaluate": "measuring returns",
}


def time_rows(study: Study) -> list[dict[str, Any]]:
    """Seconds per outer iteration in each phase, for each main cell whose times are known.

    The phases (those of them that the algorithm has) are medians over all outer iterations of all
    finished runs, and ``ms_per_step`` is the training time per real step of whole runs, random data
    included and ``evaluate`` left out. Where an algorithm has several stages there is a row for
    each, of its iterations and real steps, and ``share`` is its part of the training time.
    """
    rows = []
    phases = [phase for phase in study.facts.phases if phase in _WORDS]
    for cell, runs in study.cells.items():
        timed = [run for run in runs if run.finished and np.isfinite(run.milliseconds_per_step)]
        if cell.variant or not timed:
            continue
        place = {"task": cell.task, "noise": cell.noise, "l1": cell.arm}
        if not study.facts.stages:
            whole = [np.full(len(run.returns), True) for run in timed]
            rows.append({**place, "runs": len(timed), **_times(timed, whole, phases)})
        for position, stage in enumerate(study.facts.stages):
            during = [run.during(position) for run in timed]
            if any(part.any() for part in during):
                named = {**place, "stage": stage.name, "runs": len(timed)}
                rows.append({**named, **_times(timed, during, phases), **_share(timed, during)})
    return rows


def _times(
    runs: Sequence[Run], parts: Sequence[np.ndarray], phases: Sequence[str]
) -> dict[str, float]:
    """Medians over the outer iterations of these parts of the runs, and time per real step."""
    found = {
        phase: [run.seconds[phase][part] for run, part in zip(runs, parts, strict=True)]
        for phase in phases
    }
    steps = [
        np.diff(run.real_steps, prepend=0)[part].sum()
        for run, part in zip(runs, parts, strict=True)
    ]
    seconds = [_seconds(run, part) for run, part in zip(runs, parts, strict=True)]
    per_step = [1000 * t / n if n else math.nan for t, n in zip(seconds, steps, strict=True)]
    return {
        **{phase: float(np.median(np.concatenate(times))) for phase, times in found.items()},
        "ms_per_step": float(np.mean(per_step)),
    }


def _share(runs: Sequence[Run], parts: Sequence[np.ndarray]) -> dict[str, float]:
    shares = [_seconds(run, part) / _seconds(run) for run, part in zip(runs, parts, strict=True)]
    return {"share": float(np.mean(shares))}


def _seconds(run: Run, part: np.ndarray | slice = slice(None)) -> float:
    return float(run.training_seconds[part].sum())


def time_table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown."""
    return markdown(
        [
            {
                "task": row["task"],
                "noise": row["noise"],
                "L1": row["l1"],
                "stage": row.get("stage", ""),
                "runs": str(row["runs"]),
                **{f"{w}, s": number(row[phase]) for phase, w in _WORDS.items() if phase in row},
                "training, ms per real step": number(row["ms_per_step"]),
                "share of the training": f"{row['share']:.0%}" if "share" in row else "",
            }
            for row in rows
        ]
    )
