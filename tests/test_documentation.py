"""The Python snippets of README and guide run as they stand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SNIPPETS = [
    (page, snippet)
    for page in ("README.md", "docs/quickstart.md")
    for snippet in re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
]


@pytest.mark.parametrize(("page", "snippet"), SNIPPETS, ids=[page for page, _ in SNIPPETS])
def test_snippet_runs(page: str, snippet: str) -> None:
    names: dict[str, object] = {}
    exec(compile(snippet, page, "exec"), names)
    env = names.get("augmented", names.get("env"))
    assert env.rollout(3)["next", "l1", "u_exec"].shape[-1] == 1


def test_relative_links_lead_somewhere() -> None:
    for page in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]:
        for target in re.findall(r"\]\((?!https?:)([^)#\s]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
