"""Table and figures of the L1 page, from an evaluation of frozen policies.

    python docs/results/robustness.py runs/robustness/evaluation

Writes robustness.md, robustness.csv and the figures beside this file; the page includes them.
"""

from __future__ import annotations

import csv
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.evaluation_summary import summary_lines
from torchrl_l1.report.page import markdown

HERE = Path(__file__).parent


def robustness(source: Path) -> None:
    """The output of ``torchrl-l1 evaluate``: table, plot and filmstrip."""
    with (source / "summary.csv").open() as handle:
        summary = list(csv.DictReader(handle))
    for kind in ("robustness.png", "filmstrip.png"):
        if (source / kind).exists():
            shutil.copy(source / kind, HERE / kind)
    shutil.copy(source / "evaluation.csv", HERE / "robustness_cells.csv")
    rows = summary_lines(summary, ("policy",), digits=3)
    seeds, episodes = summary[0]["training_seeds"], summary[0]["episodes_per_seed"]
    note = (
        f"Mean return: median [lowest, highest] of {seeds} training seeds, {episodes} episodes "
        "each. The action bound is 3."
    )
    write_table(HERE / "robustness.csv", rows)
    figures = "![robustness](results/robustness.png)\n" + filmstrip_figure(summary)
    text = "\n\n".join([markdown(rows), note, figures])
    (HERE / "robustness.md").write_text(text)
    print(text)


def filmstrip_figure(summary: Sequence[dict[str, str]]) -> str:
    """The filmstrip with a caption, or nothing where it could not be rendered."""
    if not (HERE / "filmstrip.png").exists():
        return ""
    worst = max((float(row["bias"]) for row in summary), key=abs)
    caption = f"The first training seed's policy (mean action) at a bias of {worst:g}."
    return f"\n![filmstrip](results/filmstrip.png)\n\n*{caption}*\n"


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    robustness(Path(sys.argv[1]))
