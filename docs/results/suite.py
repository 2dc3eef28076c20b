"""The suite of disturbances on frozen policies: off, the paper's, the robust one, the oracle.

    python docs/results/suite.py [FOLDER]

Reads the episodes that `torchrl-l1 evaluate --suite quick` (or `full`) wrote into
FOLDER/TASK/seed_N, if a FOLDER is given, and keeps their returns in `suite/TASK.csv` beside this
file, in place of those of the same policy and controller. Writes from those `suite/TASK.md`, one
row per disturbance, `suite/TASK_values.md`, one row per value of it, and `suite/verdicts.md` and
`.png`, disturbances by tasks.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import TwoSlopeNorm

from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.page import markdown
from torchrl_l1.report.statistics import Recovery, recovered

HERE = Path(__file__).with_name("suite")
TASKS = ("inverted_pendulum", "swimmer", "hopper", "walker", "half_cheetah")
CONTROLLERS = ("paper", "robust", "oracle")
NONE = ("none", 0.0)
Cell = tuple[str, float]
# Returns of the episodes, by policy, controller and (disturbance, value).
Returns = dict[tuple[str, str, Cell], np.ndarray]

# A change is worth speaking of from here, as a share of the undisturbed return or of the loss,
# whichever is larger.
LEAST = 0.02
CANCELLED = 0.7
# A pole that returns more than this stands still: what is left are thousandths of a radian.
STANDING = 0.005


def cell_of(row: dict[str, str]) -> Cell:
    """The disturbance of an episode, and its value."""
    found = [
        (name, float(row[name]))
        for name, entry in DISTURBANCES.items()
        if name in row and float(row[name]) != entry.neutral
    ]
    return found[0] if found else NONE


def gather(folder: Path, task: str) -> None:
    """Keep the returns of all policies and controllers of a task in one file."""
    rows: dict[tuple[str, str, str, float], list[str]] = {}
    for file in sorted(folder.glob(f"{task}/seed_*/episodes.csv")):
        with file.open(newline="") as handle:
            for row in csv.DictReader(handle):
                key = (file.parts[-2], row["l1"], *cell_of(row))
                rows.setdefault(key, []).append(f"{float(row['return']):.6g}")
    if not rows:
        return
    HERE.mkdir(exist_ok=True)
    kept, new = HERE / f"{task}.csv", {key[:2] for key in rows}
    names = ("run", "l1", "disturbance", "value", "returns")
    if kept.exists():
        with kept.open(newline="") as handle:
            for old in csv.DictReader(handle):
                if (old["run"], old["l1"]) not in new:
                    key = (old["run"], old["l1"], old["disturbance"], float(old["value"]))
                    rows[key] = old["returns"].split()
    lines = [dict(zip(names, (*key, " ".join(rows[key])), strict=True)) for key in sorted(rows)]
    write_table(kept, lines)


def read(task: str) -> Returns:
    """The returns that are kept of a task."""
    with (HERE / f"{task}.csv").open(newline="") as handle:
        return {
            (row["run"], row["l1"], (row["disturbance"], float(row["value"]))): np.array(
                row["returns"].split(), dtype=np.float64
            )
            for row in csv.DictReader(handle)
        }


def together(returns: Returns, l1: str, cells: Sequence[Cell]) -> list[np.ndarray]:
    """Returns of each policy in several cells, one after the other."""
    runs = sorted({key[0] for key in returns})
    return [np.concatenate([returns[run, l1, cell] for cell in cells]) for run in runs]


def regained(returns: Returns, l1: str, cells: Sequence[Cell]) -> Recovery:
    """What a controller gives back of what the disturbance takes."""
    return recovered(
        together(returns, "off", cells),
        together(returns, l1, cells),
        together(returns, "off", [NONE] * len(cells)),
    )


def change(returns: Returns, l1: str, cells: Sequence[Cell]) -> tuple[float, float, float]:
    """Return less that without L1, as a share of its scale, with its 95 % interval."""
    on, off = (together(returns, one, cells) for one in (l1, "off"))
    zero = [np.zeros_like(one) for one in off]
    found = recovered(zero, zero, [a - b for a, b in zip(on, off, strict=True)])
    size, interval = scale(returns, cells), found.gap_interval
    return found.gap / size, interval.low / size, interval.high / size


def scale(returns: Returns, cells: Sequence[Cell]) -> float:
    """Magnitude of the undisturbed return without L1, or of the loss if that is larger."""
    undisturbed = np.concatenate(together(returns, "off", [NONE])).mean()
    disturbed = np.concatenate(together(returns, "off", cells)).mean()
    return max(float(abs(undisturbed)), float(abs(undisturbed - disturbed)), STANDING)


def verdict(returns: Returns, l1: str, cells: Sequence[Cell]) -> str:
    """What the controller does about a disturbance, in a word or two."""
    mean, low, high = change(returns, l1, cells)
    if high < 0 and mean < -LEAST:
        return "worse"
    if not (low > 0 and mean > LEAST):
        return "not touched"
    back = regained(returns, l1, cells)
    whole = back.share is not None and back.gap > 0 and back.share >= CANCELLED
    return "cancelled" if whole else "helped"


def table(returns: Returns, groups: Iterable[tuple[str, Sequence[Cell]]]) -> str:
    """One line for each group of cells."""
    lines = []
    for words, cells in groups:
        off = float(np.mean(np.concatenate(together(returns, "off", cells))))
        line: dict[str, Any] = {"disturbance": words, "off": f"{off:.4g}"}
        for l1 in CONTROLLERS:
            on = float(np.mean(np.concatenate(together(returns, l1, cells))))
            line[l1] = f"{on:.4g}"
        loss = regained(returns, "off", cells)
        line["loss"] = f"{loss.gap:.4g}" if cells[0] != NONE else ""
        for l1 in CONTROLLERS:
            back = regained(returns, l1, cells) if cells[0] != NONE else None
            shown = (
                back is not None
                and back.share is not None
                and back.gap > LEAST * scale(returns, cells)
            )
            line[f"{l1} gives back"] = _share(back) if shown and back is not None else ""
        for l1 in ("paper", "robust"):
            line[f"{l1}:"] = verdict(returns, l1, cells)
        lines.append(line)
    return markdown(lines)


def _share(found: Recovery) -> str:
    assert found.share is not None and found.interval is not None
    return f"{found.share:.2f} [{found.interval.low:.2f}, {found.interval.high:.2f}]"


def groups_of(returns: Returns) -> dict[str, list[Cell]]:
    """The cells that were tested of each disturbance, in the order of the registry."""
    tested = {key[2] for key in returns}
    groups = {name: sorted(cell for cell in tested if cell[0] == name) for name in DISTURBANCES}
    return {name: cells for name, cells in groups.items() if cells}


def plot(of: dict[str, Returns], file: Path) -> None:
    """Changes of the return by the two controllers: disturbances by tasks."""
    names = [name for name in DISTURBANCES if any(name in groups_of(one) for one in of.values())]
    figure, axes = plt.subplots(1, 2, figsize=(9, 6.5), sharey=True, layout="constrained")
    for l1, ax in zip(("paper", "robust"), axes, strict=True):
        shares = np.full((len(names), len(of)), np.nan)
        for column, returns in enumerate(of.values()):
            for name, cells in groups_of(returns).items():
                row = names.index(name)
                shares[row, column] = change(returns, l1, cells)[0]
                word = verdict(returns, l1, cells)
                mark = {"cancelled": "●", "helped": "+", "worse": "–"}.get(word, "")
                color = "white" if abs(shares[row, column]) > 0.3 else "black"
                ax.text(column, row, mark, ha="center", va="center", color=color, weight="bold")
        norm = TwoSlopeNorm(0, -0.5, 0.5)
        image = ax.imshow(np.clip(shares, -0.5, 0.5), cmap="RdBu", norm=norm, aspect="auto")
        ax.set_title(f"L1 {l1}")
        tasks = [task.replace("_", " ") for task in of]
        ax.set_xticks(range(len(of)), tasks, rotation=30, ha="right")
        ax.set_yticks(range(len(names)), [DISTURBANCES[name].words for name in names])
    figure.suptitle("● cancelled   + helped   – worse")
    figure.colorbar(
        image,
        ax=axes,
        label="change of the return, as a share of the undisturbed one or of the loss",
        shrink=0.7,
    )
    figure.savefig(file, dpi=110)
    plt.close(figure)


def main() -> None:
    """Read what is new, then write all tables and the figure."""
    of: dict[str, Returns] = {}
    for task in TASKS:
        if len(sys.argv) > 1:
            gather(Path(sys.argv[1]), task)
        if (HERE / f"{task}.csv").exists():
            of[task] = read(task)
    words = {
        name: {"disturbance": entry.words, "matched": "yes" if entry.matched else ""}
        for name, entry in DISTURBANCES.items()
        if any(name in groups_of(returns) for returns in of.values())
    }
    for task, returns in of.items():
        groups = groups_of(returns)
        kinds = [(DISTURBANCES[name].words, cells) for name, cells in groups.items()]
        every = [(f"{DISTURBANCES[c[0]].words} {c[1]:g}", [c]) for g in groups.values() for c in g]
        none: list[tuple[str, list[Cell]]] = [("none", [NONE])]
        (HERE / f"{task}.md").write_text(table(returns, none + kinds) + "\n")
        (HERE / f"{task}_values.md").write_text(table(returns, none + every) + "\n")
        policies = len({key[0] for key in returns})
        column = f"{task.replace('_', ' ')} ({policies})"
        for name, line in words.items():
            cells = groups.get(name)  # none where it cannot act
            verdicts = [verdict(returns, l1, cells) for l1 in ("paper", "robust") if cells]
            line[column] = " / ".join(verdicts) or "–"
    (HERE / "verdicts.md").write_text(markdown(list(words.values())) + "\n")
    plot(of, HERE / "verdicts.png")
    print(f"Tables and figure: {HERE}")


if __name__ == "__main__":
    main()
