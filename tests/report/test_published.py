from __future__ import annotations

import csv
import lzma
import re
from pathlib import Path

import numpy as np
import pytest

from torchrl_l1.report.published import (
    CURVE_COLUMNS,
    ReferenceCurves,
    published_cell,
    published_cells,
)
from torchrl_l1.report.statistics import final_return, published_spread

SHARED = Path(__file__).parents[3] / "shared"
TABLES = SHARED / "reference" / "paper_tables.csv"
PAPER = SHARED / "paper.tex"
REFERENCE = Path(__file__).parents[2] / "docs/results/l1_metrpo_curves.csv.xz"
HEADER = ",".join(CURVE_COLUMNS)

TASKS = ("inverted_pendulum", "swimmer", "hopper", "walker", "half_cheetah")
NOISES = {"clean": "none", "action_0.1": "action", "obs_0.1": "observation"}
NOISES["action_0.1+obs_0.1"] = "both"
ARMS = {
    **dict.fromkeys(("metrpo", "mbmf"), ("off", "off")),
    **dict.fromkeys(("l1_metrpo", "l1_mbmf"), ("on", "on")),
    "l1_metrpo_train_only": ("on", "off"),
    "l1_metrpo_test_only": ("off", "on"),
}


def test_every_cell_is_there_with_numbers_and_source() -> None:
    cells = published_cells()
    assert len(cells) == 4 * 5 * 3 * 2
    for (table, *_), cell in cells.items():
        float(cell.mean)
        assert float(cell.std) >= 0
        assert cell.source == f"arXiv 2403.14860, Table {table}"


@pytest.mark.skipif(not TABLES.exists(), reason="no ../shared/reference/paper_tables.csv")
def test_cells_are_those_of_the_transcribed_tables() -> None:
    with TABLES.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(published_cells())
    for row in rows:
        table = row["table"][len("table")]
        train, test = ARMS[row["arm"]]
        if table == "2":
            train, test = "off", "on" if row["arm"] == "l1_metrpo" else "off"
        task = row["env"].removesuffix("2d")
        cell = published_cells()[table, task, NOISES[row["noise"]], train, test]
        assert (cell.mean, cell.std) == (row["mean"], row["std"])


@pytest.mark.skipif(not PAPER.exists(), reason="no ../shared/paper.tex")
def test_cells_are_those_of_the_papers_source() -> None:
    text = re.sub(r"(?<!\\)%.*", "", PAPER.read_text())
    tables = [
        t for t in re.findall(r"\\begin{tabular}.*?\\end{tabular}", text, re.S) if r"\pm" in t
    ]
    assert len(tables) == 4
    first = ["none", "action", "observation"]
    noises = {"1": first, "2": ["action", "observation", "both"], "4": first, "5": first}
    columns = {"1": ("off off", "on on"), "2": ("off off", "off on")}
    columns |= {"4": columns["1"], "5": ("on off", "off on")}
    for number, table in zip("1245", tables, strict=True):
        pairs = re.findall(r"(-?[\d.]+)\s*\\pm\s*(-?[\d.]+)", table)
        keys = [(task, noise, c) for task in TASKS for noise in noises[number] for c in (0, 1)]
        assert len(pairs) == len(keys)
        for pair, (task, noise, column) in zip(pairs, keys, strict=True):
            cell = published_cells()[(number, task, noise, *columns[number][column].split())]
            assert (cell.mean, cell.std) == pair


def test_known_errata_are_marked_and_nothing_else() -> None:
    marked = {key for key, cell in published_cells().items() if cell.erratum}
    expected = {("2", "inverted_pendulum", "action", "off", "off")}
    for noise in ("none", "action", "observation"):
        for arm in ("off", "on"):
            expected |= {("1", task, noise, arm, arm) for task in ("half_cheetah", "walker")}
    copied = ("swimmer", "hopper", "half_cheetah")
    expected |= {("4", task, "none", "off", "off") for task in copied}
    for noise in ("none", "action", "observation"):
        expected |= {("4", "walker", noise, arm, arm) for arm in ("off", "on")}
    assert marked == expected
    assert (
        "no return exceeds 0"
        in published_cells()["2", "inverted_pendulum", "action", "off", "off"].erratum
    )


def test_cells_are_found_by_training_and_test() -> None:
    def mean(*place: str) -> str | None:
        cell = published_cell(*place)
        return cell and cell.mean

    assert mean("swimmer", "action", "off", "action", "off") == "258.7"
    assert mean("swimmer", "action", "paper", "action", "paper") == "322.7"
    assert mean("swimmer", "action", "reference", "action", "reference") == "322.7"
    assert mean("swimmer", "none", "off", "action", "off") == "250.8"
    assert mean("swimmer", "none", "off", "both", "paper") == "327.3"
    assert mean("swimmer", "action", "paper", "action", "off") == "321.8"
    assert mean("swimmer", "action", "off", "action", "paper") == "298.9"
    assert mean("swimmer", "action", "slow", "action", "slow") is None
    assert mean("swimmer", "action", "off", "none", "off") is None
    assert mean("swimmer", "none", "paper", "action", "paper") is None
    assert mean("ant", "none", "off", "none", "off") is None
    # Of MBMF, the returns of the training are published, and no tests of frozen policies.
    assert mean("swimmer", "action", "off", "action", "off", "mbmf") == "304.8"
    assert mean("inverted_pendulum", "none", "paper", "none", "paper", "mbmf") == "-10.5"
    assert mean("swimmer", "action", "paper", "action", "off", "mbmf") is None
    assert mean("swimmer", "none", "off", "action", "off", "mbmf") is None
    assert mean("swimmer", "none", "off", "none", "off", "pets") is None


def write(path: Path, *rows: str) -> Path:
    path.write_text("\n".join([HEADER, *rows]) + "\n")
    return path


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
        (["L1_ON,Hopper,1,10,2,1", "L1_ON,Hopper,1,2,1,1"], "2 of L1_ON Hopper 1 comes after 10"),
        (2 * ["L1_ON,Hopper,1,0,1,1"], "iteration 0 of L1_ON Hopper 1 comes after 0"),
        (["L1_ON,Walker,1,0,1,-1,5"], "line 2: more values than the 6 columns"),
    ],
)
def test_unusable_curves_are_refused(tmp_path: Path, rows: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=r"curves\.csv") as error:
        ReferenceCurves(write(tmp_path / "curves.csv", *rows))
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (HEADER.encode(), "cannot read"),
        (lzma.compress(f"{HEADER}\nL1_ON,Walker,1,0,1,1\n".encode())[:-20], "cannot read"),
        (lzma.compress(b"\xff"), "cannot read"),
        (lzma.compress(bytes(200_000_001), preset=0), "holds more than 200000000 bytes"),
    ],
    ids=["not compressed", "torn", "no text", "too long"],
)
def test_unusable_compressed_curves_are_refused(
    tmp_path: Path, content: bytes, message: str
) -> None:
    (tmp_path / "curves.csv.xz").write_bytes(content)
    with pytest.raises(ValueError, match=r"curves\.csv\.xz") as error:
        ReferenceCurves(tmp_path / "curves.csv.xz")
    assert message in str(error.value)


def test_missing_column_and_file_are_named(tmp_path: Path) -> None:
    (tmp_path / "curves.csv").write_text("arm,seed\nL1_ON,1\n")
    with pytest.raises(ValueError, match="no column setting, iteration"):
        ReferenceCurves(tmp_path / "curves.csv")
    with pytest.raises(FileNotFoundError, match="elsewhere"):
        ReferenceCurves(tmp_path / "elsewhere.csv")
