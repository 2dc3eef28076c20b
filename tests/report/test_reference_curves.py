from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from torchrl_l1.report.published import COLUMNS, ReferenceCurves, published_cells
from torchrl_l1.report.statistics import final_return, published_spread

REFERENCE = Path(__file__).parents[3] / "shared" / "reference" / "l1_metrpo_curves.csv"
HEADER = ",".join(COLUMNS)


def write(path: Path, *rows: str) -> Path:
    path.write_text("\n".join([HEADER, *rows]) + "\n")
    return path


@pytest.mark.skipif(not REFERENCE.exists(), reason="no ../shared/reference/l1_metrpo_curves.csv")
def test_the_published_rule_reproduces_the_printed_table() -> None:
    curves = ReferenceCurves(REFERENCE)
    checked = 0
    for (table, task, noise, trained, _), cell in published_cells().items():
        if table != "1":
            continue
        found = curves.training(task, noise, "paper" if trained == "on" else "off")
        assert found is not None and len(found.returns) == 4
        mean, spread = final_return(found.returns).mean(), published_spread(found.returns)
        close = abs(mean - float(cell.mean)) < 0.11 and abs(spread - float(cell.std)) < 0.11
        assert close == (task != "half_cheetah"), (task, noise, trained)
        if task == "half_cheetah":
            assert f"{mean:.0f} ± {spread:.0f}" in cell.erratum
        checked += 1
    assert checked == 30


@pytest.mark.skipif(not REFERENCE.exists(), reason="no ../shared/reference/l1_metrpo_curves.csv")
def test_reference_steps_count_all_real_steps() -> None:
    curves = ReferenceCurves(REFERENCE).training("half_cheetah", "none", "off")
    assert curves is not None
    # 6 episodes of 1000 random steps, then 6 per iteration.
    np.testing.assert_array_equal(curves.real_steps[0], 6000 * np.arange(2, 35))
    affine = ReferenceCurves(REFERENCE).model_form("half_cheetah", "affine")
    assert affine is not None and affine.returns.shape == (4, 33)


def test_settings_are_understood_and_absent_ones_are_none(tmp_path: Path) -> None:
    file = write(
        tmp_path / "curves.csv",
        "L1_ON,Walker_Action_Noise,1,0,8000,-7",
        "L1_ON,Walker_Action_Noise,1,1,12000,-5",
        "nl_vs_ca,Inverted_Pendulum_ca,3,0,3332,-90",
    )
    curves = ReferenceCurves(file)
    found = curves.training("walker", "action", "reference")
    assert found is not None
    assert found.returns.tolist() == [[-7.0, -5.0]]
    assert found.real_steps.tolist() == [[12000.0, 18000.0]]
    assert curves.training("walker", "action", "off") is None
    affine = curves.model_form("inverted_pendulum", "affine")
    assert affine is not None and affine.returns.tolist() == [[-90.0]]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (["L1_ON,Humanoid,1,0,1,1"], "unknown arm and setting 'L1_ON', 'Humanoid'"),
        (["L1_ON,Walker,1,0,1,nan"], "line 2: average_return is 'nan'"),
        (["L1_ON,Walker,1,0,1,1", "L1_ON,Walker,1,1"], "line 3: total_train_samples is None"),
        (["L1_ON,Hopper,1,0,1,1", "L1_ON,Hopper,1,1,2,1", "L1_ON,Hopper,2,0,1,1"], "in length"),
    ],
)
def test_unusable_curves_are_refused(tmp_path: Path, rows: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=r"curves\.csv") as error:
        ReferenceCurves(write(tmp_path / "curves.csv", *rows))
    assert message in str(error.value)


def test_missing_column_and_file_are_named(tmp_path: Path) -> None:
    (tmp_path / "curves.csv").write_text("arm,seed\nL1_ON,1\n")
    with pytest.raises(ValueError, match="no column setting, iteration"):
        ReferenceCurves(tmp_path / "curves.csv")
    with pytest.raises(FileNotFoundError, match="elsewhere"):
        ReferenceCurves(tmp_path / "elsewhere.csv")
