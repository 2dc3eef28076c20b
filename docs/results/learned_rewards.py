"""METRPO on HalfCheetah with a learned reward beside the task's own, round by round.

    python docs/results/learned_rewards.py [FOLDER]

Reads `metrics.csv` of the runs in FOLDER/built_in/seed_N and FOLDER/learned/seed_N, if a FOLDER is
given, and keeps what is shown of them in `learned_rewards.csv` beside this file, in place of what
was kept of the same runs. Writes from it `learned_rewards.md` and `learned_rewards.png`.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.page import markdown
from torchrl_l1.report.style import color, grid, save

KEPT = Path(__file__).with_suffix(".csv")
WORDS = {"built_in": "built in", "learned": "learned"}
EXPLAINED = "reward_model/explained_variance"
MOST_STEPS = 96_000
Row = dict[str, str]


def gather(folder: Path) -> None:
    """Keep steps, returns and the fit of the reward of all runs in one file."""
    rows: list[Row] = []
    files = [file for reward in WORDS for file in folder.glob(f"{reward}/seed_*/metrics.csv")]
    if not files:
        sys.exit(f"no runs in {' or '.join(str(folder / reward) for reward in WORDS)}")
    for file in files:
        own = {"reward": file.parts[-3], "seed": file.parts[-2].removeprefix("seed_")}
        with file.open(newline="") as handle:
            rows += [
                own
                | {name: row[name] for name in ("real_steps", "return_mean")}
                | {"explained_variance": row.get(EXPLAINED, "")}
                for row in csv.DictReader(handle)
                if int(row["real_steps"]) <= MOST_STEPS
            ]
    new = {run_of(row) for row in rows}
    old = [row for row in read() if run_of(row) not in new] if KEPT.exists() else []
    write_table(KEPT, sorted(old + rows, key=run_of))


def run_of(row: Row) -> tuple[str, str]:
    """Reward and seed."""
    return row["reward"], row["seed"]


def read() -> list[Row]:
    """The rows that are kept."""
    with KEPT.open(newline="") as handle:
        return list(csv.DictReader(handle))


def main() -> None:
    """Read what is new, then write table and figure."""
    if len(sys.argv) > 1:
        gather(Path(sys.argv[1]))
    rows = read()
    runs: dict[tuple[str, str], dict[int, Row]] = {}
    for row in rows:
        runs.setdefault(run_of(row), {})[int(row["real_steps"])] = row
    table = []
    for steps in sorted({int(row["real_steps"]) for row in rows}):
        line = {"real steps": str(steps)}
        for (reward, seed), at in runs.items():
            returned = f"{float(at[steps]['return_mean']):.0f}" if steps in at else ""
            line[f"{WORDS[reward]}, seed {seed}"] = returned
        found = [at[steps]["explained_variance"] for at in runs.values() if steps in at]
        explained = [float(one) for one in found if one]
        line["explained variance"] = f"{min(explained):.5f}" if explained else ""
        table.append(line)
    KEPT.with_suffix(".md").write_text(markdown(table) + "\n")
    figure, (axis,) = grid(1, 1, 6.4, 3.6)
    for (reward, seed), at in runs.items():
        axis.plot(
            list(at),
            [float(row["return_mean"]) for row in at.values()],
            "-" if reward == "learned" else "--",
            color=color(int(seed)),
            label=f"{WORDS[reward]}, seed {seed}",
        )
    axis.set(title="METRPO on HalfCheetah, by its reward", xlabel="real steps", ylabel="return")
    axis.legend(frameon=False, fontsize=8, loc="upper left")
    save(figure, KEPT.with_suffix(".png"))
    print(f"Table: {KEPT.with_suffix('.md')}\nFigure: {KEPT.with_suffix('.png')}")


if __name__ == "__main__":
    main()
