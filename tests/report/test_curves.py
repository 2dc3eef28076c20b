from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from torchrl_l1.report import curves
from torchrl_l1.report.curves import Line, Panel, main_lines
from torchrl_l1.report.runs import find_runs
from torchrl_l1.report.study import Study, studies
from torchrl_l1.report.style import save

WriteRun = Callable[..., Path]


@pytest.mark.parametrize(
    ("recipe", "expected"),
    [("offline/inverted_pendulum", [1, 2, 3]), ("metrpo/inverted_pendulum", [5, 7.5, 10])],
)
def test_what_learns_from_data_that_stay_the_same_is_drawn_over_its_iterations(
    recipe: str, expected: list[float], write_run: WriteRun, tmp_path: Path
) -> None:
    write_run([-3.0, -2.0, -1.0], "l1=off", recipe=recipe)
    ((_, lines),) = main_lines(Study(find_runs([tmp_path])), "inverted_pendulum")
    panel = Panel("", lines)
    assert panel.offline == recipe.startswith("offline")
    (run,) = lines[0].runs
    np.testing.assert_allclose(panel.along(run), expected)


def test_beside_others_it_is_drawn_over_real_steps(write_run: WriteRun, tmp_path: Path) -> None:
    for recipe in ("offline/inverted_pendulum", "metrpo/inverted_pendulum"):
        write_run([-3.0, -2.0], "l1=off", recipe=recipe)
    lines = lines_of(tmp_path)
    assert len(lines) == 2 and not Panel("", lines).offline


def lines_of(folder: Path) -> list[Line]:
    """Of all algorithms' runs."""
    return [
        line
        for one in studies(find_runs([folder]))
        for _, found in main_lines(one, "inverted_pendulum")
        for line in found
    ]


@pytest.mark.parametrize(("finished", "scale"), [(False, "linear"), (True, "log")])
def test_a_run_that_has_just_begun_changes_no_axis(
    finished: bool,
    scale: str,
    write_run: WriteRun,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_run([-3.0] * 20, "l1=off")
    if finished:
        write_run([-3.0] * 2, "l1=off", recipe="pets/inverted_pendulum")
    else:
        write_run([-3.0] * 2, "l1=paper", iterations=20)
    lines = lines_of(tmp_path)
    assert len(lines) == 2
    figures: list[Figure] = []

    def keep(figure: Figure, file: Path) -> Path:
        figures.append(figure)
        return save(figure, file)

    monkeypatch.setattr(curves, "save", keep)
    assert curves.plot_panels([Panel("", lines)], tmp_path / "curves.png")
    (axis,) = figures[0].axes
    assert axis.get_xscale() == scale
    labels = [text.get_text() for minor in (False, True) for text in axis.get_xticklabels(minor)]
    assert any(labels) and not any("$" in label for label in labels)


def test_a_line_without_a_finished_run_is_in_the_legend(
    write_run: WriteRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_run([-3.0] * 2, "l1=off", iterations=20)
    write_run([-3.0] * 20, "l1=paper")
    figures: list[Figure] = []
    monkeypatch.setattr(curves, "save", lambda figure, _: figures.append(figure))
    curves.plot_panels([Panel("", lines_of(tmp_path))], tmp_path / "curves.png")
    (legend,) = figures[0].legends
    entries = {
        text.get_text(): handle.get_color()
        for text, handle in zip(legend.get_texts(), legend.legend_handles, strict=True)
    }
    assert {"L1 off", "L1 paper", "unfinished run"} <= set(entries)
    assert entries["L1 off"] != entries["L1 paper"]


def test_every_point_of_the_figures_is_in_a_table(write_run: WriteRun, tmp_path: Path) -> None:
    write_run([-3.0, -2.0, -1.0], "l1=off")
    write_run([-4.0, -2.5, 0.1], "l1=paper", seed=3)
    rows = curves.curve_rows(Study(find_runs([tmp_path])))
    shown = [
        (row["l1"], row["seed"], row["iteration"], row["real_steps"], row["return"]) for row in rows
    ]
    assert shown == [
        ("off", 0, 0, 5000, -3.0),
        ("off", 0, 1, 7500, -2.0),
        ("off", 0, 2, 10000, -1.0),
        ("paper", 3, 0, 5000, -4.0),
        ("paper", 3, 1, 7500, -2.5),
        ("paper", 3, 2, 10000, 0.1),
    ]
    assert all(row["task"] == "inverted_pendulum" and row["noise"] == "none" for row in rows)
