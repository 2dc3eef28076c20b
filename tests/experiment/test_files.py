"""What reads files of settings, and what writes files."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from torchrl_l1.atomic import keep_file, write_atomically
from torchrl_l1.experiment import files
from torchrl_l1.experiment.errors import message
from torchrl_l1.experiment.files import bounded_overrides, locked, make_place, settings_content

WORDS = """
yes No on off true ~ null .inf -.INF .NaN 2020-01-01 1e-3 1_000 0x1F 010 0b11 1:30 1:30.5
1.5e5 1.5e+5 1_0.5e3 "a" '1' [] {} [1,a] = << 1. .5 .5e3 .5e-3 1e3 - ? | >- ??? &a *a !!set ${x}
a:b a#b 5. +.1e:2 -0 1__0.
"""
SCALARS = st.sampled_from(WORDS.split()) | st.text("0123456789+-._eExXobn:", min_size=1, max_size=7)
KEYS = st.sampled_from(["a", "b", "1", "yes", "null", "1.5", "? [a]", "'a'"])


def outcome(read: Any) -> Any:
    try:
        return repr(read())
    except Exception as error:
        return type(error)


@given(st.lists(st.tuples(KEYS, SCALARS, st.sampled_from(["", "  ", "- "])), max_size=4))
@example([("a", "1e-3", ""), ("b", "", ""), ("c", "no", "  ")])
def test_settings_are_what_omegaconf_reads(
    tmp_path_factory: pytest.TempPathFactory, lines: list[tuple[str, str, str]]
) -> None:
    text = "".join(f"{indent}{key}: {value}\n" for key, value, indent in lines)
    file = tmp_path_factory.getbasetemp() / "settings.yaml"
    file.write_text(text)
    expected = outcome(lambda: OmegaConf.to_container(OmegaConf.create(text)))
    assert outcome(lambda: settings_content(file)) == expected


@pytest.mark.parametrize("text", ["[" * 100_000, "- " * 100_000, "? " * 100_000, "{a: " * 999])
def test_depth_without_bounds_is_refused(text: str, tmp_path: Path) -> None:
    """Libyaml would end the process."""
    (tmp_path / "deep.yaml").write_text(text)
    with pytest.raises(Exception, match=r"recursion|nested|expected|did not find"):
        settings_content(tmp_path / "deep.yaml")


def test_plain_settings_need_no_omegaconf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "OmegaConf", None)
    (tmp_path / "a.yaml").write_text("a: 1e-3\nb:\n  c: [x, 2020-01-01]\n  d: 'off'\n")
    expected = {"a": 1e-3, "b": {"c": ["x", "2020-01-01"], "d": "off"}}
    assert settings_content(tmp_path / "a.yaml") == expected


@given(value=st.text("./,=a", max_size=300))
@example(value="../../../../data/mine.npz")
@example(value="../..")
def test_overrides_name_a_folder_below_that_of_the_recipe(value: str) -> None:
    name = bounded_overrides(f"horizon=5,dataset={value}")
    folder = os.path.normpath(f"runs/mine/{name}/seed_0")
    assert folder.startswith("runs/mine/horizon=5,")


def test_writers_of_one_place_do_not_meet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One begins and ends while the other is about to replace the file."""
    sync = os.fsync

    def meet(write: Any) -> None:
        def other_first(descriptor: int) -> None:
            monkeypatch.setattr(os, "fsync", sync)
            write()
            sync(descriptor)

        monkeypatch.setattr(os, "fsync", other_first)

    meet(lambda: write_atomically(tmp_path / "a.csv", "others"))
    write_atomically(tmp_path / "a.csv", "mine")
    meet(lambda: make_place(tmp_path / "b.csv"))
    make_place(tmp_path / "c.csv")
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {"a.csv": "mine"}


def test_a_file_system_without_locks_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the system call says it, on which the lock of any library rests."""
    fcntl = pytest.importorskip("fcntl")
    refused = OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    monkeypatch.setattr(fcntl, "flock", Mock(side_effect=refused))
    with pytest.raises(OSError, match=f"{tmp_path}.*lock") as refusal, locked(tmp_path / ".lock"):
        pass
    assert "mounted with flock" in message(refusal.value)


def test_a_second_name_of_a_file_leaves_no_third(tmp_path: Path) -> None:
    file, second = tmp_path / "file", tmp_path / "second"
    file.write_text("content")
    for _ in range(2):
        keep_file(file, second)
    assert sorted(tmp_path.iterdir()) == [file, second]
