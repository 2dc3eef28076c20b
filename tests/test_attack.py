"""The attack itself: some of each kind, and that it sees what is not survived."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.attack import storage
from tests.attack.__main__ import GROUPS, attack
from tests.attack.outcome import Row, Said, changes, table
from tests.conftest import HAS_FORKS

pytestmark = pytest.mark.skipif(not HAS_FORKS, reason="processes are forked")


@contextmanager
def open_folder() -> Iterator[Path]:
    """One that another user can look into, which those of pytest are not."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


# The whole takes minutes: ``python -m tests.attack``.
SOME = {"kills": "METRPO", "storage": "in the way", "hostile": "pickles", "numeric": "METRPO"}


@pytest.mark.parametrize("group", list(GROUPS))
def test_some_of_each_kind_are_survived(group: str) -> None:
    with open_folder() as folder:
        rows = attack(folder, quick=True, seed=1, groups=[group], match=SOME[group])
    assert not [failure for row in rows for failure in row.failures], table(rows)
    assert rows and all(row.tried or row.skipped for row in rows)


def test_what_is_not_survived_is_seen() -> None:
    row = Row("kind")
    row.add("fine")
    row.add("refused badly", "two lines")
    row.add("lost", lost="a file")
    assert table([row]).splitlines()[2] == "| kind | 3 | 1 | 2 |"
    assert "kind: refused badly: two lines" in table([row])
    said = Said(["report"], 1, "torchrl-l1 report: no disk; buy one\n")
    assert said.refusal("no disk", "buy") is None
    assert "is not in" in str(said.refusal("no memory"))
    assert "status 1" in str(said.problem())
    assert "traceback" in str(Said(["report"], 1, "Traceback (most recent\nE: x\n").problem((1,)))
    assert "0 lines" in str(Said(["report"], 1, "something\n").refusal())
    assert "still running" in str(Said(["report"], None, "").problem())
    assert changes({"a": b"1", "b": b"2"}, {"a": b"1", "b": b"3", "c": b""}) == "changed: b"


@pytest.fixture(scope="module")
def place() -> Iterator[Path]:
    with open_folder() as folder:
        yield folder


@pytest.fixture(scope="module")
def commands(place: Path) -> dict[str, storage.Writer]:
    return {writer.name: writer for writer in storage.writers(place)}


NAMES = ("run", "campaign", "evaluate", "report", "robustify", "export", "play")


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *[("no permission", name) for name in NAMES],
        *[("read-only file system", name) for name in ("run", "evaluate", "report")],
    ],
)
def test_folders_that_must_not_be_written_are_told_in_a_line(
    name: str, kind: str, place: Path, commands: dict[str, storage.Writer]
) -> None:
    assert tuple(commands) == NAMES
    if kind == "read-only file system" and (why := storage.may_mount()):
        pytest.skip(why)
    row = Row(kind)
    (fault,) = [fault for fault in storage.faults() if fault.name == kind]
    before = storage.contents(place / "run")
    storage.under(row, commands[name], fault, place, before)
    assert row.tried == 1 and not row.failures, row.failures
