"""The share of an oracle's gain that controllers recover: columns, tables and heat maps."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, SymLogNorm, TwoSlopeNorm

from torchrl_l1.algorithms.collection import ORACLE
from torchrl_l1.algorithms.facts import AlgorithmFacts
from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.l1_options import UNTUNED
from torchrl_l1.experiment.matrix import disturbance_words, disturbed
from torchrl_l1.report.page import (
    Page,
    Row,
    grouped,
    interval_text,
    markdown,
    number,
    spread_text,
    values_text,
)
from torchrl_l1.report.statistics import Interval, recovered
from torchrl_l1.report.study import noise_order
from torchrl_l1.report.style import (
    arm_label,
    grid,
    named,
    noise_words,
    reaches_far_below,
    save,
    title,
)

FEW_DISTURBANCES = 2
"""Up to so many varying disturbances have their own columns; beyond, one column names them."""

# The pixels of a figure per side are limited, and so is patience.
_LINE_INCHES, _CELL_INCHES = 0.24, 1.05


def recovery_columns(
    off: Mapping[Hashable, Sequence[float]],
    on: Mapping[Hashable, Sequence[float]],
    oracle: Mapping[Hashable, Sequence[float]],
) -> dict[str, Any]:
    """Columns of :func:`~torchrl_l1.report.statistics.recovered`; none if nothing can be paired.

    ``gap`` is the oracle's mean return less that without L1, and ``recovered`` the share of it
    that the controller recovers, each with ``_low`` and ``_high``; there is no ``recovered``
    if the interval of the gap includes 0. ``recovered_policies`` counts the policies.

    Args:
        off: returns of the episodes of each policy without L1.
        on: the same with the controller.
        oracle: the same with the oracle.
    """
    shared = [
        policy
        for policy, returns in off.items()
        if len(returns) == len(on.get(policy, ())) == len(oracle.get(policy, ())) > 0
    ]
    if not shared:
        return {}
    found = recovered(
        *([np.asarray(one[policy]) for policy in shared] for one in (off, on, oracle))
    )
    columns: dict[str, Any] = {
        "gap": found.gap,
        "gap_low": found.gap_interval.low,
        "gap_high": found.gap_interval.high,
        "recovered_policies": found.policies,
    }
    if found.share is not None and found.interval is not None:
        low, high = found.interval.low, found.interval.high
        columns |= {"recovered": found.share, "recovered_low": low, "recovered_high": high}
    return columns


def recovered_text(row: Row) -> str:
    """The share with its interval, or a dash; starred if the disturbance increases the return.

    Examples:
        >>> recovered_text({"recovered": 0.8234, "recovered_low": 0.7, "recovered_high": 0.95})
        '0.82 [0.70, 0.95]'
        >>> recovered_text({"recovered": 1.1, "recovered_low": 1, "recovered_high": 2, "gap": -3.0})
        '1.10* [1.00, 2.00]'
        >>> recovered_text({"gap": 0.1})
        '–'
    """
    if row.get("recovered") in (None, ""):  # empty in tables read again
        return "–"
    interval = Interval(*(float(row[f"recovered_{side}"]) for side in ("low", "high")))
    return f"{float(row['recovered']):.2f}{_star(row)} {interval:.2f}"


def _star(row: Row) -> str:
    """Marks a share of what the disturbance adds to the return, rather than of what it takes."""
    return "*" * (float(row.get("gap") or 0.0) < 0)


def is_about_robustness(rows: Sequence[Row]) -> bool:
    """Whether tests include an oracle or more than a few disturbances."""
    return any(row["l1"] == ORACLE for row in rows) or len(varied(rows)) > FEW_DISTURBANCES


def varied(rows: Sequence[Row]) -> list[str]:
    """Names of the disturbances that are not neutral in at least one row."""
    found = {name for row in rows for name in disturbed(row)}
    return [name for name in DISTURBANCES if name in found]


def disturbance_cells(row: Row, names: Sequence[str]) -> dict[str, str]:
    """A row's disturbances as cells of a table; neutral ones are left empty.

    Args:
        row: row of the table.
        names: names of the disturbances that vary in the table.

    Examples:
        >>> disturbance_cells({"bias": 0.5, "gain": 1.0}, ["bias", "gain"])
        {'bias': '0.5', 'gain': ''}
        >>> disturbance_cells({"bias": 0.5, "gain": 1.0}, ["bias", "gain", "lag"])
        {'disturbance': 'bias 0.5'}
    """
    found = disturbed(row)
    if len(names) > FEW_DISTURBANCES:
        return {"disturbance": disturbance_words(row) if found else ""}
    return {name: f"{found[name]:g}" if name in found else "" for name in names}


def by_disturbance(row: Row) -> tuple[Any, ...]:
    """Sort key: undisturbed first, then by disturbance and by value."""
    found = disturbed(row)
    order = list(DISTURBANCES)
    return len(found), [(order.index(name), value) for name, value in found.items()]


def controllers(rows: Sequence[Row]) -> list[str]:
    """The controllers of some tests in order, the oracle last."""
    return sorted(dict.fromkeys(row["l1"] for row in rows), key=lambda l1: l1 == ORACLE)


def robustness_table(rows: Sequence[Row]) -> str:
    """A line per disturbance: the return of each controller, and the share that it recovers.

    If episodes differ in length, their mean number of steps follows the return.

    Args:
        rows: rows of :func:`~torchrl_l1.report.evaluations.evaluation_rows`, of one cell and stage
            of the training, one kind of policy and one noise.
    """
    lengths = {row["steps_mean"] for row in rows if row.get("steps_mean") is not None}
    tested = controllers(rows)
    lines = []
    for _, found in grouped(sorted(rows, key=by_disturbance), tuple(DISTURBANCES), "l1"):
        first = next(iter(found.values()))
        line = {"disturbance": disturbance_words(first), "training seeds": training_seeds(found)}
        line |= {arm_label(l1): _return_text(found.get(l1), len(lengths) > 1) for l1 in tested}
        line["oracle less off"] = "–"
        gaps = [row for row in found.values() if "gap" in row]
        if gaps:
            gap = max(gaps, key=lambda row: row["recovered_policies"])
            line["oracle less off"] = f"{number(gap['gap'])} {interval_text(gap, 'gap')}"
        line |= {
            f"{arm_label(l1)} recovered": recovered_text(found.get(l1, {}))
            for l1 in tested
            if l1 not in UNTUNED
        }
        lines.append(line)
    return markdown(lines)


def training_seeds(tests: Mapping[str, Row]) -> str:
    """Number of training seeds that the controllers were tested with; of each if they differ."""
    return values_text({arm_label(l1): str(row["training_seeds"]) for l1, row in tests.items()})


def _return_text(row: Row | None, with_steps: bool) -> str:
    if row is None:
        return "–"
    text = spread_text(row["return_mean"], row["std"] if row["training_seeds"] > 1 else None)
    steps = row.get("steps_mean")
    return f"{text}, {steps:.0f} steps" if with_steps and steps is not None else text


def training_cells(rows: Sequence[Row]) -> Iterator[tuple[str, tuple[str, ...], list[Row]]]:
    """The rows of each cell and stage of the training, with a heading and words for file names."""

    def place(row: Row) -> tuple[str, ...]:
        keys = ("task", "training_noise", "training_l1", "variant")
        return (*(row[key] for key in keys), str(row.get("stage", "")))

    for cell in dict.fromkeys(map(place, rows)):
        task, noise, l1, variant, _ = cell
        heading = f"{title(task)}: trained with {noise_words(noise)} and {arm_label(l1)}"
        heading += f" ({variant})" * bool(variant)
        yield heading, cell, [row for row in rows if place(row) == cell]


@dataclass(frozen=True)
class HeatMap:
    """What a heat map shows.

    Attributes:
        column: column of the rows.
        words: text below the heading.
        colors: name of a colour map.
        text: text of a row's cell.
        scale: colour scale for all finite values.
        without: controllers without a column.
        colored: whether a row's cell has a colour besides its number.
    """

    column: str
    words: str
    colors: str
    text: Callable[[Row], str]
    scale: Callable[[np.ndarray], Normalize]
    without: tuple[str, ...] = ()
    colored: Callable[[Row], bool] = lambda row: True


def _share_scale(values: np.ndarray) -> Normalize:
    # Beyond these limits the number in the cell shows it.
    return TwoSlopeNorm(0.0, -1.0, 1.0)


def _return_scale(values: np.ndarray) -> Normalize:
    low, high = float(values.min()), float(values.max())
    if reaches_far_below(values, below=-1.0):
        return SymLogNorm(0.1, vmin=low, vmax=high)
    return Normalize(low, high)


SHARES = HeatMap(
    "recovered",
    "recovered: 1 as the oracle, 0 as L1 off; empty: these two do not differ\n"
    "*: the disturbance increases the return; 1 undoes that",
    "RdBu",
    lambda row: f"{float(row['recovered']):.2f}{_star(row)}",
    _share_scale,
    UNTUNED,
    lambda row: not _star(row),
)
"""The shares that controllers recover; empty where oracle and L1 off do not differ."""

RETURNS = HeatMap(
    "return_mean", "mean return", "viridis", lambda row: number(row["return_mean"]), _return_scale
)
"""Means over training seeds."""

MEDIANS = HeatMap(
    "return_median",
    "median return",
    "viridis",
    lambda row: number(row["return_median"]),
    _return_scale,
)
"""Medians over training seeds."""


def plot_heat_map(
    rows: Sequence[Row], shown: HeatMap, heading: str, file: Path, algorithm: AlgorithmFacts
) -> Path | None:
    """Controllers across, disturbances down, a number in each cell; missing ones are grey.

    There is a panel for each stage, kind of policy and noise.

    Args:
        rows: rows of one cell of the training.
        shown: what the cells show.
        heading: title of the figure.
        file: the file to write.
        algorithm: the algorithm of the policies.

    Returns:
        the file, or ``None`` if there is no value to show.
    """
    mine = [row for row in rows if row["l1"] not in shown.without]
    known = [row for row in mine if row.get(shown.column) is not None]
    if not known:
        return None
    scale = shown.scale(np.array([float(row[shown.column]) for row in known]))
    tested = controllers(mine)
    lines = list(dict.fromkeys(map(disturbance_words, sorted(mine, key=by_disturbance))))
    places = sorted(
        dict.fromkeys(map(tested_place, known)), key=lambda place: noise_order(place[2])
    )
    labels = 0.075 * max(map(len, lines))
    figure, axes = grid(
        len(places),
        columns=len(places),
        width=labels + _CELL_INCHES * len(tested) + 0.3,
        height=_LINE_INCHES * len(lines) + 1.7,
    )
    for axis, (stage, policy, noise) in zip(axes, places, strict=True):
        cells = {
            (lines.index(disturbance_words(row)), tested.index(row["l1"])): row
            for row in known
            if tested_place(row) == (stage, policy, noise)
        }
        _draw(axis, cells, (len(lines), len(tested)), shown, scale)
        axis.set_xticks(range(len(tested)), [arm_label(l1).replace(" ", "\n") for l1 in tested])
        axis.set_yticks(range(len(lines)), lines)
        axis.set_title(panel_title(algorithm.acting(policy, stage), noise), fontsize=10)
    figure.suptitle(f"{heading}\n{shown.words}", fontsize=10)
    return save(figure, file)


def _draw(
    axis: Axes,
    cells: Mapping[tuple[int, int], Row],
    shape: tuple[int, int],
    shown: HeatMap,
    scale: Normalize,
) -> None:
    values = np.ma.masked_all(shape)
    for place, row in cells.items():
        if shown.colored(row):
            values[place] = float(row[shown.column])
    image = axis.imshow(values, cmap=shown.colors, norm=scale, aspect="auto")
    for (line, column), row in cells.items():
        red, green, blue, _ = image.cmap(float(np.clip(scale(float(row[shown.column])), 0.0, 1.0)))
        dark = shown.colored(row) and 0.299 * red + 0.587 * green + 0.114 * blue < 0.5
        axis.text(
            column, line, shown.text(row), ha="center", va="center", fontsize=8,
            color="white" if dark else "black",
        )  # fmt: skip
    axis.set_facecolor("0.9")
    axis.xaxis.tick_top()
    axis.tick_params(length=0, labelsize=8)
    axis.set_xticks(np.arange(0.5, shape[1] - 1), minor=True)
    axis.set_yticks(np.arange(0.5, shape[0] - 1), minor=True)
    axis.grid(which="minor", color="white", linewidth=1.5)
    axis.tick_params(which="minor", length=0)


def tested_place(row: Row) -> tuple[str, str, str]:
    """Stage, kind of policy and noise of a test, each with its own panels and tables."""
    return row.get("stage", ""), row["policy"], row["noise"]


def panel_title(actions: str, noise: str) -> str:
    """How a policy acts and under which noise, if either is worth naming.

    Examples:
        >>> panel_title("sampled actions", "action"), panel_title("sampled actions", "none")
        ('sampled actions, noise: action', 'sampled actions')
    """
    return ", ".join(filter(None, (actions, f"noise: {noise}" * (noise != "none"))))


def recovery_section(page: Page, algorithm: AlgorithmFacts, name: str, rows: Sequence[Row]) -> None:
    """Tables and heat maps: the returns, and the share of the oracle's gain that is recovered."""
    if any(row["l1"] == ORACLE for row in rows):
        page.text(
            "The oracle sends the policy's action less the matched disturbance, clipped: no "
            "controller can cancel more. *Recovered* is (L1 − off) / (oracle − off) with Fieller's "
            "95 % interval over policies. It is empty where the oracle and L1 off do not differ "
            "significantly, as for disturbances that no input can cancel, and nearly always with "
            "two or three policies. A star marks disturbances that increase the return: 1 undoes "
            "that."
        )
    if any(row.get("recovered_policies") == 1 for row in rows):
        page.text(
            "With one training seed, the interval is a bootstrap over its episodes alone and says "
            "nothing about other trainings."
        )
    for heading, words, chosen in training_cells(rows):
        stage = words[-1]
        heading += f", stage {stage}" * bool(stage)
        for policy, noise in dict.fromkeys((row["policy"], row["noise"]) for row in chosen):
            mine = [row for row in chosen if (row["policy"], row["noise"]) == (policy, noise)]
            acting = panel_title(algorithm.actions(policy, stage), noise)
            page.text(f"{', '.join(filter(None, (heading, acting)))}:", robustness_table(mine))
        for shown, what in ((RETURNS, "returns"), (SHARES, "recovered")):
            file = page.file(what, name, *words)
            drawn = plot_heat_map(chosen, shown, named(page.name, heading), file, algorithm)
            page.figure(drawn, f"{heading}: {what}")
