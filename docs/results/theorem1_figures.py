"""Figures and tables of what theorem1.py finds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.ticker import NullLocator

from torchrl_l1.report.page import markdown
from torchrl_l1.report.style import color, grid, legend_below, save

Row = dict[str, str | float]


def selected(runs: Sequence[Row], **values: str | float) -> list[Row]:
    """The runs with these values, in order of sampling time."""
    rows = [r for r in runs if all(r[key] == value for key, value in values.items())]
    return sorted(rows, key=lambda r: float(r["sampling_time"]))


def unique(runs: Sequence[Row], column: str) -> list[float]:
    """Values of a column, ascending."""
    return sorted({float(run[column]) for run in runs})


def columns(rows: Sequence[Row], *names: str) -> list[list[float]]:
    """Columns as lists of numbers."""
    return [[float(row[name]) for row in rows] for name in names]


def draw_errors(runs: Sequence[Row], file: Path) -> None:
    """Error against sampling time, the bounds around it."""
    panels = {
        "linear": ("linear, L1 acts", 1.0),
        "non-affine": ("non-affine, L1 acts", 1.0),
        "alternating": ("non-affine, alternating input", 0.0),
    }
    figure, axes = grid(len(panels), 3, 3.7, 3.6)
    for axis, (plant, (title, acting)) in zip(axes, panels.items(), strict=True):
        for index, epsilon in enumerate(unique(runs, "epsilon_a")):
            rows = selected(runs, plant=plant, acting=acting, epsilon_a=epsilon, noise=0.0)
            if not rows:
                continue
            draw = partial(axis.plot, color=color(index), linewidth=1)
            times, error, bound, printed = columns(
                rows, "sampling_time", "error", "bound", "bound_in_print"
            )
            draw(times, error, marker="o", markersize=3, label=f"ε_a = {epsilon:g}")
            draw(times, bound, linestyle="--")
            draw(times, printed, linestyle=":")
        axis.set(xscale="log", yscale="log", title=title, xlabel="sampling time (s)")
    axes[0].set_ylabel("largest error of the estimate (1/s)")
    axes[0].plot([], [], color="grey", linestyle="--", label="bound of the sampled law")
    axes[0].plot([], [], color="grey", linestyle=":", label="bound as the proof prints it")
    legend_below(figure, axes, last=("bound",))
    save(figure, file)


def draw_floors(runs: Sequence[Row], file: Path) -> None:
    """What stays as the sampling time shrinks; and what noise on the state does."""
    figure, (floors, noises) = grid(2, 2, 4.6, 3.6)
    finest = min(float(run["sampling_time"]) for run in runs)
    curves = {
        "alternating input": ("alternating", 0.0),
        "L1 acts": ("non-affine", 1.0),
        "L1 estimates only": ("non-affine", 0.0),
    }
    for index, (label, (plant, acting)) in enumerate(curves.items()):
        rows = selected(runs, plant=plant, acting=acting, sampling_time=finest, noise=0.0)
        epsilon, error = columns([r for r in rows if r["epsilon_a"]], "epsilon_a", "error")
        floors.plot(epsilon, error, marker="o", markersize=4, color=color(index), label=label)
    ends = np.array([min(epsilon), max(epsilon)])
    floors.plot(ends, 2 * ends, color="black", linestyle="--", label="2 ε_a")
    floors.plot(ends, ends, color="black", linestyle=":", label="ε_a")
    floors.set(xlabel="ε_a (1/s)", ylabel=f"largest error at {finest:g} s (1/s)")
    floors.legend(frameon=False, fontsize=8)
    for index, noise in enumerate(unique(runs, "noise")[1:]):
        rows = selected(runs, plant="linear", noise=noise)
        times, error, expected = columns(rows, "sampling_time", "error_rms", "rms_expected")
        noises.plot(times, expected, color=color(index), linewidth=1)
        noises.plot(times, error, "o", markersize=4, color=color(index), label=f"noise {noise:g}")
    noises.plot([], [], color="grey", linewidth=1, label="closed form")
    noises.set(xlabel="sampling time (s)", ylabel="root mean square error (1/s)")
    noises.legend(frameon=False, fontsize=8)
    for axis in (floors, noises):
        axis.set(xscale="log", yscale="log")
    floors.set_xticks(list(epsilon), labels=[f"{value:g}" for value in epsilon])
    floors.xaxis.set_minor_locator(NullLocator())
    save(figure, file)


def shown(value: str | float) -> str:
    """A cell of a table."""
    if isinstance(value, str):
        return value
    return "–" if math.isnan(value) else f"{value:.3g}"


def table(rows: Sequence[Row], headings: dict[str, str]) -> str:
    """Some columns as a Markdown table."""
    return markdown([{head: shown(row[key]) for key, head in headings.items()} for row in rows])


SLOPES = {
    "plant": "plant",
    "acting": "L1 acts",
    "epsilon_a": "epsilon_a",
    "slope": "slope",
    "smallest_error": "error at the shortest T",
    "floor": "floor",
    "floor_over_epsilon": "floor / epsilon_a",
    "affinization_error": "largest affine error",
    "closest_to_bound": "largest error / bound",
    "closest_to_print": "largest error / printed bound",
}


MATCHED = {
    "noise_ratio": "noise ratio",
    "estimator": "estimator",
    "variance": "variance",
    "variance_expected": "closed form",
    "cramer_rao": "Cramér-Rao",
    "over_cramer_rao": "variance / Cramér-Rao",
    "bias": "bias",
    "bias_expected": "its closed form",
    "gain": "gain",
}
