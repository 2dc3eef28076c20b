from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from torchrl_l1.report.curves import Panel, main_lines
from torchrl_l1.report.runs import find_runs
from torchrl_l1.report.study import Study, studies

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
    lines = [
        line
        for one in studies(find_runs([tmp_path]))
        for _, found in main_lines(one, "inverted_pendulum")
        for line in found
    ]
    assert len(lines) == 2 and not Panel("", lines).offline
