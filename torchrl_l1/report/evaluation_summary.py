"""What ``torchrl-l1 evaluate`` says of several training seeds: rows and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.l1_options import controller_label
from torchrl_l1.report.page import grouped, markdown
from torchrl_l1.report.style import arm_label

Row = Mapping[str, Any]


def summarize(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Median, lowest and highest mean return over the training seeds, per condition.

    A controller is named by its option and the values that the test has set. Only where rows
    have a ``stage`` has the summary. Disturbances that rows have no column of are neutral.

    Args:
        rows: of :func:`~torchrl_l1.experiment.evaluate.evaluate`.
    """
    neutral = {name: entry.neutral for name, entry in DISTURBANCES.items()}
    keys = ("stage", "policy", "noise", *neutral, "l1")
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        name = controller_label(row["l1"], row.get("epsilon"), row.get("alpha"))
        cell = {"stage": None, **neutral, **row, "l1": name}
        groups.setdefault(tuple(cell[key] for key in keys), []).append(row)
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
        if "l1/switch_rate" in members[0]:
            rates = [float(row["l1/switch_rate"]) for row in members]
            entry["switches_per_1000_steps"] = 1000 * median(rates)
        summary.append(entry)
    return summary


def summary_tables(summary: Sequence[Row]) -> str:
    """A summary as Markdown that reads well in a terminal: a table per stage, policy and noise."""
    blocks = []
    for (stage, policy, noise), _ in grouped(summary, ("stage", "policy", "noise"), "l1"):
        mine = [
            row
            for row in summary
            if (row.get("stage", ""), row["policy"], row["noise"]) == (stage, policy, noise)
        ]
        seeds = mine[0]["training_seeds"]
        words = ", ".join(filter(None, (stage, f"{policy} policy", f"noise {noise}")))
        blocks.append(
            f"{words}: mean return, median [lowest, highest] of {seeds} "
            f"training seed{'s' * (seeds > 1)}\n\n{_aligned(markdown(summary_lines(mine)))}"
        )
    return "\n\n".join(blocks)


def summary_lines(
    summary: Sequence[Row], keys: Sequence[str] = (), digits: int = 4
) -> list[dict[str, str]]:
    """A line per disturbance, with those disturbances that are not neutral; a column per L1.

    Args:
        summary: of :func:`summarize`, or its table read again.
        keys: what else tells lines apart, in front.
        digits: significant ones of the returns.
    """
    disturbed = [
        name
        for name, entry in DISTURBANCES.items()
        if any(float(row.get(name, entry.neutral)) != entry.neutral for row in summary)
    ]
    controllers = dict.fromkeys(row["l1"] for row in summary)
    lines = []
    for place, found in grouped(summary, (*keys, *disturbed), "l1"):
        words = place[: len(keys)], (f"{float(value):g}" for value in place[len(keys) :])
        line = dict(zip((*keys, *disturbed), (*words[0], *words[1]), strict=True))
        line |= {arm_label(l1): _with_range(found.get(l1), digits) for l1 in controllers}
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
