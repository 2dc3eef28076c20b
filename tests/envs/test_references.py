from __future__ import annotations

import math
from pathlib import Path

import pytest

from torchrl_l1.envs import load_attribute


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
