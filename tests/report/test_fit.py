from __future__ import annotations

import math
from pathlib import Path

import pytest

from torchrl_l1.dynamics import FitQuality
from torchrl_l1.report import draw_fit_quality, fit


def test_a_panel_per_entry_with_its_errors_and_its_spread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    quality = FitQuality(
        names=("angle", "rate", "still"),
        units=("rad", "rad/s", ""),
        spread=(1.0, 2.0, 0.0),
        change=(0.1, 0.2, 0.0),
        rmse=(0.01, 0.02, 0.0),
        explained=(0.99, 0.98, math.nan),
        open_loop={10: (0.1, 0.3, 0.0), 50: (math.nan, math.inf, 0.0)},
        gain_spread=0.1,
        input_error=(0.2,),
        training=90,
        validation=10,
        dropped=0,
    )
    drawn = []
    monkeypatch.setattr(fit, "save", lambda figure, file: drawn.append(figure) or file)
    assert draw_fit_quality(quality, tmp_path / "quality.png") == tmp_path / "quality.png"
    panels = drawn[0].axes
    assert [panel.get_title() for panel in panels] == ["angle (rad)", "rate (rad/s)", "still"]
    error, spread = panels[0].get_lines()
    assert list(error.get_xdata()) == [1, 10] and list(error.get_ydata()) == [0.01, 0.1]
    assert set(spread.get_ydata()) == {1.0}
    assert list(panels[2].get_lines()[0].get_xdata()) == [1, 10, 50]
    assert [panel.get_yscale() for panel in panels] == ["log", "log", "linear"]
    monkeypatch.undo()
    fit.save(drawn[0], tmp_path / "quality.png")
    ticks = [label.get_text() for label in panels[0].get_yticklabels()]
    assert "0.1" in ticks and not any("$" in tick for tick in ticks)  # formulas are off
    assert draw_fit_quality(quality, tmp_path / "quality.png").stat().st_size > 1000
