from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from torchrl_l1.envs import rendering
from torchrl_l1.envs.rendering import (
    RenderingUnavailable,
    animation,
    filmstrip,
    rollout_frames,
)


def _flat(value: int, count: int) -> list[np.ndarray]:
    return [np.full((30, 40, 3), value, dtype=np.uint8) for _ in range(count)]


def _pole_pixels(frame: np.ndarray) -> np.ndarray:
    red, green, blue = frame.astype(int).transpose(2, 0, 1)
    return np.argwhere((green > red + 40) & (blue > red + 40))


def test_frames_show_the_tilt_of_the_pole():
    poses = np.array([[0.0, 0.0], [0.0, 0.8], [0.0, -0.8]])
    try:
        frames = rollout_frames("inverted_pendulum", poses, size=(160, 120))
    except RenderingUnavailable as error:
        pytest.skip(f"this machine has no off-screen OpenGL: {error}")
    assert [frame.shape for frame in frames] == [(120, 160, 3)] * 3
    assert all(frame.dtype == np.uint8 for frame in frames)
    assert (frames[0][0, 0] > 150).all()  # a light background
    upright, right, left = (_pole_pixels(frame) for frame in frames)
    assert len(upright) > 50
    assert np.ptp(upright[:, 0]) > 3 * np.ptp(upright[:, 1])  # tall and thin
    assert right[:, 1].mean() > upright[:, 1].mean() + 3
    assert left[:, 1].mean() < upright[:, 1].mean() - 3


def test_a_machine_without_opengl_gets_a_clear_error(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "no-such-backend")
    with pytest.raises(RenderingUnavailable, match=r"Tried no-such-backend: .*MUJOCO_GL"):
        rollout_frames("inverted_pendulum", np.zeros((1, 2)))


def test_backends(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(rendering.sys, "platform", "linux")
    assert rendering._backends() == ["egl", "osmesa"]
    monkeypatch.setenv("DISPLAY", ":0")
    assert rendering._backends() == ["egl", "osmesa", "glfw"]
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert rendering._backends() == ["osmesa"]


def test_wrong_poses():
    with pytest.raises(ValueError, match=r"\(3, 4\), expected \(T, 2\)"):
        rollout_frames("inverted_pendulum", np.zeros((3, 4)))


def test_filmstrip(tmp_path):
    rows = {"L1 off": _flat(10, 9), "L1 on": _flat(200, 5)}
    path = filmstrip(rows, tmp_path / "new" / "strip.png", every=2, dt=0.04)
    image = np.asarray(Image.open(path).convert("L"))
    # Five dark cells of the first row, three light ones of the second, nothing beyond.
    dark = (image == 10).sum(0) > 40
    light = (image == 200).sum(0) > 40
    assert np.count_nonzero(np.diff(dark.astype(int)) == 1) == 5
    assert np.count_nonzero(np.diff(light.astype(int)) == 1) == 3
    assert (image == 10).any(1).argmax() < (image == 200).any(1).argmax()


def test_animation(tmp_path):
    rows = {"off": _flat(10, 6), "on": [*_flat(100, 2), *_flat(200, 1)]}
    path = animation(rows, tmp_path / "new" / "rollout.gif", dt=0.05)
    with Image.open(path) as image:
        assert image.size == (40, 60)
        lows, duration = [], 0
        for index in range(image.n_frames):
            image.seek(index)
            duration += image.info["duration"]
            pixels = np.asarray(image.convert("L")).astype(int)
            assert abs(pixels[25, 35] - 10) <= 2
            lows.append(pixels[55, 35])
    assert duration == 6 * 50  # the format merges equal frames
    assert abs(lows[0] - 100) <= 2 and abs(lows[-1] - 200) <= 2


@pytest.mark.parametrize("dt", [0.001, 0.008, 0.016, 0.025, 0.05])
def test_animations_of_any_step_take_the_time_that_they_show(tmp_path, dt):
    rows = {"off": [np.full((30, 40, 3), 2 * k, np.uint8) for k in range(100)]}
    with Image.open(animation(rows, tmp_path / "a.gif", dt=dt)) as image:
        duration = 0
        for index in range(image.n_frames):
            image.seek(index)
            duration += image.info["duration"]
    assert abs(duration - 1000 * 100 * dt) <= 20


@pytest.mark.parametrize("draw", [filmstrip, animation])
def test_bad_rows(draw, tmp_path):
    good = _flat(1, 2)
    other = [np.zeros((10, 10, 3), dtype=np.uint8)]
    for rows in ({}, {"a": []}, {"a": good, "b": []}, {"a": good, "b": other}):
        with pytest.raises(ValueError, match="at least one frame"):
            draw(rows, tmp_path / "x")
    with pytest.raises(ValueError, match="every must be at least 1"):
        draw({"a": good}, tmp_path / "x", every=0)
    assert not list(tmp_path.iterdir())
