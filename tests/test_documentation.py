"""The Python snippets of README and guide run as they stand."""

from __future__ import annotations

import csv
import importlib.util
import json
import re
import sys
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
def collect(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("docs_collect", ROOT / "docs/results/collect.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # where dataclasses look for it
    spec.loader.exec_module(module)
    module.HERE = tmp_path / "results"
    module.HERE.mkdir()
    return module


def write_rows(file: Path, rows: list[dict[str, object]]) -> None:
    with file.open("w", newline="") as handle:
        writer = csv.DictWriter(handle, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def finished_run(folder: Path, seed: int, returns: float) -> str:
    folder.mkdir()
    (folder / "config.yaml").write_text(f"outer_iterations: 2\nseed: {seed}\nlabel: executed\n")
    metrics = {"return_mean": returns, "return_deterministic": 2 * returns, "l1/switch_rate": 0.5}
    write_rows(folder / "metrics.csv", [metrics | {"real_steps": s} for s in (100, 200)])
    seconds = {"iteration": 0, "random": 0.5, "fit": 1, "trpo": 2, "collect": 0.5, "evaluate": 1}
    write_rows(folder / "timing.csv", [seconds, seconds])
    names = ("python", "torch", "torchrl", "mujoco")
    (folder / "versions.json").write_text(json.dumps(dict.fromkeys(names, "1")))
    return str(folder)


def test_tables_of_runs(collect: ModuleType, tmp_path: Path) -> None:
    runs = [finished_run(tmp_path / str(seed), seed, 100 * (seed + 1)) for seed in (0, 1)]
    collect.half_cheetah(runs)
    collect.labels(runs)
    text = (collect.HERE / "half_cheetah.md").read_text()
    # Two iterations of 4 s without the evaluation and of 5 s with it, over 200 steps.
    assert "| 0 | 100 | 200 | 40.00 | 50.00 |" in text
    assert "| mean | 150 | 300 | 40.00 | 50.00 |" in text
    assert "| standard deviation | 71 | 141 | 0.00 | 0.00 |" in text
    for name in ("half_cheetah", "labels"):
        table = [row for row in (collect.HERE / f"{name}.md").read_text().split("\n") if "|" in row]
        assert len({row.count("|") for row in table}) == 1, f"ragged table {name}"
        assert (collect.HERE / f"{name}.png").exists()


def test_robustness_page_shows_the_filmstrip(collect: ModuleType, tmp_path: Path) -> None:
    cell = {"policy": "stochastic", "training_seeds": 1, "episodes_per_seed": 2}
    cell |= dict.fromkeys(("return_median", "return_lowest", "return_highest"), -1.0)
    rows = [cell | {"l1": on, "bias": bias} for bias in (0.0, -1.5) for on in ("off", "paper")]
    write_rows(tmp_path / "summary.csv", rows)
    write_rows(tmp_path / "evaluation.csv", rows)
    collect.robustness([str(tmp_path)])
    assert "filmstrip" not in (collect.HERE / "robustness.md").read_text()
    (tmp_path / "filmstrip.png").write_bytes(b"")
    collect.robustness([str(tmp_path)])
    page = (collect.HERE / "robustness.md").read_text()
    assert "(results/filmstrip.png)" in page and "bias of -1.5" in page


def test_relative_links_lead_somewhere() -> None:
    for page in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]:
        for target in re.findall(r"\]\((?!https?:)([^)#\s]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
