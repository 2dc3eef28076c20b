"""MuJoCo physics of many environments: plain NumPy in, plain NumPy out."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numpy as np

from .tasks import Task

__all__ = ["BatchedSimulator"]

# Beyond this magnitude MuJoCo itself calls a number bad (mjMAXVAL).
MAX_MAGNITUDE = 1e10
_BAD_STATE = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]


class BatchedSimulator:
    """``num_envs`` persistent :class:`mujoco.MjData` over one :class:`mujoco.MjModel`.

    Every environment keeps its own ``MjData`` from step to step, solver warm start included, so
    that trajectories are bit-equal to Gymnasium's.

    Args:
        task: the task to simulate.
        num_envs: number of environments ``N``.
        threads: threads that share the environments; results do not depend on it.

    Attributes:
        model: the compiled MuJoCo model.
        data: MuJoCo's own record of each environment (contacts, sensors, body poses).
        qpos: positions ``(N, nq)``, float64.
        qvel: velocities ``(N, nv)``, float64.
    """

    def __init__(self, task: Task, num_envs: int, threads: int = 1) -> None:
        self.task = task
        self.num_envs = num_envs
        self.threads = min(threads, num_envs)
        self.model: mujoco.MjModel = task.build_model()
        self.data = [mujoco.MjData(self.model) for _ in range(num_envs)]
        self._bind()
        self.qpos = np.stack(self._qpos_views)
        self.qvel = np.stack(self._qvel_views)

    def _bind(self) -> None:
        # MuJoCo's arrays are views whose look-up through MjData costs more than their use.
        self._ctrl_views = [data.ctrl for data in self.data]
        self._qpos_views = [data.qpos for data in self.data]
        self._qvel_views = [data.qvel for data in self.data]
        self._warning_views = [data.warning.number for data in self.data]
        self._pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None

    def __getstate__(self) -> dict[str, Any]:
        # A copied view would no longer be MuJoCo's memory: rebuild the views instead.
        left_out = ("_views", "_pool")
        return {k: v for k, v in self.__dict__.items() if not k.endswith(left_out)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._bind()

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
        chosen = range(self.num_envs) if indices is None else indices
        for name, value, size in (("qpos", qpos, self.model.nq), ("qvel", qvel, self.model.nv)):
            if np.shape(value) != (len(chosen), size):
                raise ValueError(
                    f"{name} has shape {np.shape(value)}, expected {(len(chosen), size)}: "
                    f"one row for each of the {len(chosen)} environments that are set."
                )
            if not np.isfinite(value).all():
                raise ValueError(f"{name} has entries that are not finite.")
        for row, index in enumerate(chosen):
            data = self.data[index]
            mujoco.mj_resetData(self.model, data)
            data.qpos[:] = qpos[row]
            data.qvel[:] = qvel[row]
            mujoco.mj_forward(self.model, data)  # so that contacts and poses are of this state
            self.qpos[index] = qpos[row]
            self.qvel[index] = qvel[row]

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
        if self._pool is None:
            self._advance(control, 0)
        else:
            others = [self._pool.submit(self._advance, control, i) for i in range(1, self.threads)]
            self._advance(control, 0)
            for other in others:
                other.result()
        shape = (self.num_envs, -1)
        qpos = np.concatenate(self._qpos_views).reshape(shape)
        qvel = np.concatenate(self._qvel_views).reshape(shape)
        warnings = np.concatenate(self._warning_views)
        # MuJoCo checks at the start of a step: what the last one produced is unchecked. A maximum
        # is NaN as soon as one entry is, and fails the comparison as well.
        sound = np.abs(qpos).max() <= MAX_MAGNITUDE and np.abs(qvel).max() <= MAX_MAGNITUDE
        if not sound or warnings.any():
            bad = warnings.reshape(shape)[:, _BAD_STATE].any(1)
            bad |= ~(np.abs(qpos) <= MAX_MAGNITUDE).all(1) | ~(np.abs(qvel) <= MAX_MAGNITUDE).all(1)
            indices = np.flatnonzero(bad)
            qpos[indices], qvel[indices] = self.qpos[indices], self.qvel[indices]
            self.set_state(qpos[indices], qvel[indices], indices)
        else:
            bad = np.zeros(self.num_envs, dtype=bool)
        self.qpos, self.qvel = qpos, qvel
        return bad

    def _advance(self, control: np.ndarray, part: int) -> None:
        model, frame_skip, mj_step = self.model, self.task.frame_skip, mujoco.mj_step
        share = slice(part, None, self.threads)
        for view, row, data in zip(
            self._ctrl_views[share], control[share], self.data[share], strict=True
        ):
            view[:] = row
            mj_step(model, data, nstep=frame_skip)  # releases the GIL
