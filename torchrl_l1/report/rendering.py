"""Rows of evaluations as the Markdown tables that a reader sees."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl_l1.report.evaluation_tables import PHASES
from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.page import (
    Footnotes,
    Row,
    difference_text,
    grouped,
    markdown,
    number,
    paper_text,
    return_text,
)


def evaluation_table(rows: Sequence[Row]) -> str:
    """Frozen policies under other conditions than they were trained in, a column per L1.

    Args:
        rows: of one kind of policy and one L1 setting of the training.
    """
    notes = Footnotes()
    tested = list(dict.fromkeys(row["l1"] for row in rows))
    keys = ("task", "training_noise", "variant", "stage", "noise", "bias", "gain")
    lines = []
    for cell, found in grouped(rows, keys, "l1"):
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
        line |= {f"L1 {l1}": return_text(found.get(l1)) for l1 in tested}
        line |= {
            f"L1 {l1} less off": difference_text(found.get(l1, {}))
            for l1 in tested
            if l1 != BASELINE
        }
        line |= {f"paper, L1 {l1}": paper_text(found.get(l1, {}), notes) for l1 in tested}
        lines.append(line)
    return notes.below(markdown(lines))


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
            "return": return_text(row),
            "less off": difference_text(row),
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
    for cell, found in grouped(rows, keys, "phase"):
        line = dict(zip(keys, cell, strict=True))
        line |= {phase: return_text(found.get(phase)) for phase in PHASES}
        line["training seeds"] = ", ".join(
            sorted({str(row["training_seeds"]) for row in found.values()})
        )
        line |= {f"paper, {phase}": paper_text(found.get(phase, {}), notes) for phase in PHASES}
        lines.append(line)
    return notes.below(markdown(lines))
