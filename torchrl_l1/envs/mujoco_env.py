"""The benchmark tasks as one batched TorchRL environment."""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.data.utils import DEVICE_TYPING
from torchrl.envs import EnvBase

from torchrl_l1.envs.plant import PlantValue
from torchrl_l1.envs.simulation import TaskSimulation
from torchrl_l1.envs.task import Task
from torchrl_l1.envs.tasks import built_in_task


class CPUEnv(EnvBase):
    """An environment whose physics is on the CPU."""

    def to(self, device: DEVICE_TYPING) -> EnvBase:
        """Return it unchanged on the CPU.

        Raises:
            ValueError: for any other device.
        """
        if torch.device(device).type != "cpu":
            raise ValueError(
                f"{type(self).__name__} steps on the CPU; its data may be elsewhere: "
                f"TransformedEnv(env, DeviceCastTransform({str(device)!r}))"
            )
        return super().to(device)


def drawn_seed() -> int:
    """A seed from torch's global generator, of which forked workers have equal copies.

    Workers of :mod:`multiprocessing` get different seeds by their numbers.
    """
    drawn = int(torch.empty((), dtype=torch.int64).random_())
    worker = multiprocessing.current_process()._identity
    if not worker:
        return drawn
    return int(np.random.SeedSequence([drawn, *worker]).generate_state(1)[0])


def declare_specs(
    env: EnvBase, observation_dim: int, action_spec: Bounded, dtype: torch.dtype
) -> None:
    """Set the specs that all our batched environments have in common.

    Args:
        env: the environment, whose batch size is set.
        observation_dim: width of the observation.
        action_spec: spec of the action.
        dtype: dtype of observation and reward.
    """
    batch = env.batch_size
    flag = Binary(shape=(*batch, 1), dtype=torch.bool)
    env.observation_spec = Composite(
        observation=Unbounded((*batch, observation_dim), dtype=dtype),
        non_finite=flag.clone(),
        shape=batch,
    )
    env.action_spec = action_spec
    env.reward_spec = Unbounded((*batch, 1), dtype=dtype)
    flags = ("done", "terminated", "truncated")
    env.full_done_spec = Composite({key: flag.clone() for key in flags}, shape=batch)


def reset_rows(tensordict: TensorDictBase | None, num_envs: int) -> np.ndarray:
    """Indices of the environments selected by a ``"_reset"`` mask; all without a mask."""
    mask = None if tensordict is None else tensordict.get("_reset", None)
    if mask is None:
        return np.arange(num_envs)
    return np.flatnonzero(mask.reshape(num_envs, -1).any(-1).numpy())


def stepped_rows(tensordict: TensorDictBase, num_envs: int) -> Tensor | None:
    """Environments that a ``"_step"`` mask lets step ``(N,)``; ``None`` without a mask."""
    mask = tensordict.get("_step", None)
    return None if mask is None else mask.reshape(num_envs, -1).any(-1)


def keep_others(data: TensorDict, tensordict: TensorDictBase, stepped: Tensor) -> TensorDict:
    """Give environments that took no step their previous flags, and a reward of zero."""
    mask = stepped.unsqueeze(-1)
    for name in ("non_finite", "terminated", "truncated", "done"):
        before = tensordict.get(name, None)
        if before is not None:
            data[name] = torch.where(mask, data[name], before)
    data["reward"] = data["reward"].masked_fill(~mask, 0.0)
    return data


