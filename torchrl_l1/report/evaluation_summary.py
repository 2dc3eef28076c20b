"""The summary of ``torchrl-l1 evaluate`` over training seeds: rows and tables."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from statistics import median
from typing import Any

from torchrl_l1.algorithms.collection import ORACLE
from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.l1_options import UNTUNED, controller_label
from torchrl_l1.experiment.matrix import TUNING, disturbance_words
from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.page import Row, grouped, markdown
from torchrl_l1.report.reading import SWITCH_RATE
from torchrl_l1.report.recovery import (
    FEW_DISTURBANCES,
    controllers,
    recovered_text,
    recovery_columns,
    tested_place,
    varied,
)
from torchrl_l1.report.style import arm_label

Key = tuple[Any, ...]


def summarize(rows: Sequence[Row], episodes: Sequence[Row] = ()) -> list[dict[str, Any]]:
    """Median, lowest and highest mean return over the training seeds, per condition.

    A controller is named by its option and the values that the test has set. The summary has a
    ``stage`` only if the rows have one. Disturbances without a column are neutral. If an oracle was
    also tested, there are the columns of
    :func:`~torchrl_l1.report.recovery.recovery_columns`.

    Args:
        rows: rows of :func:`~torchrl_l1.experiment.evaluate.evaluate`.
        episodes: the rows of their single episodes, from
            :func:`~torchrl_l1.experiment.evaluate.evaluate_episodes`.
    """
    keys = ("stage", "policy", "noise", *DISTURBANCES, "l1")
    groups: dict[Key, list[Row]] = {}
    for row in rows:
        groups.setdefault(_key(row, keys), []).append(row)
    singly: dict[Key, dict[Hashable, list[float]]] = {}
    for row in episodes:
        singly.setdefault(_key(row, keys), {}).setdefault(row["run"], []).append(row["return"])
    summary = []
    for found, members in groups.items():
        returns = [float(row["return_mean"]) for row in members]
        entry = {
            **{k: v for k, v in zip(keys, found, strict=True) if (k, v) != ("stage", None)},
            "training_seeds": len(members),
            "episodes_per_seed": members[0]["episodes"],
            "return_median": median(returns),
            "return_lowest": min(returns),
            "return_highest": max(returns),
        }
        if SWITCH_RATE in members[0]:
            rates = [float(row[SWITCH_RATE]) for row in members]
            entry["switches_per_1000_steps"] = 1000 * median(rates)
        if found[-1] not in UNTUNED:
            which = (BASELINE, found[-1], ORACLE)
            entry |= recovery_columns(*(singly.get((*found[:-1], l1), {}) for l1 in which))
        summary.append(entry)
    return summary


def _key(row: Row, keys: Sequence[str]) -> Key:
    neutral = {name: entry.neutral for name, entry in DISTURBANCES.items()}
    name = controller_label(row["l1"], **{axis: row.get(axis) for axis in TUNING})
    cell = {"stage": None, **neutral, **row, "l1": name}
    return tuple(cell[key] for key in keys)


def summary_tables(summary: Sequence[Row]) -> str:
    """A summary as Markdown, readable in a terminal: a table per stage, policy and noise."""
    blocks = []
    for (stage, policy, noise), _ in grouped(summary, ("stage", "policy", "noise"), "l1"):
        mine = [row for row in summary if tested_place(row) == (stage, policy, noise)]
        seeds = mine[0]["training_seeds"]
        words = ", ".join(filter(None, (stage, f"{policy} policy", f"noise {noise}")))
        table = _aligned(markdown(summary_lines(mine)))
        blocks.append(
            f"{words}: mean return, median [lowest, highest] of {seeds} "
            f"training seed{'s' * (seeds > 1)}{_recovered_words(mine)}\n\n{table}"
        )
    return "\n\n".join(blocks)


def _recovered_words(summary: Sequence[Row]) -> str:
    """The meaning of recovered, if there is any, and over how many policies its interval is."""
    policies = max((int(row.get("recovered_policies") or 0) for row in summary), default=0)
    if not policies:
        return ""
    over = "policies" if policies > 1 else "the episodes of this one policy alone"
    stars = any(float(row.get("gap") or 0.0) < 0 for row in summary)
    words = " (*: the disturbance increases the return; 1 undoes that)" * stars
    return f"; recovered, with its 95 % interval over {over}{words}"


def summary_lines(
    summary: Sequence[Row], keys: Sequence[str] = (), digits: int = 4
) -> list[dict[str, str]]:
    """A line per condition, with the disturbances that are not neutral; a column per L1.

    If more than a few disturbances vary, a single column names that of the line.

    Args:
        summary: rows of :func:`summarize`, or of its table read again.
        keys: further columns that distinguish lines, at the front.
        digits: significant digits of the returns.
    """
    names = varied(summary)
    tested = controllers(summary)
    # Without an oracle there is nothing recovered.
    shown = [l1 for l1 in tested if l1 not in UNTUNED] if ORACLE in tested else []
    neutral = {name: entry.neutral for name, entry in DISTURBANCES.items()}
    lines = []
    for place, found in grouped([{**neutral, **row} for row in summary], (*keys, *names), "l1"):
        line = dict(zip(keys, place, strict=False))
        values = dict(zip(names, map(float, place[len(keys) :]), strict=True))
        if len(names) > FEW_DISTURBANCES:
            line["disturbance"] = disturbance_words(values)
        else:
            line |= {name: f"{value:g}" for name, value in values.items()}
        line |= {arm_label(l1): _with_range(found.get(l1), digits) for l1 in tested}
        line |= {f"{arm_label(l1)} recovered": recovered_text(found.get(l1, {})) for l1 in shown}
        lines.append(line)
    return lines


def _with_range(row: Row | None, digits: int) -> str:
    if row is None:
        return "–"
    middle, *limits = (
        f"{float(row[f'return_{which}']):.{digits}g}" for which in ("median", "lowest", "highest")
    )
    return f"{middle} [{', '.join(limits)}]"


def _aligned(table: str) -> str:
    """A Markdown table whose columns are as wide as their widest cell."""
    rows = [line.strip("|").split("|") for line in table.splitlines()]
    widths = [max(len(cell.strip()) for cell in column) for column in zip(*rows, strict=True)]
    filled = [
        [
            cell.strip().rjust(width, "-" if cell == "---" else " ")
            for cell, width in zip(row, widths, strict=True)
        ]
        for row in rows
    ]
    return "\n".join(f"| {' | '.join(row)} |" for row in filled)
