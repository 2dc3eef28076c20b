"""The benchmark tasks as single Gymnasium environments, and their registration."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np
import torch
from gymnasium.spaces import Box

from torchrl_l1.envs.simulation import TaskSimulation
from torchrl_l1.envs.task import Task
from torchrl_l1.envs.tasks import built_in_task

_ONLY = np.zeros(1, dtype=np.int64)


class MujocoTaskEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment of a benchmark task, for Gymnasium and libraries based on it.

    Task data and physics are those of :class:`~torchrl_l1.envs.BatchedMujocoEnv`; only the horizon
    is left to Gymnasium: ``gymnasium.make("torchrl_l1/HalfCheetah-v0")`` adds its ``TimeLimit``.
    Observations are float64 and without noise. The action space is the actuators' range; actions
    outside it are passed on unchanged, and clipped where the task's physics and reward do so.

    If the simulation becomes unstable in a step, the episode terminates with the last good
    observation and ``info["non_finite"]`` set.

    Args:
        task: a key of :data:`~torchrl_l1.envs.TASKS`, or a :class:`~torchrl_l1.envs.Task`.
        render_mode: ``None`` or ``"rgb_array"``. Frames come from the XML's ``track`` camera if it
            has one.
        width: width of a frame in pixels.
        height: height of a frame in pixels.

    Raises:
        KeyError: if the task is unknown.
        ValueError: if the render mode is unknown.

    Examples:
        >>> import gymnasium, torchrl_l1
        >>> env = gymnasium.make("torchrl_l1/HalfCheetah-v0")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, env.spec.max_episode_steps
        ((17,), 1000)
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    _renderer: mujoco.Renderer | None = None
    _CAMERA: ClassVar[str] = "track"

    def __init__(
        self,
        task: str | Task,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
    ) -> None:
        self.task = task = built_in_task(task)
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ValueError(f"render_mode must be None or one of {modes}, got {render_mode!r}")
        self.metadata = {**self.metadata, "render_fps": round(1 / task.dt)}
        self.render_mode = render_mode
        self.width, self.height = width, height
        self._simulation = TaskSimulation(task, 1)
        self.observation_space = Box(-np.inf, np.inf, (task.observation_dim,), np.float64)
        self.action_space = Box(task.action_low, task.action_high, (task.action_dim,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seed of this and all following resets; if ``None``, they continue from the last
                seed. With the same seed the first reset equals that of a
                :class:`~torchrl_l1.envs.BatchedMujocoEnv` with one environment.
            options: not used.

        Returns:
            The observation ``(n,)`` and an empty dictionary.
        """
        super().reset(seed=seed, options=options)
        self._simulation.reset(self.np_random, _ONLY)
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance by one environment step of ``task.dt`` seconds.

        Args:
            action: actuator inputs ``(m,)``.

        Returns:
            Observation ``(n,)``, reward, whether the episode terminated, ``False`` (the horizon is
            Gymnasium's ``TimeLimit``), and ``{"non_finite": bool}``.

        Raises:
            ValueError: if the action has the wrong shape or is not finite.
        """
        if np.shape(action) != self.action_space.shape:
            raise ValueError(
                f"action has shape {np.shape(action)}, expected {self.action_space.shape}"
            )
        values = torch.as_tensor(np.asarray(action, dtype=np.float64))
        reward, terminated, bad = self._simulation.step(values.unsqueeze(0))
        info = {"non_finite": bool(bad)}
        return self._observation(), float(reward), bool(terminated), False, info

    def simulator_state(self) -> tuple[np.ndarray, np.ndarray]:
        """Copies of the simulator's ``qpos (nq,)`` and ``qvel (nv,)``."""
        simulator = self._simulation.simulator
        return simulator.qpos[0].copy(), simulator.qvel[0].copy()

    def set_simulator_state(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Start an episode from a given state; call it after ``reset``.

        Args:
            qpos: positions ``(nq,)``.
            qvel: velocities ``(nv,)``.

        Returns:
            The observation ``(n,)``.

        Raises:
            ValueError: if a shape is wrong or a number is not finite.
        """
        self._simulation.set_state(np.asarray(qpos)[None], np.asarray(qvel)[None])
        return self._observation()

    def _observation(self) -> np.ndarray:
        return self._simulation.observation[0].numpy().copy()

    def render(self) -> np.ndarray | None:
        """A frame ``(height, width, 3)`` of the current state, uint8; ``None`` without render mode.

        Raises:
            RuntimeError: if OpenGL cannot draw off screen here.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() does nothing without a render mode: create the environment with "
                'render_mode="rgb_array".'
            )
            return None
        model = self._simulation.simulator.model
        if self._renderer is None:
            self._renderer = self._make_renderer(model)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = self.simulator_state()
        mujoco.mj_forward(model, data)
        tracked = any(model.camera(i).name == self._CAMERA for i in range(model.ncam))
        self._renderer.update_scene(data, self._CAMERA if tracked else -1)
        frame: np.ndarray = self._renderer.render()
        return frame

    def _make_renderer(self, model: mujoco.MjModel) -> mujoco.Renderer:
        # The XML's off-screen buffer may be smaller than the frame.
        buffer = model.vis.global_
        buffer.offwidth = max(buffer.offwidth, self.width)
        buffer.offheight = max(buffer.offheight, self.height)
        try:
            return mujoco.Renderer(model, self.height, self.width)
        except Exception as error:  # every OpenGL binding has its own exceptions
            raise RuntimeError(
                "MuJoCo cannot draw off screen here; set the environment variable MUJOCO_GL to egl "
                "or osmesa before Python starts, and install that backend (libegl1, libosmesa6)"
            ) from error

    def close(self) -> None:
        """Close the renderer, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
