"""Pictures of rollouts without a display: frames, filmstrips and animations."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import IO

import mujoco
import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from torchrl_l1.atomic import write_through
from torchrl_l1.envs.task import Task
from torchrl_l1.envs.tasks import built_in_task

_WORKER = Path(__file__).with_name("_render_worker.py")
_TIMEOUT_SECONDS = 300


class RenderingUnavailable(RuntimeError):
    """No OpenGL backend of this machine can draw off screen."""


def _backends() -> list[str]:
    if chosen := os.environ.get("MUJOCO_GL"):
        return [chosen]
    if sys.platform != "linux":
        return [""]  # macOS and Windows draw off screen with their native backend
    return ["egl", "osmesa"] + (["glfw"] if os.environ.get("DISPLAY") else [])


def _decorated(task: Task) -> mujoco.MjModel:
    spec = task.build_spec()
    if all(texture.type != mujoco.mjtTexture.mjTEXTURE_SKYBOX for texture in spec.textures):
        spec.add_texture(
            name="background",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
            rgb1=[0.93, 0.94, 0.96],
            rgb2=[0.93, 0.94, 0.96],
            width=8,
            height=48,
        )
    if not any(body.lights for body in spec.bodies):
        spec.visual.headlight.ambient = [0.5, 0.5, 0.5]
        spec.visual.headlight.diffuse = [0.6, 0.6, 0.6]
    return task.build_model(spec)


def rollout_frames(
    task: str | Task, qpos: np.ndarray, *, size: tuple[int, int] = (240, 180)
) -> list[np.ndarray]:
    """Draw the poses of a rollout in a separate process.

    The poses can be recorded with ``rollout``'s callback:
    ``env.rollout(100, policy, callback=lambda env, _: poses.append(env.simulator_state()[0][0]))``.

    The backend is the one named by ``MUJOCO_GL``, or else the first of EGL, OSMesa and (with a
    display) GLFW that works.

    Args:
        task: a key of :data:`~torchrl_l1.envs.TASKS`, or a :class:`~torchrl_l1.envs.Task`.
        qpos: simulator positions ``(T, nq)``; velocities are not drawn.
        size: width and height of a frame in pixels.

    Returns:
        ``T`` RGB images ``(height, width, 3)``, uint8.

    Raises:
        ValueError: if ``qpos`` has the wrong shape.
        RenderingUnavailable: if no backend works; the message contains the error of each.
    """
    return draw_poses(_decorated(built_in_task(task)), qpos, size=size)


def draw_poses(
    model: mujoco.MjModel, qpos: np.ndarray, *, size: tuple[int, int] = (240, 180)
) -> list[np.ndarray]:
    """As :func:`rollout_frames`, for any MuJoCo model."""
    if np.ndim(qpos) != 2 or np.shape(qpos)[1] != model.nq:
        raise ValueError(f"qpos has shape {np.shape(qpos)}, expected (T, {model.nq})")
    reports = []
    with tempfile.TemporaryDirectory() as folder:
        arrays, binary, output = (str(Path(folder, n)) for n in ("in.npz", "model.mjb", "out.npy"))
        np.savez(arrays, qpos=qpos, size=size)
        mujoco.mj_saveModel(model, binary)
        command = [sys.executable, str(_WORKER), arrays, binary, output]
        for backend in _backends():
            environment = {**os.environ, "MUJOCO_GL": backend}
            # PyOpenGL insists on a platform that matches the backend.
            environment.pop("PYOPENGL_PLATFORM", None)
            try:
                subprocess.run(
                    command,
                    env=environment,
                    check=True,
                    capture_output=True,
                    text=True,
                    timeout=_TIMEOUT_SECONDS,
                )
            except subprocess.TimeoutExpired:
                reports.append(f"{backend}: no answer within {_TIMEOUT_SECONDS} s")
            except subprocess.CalledProcessError as error:
                lines = error.stderr.strip().splitlines() or [f"exit status {error.returncode}"]
                reports.append(f"{backend or 'default'}: {lines[-1]}")
            else:
                return list(np.load(output))
    raise RenderingUnavailable(
        "MuJoCo cannot draw off screen here. Install EGL (libegl1) or OSMesa (libosmesa6), or set "
        "MUJOCO_GL to a backend that works. Tried " + "; ".join(reports)
    )


def _checked(rows: Mapping[str, Sequence[np.ndarray]], every: int) -> dict[str, list[np.ndarray]]:
    if every < 1:
        raise ValueError(f"every must be at least 1, got {every}")
    shapes = {np.shape(frame) for frames in rows.values() for frame in frames}
    if len(shapes) != 1 or not all(len(frames) for frames in rows.values()):
        raise ValueError(
            "Every row needs at least one frame, and all frames one shape; found "
            f"{ {label: len(frames) for label, frames in rows.items()} } of shapes {shapes}"
        )
    return {label: list(frames)[::every] for label, frames in rows.items()}


def filmstrip(
    rows: Mapping[str, Sequence[np.ndarray]],
    path: str | Path,
    *,
    every: int = 1,
    dt: float | None = None,
) -> Path:
    """Write a labelled picture with one row of frames for each rollout.

    Args:
        rows: frames ``(height, width, 3)`` of each rollout, by the label to print beside them.
        path: the PNG file to write; its folder is created.
        every: shows every n-th frame, starting with the first.
        dt: duration of one step in seconds; if given, it labels the columns with their times.

    Returns:
        The path.

    Raises:
        ValueError: if a row is empty, shapes differ, or ``every`` is not positive.
    """
    shown = _checked(rows, every)
    columns = max(len(frames) for frames in shown.values())
    height, width = next(iter(shown.values()))[0].shape[:2]
    cell = 1.6
    figure = Figure(figsize=(cell * columns, cell * height / width * len(shown) + 0.3))
    axes = figure.subplots(len(shown), columns, squeeze=False)
    for line, (label, frames) in zip(axes, shown.items(), strict=True):
        line[0].set_ylabel(label, fontsize=9)
        for column, axis in enumerate(line):
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
            if column < len(frames):
                axis.imshow(frames[column])
    if dt is not None:
        for column, axis in enumerate(axes[0]):
            axis.set_title(f"{column * every * dt:.2g} s", fontsize=8)
    figure.subplots_adjust(wspace=0.03, hspace=0.03)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_through(
        path, lambda file: figure.savefig(file, format="png", dpi=110, bbox_inches="tight")
    )
    return path


def animation(
    rows: Mapping[str, Sequence[np.ndarray]],
    path: str | Path,
    *,
    every: int = 1,
    dt: float = 0.04,
) -> Path:
    """Write a looping GIF with the rollouts one below the other, in real time.

    A rollout shorter than the others holds its last frame.

    Args:
        rows: frames ``(height, width, 3)`` of each rollout, by the label to print on them.
        path: the GIF file to write; its folder is created.
        every: shows every n-th frame, starting with the first.
        dt: duration of one step in seconds; if it is short, some frames are skipped.

    Returns:
        The path.

    Raises:
        ValueError: if a row is empty, shapes differ, or ``every`` is not positive.
    """
    shown = _checked(rows, every)
    height, width = next(iter(shown.values()))[0].shape[:2]
    images = []
    count = max(len(frames) for frames in shown.values())
    indices, duration = gif_frames(count, dt * every)
    for index in indices:
        image = Image.new("RGB", (width, height * len(shown)))
        for line, (label, frames) in enumerate(shown.items()):
            frame = Image.fromarray(frames[min(index, len(frames) - 1)])
            ImageDraw.Draw(frame).text((6, 4), label, fill="white", stroke_width=2, stroke_fill=0)
            image.paste(frame, (0, line * height))
        images.append(image)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_through(path, partial(write_gif, images, duration))
    return path


def gif_frames(count: int, dt: float) -> tuple[list[int], int]:
    """Which frames a real-time GIF shows, and how long each, ms.

    The format stores times in multiples of 10 ms, and players slow down frames below 20 ms.

    Args:
        count: number of all frames.
        dt: time between them, s.

    Examples:
        >>> gif_frames(4, 0.05)
        ([0, 1, 2, 3], 50)
        >>> gif_frames(6, 0.008)
        ([0, 2, 5], 20)
    """
    duration = max(20, 10 * round(100 * dt))
    per_image = duration / (1000 * dt)
    shown = max(1, math.ceil(count / per_image - 1e-6))
    return [min(count - 1, int(index * per_image + 1e-6)) for index in range(shown)], duration


def write_gif(images: Sequence[Image.Image], duration: int, file: IO[bytes]) -> None:
    """Write pictures as a looping GIF.

    Args:
        images: the pictures.
        duration: duration of each, ms.
        file: a file open for writing.
    """
    first, *others = images
    first.save(file, "GIF", save_all=True, append_images=others, duration=duration, loop=0)
