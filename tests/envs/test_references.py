from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest

from torchrl_l1.envs import load_attribute
from torchrl_l1.envs.references import folders_of


def test_names_lead_to_what_they_name(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text("answer = 42\n")
    assert load_attribute(f"{file}:answer") == 42
    assert load_attribute("math:pi") == math.pi


@pytest.mark.parametrize(
    ("name", "words"),
    [("nowhere:x", "no module 'nowhere'"), ("no.py:x", "no file no.py"), ("math:x", "has no 'x'")],
)
def test_what_is_not_there_is_said(name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        load_attribute(name)


def test_files_and_packages_are_found_on_the_search_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    package = tmp_path / "a_package_of_this_test"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "inner.py").write_text("from a_package_of_this_test import other\nx = other.y\n")
    (package / "other.py").write_text("y = 7\n")
    (tmp_path / "own.py").write_text("answer = 42\n")
    with pytest.raises(ValueError, match="no module"):
        load_attribute("a_package_of_this_test.inner:x")
    assert load_attribute("own.py:answer", [tmp_path]) == 42
    assert load_attribute("a_package_of_this_test.inner:x", [tmp_path]) == 7
    for name in [name for name in sys.modules if name.startswith("a_package_of_this_test")]:
        del sys.modules[name]


def test_a_file_that_changes_is_read_again(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text("count = []\n")
    first = load_attribute(f"{file}:count")
    assert load_attribute(f"{file}:count") is first
    file.write_text("count = [1]\n")
    import os

    os.utime(file, ns=(1, 1))
    assert load_attribute(f"{file}:count") == [1]


def test_folders_are_those_that_hold_what_is_named(tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    for folder in (one, other, other / "package"):
        folder.mkdir()
    (one / "own.py").write_text("")
    names = ["own.py:make", "package:Env-v0", "gymnasium/Reacher-v5", "half_cheetah", "learned"]
    assert folders_of(names, [one, other, tmp_path]) == [str(one), str(other)]
    assert folders_of(["gymnasium/package:Env-v0"], [other]) == [str(other)]
    assert folders_of(["gymnasium/Reacher-v5", "builtin"], [one, other]) == []


@pytest.mark.parametrize("line", ["import a_module_that_is_missing", "1 / 0", "def broken(:"])
def test_a_file_that_fails_is_named_and_leaves_nothing_behind(line: str, tmp_path: Path) -> None:
    file = tmp_path / "half_loaded.py"
    file.write_text(f"x = 1\n{line}\n")
    with pytest.raises(ValueError, match=r"half_loaded.py cannot be imported \(\w+: ") as caught:
        load_attribute(f"{file}:x")
    assert "\n" not in str(caught.value) and "half_loaded" not in sys.modules


def test_a_module_that_fails_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "a_failing_module.py").write_text("1 / 0\n")
    with pytest.raises(ValueError, match=r"a_failing_module cannot be imported \(ZeroDivision"):
        load_attribute("a_failing_module:x")
