"""Films of episodes with L1 off or on, one or several side by side."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np
import torch
from matplotlib import pyplot
from matplotlib.animation import FuncAnimation
from PIL import Image, ImageDraw
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_l1.algorithms.collection import seed_streams, stream_seed
from torchrl_l1.atomic import write_atomically, write_through
from torchrl_l1.control import L1Transform
from torchrl_l1.deployment.learning import policy_transforms
from torchrl_l1.deployment.robust_controller import RobustController
from torchrl_l1.envs.references import making, require
from torchrl_l1.envs.rendering import draw_poses, gif_frames, rollout_frames, write_gif
from torchrl_l1.envs.vectors import simulation_of
from torchrl_l1.experiment.l1_options import OFF

SUFFIXES = (".mp4", ".gif")
"""Films that :func:`write_film` can write."""


@dataclass(frozen=True)
class Film:
    """An episode as images.

    Attributes:
        label: the text written on the frames.
        frames: RGB images ``(height, width, 3)``, uint8, one for each step.
        total: the undiscounted return.
        ended: whether the episode terminated, as in a fall.
    """

    label: str
    frames: Sequence[np.ndarray]
    total: float
    ended: bool


def film(
    robust: RobustController,
    l1: str,
    disturbances: Mapping[str, float],
    *,
    steps: int = 500,
    seed: int = 0,
    size: tuple[int, int] = (480, 360),
) -> Film:
    """Record an episode.

    MuJoCo environments are drawn off screen in a separate process, others by their ``render``.

    Args:
        robust: policy, model and environment.
        l1: ``"off"`` or one of the presets.
        disturbances: values by name.
        steps: number of steps after which the episode is cut off.
        seed: seed of reset and disturbances.
        size: width and height in pixels, for MuJoCo environments.

    Raises:
        RenderingUnavailable: if MuJoCo cannot draw here.
        ValueError: for an environment that cannot be drawn, or an unknown preset.
    """
    source = robust.source
    control: list[Transform] = policy_transforms(robust.policy, source.one)
    if l1 != OFF:
        control.append(L1Transform(robust.model, robust.settings(l1)))
    mujoco_ = source.task is not None or _physics(source.one()) is not None
    if not mujoco_ and not source.renders:
        raise ValueError(
            f"{source.name or 'the environment'} cannot be drawn: use one of Gymnasium or "
            "dm_control, or a built-in task"
        )
    options: dict[str, Any] = {} if mujoco_ else {"render_mode": "rgb_array"}
    env = source.single(disturbances, control, **options)
    shown: list[np.ndarray] = []

    def record(*_: object) -> None:
        shown.append(_pose(env) if mujoco_ else np.asarray(_unwrapped(env)._env.render()))

    with torch.random.fork_rng(devices=[]), torch.no_grad():
        env.set_seed(stream_seed(seed, "play") % 2**31)
        seed_streams(seed, "play")
        # Gymnasium asks for its rendering package only when it first draws.
        with set_exploration_type(ExplorationType.DETERMINISTIC), making(source.name):
            data = env.rollout(steps, robust.policy, callback=record)
    record()  # the last step, after which there is no callback
    ended = bool(data["next", "terminated"].any())
    frames = shown
    if source.task is not None:
        frames = rollout_frames(source.task, np.stack(shown), size=size)
    elif (physics := _physics(env)) is not None:
        frames = draw_poses(physics[0], np.stack(shown), size=size)
    words = "L1 off" if l1 == OFF else f"L1 {l1}"
    env.close()
    return Film(words, frames, float(data["next", "reward"].sum()), ended)


def _unwrapped(env: EnvBase) -> Any:
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def _physics(env: EnvBase) -> tuple[mujoco.MjModel, Any] | None:
    """MuJoCo's model and data behind an environment of Gymnasium or dm_control."""
    found = simulation_of(env)
    if found is not None:
        return found.model, found.data
    physics = getattr(getattr(_unwrapped(env), "_env", None), "physics", None)
    return None if physics is None else (physics.model.ptr, physics.data)


def _pose(env: EnvBase) -> np.ndarray:
    base = _unwrapped(env)
    if hasattr(base, "simulator_state"):
        pose: np.ndarray = base.simulator_state()[0][0]
        return pose
    physics = _physics(env)
    assert physics is not None
    return np.array(physics[1].qpos)