class BatchedMujocoEnv(CPUEnv):
    """A MuJoCo benchmark task with ``num_envs`` environments in one process.

    The physics is bit-identical to Gymnasium's (the same XML and ``mj_step``, with the whole
    integration state kept from step to step); observations, rewards, resets and termination come
    from the :class:`Task`. Environments reset independently through the usual ``"_reset"`` mask.
    Those that a ``"_step"`` mask leaves out stay as they are, with a reward of zero.

    Reward and termination are evaluated in float64 on the clean state and on the action that this
    environment receives (with upstream noise and disturbances, before MuJoCo's clamping).

    If the simulation of one environment becomes unstable (not finite, or beyond 1e10), or its
    observation or reward is not finite, that step has ``("next", "non_finite")`` and ``("next",
    "terminated")`` set, its next observation repeats the last good one and its reward is finite.
    Count these steps, and keep them out of a dynamics model's data: the transition that they show
    did not happen.

    Args:
        task: a key of :data:`~torchrl_l1.envs.TASKS`, or a :class:`~torchrl_l1.envs.Task`.
        num_envs: number of environments ``N``; the batch size is ``[N]``.

    Keyword Args:
        seed: seed of the resets; drawn from torch's global generator if ``None``, a different one
            in each worker of :mod:`multiprocessing`.
        max_steps: steps after which an episode is truncated; the task's horizon if ``None``.
        dtype: floating dtype of observation, action and reward.
        threads: threads that share the physics; the results do not depend on it. More than one
            helps only if cores are idle and the physics takes most of the time of a step.
        plant: changes of the plant by name, those of :func:`~torchrl_l1.envs.disturbed_model` and
            ``wind`` of :func:`~torchrl_l1.envs.wind_force`; each a number, one for each
            environment, or drawn at resets, for example by :class:`~torchrl_l1.envs.Uniform`.

    Raises:
        KeyError: if the task is unknown.
        ValueError: if ``num_envs``, ``max_steps`` or ``threads`` is not positive, or a change of
            the plant does not exist.

    Examples:
        >>> env = BatchedMujocoEnv("inverted_pendulum", num_envs=3, seed=0)
        >>> rollout = env.rollout(100)
        >>> rollout["next", "reward"].shape
        torch.Size([3, 100, 1])
        >>> bool(rollout["next", "truncated"][:, -1].all())
        True
    """

    def __init__(
        self,
        task: str | Task,
        num_envs: int = 1,
        *,
        seed: int | None = None,
        max_steps: int | None = None,
        dtype: torch.dtype = torch.float32,
        threads: int = 1,
        plant: Mapping[str, PlantValue] | None = None,
    ) -> None:
        task = built_in_task(task)
        max_steps = task.horizon if max_steps is None else max_steps
        counts = {"num_envs": num_envs, "max_steps": max_steps, "threads": threads}
        for name, value in counts.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        super().__init__(device="cpu", batch_size=[num_envs])
        self.task = task
        self.num_envs = num_envs
        self.max_steps = max_steps
        self._dtype = dtype
        self._simulation = TaskSimulation(task, num_envs, threads, plant)
        self._steps = np.zeros(num_envs, dtype=np.int64)
        action_spec = Bounded(
            task.action_low, task.action_high, (num_envs, task.action_dim), dtype=dtype
        )
        declare_specs(self, task.observation_dim, action_spec, dtype)
        self.set_seed(drawn_seed() if seed is None else seed)

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled MuJoCo model, before changes of the plant; shared by all environments."""
        return self._simulation.simulator.model

    def simulator_state(self) -> tuple[np.ndarray, np.ndarray]:
        """Current simulator states.

        Returns:
            Copies of ``qpos (N, nq)`` and ``qvel (N, nv)``, float64.
        """
        simulator = self._simulation.simulator
        return simulator.qpos.copy(), simulator.qvel.copy()

    def set_simulator_state(self, qpos: np.ndarray, qvel: np.ndarray) -> Tensor:
        """Start a new episode in every environment from a given simulator state.

        For comparisons and rendering. Transforms are not notified: those with a state (a step
        counter, a controller) need an ordinary reset first.

        Args:
            qpos: positions ``(N, nq)``.
            qvel: velocities ``(N, nv)``.

        Returns:
            The observation ``(N, n)`` of these states.

        Raises:
            ValueError: if a shape is wrong or a number is not finite.
        """
        self._simulation.set_state(qpos, qvel)
        self._steps[:] = 0
        return self._emitted()

    def _emitted(self) -> Tensor:
        # A copy even in float64: in-place edits downstream must not reach the clean state.
        return self._simulation.observation.to(self._dtype, copy=True)

    def _set_seed(self, seed: int | None) -> None:
        self._rng = np.random.default_rng(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        indices = reset_rows(tensordict, self.num_envs)
        self._simulation.reset(self._rng, indices)
        self._steps[indices] = 0
        # Environments outside the mask keep their own entries: TorchRL merges by the mask.
        flag = torch.zeros(self.num_envs, 1, dtype=torch.bool)
        return TensorDict(
            {
                "observation": self._emitted(),
                "non_finite": flag,
                "done": flag.clone(),
                "terminated": flag.clone(),
                "truncated": flag.clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        stepped = stepped_rows(tensordict, self.num_envs)
        reward, terminated, bad = self._simulation.step(tensordict.get("action"), stepped)
        self._steps += 1 if stepped is None else stepped.numpy()
        terminated = terminated.unsqueeze(-1)
        truncated = torch.from_numpy(self._steps >= self.max_steps).unsqueeze(-1)
        data = TensorDict(
            {
                "observation": self._emitted(),
                "non_finite": bad.unsqueeze(-1),
                "reward": reward.unsqueeze(-1).to(self._dtype),
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
            batch_size=self.batch_size,
            device=self.device,
        )
        return data if stepped is None else keep_others(data, tensordict, stepped)
