"""Summary, table and plot of an evaluation over disturbances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from torchrl_l1.experiment.l1_options import controller_label

matplotlib.use("Agg")


_PANEL = ("stage", "policy", "noise")
_CELL = (*_PANEL, "bias", "gain", "l1")


def summarize(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Median, lowest and highest mean return over the training seeds, per condition.

    A controller is named by its option and the values that the test has set. Only where rows
    have a ``stage`` has the summary.
    """
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        name = controller_label(row["l1"], row.get("epsilon"), row.get("alpha"))
        named = {"stage": None, **row, "l1": name}
        groups.setdefault(tuple(named[key] for key in _CELL), []).append(row)
    summary = []
    for cell, members in groups.items():
        returns = [float(row["return_mean"]) for row in members]
        named = {k: v for k, v in zip(_CELL, cell, strict=True) if (k, v) != ("stage", None)}
        entry = {
            **named,
            "training_seeds": len(members),
            "episodes_per_seed": members[0]["episodes"],
            "return_median": median(returns),
            "return_lowest": min(returns),
            "return_highest": max(returns),
        }
        if "l1/switch_rate" in members[0]:
            rates = [float(row["l1/switch_rate"]) for row in members]
            entry["switches_per_1000_steps"] = 1000 * median(rates)
        summary.append(entry)
    return summary


def table(summary: Sequence[Mapping[str, Any]]) -> str:
    """The summary as text: one line per disturbance, one column per controller."""
    controllers = list(dict.fromkeys(row["l1"] for row in summary))
    width = max(34, 2 + max(map(len, controllers), default=0))
    lines = []
    keys = dict.fromkeys((_panel(r), r["bias"], r["gain"]) for r in summary)
    heading = None
    for panel, bias, gain in keys:
        if heading != panel:
            heading = panel
            seeds = next(row["training_seeds"] for row in summary if _panel(row) == panel)
            lines.append(
                f"\n{_panel_words(panel, ' policy, noise ')}: mean return, "
                f"median [lowest, highest] of {seeds} training seed{'s' * (seeds > 1)}"
            )
            lines.append(f"{'bias':>7}{'gain':>7}" + "".join(f"{c:>{width}}" for c in controllers))
        cells = ""
        for controller in controllers:
            row = next(
                r
                for r in summary
                if (_panel(r), r["bias"], r["gain"], r["l1"]) == (panel, bias, gain, controller)
            )
            spread = f"[{row['return_lowest']:.4g}, {row['return_highest']:.4g}]"
            cells += f"{row['return_median']:>{width - 23}.4g} {spread:>22}"
        lines.append(f"{bias:>7g}{gain:>7g}{cells}")
    return "\n".join(lines)


def _panel(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(row.get(key) for key in _PANEL)


def _panel_words(panel: tuple[Any, ...], between: str) -> str:
    stage, policy, noise = panel
    return f"{stage}, " * bool(stage) + f"{policy}{between}{noise}"


def plot_robustness(summary: Sequence[Mapping[str, Any]], file: Path, title: str) -> None:
    """Return against actuator bias and against gain, one line per controller.

    A panel per kind of disturbance and per stage, policy and noise; the band spans the training
    seeds.
    """
    panels = []
    for panel in dict.fromkeys(map(_panel, summary)):
        rows = [r for r in summary if _panel(r) == panel]
        for axis_name, other, neutral in (("bias", "gain", 1.0), ("gain", "bias", 0.0)):
            chosen = [r for r in rows if r[other] == neutral]
            if len({r[axis_name] for r in chosen}) > 1 or (axis_name == "bias" and chosen):
                panels.append((_panel_words(panel, " policy, noise: "), axis_name, chosen))
    figure, axes = plt.subplots(
        1, len(panels), figsize=(5.2 * len(panels), 4.2), squeeze=False, constrained_layout=True
    )
    for axis, (heading, disturbance, rows) in zip(axes[0], panels, strict=True):
        _draw_panel(axis, heading, disturbance, rows)
    figure.suptitle(title)
    figure.savefig(file, dpi=130)
    plt.close(figure)


def _draw_panel(
    axis: Axes, heading: str, disturbance: str, rows: Sequence[Mapping[str, Any]]
) -> None:
    for controller in dict.fromkeys(r["l1"] for r in rows):
        line = sorted((r for r in rows if r["l1"] == controller), key=lambda r: r[disturbance])
        x = [r[disturbance] for r in line]
        label = "L1 off" if controller == "off" else f"L1 {controller}"
        (drawn,) = axis.plot(x, [r["return_median"] for r in line], "o-", label=label)
        axis.fill_between(
            x,
            [r["return_lowest"] for r in line],
            [r["return_highest"] for r in line],
            alpha=0.2,
            color=drawn.get_color(),
            linewidth=0,
        )
    lowest = min(r["return_lowest"] for r in rows)
    if max(r["return_highest"] for r in rows) <= 0 and lowest < -5:
        axis.set_yscale("symlog", linthresh=1)
    units = "action units" if disturbance == "bias" else "factor"
    axis.set_xlabel(f"actuator {disturbance} ({units})")
    axis.set_ylabel("return")
    axis.set_title(heading, fontsize=10)
    axis.grid(alpha=0.3)
    axis.legend()
