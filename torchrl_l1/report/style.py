"""Colours, names and scales shared by all figures."""

from __future__ import annotations

import gc
import itertools
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogFormatter, NullFormatter

from torchrl_l1.algorithms.collection import ORACLE
from torchrl_l1.atomic import write_through
from torchrl_l1.report.identity import BASELINE, NOISES

_DPI = 130

# Okabe and Ito: distinguishable with any colour vision. Grey is reserved for the authors' curves.
_ARMS = {BASELINE: "#D55E00", "paper": "#0072B2", "robust": "#009E73"}
_ARMS |= {"reference": "#E69F00", "slow": "#CC79A7"}
_ARMS[ORACLE] = "#000000"
_CYCLE = ("#D55E00", "#0072B2", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#000000")

_STYLES: Sequence[Any] = ("-", "-.", (0, (6, 1, 1, 1, 1, 1)), (0, (1, 1)))
_MARKERS = "osD^"


def color(index: int, arm: str | None = None) -> str:
    """Colour of an arm, or of the n-th line."""
    return _ARMS.get(arm or "", _CYCLE[index % len(_CYCLE)])


@dataclass(frozen=True)
class Look:
    """How a line differs from the others in its figure.

    Attributes:
        color: an arm has its own colour, which no other line has.
        style: matplotlib line style; like the marker, it changes when colours repeat.
        marker: marker of its points, if it has any.
    """

    color: str
    style: Any = _STYLES[0]
    marker: str = _MARKERS[0]


def looks(names: Collection[str]) -> dict[str, Look]:
    """How to draw several lines, by the name of an arm or any other name.

    Examples:
        >>> [look.color for look in looks(["off", "paper", "paper epsilon=0.3"]).values()]
        ['#D55E00', '#0072B2', '#009E73']
    """
    arms = {name: Look(_ARMS[name]) for name in names if name in _ARMS}
    taken = {look.color for look in arms.values()}
    free = [
        Look(shade, style, marker)
        for style, marker in zip(_STYLES, _MARKERS, strict=False)
        for shade in _CYCLE
        if shade not in taken
    ]
    others = [name for name in names if name not in arms]
    return arms | dict(zip(others, itertools.cycle(free), strict=False))


def arm_label(arm: str) -> str:
    """An arm's name in a legend.

    Examples:
        >>> arm_label("off"), arm_label("paper"), arm_label("oracle")
        ('L1 off', 'L1 paper', 'oracle')
    """
    if arm == ORACLE:
        return arm
    return "L1 off" if arm == BASELINE else f"L1 {arm}"


def arm_style(arm: str, arms: Sequence[str]) -> Any:
    """Style of an arm's lines if the colour marks the algorithm.

    Args:
        arm: the arm.
        arms: all of them.
    """
    on = [other for other in arms if other != BASELINE]
    return "--" if arm == BASELINE else _STYLES[on.index(arm) % len(_STYLES)]


def algorithm_label(name: str, arm: str) -> str:
    """An algorithm with an arm, as the paper names them.

    Examples:
        >>> [algorithm_label("PETS", arm) for arm in ("off", "paper", "reference")]
        ['PETS', 'L1-PETS', 'L1-PETS (reference)']
    """
    if arm == BASELINE:
        return name
    return f"L1-{name}" if arm == "paper" else f"L1-{name} ({arm})"


def named(name: str, text: str) -> str:
    """A heading or caption prefixed with the name of an algorithm, if there is one.

    Examples:
        >>> named("PETS", "Training"), named("", "Training")
        ('PETS: Training', 'Training')
    """
    return f"{name}: {text}" if name else text


def title(task: str, noise: str | None = None) -> str:
    """A task's name in headings, with its noise.

    Examples:
        >>> title("half_cheetah", "action")
        'Half cheetah, action noise'
    """
    # Names of external environments stay as they are.
    name = task if re.search(r"[/:]", task) else task.replace("_", " ").capitalize()
    return name if noise is None else f"{name}, {noise_words(noise)}"


def noise_words(noise: str) -> str:
    """A noise setting in headings.

    Examples:
        >>> noise_words("none"), noise_words("action 0.3, observation 0.05")
        ('no noise', 'action noise 0.3 and observation noise 0.05')
    """
    if noise in NOISES:
        return NOISES[noise]
    levels = [re.fullmatch(r"(\w+) (\S+)", part) for part in noise.split(", ")]
    if not all(levels):
        return f"noise {noise}"
    return " and ".join(f"{level[1]} noise {level[2]}" for level in levels if level)


def grid(panels: int, columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure with so many panels, in rows of at most ``columns``; sizes in inches."""
    columns = min(panels, columns)
    rows = -(-panels // columns)
    # A single panel still needs room for a legend.
    figure = Figure(figsize=(max(width * columns, 6.4), height * rows), dpi=_DPI)
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    flat = list(axes.flat)
    for empty in flat[panels:]:
        empty.set_visible(False)
    return figure, flat[:panels]


def reaches_far_below(values: np.ndarray, below: float = -5.0) -> bool:
    """Whether returns range from 0 to far below, so that only a logarithm shows them all."""
    return bool(values.size and -0.5 < values.max() <= 0 and values.min() < below)


def fit_scale(axes: Sequence[Axes], values: Iterable[np.ndarray | Sequence[float]]) -> None:
    """A symmetric logarithmic scale if returns range from 0 to far below.

    On the pendulum, -100 is a fallen pole, -1 a poor and -0.01 a good controller.
    """
    every = np.concatenate([np.asarray(list(value), dtype=float) for value in values])
    if reaches_far_below(every):
        ticks = [0.0] + [-(10.0**k) for k in range(-1, 7) if 10.0**k < -3 * every.min()]
        for axis in axes:
            axis.set_yscale("symlog", linthresh=0.1, linscale=0.5)
            # In plain text: formulas are off, since names come from files.
            axis.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
            # Otherwise the margins would be those of the linear scale.
            axis.set_ylim(1.6 * every.min(), 0.03)


def legend_below(figure: Figure, axes: Sequence[Axes], last: Sequence[str] = ()) -> None:
    """One legend for all panels, under them; equal entries appear once.

    Args:
        figure: the figure.
        axes: its panels.
        last: prefixes of labels that come last.
    """
    entries: dict[str, Artist] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    labels = sorted(entries, key=lambda label: label.startswith(tuple(last)))
    # Width of an entry at this font size, in inches.
    width = 0.075 * max(map(len, labels), default=0) + 0.6
    fitting = max(1, int(figure.get_figwidth() / width))
    rows = -(-len(labels) // fitting)
    figure.legend(
        [entries[label] for label in labels],
        labels,
        loc="outside lower center",
        ncols=-(-len(labels) // max(rows, 1)),
        frameon=False,
        fontsize=9,
    )


def save(figure: Figure, file: Path) -> Path:
    """Write a figure."""
    for each in figure.axes:
        for axis in (each.xaxis, each.yaxis):
            # Its default labels are formulas, which are off.
            if isinstance(axis.get_major_formatter(), LogFormatter):
                axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            if isinstance(axis.get_minor_formatter(), LogFormatter):
                low, high = axis.get_view_interval()
                axis.set_minor_formatter(LogFormatter() if high < 10 * low else NullFormatter())
    # Labels contain values from files: text between dollar signs is not a formula. Other figures in
    # the process are the user's.
    for text in figure.findobj(Text):
        text.set_parse_math(False)
    # Tick labels are created while drawing.
    with matplotlib.rc_context({"text.parse_math": False}):
        # As the figure's own layout, it would cause another drawing that nobody sees.
        ConstrainedLayoutEngine().execute(figure)
        write_through(file, lambda buffer: figure.savefig(buffer, format=file.suffix[1:] or "png"))
    # Its pixels are no longer needed; reference cycles would keep them for long.
    FigureCanvasBase(figure)
    gc.collect(1)
    return file
