from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.animation import FuncAnimation
from PIL import Image

from torchrl_l1.cli import main
from torchrl_l1.deployment import play
from torchrl_l1.envs.rendering import RenderingUnavailable


def flat(value: int, count: int, label: str = "", ended: bool = False) -> play.Film:
    frames = [np.full((60, 200, 3), value, np.uint8) for _ in range(count)]
    return play.Film(label, frames, float(count), ended)


def test_the_shorter_film_holds_its_last_frame():
    frames = play.side_by_side([flat(50, 2, "L1 off", ended=True), flat(90, 4)])
    assert len(frames) == 4
    assert all(frame.shape == (60, 400, 3) for frame in frames)
    assert all(
        (frame[40:, :200] == 50).all() and (frame[40:, 200:] == 90).all() for frame in frames
    )
    assert (frames[3][:40] != frames[1][:40]).any()  # it says that it has ended


def test_films_run_in_real_time(tmp_path):
    frames = [np.full((20, 20, 3), 10 * k, np.uint8) for k in range(20)]
    # Hopper's 0.008 s and 0.025 s are no multiples of the times that a GIF can have.
    for dt, count in ((0.04, 20), (0.01, 10), (0.005, 5), (0.008, 8), (0.025, 25)):
        file = play.write_film(frames, tmp_path / "film.gif", dt)
        with Image.open(file) as image:
            duration = 0
            for index in range(image.n_frames):
                image.seek(index)
                duration += image.info["duration"]
            assert image.n_frames <= count and duration == pytest.approx(1000 * 20 * dt, abs=1)


def test_films_as_mp4(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    file = play.write_film(play.side_by_side([flat(200, 25)]), tmp_path / "film.mp4", 0.04)
    meta = next(ffmpeg.read_frames(str(file)))
    assert meta["size"] == (200, 60) and meta["fps"] == 25


def test_what_cannot_be_shown_is_refused_at_once(monkeypatch, tmp_path):
    with pytest.raises(ValueError, match="must end in"):
        play.check_film(tmp_path / "film.avi")
    monkeypatch.setattr(play.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ValueError, match="no display"):
        play.check_film(None)


def test_the_place_of_a_film_is_looked_at_before_work(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    (tmp_path / "film.gif").mkdir()
    command = import_module("torchrl_l1.cli.play")
    monkeypatch.setattr(command, "load_target", lambda *_, **__: SimpleNamespace(preset="robust"))
    monkeypatch.setattr(command, "film", None)
    for place in ("file/film.gif", "film.gif"):
        with pytest.raises(SystemExit):
            main(["play", "runs/a", "--output", str(tmp_path / place)])
        assert "move it away" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--l1=robust", "--compare"])
def test_a_policy_in_an_environment_has_no_l1(option, policy_file, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(import_module("torchrl_l1.cli.play"), "film", None)
    film = str(tmp_path / "film.gif")
    with pytest.raises(SystemExit):
        main(["play", "inverted_pendulum", "--policy", f"{policy_file}:balance", option,
              "--output", film])  # fmt: skip
    assert "has no L1: robustify it first" in capsys.readouterr().err


def test_a_film_of_an_episode(robust):
    try:
        films = [
            play.film(robust, l1, {"bias": 1.0}, steps=12, size=(80, 60))
            for l1 in ("off", "robust")
        ]
    except RenderingUnavailable as error:
        pytest.skip(f"this machine has no off-screen OpenGL: {error}")
    off, on = films
    assert (off.label, on.label) == ("L1 off", "L1 robust")
    assert off.frames[0].shape == (60, 80, 3)
    # One for each step, the last included; with a reward of one in each that does not fall.
    assert len(off.frames) == 12
    # L1 cancels the bias: the two part.
    assert (off.frames[-1] != on.frames[-1]).any() and off.total < on.total


def test_poses_of_gymnasiums_own_environments(robust):
    from torchrl_l1.deployment import environment_source

    env = environment_source("InvertedPendulum-v5").single(seed=0)
    data = env.reset()
    # Its observation begins with the positions.
    np.testing.assert_allclose(play._pose(env), data["observation"][:2].numpy(), rtol=1e-6)
    assert play._physics(env)[0].nq == 2
    assert play._physics(environment_source("Pendulum-v1").one()) is None


class Watched(FuncAnimation):
    """An animation that a test can wind on."""

    def __init__(self, *arguments, **options) -> None:
        super().__init__(*arguments, **options)
        Watched.last = self


def watching(monkeypatch, count: int) -> list[int]:
    """A viewer that looks at so many frames, as gray values, before it closes the window."""
    seen = []

    def look() -> None:
        figure = play.pyplot.gcf()
        figure.canvas.draw()
        for _ in range(count):
            seen.append(int(figure.axes[0].images[0].get_array()[30, 30, 0]))
            Watched.last._step()
        play.pyplot.close(figure)

    monkeypatch.setattr(play, "FuncAnimation", Watched)
    switch = play.pyplot.switch_backend
    monkeypatch.setattr(play.pyplot, "switch_backend", lambda backend: switch("Agg"))
    monkeypatch.setattr(play.pyplot, "show", look)
    return seen


@pytest.mark.parametrize(("dt", "every", "interval"), [(0.04, 1, 40), (0.005, 4, 20)])
def test_a_window_shows_the_film_in_real_time(monkeypatch, dt, every, interval):
    seen = watching(monkeypatch, 5)
    frames = [np.full((60, 200, 3), 10 * k, np.uint8) for k in range(20)]
    play.show_film(frames, dt, "pendulum")
    # The first frame is drawn twice, by the canvas and as the animation begins.
    assert list(dict.fromkeys(seen))[:4] == [10 * every * k for k in range(4)]
    assert Watched.last.event_source.interval == interval


def test_the_command_opens_a_window(robust, policy_file, tmp_path, monkeypatch, capsys):
    replace(robust, origin={"policy": f"{policy_file}:balance"}).save(tmp_path / "controller")
    monkeypatch.setenv("DISPLAY", ":0")
    seen = watching(monkeypatch, 3)
    arguments = ["play", str(tmp_path), "--trust", "--bias", "1", "--compare", "--steps", "5"]
    try:
        main(arguments)
    except SystemExit:
        if "off-screen" in (message := capsys.readouterr().err):
            pytest.skip(message)
        raise
    assert len(seen) == 3
    printed = capsys.readouterr().out
    assert "L1 off: return" in printed and "L1 robust: return" in printed
