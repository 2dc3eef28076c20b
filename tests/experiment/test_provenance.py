from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from torchrl_l1.experiment.provenance import commit, differences


def test_commit_of_a_checkout_and_whether_it_was_changed(tmp_path: Path) -> None:
    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    package = tmp_path / "package"
    package.mkdir()
    (package / "code.py").write_text("x = 1")
    assert commit(package) is None
    git("init")
    assert commit(package) is None  # no commit yet
    git("add", ".")
    git("commit", "-m", "first")
    head = git("rev-parse", "HEAD")
    assert commit(package) == head
    (tmp_path / "notes.md").write_text("beside the package")
    assert commit(package) == head
    (package / "code.py").write_text("x = 2")
    assert commit(package) == f"{head} with changes"


def test_installation_below_somebody_elses_checkout_has_no_commit(tmp_path: Path) -> None:
    subprocess.run(["git", "init", str(tmp_path)], check=True, capture_output=True)
    package = tmp_path / "venv" / "site-packages" / "package"
    package.mkdir(parents=True)
    assert commit(package) is None


def test_no_git_no_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".git").mkdir()
    monkeypatch.setenv("PATH", "")
    assert commit(tmp_path / "package") is None


def test_files_of_one_name_in_other_folders_are_compared(tmp_path: Path) -> None:
    for folder, text in (("one", "a = 1"), ("copy", "a = 1"), ("other", "a = 2")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "own.py").write_text(text)
    one, copy, other = (
        {"algorithm": "pets", "task": "own.py:make", "search_path": [str(tmp_path / folder)]}
        for folder in ("one", "copy", "other")
    )
    assert differences(one, copy) == [] == differences(one, one)
    (found,) = differences(one, other)
    assert found.startswith("search_path: [") and str(tmp_path / "other") in found
    (tmp_path / "one/own.py").unlink()  # a project that has moved
    assert differences(one, other) == []


def test_a_run_goes_on_and_is_read_where_its_configuration_is_older_than_its_checkpoint() -> None:
    """One that a later version has gone on with: only the checkpoint knows the new setting."""
    newer = {"algorithm": "metrpo", "seed": 0, "threads": 1, "l1": {"enabled": True, "a_s": -1.0}}
    older = {"algorithm": "metrpo", "seed": 0, "l1": {"enabled": True}}
    assert differences(newer, older) == [] == differences(older, newer)
    (found,) = differences({**newer, "threads": 2}, older)
    assert found == "threads: 2 there, 1 now"
    (found,) = differences(older, {**newer, "l1": {"enabled": True, "a_s": -2.0}})
    assert found == "l1.a_s: -1.0 there, -2.0 now"
