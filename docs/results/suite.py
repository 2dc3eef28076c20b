"""The suite of disturbances on frozen policies: off, the paper's, the robust one, the oracle.

    python docs/results/suite.py [FOLDER]
    python docs/results/suite.py earlier FOLDER

Reads the episodes that `torchrl-l1 evaluate --suite full` wrote into FOLDER/TASK/seed_N, if a
FOLDER is given, and keeps their returns in `suite/TASK.csv` beside this file, in place of those of
the same policy and controller; with `earlier` those of the robust controller alone, as its
earlier version. Writes from those `suite/TASK.md`, one row per disturbance,
`suite/TASK_values.md`, one row per value of it, `suite/verdicts.md` and `.png`, disturbances by
tasks, and `suite/changed.md`, where the robust controller's verdicts differ from the earlier ones.

Intervals are Student's t and Fieller's, over policies if there are three or more, else over resets.
The change of the return, as a share of the undisturbed one or of the loss if that is larger,
decides: *worse* and *helped* are changes of more than 2 % whose 95 % interval excludes 0, and
*cancelled* is a help that gives back 70 % of the loss. *Not touched* is a change whose interval
lies within 10 % on either side of 0; of all others one *cannot tell*.
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
from matplotlib.patches import Patch, Rectangle

from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.page import markdown
from torchrl_l1.report.statistics import MIN_SAMPLES, Interval, mean_interval, ratio

HERE = Path(__file__).with_name("suite")
TASKS = ("inverted_pendulum", "swimmer", "hopper", "walker", "half_cheetah")
CONTROLLERS = ("paper", "robust", "oracle")
EARLIER = "earlier"  # the robust controller that took changes for noise
NONE = ("none", 0.0)
Cell = tuple[str, float]
# Returns of the episodes, by policy, controller and (disturbance, value).
Returns = dict[tuple[str, str, Cell], np.ndarray]

# A change is worth speaking of from here, as a share of the undisturbed return or of the loss,
# whichever is larger.
LEAST = 0.02
# A change that is certainly smaller is none.
EQUAL = 0.1
CANCELLED = 0.7
VERDICTS = {"cancelled": "●", "helped": "+", "worse": "–", "not touched": "", "cannot tell": ""}
HATCH = "////"
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


def gather(folder: Path, task: str, renamed: dict[str, str] | None = None) -> None:
    """Keep the returns of all policies and controllers of a task in one file.

    Of controllers that get another name, those alone.
    """
    rows: dict[tuple[str, str, str, float], list[str]] = {}
    for file in sorted(folder.glob(f"{task}/seed_*/episodes.csv")):
        with file.open(newline="") as handle:
            for row in csv.DictReader(handle):
                if renamed is not None and row["l1"] not in renamed:
                    continue
                l1 = (renamed or {}).get(row["l1"], row["l1"])
                key = (file.parts[-2], l1, *cell_of(row))
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


def sample(returns: Returns, l1: str, cells: Sequence[Cell]) -> np.ndarray:
    """Mean returns over cells, whose resets are the same.

    Of each policy if there are three or more, else from each reset, over the policies.
    """
    runs = sorted({key[0] for key in returns})
    of = np.array([np.mean([returns[run, l1, cell] for cell in cells], axis=0) for run in runs])
    return of.mean(axis=1 if len(runs) >= MIN_SAMPLES else 0)


def interval_of(values: np.ndarray) -> Interval:
    """95 % interval of the mean, without bounds of fewer than three values."""
    return mean_interval(list(values)) or Interval(-np.inf, np.inf)


def change(returns: Returns, l1: str, cells: Sequence[Cell]) -> tuple[float, Interval]:
    """Return less that without L1, as a share of its scale, with its interval."""
    difference = sample(returns, l1, cells) - sample(returns, "off", cells)
    shares = difference / scale(returns, cells)
    return float(shares.mean()), interval_of(shares)


def scale(returns: Returns, cells: Sequence[Cell]) -> float:
    """Magnitude of the undisturbed return without L1, or of the loss if that is larger."""
    undisturbed = sample(returns, "off", [NONE]).mean()
    return max(float(abs(undisturbed)), float(abs(lost(returns, cells).mean())), STANDING)


def lost(returns: Returns, cells: Sequence[Cell]) -> np.ndarray:
    """What the disturbance costs without L1, by policy or by reset."""
    return sample(returns, "off", [NONE]) - sample(returns, "off", cells)


def regained(returns: Returns, l1: str, cells: Sequence[Cell]) -> tuple[float, Interval] | None:
    """Share of what a disturbance costs that a controller gives back; none if it costs nothing."""
    loss = lost(returns, cells)
    if interval_of(loss).low <= 0 or loss.mean() <= LEAST * scale(returns, cells):
        return None
    return ratio(sample(returns, l1, cells) - sample(returns, "off", cells), loss)


def verdict(returns: Returns, l1: str, cells: Sequence[Cell]) -> str:
    """What the controller does about a disturbance, in a word or two."""
    mean, interval = change(returns, l1, cells)
    if interval.high < 0 and mean < -LEAST:
        return "worse"
    if interval.low > 0 and mean > LEAST:
        back = regained(returns, l1, cells)
        return "cancelled" if back is not None and back[0] >= CANCELLED else "helped"
    none = interval.low >= -EQUAL and interval.high <= EQUAL
    return "not touched" if none else "cannot tell"


def table(returns: Returns, groups: Iterable[tuple[str, Sequence[Cell]]]) -> str:
    """One line for each group of cells."""
    lines = []
    for words, cells in groups:
        line: dict[str, Any] = {"disturbance": words}
        for l1 in ("off", *CONTROLLERS):
            line[l1] = f"{sample(returns, l1, cells).mean():.4g}"
        line["loss"] = f"{lost(returns, cells).mean():.4g}" if cells[0] != NONE else ""
        for l1 in CONTROLLERS:
            back = regained(returns, l1, cells)
            line[f"{l1} gives back"] = f"{back[0]:.2f} {back[1]:.2f}" if back is not None else ""
        for l1 in ("paper", "robust"):
            line[f"{l1}:"] = verdict(returns, l1, cells)
        lines.append(line)
    return markdown(lines)


def groups_of(returns: Returns) -> dict[str, list[Cell]]:
    """The cells that were tested of each disturbance, in the order of the registry."""
    tested = {key[2] for key in returns}
    groups = {name: sorted(cell for cell in tested if cell[0] == name) for name in DISTURBANCES}
    return {name: cells for name, cells in groups.items() if cells}


def changed(of: dict[str, Returns]) -> str:
    """Verdicts on the robust controller that have changed: the earlier one / this one.

    Of the policies that were tested both ways.
    """
    both_ways = {task: {key[0] for key in every if key[1] == EARLIER} for task, every in of.items()}
    of = {
        task: {key: values for key, values in every.items() if key[0] in both_ways[task]}
        for task, every in of.items()
        if both_ways[task]
    }
    lines = []
    for name, entry in DISTURBANCES.items():
        line = {"disturbance": entry.words}
        for task, returns in of.items():
            cells = groups_of(returns).get(name)
            both = [verdict(returns, l1, cells) for l1 in (EARLIER, "robust") if cells]
            line[task.replace("_", " ")] = " / ".join(both) if len(set(both)) == 2 else ""
        if any(list(line.values())[1:]):
            lines.append(line)
    for kinds in (("worse",), ("helped", "cancelled")):
        line = {"disturbance": f"number of *{' or '.join(kinds)}*"}
        for task, returns in of.items():
            counts = [
                sum(verdict(returns, l1, cells) in kinds for cells in groups_of(returns).values())
                for l1 in (EARLIER, "robust")
            ]
            line[task.replace("_", " ")] = " / ".join(map(str, counts))
        lines.append(line)
    return markdown(lines)


def count(word: str, lines: Sequence[dict[str, str]]) -> dict[str, str]:
    """A line with how often a verdict occurs in each column, by controller."""
    found = {"disturbance": f"number of *{word}*", "matched": ""}
    for column in list(lines[0])[2:]:
        both = zip(
            *(line[column].split(" / ") for line in lines if line[column] != "–"), strict=True
        )
        found[column] = " / ".join(str(verdicts.count(word)) for verdicts in both)
    return found


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
                if word == "cannot tell":
                    corner = column - 0.5, row - 0.5
                    ax.add_patch(Rectangle(corner, 1, 1, fill=False, hatch=HATCH, ec="0.6", lw=0))
                mark = VERDICTS[word]
                color = "white" if abs(shares[row, column]) > 0.3 else "black"
                ax.text(column, row, mark, ha="center", va="center", color=color, weight="bold")
        norm = TwoSlopeNorm(0, -0.5, 0.5)
        image = ax.imshow(shares, cmap="RdBu", norm=norm, aspect="auto")
        ax.set_title(f"L1 {l1}")
        tasks = [task.replace("_", " ") for task in of]
        ax.set_xticks(range(len(of)), tasks, rotation=30, ha="right")
        ax.set_yticks(range(len(names)), [DISTURBANCES[name].words for name in names])
    figure.suptitle("● cancelled   + helped   – worse   no mark: not touched")
    unknown = Patch(fill=False, hatch=HATCH, ec="0.6", lw=0, label="cannot tell")
    figure.legend(handles=[unknown], loc="outside lower center", frameon=False)
    figure.colorbar(
        image,
        ax=axes,
        extend="both",
        label="change of the return, as a share of the undisturbed one or of the loss",
        shrink=0.7,
    )
    figure.savefig(file, dpi=110)
    plt.close(figure)


def main() -> None:
    """Read what is new, then write all tables and the figure."""
    of: dict[str, Returns] = {}
    for task in TASKS:
        match sys.argv[1:]:
            case ["earlier", folder]:
                gather(Path(folder), task, {"robust": EARLIER})
            case [folder]:
                gather(Path(folder), task)
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
    lines = list(words.values())
    (HERE / "verdicts.md").write_text(
        markdown(lines + [count(word, lines) for word in VERDICTS]) + "\n"
    )
    (HERE / "changed.md").write_text(changed(of) + "\n")
    plot(of, HERE / "verdicts.png")
    print(f"Tables and figure: {HERE}")


if __name__ == "__main__":
    main()
