"""Rows of values as the Markdown tables that a reader sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchrl_l1.report.settings import BASELINE
from torchrl_l1.report.tables import (
    Footnotes,
    grouped,
    interval_of,
    less_off,
    markdown,
    number,
    paper_text,
    spread_text,
    with_interval,
    with_notes,
)

Row = Mapping[str, Any]


def training_table(rows: Sequence[Row]) -> str:
    """The paper's Table 1, ours beside it, with footnotes to its cells."""
    notes = Footnotes()
    lines = [
        {
            "task": row["task"],
            "noise": row["noise"],
            "L1": row["l1"],
            "variant": row["variant"],
            "return ± spread": spread_text(row.get("return_mean"), row.get("published_spread")),
            "95 % interval": interval_of(row, "return"),
            "with the mean action": number(row.get("deterministic_mean")),
            "95 % interval of it": interval_of(row, "deterministic"),
            "seeds": str(row["seeds"]),
            "real steps": str(row.get("real_steps", "–")),
            "switches per 1000 steps": number(row.get("switches_per_1000")),
            "L1 input": number(row.get("u_a")),
            "saturation": number(row.get("saturation")),
            "paper": paper_text(row, notes),
            "authors' logs": spread_text(row.get("authors_mean"), row.get("authors_spread")),
            "unfinished": row["unfinished"],
        }
        for row in rows
    ]
    return with_notes(markdown(lines), notes)


def paired_table(rows: Sequence[Row]) -> str:
    """Differences to the baseline of the same seed."""
    lines = [
        {
            "task": row["task"],
            "noise": row["noise"],
            "L1": row["l1"],
            "variant": row["variant"],
            "policy": row.get("policy", ""),
            "pairs": str(row["pairs"]),
            **_difference(row),
            "seeds without a pair": row["without_pair"],
        }
        for row in rows
    ]
    return markdown(lines)


def stage_table(rows: Sequence[Row]) -> str:
    """The return at the end of each stage, a column per L1 setting."""
    arms = list(dict.fromkeys(row["l1"] for row in rows))
    lines = []
    keys = ("task", "noise", "variant", "stage", "policy")
    for cell, found in grouped(rows, keys, "l1"):
        on = [arm for arm in arms if arm != BASELINE]
        line = dict(zip(keys, cell, strict=True))
        line |= {
            "real steps": ", ".join(dict.fromkeys(str(row["real_steps"]) for row in found.values()))
        }
        line |= {f"L1 {arm}": with_interval(found.get(arm)) for arm in arms}
        line |= {f"L1 {arm} less off": less_off(found.get(arm, {})) for arm in on}
        line["seeds"] = ", ".join(dict.fromkeys(str(row["seeds"]) for row in found.values()))
        line["switches per 1000 steps"] = ", ".join(
            number(found[arm]["switches_per_1000"])
            for arm in on
            if "switches_per_1000" in found.get(arm, {})
        )
        lines.append(line)
    return markdown(lines)


def algorithm_table(rows: Sequence[Row]) -> str:
    """The algorithms with each L1 setting, task by task."""
    lines = [
        {
            "task": row["task"],
            "noise": row["noise"],
            "algorithm": row["algorithm"],
            "L1": row["l1"],
            "return ± spread": spread_text(row.get("return_mean"), row.get("published_spread")),
            "95 % interval": interval_of(row, "return"),
            "seeds": str(row["seeds"]),
            "real steps": str(row.get("real_steps", "–")),
            "unfinished": row["unfinished"],
        }
        for row in rows
    ]
    return markdown(lines)


def algorithm_pairs_table(rows: Sequence[Row]) -> str:
    """Differences between algorithms."""
    lines = [
        {
            "task": row["task"],
            "noise": row["noise"],
            "difference": f"{row['of']} less {row['less']}",
            "pairs": str(row["pairs"]),
            **_difference(row),
            "seeds without a pair": row["without_pair"],
        }
        for row in rows
    ]
    return markdown(lines)


def _difference(row: Row) -> dict[str, str]:
    values = str(row.get("differences", "")).split()
    few = row.get("difference_low") is None
    return {
        "mean difference": "–" if few else number(row["difference_mean"]),
        "95 % interval": interval_of(row, "difference"),
        "interquartile mean": number(row.get("iqm")),
        "95 % interval of it": interval_of(row, "iqm"),
        "differences": ", ".join(number(float(value)) for value in values) if few else "",
    }
