"""The records of campaigns: what goes into them comes out of them, and makes the same reports."""

from __future__ import annotations

import csv
import importlib.util
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from torchrl_l1.report.runs import find_runs

RESULTS = Path(__file__).parents[1] / "docs/results"
NAME = "mbmf_rest"


@pytest.fixture
def records(tmp_path: Path) -> ModuleType:
    """The script as it is beside a copy of one campaign's records."""
    results = tmp_path / "results"
    (results / NAME).mkdir(parents=True)
    shutil.copy(RESULTS / "records.py", results)
    shutil.copy(RESULTS / NAME / "records.tar.xz", results / NAME)
    spec = importlib.util.spec_from_file_location("copied_records", results / "records.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def unpack(records: ModuleType, tmp_path: Path) -> Callable[[], Path]:
    def unpacked() -> Path:
        folder = tmp_path / "runs" / NAME
        shutil.rmtree(folder, ignore_errors=True)
        records.unpack(NAME, folder)
        return folder

    return unpacked


def contents(folder: Path) -> dict[str, bytes]:
    files = (file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


@pytest.mark.parametrize("name", sorted(f.parent.name for f in RESULTS.glob("*/records.tar.xz")))
def test_records_are_of_the_finished_runs_of_the_committed_report(
    name: str, tmp_path: Path, records: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(records, "HERE", RESULTS)
    records.unpack(name, tmp_path / name)
    found = {str(run.path.relative_to(tmp_path / name)): run for run in find_runs([tmp_path])}
    with (RESULTS / name / "runs.csv").open(newline="") as file:
        finished = [row for row in csv.DictReader(file) if row["iterations"] == row["of"]]
    rows = {row["path"].partition(f"/{name}/")[2]: row for row in finished}
    assert found.keys() == rows.keys()
    for path, run in found.items():
        assert run.finished
        assert float(rows[path]["return"]) == pytest.approx(run.final, rel=1e-7)


def test_packing_again_changes_nothing(records: ModuleType, unpack: Callable[[], Path]) -> None:
    archive = records.HERE / NAME / "records.tar.xz"
    before = archive.read_bytes()
    count = records.pack(NAME, [unpack()])
    assert archive.read_bytes() == before
    assert count == len(find_runs([unpack()]))


def test_new_runs_join_those_that_are_there_and_weights_stay_behind(
    records: ModuleType, unpack: Callable[[], Path], tmp_path: Path
) -> None:
    folder = unpack()
    every = contents(folder)
    first, second, *others = (run.path for run in find_runs([folder]))
    (first / "model.pt").write_bytes(b"weights")
    (first / ".lock").touch()
    elsewhere = tmp_path / "elsewhere" / NAME / second.relative_to(folder)
    shutil.copytree(second, elsewhere)
    shutil.rmtree(second)
    (records.HERE / NAME / "records.tar.xz").unlink()
    assert records.pack(NAME, [elsewhere]) == 1
    assert records.pack(NAME, [folder]) == 2 + len(others)
    assert contents(unpack()) == every


def test_a_run_that_was_trained_again_takes_the_place_of_its_record(
    records: ModuleType, unpack: Callable[[], Path]
) -> None:
    run = find_runs([unpack()])[0].path
    metrics = run / "metrics.csv"
    again = metrics.read_text().replace("1.", "2.")
    metrics.write_text(again)
    shutil.rmtree(run / "evaluations", ignore_errors=True)
    records.pack(NAME, [run])
    folder = unpack()
    assert (folder / metrics.relative_to(folder)).read_text() == again
    assert not (run / "evaluations").exists()


def test_records_do_not_tell_where_runs_were_trained(
    records: ModuleType, unpack: Callable[[], Path]
) -> None:
    run = find_runs([unpack()])[0].path
    config = run / "config.yaml"
    config.write_text(re.sub("run_dir: .*", f"run_dir: {run}", config.read_text()))
    (run / "timing.csv").write_text(f"iteration\n{run},0\n")
    records.pack(NAME, [run])
    place = f"runs/campaigns/{NAME}/{run.relative_to(run.parents[4])}"
    packed = [file.read_text() for file in unpack().rglob("*") if file.is_file()]
    assert not any(str(run) in text for text in packed)
    assert any(f"run_dir: {place}\n" in text for text in packed)


def test_unfinished_runs_are_not_packed(records: ModuleType, unpack: Callable[[], Path]) -> None:
    run = find_runs([unpack()])[0]
    metrics = run.path / "metrics.csv"
    before = metrics.read_text()
    metrics.write_text("".join(before.splitlines(keepends=True)[:-1]))
    records.pack(NAME, [run.path])
    unpack()
    assert metrics.read_text() == before


def test_runs_of_another_campaign_are_refused(
    records: ModuleType, unpack: Callable[[], Path], tmp_path: Path
) -> None:
    run = find_runs([unpack()])[0].path
    other = tmp_path / "runs" / "other" / "seed_0"
    shutil.copytree(run, other)
    with pytest.raises(SystemExit, match="lies in no folder mbmf_rest"):
        records.pack(NAME, [other])


def test_places_do_not_depend_on_what_folders_are_called(
    records: ModuleType, tmp_path: Path
) -> None:
    place = Path("mbmf/swimmer/l1=off/seed_0")
    outer = tmp_path / "mbmf" / "runs" / "campaigns" / "mbmf" / place
    assert records.behind("mbmf", outer, "mbmf/swimmer") == place
    other = tmp_path / "first" / place
    with pytest.raises(SystemExit, match="lies in no folder mbmf/mbmf/swimmer"):
        records.behind("mbmf", other, "mbmf/swimmer")
    other.mkdir(parents=True)
    (tmp_path / "first/campaign.yaml").write_text("name: mbmf\n")
    assert records.behind("mbmf", other, "mbmf/swimmer") == place


def test_the_first_folders_description_counts_and_damaged_tables_stop_nothing(
    records: ModuleType, unpack: Callable[[], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = unpack()
    description = (folder / "campaign.yaml").read_text() + "# changed\n"
    (folder / "campaign.yaml").write_text(description)
    run = next(run for run in find_runs([folder]) if run.evaluations)
    (damaged,) = (run.path / "evaluations").glob("*.csv")
    damaged.write_text("l1\n")
    records.pack(NAME, [folder])
    assert f"left out: {damaged}" in capsys.readouterr().err
    packed = unpack()
    assert (packed / "campaign.yaml").read_text() == description
    assert not damaged.exists() and (run.path / "metrics.csv").exists()


@pytest.mark.parametrize("words", [["pack"], ["pack", NAME], ["no_such_campaign"]])
def test_wrong_words_are_refused(
    records: ModuleType, words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["records.py", *words])
    with pytest.raises(SystemExit, match="usage: "):
        records.main()
