"""A frozen policy under a disturbance, L1 off above L1 on, as a filmstrip and an animation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from torchrl.envs import EnvBase

from torchrl_l1.experiment.evaluate import Condition, TrainedRun, make_collection
from torchrl_l1.experiment.rendering import (
    RenderingUnavailable,
    animation,
    filmstrip,
    rollout_frames,
)

_SECONDS_SHOWN = 4.0
_COLUMNS = 10


def write_filmstrip(
    trained: TrainedRun,
    cells: Sequence[Condition],
    seed: int,
    output: Path,
) -> None:
    """Render one deterministic episode per condition into ``filmstrip.png`` and ``.gif``.

    The conditions share their disturbance; rows are named by their controllers, and by their
    stages where there are several. Where no headless OpenGL works, a line says so and nothing is
    written.
    """
    task = trained.algorithm.task
    several = len({cell.stage for cell in cells}) > 1
    steps = min(trained.recipe.horizon or task.horizon, round(_SECONDS_SHOWN / task.dt))
    try:
        rows = {
            _label(cell, several): rollout_frames(task, _poses(trained, cell, steps, seed))
            for cell in cells
        }
    except RenderingUnavailable as error:
        print(f"No filmstrip: {error}")
        return
    strip = filmstrip(rows, output / "filmstrip.png", every=max(1, steps // _COLUMNS), dt=task.dt)
    moving = animation(rows, output / "rollout.gif", dt=task.dt)
    print(f"Filmstrip at bias {cells[0].bias:g}: {strip}, animation: {moving}")


def _label(cell: Condition, several: bool) -> str:
    """A line for each value that is set: a row is not wide."""
    controller = "L1 " + cell.controller.replace(" ", "\n")
    return f"{cell.stage}\n{controller}" if several else controller


def _poses(trained: TrainedRun, cell: Condition, steps: int, seed: int) -> np.ndarray:
    """Simulator positions ``(T, nq)`` of the first environment."""
    poses: list[np.ndarray] = []

    def record(env: EnvBase, _: object) -> None:
        poses.append(env.base_env.simulator_state()[0][0])

    collection = make_collection(trained, cell, 1)
    collection.evaluate(seed, deterministic=True, steps=steps, callback=record)
    return np.stack(poses)
