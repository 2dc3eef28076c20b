from __future__ import annotations

from pathlib import Path

import pytest

from tests import fuzz
from torchrl_l1.report.runs import find_readable_runs


# NumPy leaves a damaged archive to the garbage collector to close.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_mutated_files_are_read_or_refused(tmp_path: Path) -> None:
    results = fuzz.fuzz(4, 1, tmp_path)
    assert set(results) == set(fuzz.FILES)
    assert not [line for result in results.values() for line in result.wrong]
    assert sum(result.refused for result in results.values()) > 10


def test_the_script_sees_what_is_not_survived(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(folder: Path) -> None:
        raise IndexError("list index out of range")

    result = fuzz.Result()
    fuzz.attempt(broken, Path(), result, "a file")
    assert result.wrong == ["a file: IndexError: list index out of range"]
    result = fuzz.Result()
    fuzz.attempt(lambda folder: find_readable_runs([folder]), Path("nowhere"), result, "a file")
    assert (result.wrong, result.refused) == ([], 1)
