"""Rows of values as the Markdown tables that a reader sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchrl_l1.report.evaluation_tables import PHASES
from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.page import Footnotes, interval_text, markdown, number

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
            "return ± spread": _spread(row.get("return_mean"), row.get("published_spread")),
            "95 % interval": _interval(row, "return"),
            "with the mean action": number(row.get("deterministic_mean")),
            "95 % interval of it": _interval(row, "deterministic"),
            "seeds": str(row["seeds"]),
            "real steps": str(row.get("real_steps", "–")),
            "switches per 1000 steps": number(row.get("switches_per_1000")),
            "L1 input": number(row.get("u_a")),
            "saturation": number(row.get("saturation")),
            "paper": _paper(row, notes),
            "authors' logs": _spread(row.get("authors_mean"), row.get("authors_spread")),
            "unfinished": row["unfinished"],
        }
        for row in rows
    ]
    return _with_notes(markdown(lines), notes)


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
    for cell, found in _grouped(rows, keys, "l1"):
        on = [arm for arm in arms if arm != BASELINE]
        line = dict(zip(keys, cell, strict=True))
        line |= {
            "real steps": ", ".join(dict.fromkeys(str(row["real_steps"]) for row in found.values()))
        }
        line |= {f"L1 {arm}": _with_interval(found.get(arm)) for arm in arms}
        line |= {f"L1 {arm} less off": _less_off(found.get(arm, {})) for arm in on}
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
            "return ± spread": _spread(row.get("return_mean"), row.get("published_spread")),
            "95 % interval": _interval(row, "return"),
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


def evaluation_table(rows: Sequence[Row]) -> str:
    """Frozen policies under other conditions than they were trained in, a column per L1.

    Args:
        rows: of one kind of policy and one L1 setting of the training.
    """
    notes = Footnotes()
    tested = list(dict.fromkeys(row["l1"] for row in rows))
    keys = ("task", "training_noise", "variant", "stage", "noise", "bias", "gain")
    lines = []
    for cell, found in _grouped(rows, keys, "l1"):
        task, training_noise, variant, stage, noise, bias, gain = cell
        first = next(iter(found.values()))
        line = {
            "task": task,
            "training noise": "" if training_noise == "none" else training_noise,
            "variant": variant,
            "stage": stage,
            "noise": noise,
            "bias": "" if bias == 0 else f"{bias:g}",
            "gain": "" if gain == 1 else f"{gain:g}",
            "training seeds": str(first["training_seeds"]),
        }
        line |= {f"L1 {l1}": _with_interval(found.get(l1)) for l1 in tested}
        line |= {
            f"L1 {l1} less off": _less_off(found.get(l1, {})) for l1 in tested if l1 != BASELINE
        }
        line |= {f"paper, L1 {l1}": _paper(found.get(l1, {}), notes) for l1 in tested}
        lines.append(line)
    return _with_notes(markdown(lines), notes)


def tuning_table(rows: Sequence[Row]) -> str:
    """The same where tests set values of the controller: a line per controller.

    Args:
        rows: of one kind of policy and one L1 setting of the training.
    """
    lines = [
        {
            "task": row["task"],
            "training noise": "" if row["training_noise"] == "none" else row["training_noise"],
            "variant": row["variant"],
            "stage": row.get("stage", ""),
            "noise": row["noise"],
            "bias": "" if row["bias"] == 0 else f"{row['bias']:g}",
            "gain": "" if row["gain"] == 1 else f"{row['gain']:g}",
            "L1": row.get("option", row["l1"]),
            "epsilon": number(row.get("epsilon")),
            "alpha": number(row.get("alpha")),
            "training seeds": str(row["training_seeds"]),
            "return": _with_interval(row),
            "less off": _less_off(row),
            "switches per 1000 steps": number(row.get("switches_per_1000_steps")),
        }
        for row in rows
    ]
    return markdown(lines)


def ablation_table(rows: Sequence[Row]) -> str:
    """L1 in neither phase, in one or in both, side by side.

    Args:
        rows: of one kind of policy and one kind of L1.
    """
    notes = Footnotes()
    lines = []
    keys = ("task", "noise", "variant", "stage")
    for cell, found in _grouped(rows, keys, "phase"):
        line = dict(zip(keys, cell, strict=True))
        line |= {phase: _with_interval(found.get(phase)) for phase in PHASES}
        line["training seeds"] = ", ".join(
            sorted({str(row["training_seeds"]) for row in found.values()})
        )
        line |= {f"paper, {phase}": _paper(found.get(phase, {}), notes) for phase in PHASES}
        lines.append(line)
    return _with_notes(markdown(lines), notes)


def _grouped(
    rows: Sequence[Row], keys: Sequence[str], inner: str
) -> list[tuple[tuple[Any, ...], dict[str, Row]]]:
    groups: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row.get(key, "") for key in keys), {})[row[inner]] = row
    return list(groups.items())


def _with_interval(row: Row | None) -> str:
    if row is None:
        return "–"
    seeds = row["seeds"] if "seeds" in row else row["training_seeds"]
    spread = _spread(row["return_mean"], row["std"] if seeds > 1 else None)
    return f"{spread} {_interval(row, 'return')}".removesuffix(" –")


def _less_off(row: Row) -> str:
    values = str(row.get("differences", "")).split()
    if row.get("difference_low") is None:
        return ", ".join(number(float(value)) for value in values) or "–"
    return f"{number(row['difference_mean'])} {_interval(row, 'difference')}"


def _difference(row: Row) -> dict[str, str]:
    values = str(row.get("differences", "")).split()
    few = row.get("difference_low") is None
    return {
        "mean difference": "–" if few else number(row["difference_mean"]),
        "95 % interval": _interval(row, "difference"),
        "interquartile mean": number(row.get("iqm")),
        "95 % interval of it": _interval(row, "iqm"),
        "differences": ", ".join(number(float(value)) for value in values) if few else "",
    }


def _interval(row: Row, name: str) -> str:
    return interval_text(row.get(f"{name}_low"), row.get(f"{name}_high"))


def _spread(mean: float | None, spread: float | None) -> str:
    return number(mean) if spread is None else f"{number(mean)} ± {number(spread)}"


def _paper(row: Row, notes: Footnotes) -> str:
    if row.get("paper_mean") is None:
        return "–"
    return f"{row['paper_mean']} ± {row['paper_std']}{notes.mark(row['paper_erratum'])}"


def _with_notes(table: str, notes: Footnotes) -> str:
    return f"{table}\n\n{notes.text()}".rstrip()
