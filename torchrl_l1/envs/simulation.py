"""Batched MuJoCo simulation of a task, and the states in which episodes start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from torchrl_l1.envs.plant import Plant, PlantValue
from torchrl_l1.envs.task import BadAction, Task
from torchrl_l1.envs.tasks import built_in_task

# Beyond this magnitude MuJoCo itself considers a number bad (mjMAXVAL).
MAX_MAGNITUDE = 1e10
# Observations and rewards are kept in single precision, in which larger ones are infinite.
LARGEST = float(np.finfo(np.float32).max)
_BAD_STATE = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]
_NO_STAGE = int(mujoco.mjtStage.mjSTAGE_NONE)


def turned_bad(data: mujoco.MjData) -> bool:
    """Whether a single simulation has become unstable since the last call.

    It clears MuJoCo's warnings of bad states, since each restart resets its counts.
    """
    counts = data.warning.number
    warned = counts.any() and counts[_BAD_STATE].any()
    counts[_BAD_STATE] = 0
    # As in :meth:`BatchedSimulator.step`, NaN included.
    sound = np.abs(data.qpos).max() <= MAX_MAGNITUDE >= np.abs(data.qvel).max()
    return bool(warned or not sound)


class BatchedSimulator:
    """``num_envs`` simulations of one task.

    Each keeps its whole integration state from step to step, solver warm start included, so
    trajectories are bit-identical to Gymnasium's. Copies and pickles continue from the original's
    state.

    Args:
        task: the task to simulate.
        num_envs: number of environments ``N``.
        threads: threads that share the environments; results do not depend on it.
        plant: changes of the plant, see :class:`~torchrl_l1.envs.plant.Plant`.

    Attributes:
        model: the compiled MuJoCo model, without changes of the plant.
        plant: the changes of the plant, if any.
        batch: MuJoCo's own interface to all simulations (contacts, sensors, body poses, ...).
        qpos: positions ``(N, nq)``, float64; a live view.
        qvel: velocities ``(N, nv)``, float64; a live view.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        threads: int = 1,
        plant: Mapping[str, PlantValue] | None = None,
    ) -> None:
        self.task = task
        self.num_envs = num_envs
        self.threads = min(threads, num_envs)
        self.model: mujoco.MjModel = task.build_model()
        self.plant = Plant(self.model, num_envs, plant) if plant else None
        self._start()

    def _start(self) -> None:
        try:
            self.batch = Batch(self.model, self.num_envs, nthread=self.threads)
        # MuJoCo's warnings by their numbers.
        except (MemoryError, TypeError, ValueError) as error:
            if isinstance(error, TypeError) and self.num_envs < 2**31:
                raise
            raise ValueError(
                f"{self.num_envs} environments at a time do not fit into the memory of this "
                "machine: ask for fewer episodes"
            ) from error
        self.qpos: np.ndarray = self.batch.bind("qpos")
        self.qvel: np.ndarray = self.batch.bind("qvel")
        self._ctrl: np.ndarray = self.batch.bind("ctrl")
        if self.plant is not None:
            self.batch.set_models(self.plant.models())

    def __getstate__(self) -> dict[str, Any]:
        kept = ("task", "num_envs", "threads", "model", "plant")
        return {**{k: self.__dict__[k] for k in kept}, "rows": self.batch.state.copy()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        rows = state.pop("rows")
        self.__dict__.update(state)
        self._start()
        self.batch.state[:] = rows

    def set_state(
        self, qpos: np.ndarray, qvel: np.ndarray, indices: Sequence[int] | np.ndarray | None = None
    ) -> None:
        """Put environments into given states and forget their history (time, warm start).

        Args:
            qpos: positions ``(K, nq)``.
            qvel: velocities ``(K, nv)``.
            indices: the ``K`` environments; all ``N`` by default.

        Raises:
            ValueError: if a shape is not the expected one or a number is not finite.
        """
        chosen = np.arange(self.num_envs) if indices is None else np.asarray(indices)
        for name, value, size in (("qpos", qpos, self.model.nq), ("qvel", qvel, self.model.nv)):
            if np.shape(value) != (len(chosen), size):
                raise ValueError(
                    f"{name} has shape {np.shape(value)}, expected {(len(chosen), size)}: "
                    f"one row for each of the {len(chosen)} environments that are set"
                )
            if not np.isfinite(value).all():
                raise ValueError(f"{name} has entries that are not finite")
        self._renew_plant(chosen)
        self.batch.reset(chosen, stage=_NO_STAGE)
        self._apply_wind(chosen)
        self.qpos[chosen] = qpos
        self.qvel[chosen] = qvel
        self.batch.forward(chosen)

    def _renew_plant(self, chosen: np.ndarray) -> None:
        if self.plant is not None and self.plant.is_drawn:
            self.plant.redraw(chosen)
            self.batch.set_models(self.plant.models())

    def _apply_wind(self, chosen: np.ndarray) -> None:
        # Forces are part of the state, which a reset clears.
        forces = None if self.plant is None else self.plant.forces()
        if forces is not None:
            self.batch.bind("xfrc_applied")[chosen] = forces[chosen]

    def step(self, control: np.ndarray, indices: np.ndarray | None = None) -> np.ndarray:
        """Advance environments by one environment step.

        If a simulation becomes unstable (MuJoCo warns of a bad position, velocity or acceleration
        and silently restarts from the XML's pose), the environment is returned to its state before
        the step.

        Args:
            control: actuator inputs ``(N, m)``, float64; MuJoCo clamps them where the XML says so.
            indices: the environments; all ``N`` by default.

        Returns:
            Boolean ``(N,)``: the environments that became unstable.
        """
        batch = self.batch
        before = batch.state.copy()
        self._ctrl[:] = control
        batch.step(indices, nstep=self.task.frame_skip)
        # MuJoCo checks at the start of a step, so the result of the last one is unchecked. A
        # maximum is NaN as soon as one entry is, and then also fails the comparison.
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


class StartStates:
    """Clean initial observations of a task, drawn without stepping any physics.

    Random numbers come from torch's global generator, like those of the rest of an imagined
    rollout.

    Args:
        task: a key of :data:`~torchrl_l1.envs.TASKS`, or a :class:`~torchrl_l1.envs.Task`.

    Examples:
        >>> StartStates("half_cheetah")(8).shape
        torch.Size([8, 17])
    """

    def __init__(self, task: str | Task) -> None:
        self.task = built_in_task(task)
        data = mujoco.MjData(self.task.build_model())
        self._initial = (data.qpos.copy(), data.qvel.copy())

    def __call__(self, count: int) -> Tensor:
        """Initial observations ``(count, n)``, float32."""
        seed = int(torch.randint(2**31, ()))
        rng = np.random.default_rng(seed)
        qpos, qvel = self.task.sample_reset(rng, *self._initial, count)
        return torch.from_numpy(self.task.observe(qpos, qvel, qpos)).float()


class TaskStep(NamedTuple):
    """Outcome of a step: ``reward`` float64, ``terminated`` and ``bad`` bool, each ``(N,)``."""

    reward: Tensor
    terminated: Tensor
    bad: Tensor


class TaskSimulation:
    """A task in ``num_envs`` simulations, without a horizon, noise or random generator.

    Args:
        task: the task.
        num_envs: number of environments ``N``.
        threads: threads that share the physics.
        plant: changes of the plant, see :class:`~torchrl_l1.envs.plant.Plant`.

    Attributes:
        simulator: the physics.
        observation: clean observations ``(N, n)``, float64. Every reset and step replaces this
            tensor; the old one is never written to.

    Raises:
        ValueError: if a function of the task returns a wrong shape.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        threads: int = 1,
        plant: Mapping[str, PlantValue] | None = None,
    ) -> None:
        self.task = task
        self.simulator = BatchedSimulator(task, num_envs, threads, plant)
        data = mujoco.MjData(self.simulator.model)
        self._initial = (data.qpos.copy(), data.qvel.copy())
        self.observation = self._observe(self.simulator.qpos)
        self._check_functions()

    def _check_functions(self) -> None:
        task, observation = self.task, self.observation
        rows = (self.simulator.num_envs,)
        action = torch.zeros(*rows, task.action_dim, dtype=torch.float64)
        expected = {
            "observe": (observation, (*rows, task.observation_dim)),
            "reward": (task.reward(observation, action, observation), rows),
            "terminated": (task.terminated(observation), rows),
        }
        for name, (found, shape) in expected.items():
            if np.shape(found) != shape:
                raise ValueError(
                    f"Task {task.name!r}: {name} returns the shape {tuple(np.shape(found))} for "
                    f"{rows[0]} environments, expected {shape}; correct the function or the task"
                )

    def _observe(self, previous_qpos: np.ndarray) -> Tensor:
        simulator = self.simulator
        # A copy: a user's task may return the live positions themselves.
        return torch.tensor(self.task.observe(simulator.qpos, simulator.qvel, previous_qpos))

    def reset(self, rng: np.random.Generator, indices: np.ndarray) -> None:
        """Start new episodes in some environments and leave the others alone."""
        if indices.size:
            qpos, qvel = self.task.sample_reset(rng, *self._initial, indices.size)
            self.set_state(qpos, qvel, indices)

    def set_state(
        self, qpos: np.ndarray, qvel: np.ndarray, indices: np.ndarray | None = None
    ) -> None:
        """Start new episodes from given states, in all environments or in some.

        Raises:
            ValueError: if a shape is wrong or a number is not finite.
        """
        self.simulator.set_state(qpos, qvel, indices)
        started = np.arange(self.simulator.num_envs) if indices is None else indices
        fresh = self._observe(self.simulator.qpos)
        chosen = torch.zeros(len(fresh), 1, dtype=torch.bool)
        chosen[started] = True
        # The others keep entries that belong to the step they took.
        self.observation = torch.where(chosen, fresh, self.observation)

    def step(self, action: Tensor, stepped: Tensor | None = None) -> TaskStep:
        """Advance environments by one environment step.

        An environment whose simulation becomes unstable keeps its state and its observation. One
        whose observation or reward is not finite keeps its observation.

        Args:
            action: ``(N, m)``; MuJoCo clamps it where the XML says so.
            stepped: the environments that take the step ``(N,)``, bool; all if ``None``. The others
                stay as they are, whatever their action.

        Raises:
            ValueError: if the shape is wrong, or an entry is not finite or beyond 1e10.
        """
        action = self._checked(action, stepped)
        before = self.simulator.qpos.copy()
        indices = None if stepped is None else np.flatnonzero(stepped.numpy())
        bad = torch.from_numpy(self.simulator.step(action.numpy(), indices))
        previous, following = self.observation, self._observe(before)
        bad |= ~(following.abs().amax(-1) <= LARGEST)  # NaN too
        kept = bad if stepped is None else bad | ~stepped
        if kept.any():
            following = torch.where(kept.unsqueeze(-1), previous, following)
        reward = self.task.reward(previous, action, following)
        sound = reward.abs() <= LARGEST
        if not sound.all():
            bad |= ~sound
            following = torch.where(sound.unsqueeze(-1), following, previous)
            reward = torch.where(sound, reward, 0.0)
        self.observation = following
        return TaskStep(reward, self.task.terminated(following) | bad, bad)

    def _checked(self, action: Tensor, stepped: Tensor | None) -> Tensor:
        expected = (self.simulator.num_envs, self.task.action_dim)
        if tuple(action.shape) != expected:
            raise ValueError(f"'action' has shape {tuple(action.shape)}, expected {expected}")
        action = action.detach().to(torch.float64)
        if stepped is not None:
            action = action.masked_fill(~stepped.unsqueeze(-1), 0.0)
        magnitude = np.abs(action.numpy())
        # Written so that NaN fails too; MuJoCo would replace such an input by zero.
        if not magnitude.max() <= MAX_MAGNITUDE:
            index = int(np.flatnonzero(~(magnitude <= MAX_MAGNITUDE).all(1))[0])
            raise BadAction(
                f"'action' of environment {index} is {action[index].tolist()}: every entry must "
                f"be finite and at most {MAX_MAGNITUDE:g} in magnitude; check the policy's output"
            )
        return action
