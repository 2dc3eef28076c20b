"""The commit that a run ran with, in checkouts made for the test."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from torchrl_l1.experiment.run_directory import commit


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
