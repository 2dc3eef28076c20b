"""Files in W&B's format that are cut, damaged, of another run or of none."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from wandb.proto import wandb_internal_pb2

from tests import wandb_files as independent
from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.experiment.wandb_files import (
    ID_FILE,
    draw_id,
    has_ended,
    known_id,
    take_over,
    whole_records,
)

BLOCK, HEAD = 32_768, 7
METRICS = [{"iteration": i, "return_mean": -1.5 / (i + 1), "l1/u_a": 0.1 * i} for i in range(4)]
RUN = "0123456789ab"


def framed(records: Sequence[bytes]) -> bytes:
    """A LevelDB log, as its specification says it is written."""
    content = b":W&B" + (0xBEE1).to_bytes(2, "little") + b"\0"
    for record in records:
        rest, begun = record, False
        while rest or not begun:
            left = BLOCK - len(content) % BLOCK
            if left < HEAD:
                content += bytes(left)
                left = BLOCK
            part, rest = rest[: left - HEAD], rest[left - HEAD :]
            kind = (4 if begun else 1) if not rest else (3 if begun else 2)
            checksum = zlib.crc32(bytes([kind]) + part)
            content += checksum.to_bytes(4, "little") + len(part).to_bytes(2, "little")
            content += bytes([kind]) + part
            begun = True
    return content


def run_record(start: int = 1, run: str = RUN) -> bytes:
    record = wandb_internal_pb2.Record()
    record.run.run_id = run
    record.run.start_time.seconds = start
    return record.SerializeToString()


def history(row: Mapping[str, Any], step: int) -> bytes:
    record = wandb_internal_pb2.Record()
    record.history.step.num = step
    for key, value in row.items():
        item = record.history.item.add()
        item.key, item.value_json = key, json.dumps(value)
    return record.SerializeToString()


def end_record() -> bytes:
    record = wandb_internal_pb2.Record()
    record.exit.exit_code = 0
    return record.SerializeToString()


def written(folder: Path, records: Sequence[bytes], number: int = 0, run: str = RUN) -> Path:
    file = folder / "wandb" / f"offline-run-20260101_00000{number}-{run}" / f"run-{run}.wandb"
    file.parent.mkdir(parents=True)
    file.write_bytes(framed(records))
    return file


def lines() -> tuple[list[str], Any]:
    said: list[str] = []
    return said, said.append


records = st.lists(st.binary(max_size=40_000), max_size=3)


@settings(max_examples=30)
@given(records)
def test_what_is_written_is_read(content: list[bytes]) -> None:
    raw = framed(content)
    found = list(whole_records(raw))
    assert [record for record, _ in found] == content == independent.records(raw)[0]
    if found:
        assert found[-1][1] == len(raw)


@settings(max_examples=50)
@given(records, st.data())
def test_of_a_cut_or_damaged_file_the_first_records_are_read(
    content: list[bytes], data: st.DataObject
) -> None:
    raw = framed(content)
    position = data.draw(st.integers(HEAD, len(raw)))
    if data.draw(st.booleans()):
        raw = raw[:position]
    elif position < len(raw):
        flipped = raw[position] ^ data.draw(st.integers(1, 255))
        raw = raw[:position] + bytes([flipped]) + raw[position + 1 :]
    found = list(whole_records(raw))
    assert [record for record, _ in found] == content[: len(found)]
    end = found[-1][1] if found else HEAD
    assert independent.records(raw[:end]) == (content[: len(found)], "")


def test_a_torn_file_is_cut_to_its_last_whole_record(tmp_path: Path) -> None:
    rows = [history(row, i) for i, row in enumerate(METRICS[:3])]
    file = written(tmp_path, [run_record(), *rows])
    whole = file.read_bytes()
    said, say = lines()
    for cut in (1, 20, len(framed([b""]))):
        file.write_bytes(whole[:-cut])
        held = take_over(tmp_path, METRICS, say)
        assert (held.run, list(held.rows), held.next_step) == (RUN, [0, 1], 2)
        assert file.read_bytes() == framed([run_record(), *rows[:2]])
    assert not said and (tmp_path / ID_FILE).read_text() == f"{RUN}\n"


def test_a_process_that_outlives_a_kill_writes_to_no_file_of_the_run(tmp_path: Path) -> None:
    file = written(tmp_path, [run_record(), history(METRICS[0], 0)])
    before = file.read_bytes()
    with file.open("ab") as late:
        take_over(tmp_path, METRICS, print)
        late.write(framed([b"", history(METRICS[1], 1)])[HEAD + HEAD :])
    assert file.read_bytes() == before


def test_a_file_that_has_ended_is_left_alone(tmp_path: Path) -> None:
    file = written(tmp_path, [run_record(), history(METRICS[0], 0), end_record()])
    inode = file.stat().st_ino
    assert has_ended(file) and take_over(tmp_path, METRICS, print).next_step == 1
    assert file.stat().st_ino == inode


@pytest.mark.parametrize("content", [b"", b":W&B", framed([]), b"something else entirely"])
def test_a_file_that_says_nothing_of_the_run_is_removed(content: bytes, tmp_path: Path) -> None:
    good = written(tmp_path, [run_record(), history(METRICS[0], 0), end_record()])
    written(tmp_path, [], number=1).write_bytes(content)
    assert list(take_over(tmp_path, METRICS, print).rows) == [0]
    assert [path.parent for path in tmp_path.rglob("*.wandb")] == [good.parent]


@pytest.mark.parametrize("starts", [(8, 9), (9, 8)], ids=["as begun", "a clock that is behind"])
def test_files_are_put_together_by_their_steps(starts: tuple[int, int], tmp_path: Path) -> None:
    first, second = map(run_record, starts)
    written(tmp_path, [second, history(METRICS[1], 4), end_record()], number=0)
    written(tmp_path, [first, history(METRICS[0], 0), end_record()], number=1)
    written(tmp_path, [first, end_record()], number=2)
    held = take_over(tmp_path, METRICS, print)
    assert (list(held.rows), held.next_step) == ([0, 1], 5)


@pytest.mark.parametrize(
    "rows",
    [
        [(METRICS[1], 0)],
        [(METRICS[0], 0), (METRICS[2], 1)],
        [({**METRICS[0], "return_mean": 7.0}, 0)],
        [({"iteration": 0}, 0)],
    ],
    ids=["no beginning", "a gap", "another value", "a value is missing"],
)
def test_files_that_contradict_the_metrics_are_set_aside(
    rows: list[tuple[dict[str, Any], int]], tmp_path: Path
) -> None:
    file = written(tmp_path, [run_record(), *(history(row, step) for row, step in rows)])
    said, say = lines()
    held = take_over(tmp_path, METRICS, say)
    assert held.run != RUN and not held.rows and held.run == known_id(tmp_path)
    assert "set aside" in said[0] and not file.exists()
    assert list((tmp_path / "wandb").glob(f"set-aside-*/run-{RUN}.wandb"))


def test_what_older_versions_have_logged_twice_counts_once(tmp_path: Path) -> None:
    first, second = (history(row, i) for i, row in enumerate(METRICS[:2]))
    written(tmp_path, [run_record(), first, second], number=0)
    written(tmp_path, [run_record(start=2), second, history(METRICS[2], 2)], number=1)
    assert list(take_over(tmp_path, METRICS, print).rows) == [0, 1, 2]


def test_not_a_number_is_equal_to_itself(tmp_path: Path) -> None:
    row = {"iteration": 0, "loss": float("nan"), "other": float("inf")}
    written(tmp_path, [run_record(), history({**row, "loss": "NaN", "other": "Infinity"}, 0)])
    assert list(take_over(tmp_path, [row], print).rows) == [0]


def test_a_run_has_one_id_for_ever(tmp_path: Path) -> None:
    assert known_id(tmp_path) is None
    drawn = draw_id(tmp_path)
    assert known_id(tmp_path) == drawn != draw_id(tmp_path / "..")
    (tmp_path / ".." / ID_FILE).unlink()
    # A run that is older than the file, in another place than it was.
    (tmp_path / ID_FILE).unlink()
    written(tmp_path, [run_record()])
    assert known_id(tmp_path) == RUN
    (tmp_path / ID_FILE).write_text("../../etc\n")
    assert known_id(tmp_path) == RUN


def test_links_are_not_followed(tmp_path: Path) -> None:
    elsewhere = written(tmp_path / "elsewhere", [run_record(), history(METRICS[0], 0)])
    before = elsewhere.read_bytes()[:-3]
    elsewhere.write_bytes(before)
    run_dir = tmp_path / "run"
    (run_dir / "wandb").mkdir(parents=True)
    (run_dir / ID_FILE).write_text(RUN)
    (run_dir / "wandb" / elsewhere.parent.name).symlink_to(elsewhere.parent)
    assert not take_over(run_dir, METRICS, print).rows
    assert elsewhere.read_bytes() == before
    (run_dir / "wandb" / elsewhere.parent.name).unlink()
    (run_dir / "wandb").rmdir()
    (run_dir / "wandb").symlink_to(elsewhere.parents[1])
    with pytest.raises(RunDirectoryError, match="symbolic link"):
        take_over(run_dir, METRICS, print)
