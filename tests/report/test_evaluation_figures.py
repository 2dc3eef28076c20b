"""Ablation bars and disturbance charts: what is drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from torchrl_l1.report import evaluation_figures
from torchrl_l1.report.algorithms import facts
from torchrl_l1.report.evaluation_figures import plot_disturbances

METRPO, MBMF = facts("metrpo"), facts("mbmf")


def row(l1: str, bias: float = 0.0, gain: float = 1.0, **values: Any) -> dict[str, Any]:
    return {"l1": l1, "noise": "none", "bias": bias, "gain": gain, "policy": "stochastic", **values}


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    figures: list[Figure] = []
    save = evaluation_figures.save
    monkeypatch.setattr(
        evaluation_figures,
        "save",
        lambda figure, file: (figures.append(figure), save(figure, file))[1],
    )
    return figures


def test_each_return_stands_above_what_l1_adds_to_it(drawn: list[Figure], tmp_path: Path) -> None:
    rows = [
        *(row("off", bias=bias, return_mean=-100 * bias) for bias in (0.0, 0.5, 1.0)),
        *(
            row(
                "paper",
                bias=bias,
                return_mean=-bias,
                difference_mean=99 * bias,
                difference_low=90 * bias,
                difference_high=108 * bias,
            )
            for bias in (1.0, 0.0, 0.5)
        ),
        *(row("off", gain=gain, return_mean=-1 / gain) for gain in (0.5, 2.0)),
    ]
    assert (
        plot_disturbances(rows, "Task", tmp_path / "figure.png", METRPO) == tmp_path / "figure.png"
    )
    bias, gain, difference, _ = drawn[0].axes
    assert [axis.get_xlabel()[:13] for axis in (bias, gain)] == ["actuator bias", "actuator gain"]
    off, paper = bias.lines
    assert list(off.get_ydata()) == [0, -50, -100]
    assert list(paper.get_ydata()) == [0, -0.5, -1]
    (added,) = [line for line in difference.lines if line.get_marker() == "o"]
    assert list(added.get_xdata()) == [0, 0.5, 1]
    assert list(added.get_ydata()) == [0, 49.5, 99]
    assert difference.get_ylabel() == "return, less that with L1 off"
    # Returns between 0 and far below are shown on a logarithmic scale, differences never.
    assert (bias.get_yscale(), difference.get_yscale()) == ("symlog", "linear")


def test_limits_beyond_what_a_return_can_be_change_no_scale(
    drawn: list[Figure], tmp_path: Path
) -> None:
    rows = [
        row("off", bias=bias, return_mean=-60 * bias, return_low=-130 * bias, return_high=10 * bias)
        for bias in (0.0, 1.0)
    ]
    plot_disturbances(rows, "Task", tmp_path / "figure.png", METRPO)
    (axis,) = drawn[0].axes
    assert axis.get_yscale() == "symlog"
    assert axis.get_ylim()[0] < -130


def test_nothing_varied_draws_nothing(tmp_path: Path) -> None:
    assert (
        plot_disturbances([row("off", return_mean=1.0)], "Task", tmp_path / "x.png", METRPO) is None
    )
    assert not (tmp_path / "x.png").exists()
