"""Where the assumptions of theorem 1 of arXiv 2403.14860 fail in the tasks.

    python docs/results/theorem1_tasks.py RUN_DIRECTORY... [--output FOLDER]

Reads trained models and the transitions that were held out from their training, and writes
tasks.csv, tasks.md and tasks.png into FOLDER, by default `theorem1` beside this file. Residuals
are Euclidean norms in state units per second, as the paper's epsilon_l.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchrl_l1.control import solve_matched
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.experiment.evaluate import load_run
from torchrl_l1.experiment.files import write_table
from torchrl_l1.experiment.run_directory import RunDirectory
from torchrl_l1.report.page import markdown
from torchrl_l1.report.style import color, grid, save, title

QUANTILES = (0.5, 0.9, 0.99, 0.999)
STATES = 1000  # at which all corners of the box of actions are tried
ROWS = 4096
Row = dict[str, str | float]


def norm(value: Tensor) -> Tensor:
    """Euclidean norms over the last dimension."""
    return torch.linalg.vector_norm(value, dim=-1)


def residuals(model: EnsembleDynamics, x: Tensor, u: Tensor, following: Tensor) -> Tensor:
    """What the model misses of each change of state, state units per step."""
    blocks = zip(x.split(ROWS), u.split(ROWS), strict=True)
    predicted = torch.cat([model.mean_change(*block) for block in blocks])
    return following - x - predicted


def reach(model: EnsembleDynamics, x: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Most that an action changes the model's prediction, from the middle of the box to a corner.

    Args:
        model: the learned dynamics.
        x: states ``(..., n)``.
        low: lower bounds of the actions ``(m,)``.
        high: upper bounds of the actions ``(m,)``.

    Returns:
        state units per step ``(...)``.
    """
    middle = model.mean_change(x, ((low + high) / 2).expand(len(x), -1))
    corners = torch.tensor(list(itertools.product(*zip(low.tolist(), high.tolist(), strict=True))))
    moved = [norm(model.mean_change(x, corner.expand(len(x), -1)) - middle) for corner in corners]
    return torch.stack(moved).amax(0)


@torch.no_grad()
def measured(path: Path) -> tuple[Row, Tensor]:
    """What the theorem's quantities are in a run, and the held out residuals per second.

    Args:
        path: the run directory.
    """
    trained = load_run(path)
    task, model = trained.algorithm.task, trained.algorithm.acting_dynamics
    checkpoint = RunDirectory(path).load_checkpoint()
    assert checkpoint is not None and isinstance(model, EnsembleDynamics)
    buffer = checkpoint["algorithm"]["buffer"]
    x, u, following = buffer["observation"], buffer["executed"], buffer["next"]["observation"]
    held_out = buffer["validation"].nonzero().squeeze(-1)
    # The step before, where it belongs to the same episode: its residual is about the estimate.
    held_out = held_out[held_out > 0]
    before = held_out - 1
    joined = (following[before] == x[held_out]).all(-1)

    dt = task.timestep * task.frame_skip
    missed = residuals(model, x[held_out], u[held_out], following[held_out]) / dt
    earlier = residuals(model, x[before], u[before], following[before])[joined] / dt
    size, change = norm(missed), norm(missed[joined] - earlier)
    chosen = torch.randperm(len(held_out), generator=torch.Generator().manual_seed(0))[:STATES]
    states, actions = x[held_out[chosen]], u[held_out[chosen]]
    low = torch.as_tensor(task.action_low).expand(task.action_dim)
    high = torch.as_tensor(task.action_high).expand(task.action_dim)
    reached = reach(model, states, low, high) / dt
    jacobian = model.value_and_jacobian(states, actions)[1] / dt
    matched, _ = solve_matched(jacobian, missed[chosen])
    within = norm((jacobian @ matched.unsqueeze(-1)).squeeze(-1)) / size[chosen]
    tolerance = trained.recipe.l1.epsilon / dt
    quantiles = torch.quantile(size, torch.tensor(QUANTILES)).tolist()
    row: Row = {"task": task.name, "transitions": len(held_out), "sampling_time": dt}
    row |= {f"residual_{q:g}": value for q, value in zip(QUANTILES, quantiles, strict=True)}
    row |= {
        "residual_largest": size.max().item(),
        "reach_median": reached.median().item(),
        "beyond_reach": (size[chosen] > reached).double().mean().item(),
        "matched_share_median": within.median().item(),
        "needs_more_than_there_is": (matched.abs() > (high - low) / 2)
        .any(-1)
        .double()
        .mean()
        .item(),
        "epsilon_a": tolerance,
        "below_epsilon_a": (size <= tolerance).double().mean().item(),
        "change_median": change.median().item(),
        "change_0.99": torch.quantile(change, 0.99).item(),
        "change_largest": change.max().item(),
        "estimate_worse_than_none": (change > size[joined]).double().mean().item(),
    }
    return row, size


HEADINGS = {
    "residual_0.5": "median",
    "residual_0.9": "90 %",
    "residual_0.99": "99 %",
    "residual_largest": "largest",
    "reach_median": "reach of the actions",
    "beyond_reach": "beyond reach",
    "matched_share_median": "matched part",
    "epsilon_a": "epsilon_a",
    "below_epsilon_a": "below epsilon_a",
    "change_median": "change in a step, median",
    "change_largest": "its largest",
    "estimate_worse_than_none": "worse than none",
}
SHARES = ("beyond_reach", "matched_share_median", "below_epsilon_a", "estimate_worse_than_none")


def shown(column: str, value: str | float) -> str:
    """A cell of the table."""
    assert not isinstance(value, str)
    return f"{100 * value:.1f} %" if column in SHARES else f"{value:.3g}"


def draw(rows: Sequence[Row], sizes: Sequence[Tensor], file: Path) -> None:
    """How many residuals are larger than a size, beside the reach and epsilon_a."""
    figure, axes = grid(len(rows), 3, 3.4, 2.8)
    for axis, row, size in zip(axes, rows, sizes, strict=True):
        ordered = size.sort().values
        share = 1 - torch.arange(len(size)) / len(size)
        axis.plot(ordered, share, color=color(0), label="residuals")
        axis.axvline(float(row["reach_median"]), color="black", ls="--", lw=1, label="reach")
        axis.axvline(float(row["epsilon_a"]), color="grey", ls=":", label="ε_a")
        axis.set(xscale="log", yscale="log", title=title(str(row["task"])))
        axis.set(xlim=(float(ordered[len(ordered) // 100]), 2 * float(ordered[-1])))
        axis.set(xlabel="norm of the residual (1/s)")
    axes[0].set_ylabel("share that is larger")
    axes[0].legend(frameon=False, fontsize=8)
    save(figure, file)


def main(runs: Sequence[Path], output: Path) -> None:
    """Measure every run and write what was found."""
    output.mkdir(parents=True, exist_ok=True)
    rows, sizes = zip(*map(measured, runs), strict=True)
    write_table(output / "tasks.csv", rows)
    cells = [
        {"task": title(str(row["task"]))}
        | {head: shown(column, row[column]) for column, head in HEADINGS.items()}
        for row in rows
    ]
    (output / "tasks.md").write_text(markdown(cells) + "\n")
    draw(rows, sizes, output / "tasks.png")
    print(markdown(cells))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path, help="run directories, one per task")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "theorem1")
    main(**vars(parser.parse_args()))
