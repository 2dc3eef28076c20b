"""MuJoCo physics of many environments: plain NumPy in, plain NumPy out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from .task import Task

__all__ = ["BatchedSimulator"]

# Beyond this magnitude MuJoCo itself calls a number bad (mjMAXVAL).
MAX_MAGNITUDE = 1e10
_BAD_STATE = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]
_NO_STAGE = int(mujoco.mjtStage.mjSTAGE_NONE)


class BatchedSimulator:
    """``num_envs`` simulations of one task.

    Each keeps its whole integration state from step to step, solver warm start included, so that
    trajectories are bit-equal to Gymnasium's. Copies and pickles continue where the original is.

    Args:
        task: the task to simulate.
        num_envs: number of environments ``N``.
        threads: threads that share the environments; results do not depend on it.

    Attributes:
        model: the compiled MuJoCo model.
        batch: MuJoCo's own interface to all simulations (contacts, sensors, body poses, ...).
        qpos: positions ``(N, nq)``, float64; a live view.
        qvel: velocities ``(N, nv)``, float64; a live view.
    """

    def __init__(self, task: Task, num_envs: int, threads: int = 1) -> None:
        self.task = task
        self.num_envs = num_envs
        self.threads = min(threads, num_envs)
        self.model: mujoco.MjModel = task.build_model()
        self._start()

    def _start(self) -> None:
        self.batch = Batch(self.model, self.num_envs, nthread=self.threads)
        self.qpos: np.ndarray = self.batch.bind("qpos")
        self.qvel: np.ndarray = self.batch.bind("qvel")
        self._ctrl: np.ndarray = self.batch.bind("ctrl")

    def __getstate__(self) -> dict[str, Any]:
        kept = ("task", "num_envs", "threads", "model")
        return {**{k: self.__dict__[k] for k in kept}, "rows": self.batch.state.copy()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        rows = state.pop("rows")
        self.__dict__.update(state)
        self._start()
        self.batch.state[:] = rows

    def set_state(
        self, qpos: np.ndarray, qvel: np.ndarray, indices: Sequence[int] | np.ndarray | None = None
    ) -> None:
        """Puts environments into given states and forgets their history (time, warm start).

        Args:
            qpos: positions ``(K, nq)``.
            qvel: velocities ``(K, nv)``.
            indices: the ``K`` environments meant; all ``N`` by default.

        Raises:
            ValueError: if a shape is not the expected one or a number is not finite.
        """
        chosen = np.arange(self.num_envs) if indices is None else np.asarray(indices)
        for name, value, size in (("qpos", qpos, self.model.nq), ("qvel", qvel, self.model.nv)):
            if np.shape(value) != (len(chosen), size):
                raise ValueError(
                    f"{name} has shape {np.shape(value)}, expected {(len(chosen), size)}: "
                    f"one row for each of the {len(chosen)} environments that are set."
                )
            if not np.isfinite(value).all():
                raise ValueError(f"{name} has entries that are not finite.")
        self.batch.reset(chosen, stage=_NO_STAGE)
        self.qpos[chosen] = qpos
        self.qvel[chosen] = qvel
        self.batch.forward(chosen)

    def step(self, control: np.ndarray) -> np.ndarray:
        """Advances every environment by one environment step.

        Where the simulation turns bad (MuJoCo's warnings of a bad position, velocity or
        acceleration, upon which it silently restarts from the XML's pose), the environment is put
        back to the state before the step.

        Args:
            control: actuator inputs ``(N, m)``, float64; MuJoCo clamps them where the XML says so.

        Returns:
            Boolean ``(N,)``: which environments turned bad.
        """
        batch = self.batch
        before = batch.state.copy()
        self._ctrl[:] = control
        batch.step(nstep=self.task.frame_skip)
        # MuJoCo checks at the start of a step: what the last one produced is unchecked. A maximum
        # is NaN as soon as one entry is, and fails the comparison as well.
        sound = np.abs(self.qpos).max() <= MAX_MAGNITUDE >= np.abs(self.qvel).max()
        if sound and not batch.warning.any():
            return np.zeros(self.num_envs, dtype=bool)
        counts = batch.warning[:, _BAD_STATE, 1]  # of (last cause, count)
        bad: np.ndarray = (counts > 0).any(1)
        for values in (self.qpos, self.qvel):
            bad |= ~(np.abs(values) <= MAX_MAGNITUDE).all(1)
        indices = np.flatnonzero(bad)
        batch.reset(indices, stage=_NO_STAGE)  # clears the warnings
        batch.state[indices] = before[indices]
        return bad