def side_by_side(films: Sequence[Film]) -> list[np.ndarray]:
    """Frames with the films beside each other, labelled; a shorter one holds its last frame.

    Examples:
        >>> black = [np.zeros((40, 60, 3), np.uint8)]
        >>> films = [Film("L1 off", black, 1.0, True), Film("L1 on", 3 * black, 3.0, False)]
        >>> frames = side_by_side(films)
        >>> len(frames), frames[0].shape
        (3, (40, 120, 3))
    """
    count = max(len(one.frames) for one in films)
    height = max(one.frames[0].shape[0] for one in films)
    widths = [one.frames[0].shape[1] for one in films]
    shown = []
    for index in range(count):
        image = Image.new("RGB", (sum(widths), height))
        left = 0
        for one, width in zip(films, widths, strict=True):
            over = index >= len(one.frames)
            frame = Image.fromarray(one.frames[-1 if over else index])
            label = one.label + f", ended after {len(one.frames)} steps" * (over and one.ended)
            ImageDraw.Draw(frame).text((6, 4), label, fill="white", stroke_width=2, stroke_fill=0)
            image.paste(frame, (left, 0))
            left += width
        shown.append(np.asarray(image))
    return shown


def check_film(file: Path | None) -> None:
    """Refuse, before any work, a film that cannot be written or shown here.

    Raises:
        ValueError: for another suffix, a missing package, or a machine without a display.
    """
    if file is None:
        if sys.platform == "linux" and not os.environ.keys() & {"DISPLAY", "WAYLAND_DISPLAY"}:
            raise ValueError("there is no display to open a window on: give --output FILE.mp4")
    elif file.suffix not in SUFFIXES:
        raise ValueError(f"{file} must end in {' or '.join(SUFFIXES)}")
    elif file.suffix == ".mp4":
        require("imageio_ffmpeg", "video")


def _in_real_time(frames: Sequence[np.ndarray], dt: float) -> tuple[list[np.ndarray], float]:
    """At most fifty frames per second, and the time of each in seconds."""
    every = max(1, round(0.02 / dt))
    return list(frames)[::every], dt * every


def write_film(frames: Sequence[np.ndarray], file: str | Path, dt: float) -> Path:
    """Write frames in real time, at no more than fifty per second.

    Args:
        frames: RGB images.
        file: ``.mp4``, which needs the extra ``video``, or ``.gif``.
        dt: time of a step in seconds.

    Returns:
        the file.
    """
    file = Path(file)
    check_film(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix == ".gif":
        indices, duration = gif_frames(len(frames), dt)
        images = [Image.fromarray(frames[index]) for index in indices]
        write_through(file, partial(write_gif, images, duration))
        return file
    frames, seconds = _in_real_time(frames, dt)
    ffmpeg = require("imageio_ffmpeg", "video")
    height, width = (side - side % 2 for side in frames[0].shape[:2])  # the format needs even sides
    with TemporaryDirectory() as folder:
        film = Path(folder, "film.mp4")
        writer = ffmpeg.write_frames(
            str(film), (width, height), fps=1 / seconds, macro_block_size=2
        )
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame[:height, :width]))
        writer.close()
        write_atomically(file, film.read_bytes())
    return file


def show_film(frames: Sequence[np.ndarray], dt: float, title: str) -> None:
    """Show frames in real time in a window until it is closed.

    Args:
        frames: RGB images.
        dt: time of a step in seconds.
        title: of the window.

    Raises:
        ValueError: if no window can be opened.
    """
    for backend in ("macosx", "TkAgg", "QtAgg", "GTK3Agg"):
        try:
            pyplot.switch_backend(backend)
            break
        except ImportError:
            continue
    else:
        raise ValueError(
            "no window toolkit is installed (such as python3-tk): give --output FILE.mp4"
        )
    frames, seconds = _in_real_time(frames, dt)
    height, width = frames[0].shape[:2]
    figure = pyplot.figure(title, figsize=(width / 100, height / 100), dpi=100)
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set_axis_off()
    image = axis.imshow(frames[0])

    def draw(index: int) -> list[Any]:
        image.set_data(frames[index])
        return [image]

    animation = FuncAnimation(figure, draw, len(frames), interval=1000 * seconds, blit=True)
    pyplot.show()
    del animation
