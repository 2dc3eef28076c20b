"""Reports: the paper's tables and curves, with measured results beside the published ones."""

from __future__ import annotations

from torchrl_l1.report.build import report
from torchrl_l1.report.fit import draw_fit_quality
from torchrl_l1.report.published import (
    Curves,
    PublishedCell,
    ReferenceCurves,
    published_cell,
    published_cells,
)
from torchrl_l1.report.reading import Evaluation
from torchrl_l1.report.runs import Run, find_runs
from torchrl_l1.report.study import Cell, Study

__all__ = [
    "Cell",
    "Curves",
    "Evaluation",
    "PublishedCell",
    "ReferenceCurves",
    "Run",
    "Study",
    "draw_fit_quality",
    "find_runs",
    "published_cell",
    "published_cells",
    "report",
]
