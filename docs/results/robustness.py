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
    controllers = list(dict.fromkeys(row["l1"] for row in summary))
    keys = list(dict.fromkeys((row["policy"], row["bias"]) for row in summary))
    rows = []
    for policy, bias in keys:
        cells = []
        for controller in controllers:
            key = (policy, bias, controller)
            row = next(r for r in summary if (r["policy"], r["bias"], r["l1"]) == key)
            median, low, high = (float(row[f"return_{k}"]) for k in ("median", "lowest", "highest"))
            cells.append(f"{median:.3g} [{low:.3g}, {high:.3g}]")
        rows.append([policy, bias, *cells])
    names = ["L1 off" if c == "off" else f"L1 `{c}`" for c in controllers]
    seeds, episodes = summary[0]["training_seeds"], summary[0]["episodes_per_seed"]
    note = (
        f"Mean return: median [lowest, highest] of {seeds} training seeds, {episodes} episodes "
        "each. The action bound is 3."
    )
    header = ["policy", "bias", *names]
    with (HERE / "robustness.csv").open("w", newline="") as handle:
        csv.writer(handle, lineterminator="\n").writerows([header, *rows])
    table = markdown([dict(zip(header, row, strict=True)) for row in rows])
    figures = "![robustness](results/robustness.png)\n" + filmstrip_figure(summary)
    text = "\n".join([table, "", note, "", figures])
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
