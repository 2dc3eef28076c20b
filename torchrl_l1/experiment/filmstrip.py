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
    controllers: Sequence[str],
    bias: float,
    seed: int,
    output: Path,
    epsilon: float | None = None,
) -> None:
    """Render one deterministic episode per controller into ``filmstrip.png`` and ``.gif``.

    Where no headless OpenGL works, a line says so and nothing is written.
    """
    task = trained.algorithm.task
    steps = min(trained.recipe.horizon or task.horizon, round(_SECONDS_SHOWN / task.dt))
    try:
        rows = {
            f"L1 {name}": rollout_frames(
                task, _poses(trained, Condition(name, "none", bias, 1.0, ""), steps, seed, epsilon)
            )
            for name in controllers
        }
    except RenderingUnavailable as error:
        print(f"No filmstrip: {error}")
        return
    strip = filmstrip(rows, output / "filmstrip.png", every=max(1, steps // _COLUMNS), dt=task.dt)
    moving = animation(rows, output / "rollout.gif", dt=task.dt)
    print(f"Filmstrip at bias {bias:g}: {strip}, animation: {moving}")


def _poses(
    trained: TrainedRun, cell: Condition, steps: int, seed: int, epsilon: float | None
) -> np.ndarray:
    """Simulator positions ``(T, nq)`` of the first environment."""
    poses: list[np.ndarray] = []

    def record(env: EnvBase, _: object) -> None:
        poses.append(env.base_env.simulator_state()[0][0])

    collection = make_collection(trained, cell, 1, epsilon)
    collection.evaluate(seed, deterministic=True, steps=steps, callback=record)
    return np.stack(poses)
