"""The Python snippets of README and guide run as they stand."""

from __future__ import annotations

import csv
import importlib.util
import re
from pathlib import Path
from types import ModuleType

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


@pytest.fixture
def study(tmp_path: Path) -> ModuleType:
    file = ROOT / "docs/results/robustness.py"
    spec = importlib.util.spec_from_file_location("docs_robustness", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.HERE = tmp_path / "results"
    module.HERE.mkdir()
    return module


def write_rows(file: Path, rows: list[dict[str, object]]) -> None:
    with file.open("w", newline="") as handle:
        writer = csv.DictWriter(handle, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def test_robustness_page_shows_the_filmstrip(study: ModuleType, tmp_path: Path) -> None:
    cell = {"policy": "stochastic", "training_seeds": 1, "episodes_per_seed": 2}
    cell |= dict.fromkeys(("return_median", "return_lowest", "return_highest"), -1.0)
    rows = [cell | {"l1": on, "bias": bias} for bias in (0.0, -1.5) for on in ("off", "paper")]
    write_rows(tmp_path / "summary.csv", rows)
    write_rows(tmp_path / "evaluation.csv", rows)
    study.robustness(tmp_path)
    assert "filmstrip" not in (study.HERE / "robustness.md").read_text()
    (tmp_path / "filmstrip.png").write_bytes(b"")
    study.robustness(tmp_path)
    page = (study.HERE / "robustness.md").read_text()
    assert "(results/filmstrip.png)" in page and "bias of -1.5" in page


def test_relative_links_lead_somewhere() -> None:
    for page in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("docs/studies/*.md")]:
        for target in re.findall(r"\]\((?!https?:)([^)#\s]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
