"""Planning and fitting are compared on the same model, with or without the peers."""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.nn.functional import silu, softplus

from benchmarks import cheetah, fitting, peers, planning, planning_precision, shooting
from benchmarks.tables import Table
from torchrl_l1.planning import compiled_motion


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(cheetah, "HIDDEN", (8, 8, 8))
    monkeypatch.setattr(planning, "GRADIENT_STEPS", 1)
    monkeypatch.setattr(planning, "MATRIX", 32)
    config = replace(planning.CONFIG, horizon=3, candidates=6, elites=2, iterations=2)
    monkeypatch.setattr(planning, "CONFIG", config)
    transitions = cheetah.transitions
    monkeypatch.setattr(cheetah, "transitions", lambda *sizes: transitions(100, 20))
    compile = torch.compile
    monkeypatch.setattr(
        torch, "compile", lambda function, **options: compile(function, backend="eager", **options)
    )
    compiled_motion._compiled.cache_clear()
    yield
    compiled_motion._compiled.cache_clear()


def unavailable(threads: int) -> None:
    raise peers.PeersUnavailableError("no network: connect to a package index")


def test_planning_without_peers(small: None, monkeypatch, capsys) -> None:
    monkeypatch.setattr(peers, "Peer", unavailable)
    rows = planning.run(1)
    assert "without mbrl-lib: no network: connect" in capsys.readouterr().err
    compiled = {"float32, compiled", "bfloat16, compiled"}
    assert {row["implementation"] for row in rows} == compiled | {"float32", "bfloat16", "TorchRL"}
    by_name = {(row["plan"], row["implementation"]): row for row in rows}
    assert by_name["one member", "float32"]["speedup"] > 0
    assert "speedup" not in by_name["20 particles, TSinf", "float32"]
    product = by_name["product of two matrices, 32 x 32", "float32"]
    assert product["peak"] == pytest.approx(100)
    assert product["gflops"] == pytest.approx(2 * 32**3 / product["milliseconds"] / 1e6)


def test_planning_without_a_compiler(small: None, monkeypatch, capsys) -> None:
    def broken(*arguments: object, **options: object) -> None:
        raise RuntimeError("no C++ compiler")

    monkeypatch.setattr(peers, "Peer", unavailable)
    monkeypatch.setattr(torch, "compile", broken)
    rows = planning.run(1)
    assert "without compiled plans: no C++ compiler" in capsys.readouterr().err
    assert {row["implementation"] for row in rows} == {"float32", "bfloat16", "TorchRL"}


def test_random_shooting(small: None, monkeypatch) -> None:
    monkeypatch.setattr(shooting, "HIDDEN", (8, 8))
    monkeypatch.setattr(shooting, "GRADIENT_STEPS", 1)
    monkeypatch.setattr(shooting, "CONFIG", replace(shooting.CONFIG, horizon=3, candidates=6))
    monkeypatch.setattr(shooting, "SINGLE", replace(shooting.SINGLE, horizon=3, candidates=6))
    rows = shooting.run(1)
    product = "product of two matrices, 32 x 32"
    assert [row["plan"] for row in rows[::3]] == [*shooting.PLANS, product]
    for row in rows[:6]:
        assert (row.get("speedup", 0) > 0) == (row["implementation"] != "TorchRL")
    # Products of 17 + 6 by 8, 8 by 8 and 8 by 17, for each candidate, step and member.
    products = 2 * 8 * (23 + 8 + 17) * 6 * 3
    for row, members in zip(rows[:6:3], (1, 5), strict=True):
        expected = members * products / row["milliseconds"] / 1e6
        assert row["gflops"] == pytest.approx(expected)
    assert "TorchRL" in shooting.table(1).markdown()


def test_fitting_without_peers(small: None, monkeypatch) -> None:
    monkeypatch.setattr(peers, "Peer", unavailable)
    monkeypatch.setattr(fitting, "BATCHES", 2)
    monkeypatch.setattr(fitting, "BATCH_SIZE", 50)
    rows = fitting.run(1)
    cases = [(row["penalty"], row["implementation"]) for row in rows]
    assert cases == [
        (penalty, f"torchrl_l1, {precision}")
        for penalty in fitting.DECAYS
        for precision in fitting.PRECISIONS
    ]
    assert all(row["samples"] > 0 and math.isfinite(row["held_out"]) for row in rows)


def test_plans_are_judged_in_pairs(small: None, monkeypatch) -> None:
    monkeypatch.setattr(planning_precision, "PROBLEMS", 2)
    monkeypatch.setattr(planning_precision, "PARTICLES", 20)
    rows = planning_precision.run(2)
    assert [(row["state"], row["plans"]) for row in rows] == [("0", 2), ("1", 2), ("all", 4)]
    for row in rows:
        assert row["difference"] == pytest.approx(row["bfloat16"] - row["float32"], abs=1e-4)
    assert rows[2]["float32"] == pytest.approx((rows[0]["float32"] + rows[1]["float32"]) / 2)


def test_the_model_handed_over_is_the_same_function(small: None, tmp_path: Path) -> None:
    model = cheetah.fitted_model(cheetah.transitions(100, 20), 3)
    cheetah.save_for_mbrl(model, tmp_path / "model.pt")
    given = torch.load(tmp_path / "model.pt")
    x, u = torch.randn(4, 17), torch.rand(4, 6)
    z = ((torch.cat([x, u], -1) - given["input_mean"]) / given["input_std"]).expand(5, -1, -1)
    for weight, bias in zip(given["weights"][:-1], given["biases"][:-1], strict=True):
        z = silu(z @ weight + bias)
    mean, v = (z @ given["weights"][-1] + given["biases"][-1]).chunk(2, -1)
    v = given["max_logvar"] - softplus(given["max_logvar"] - v)
    v = given["min_logvar"] + softplus(v - given["min_logvar"])
    with torch.no_grad():
        expected, std = model.member_distribution(x, u)
    torch.testing.assert_close(mean, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close((v / 2).exp(), std, rtol=1e-4, atol=1e-6)


def worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str) -> None:
    path = tmp_path / "worker.py"
    path.write_text(f"import json, sys\nfor line in sys.stdin:\n    {body}\n")
    monkeypatch.setattr(peers, "_WORKER", path)
    monkeypatch.setattr(peers, "environment", lambda: Path(sys.executable))


def test_worker_answers_line_by_line(tmp_path: Path, monkeypatch) -> None:
    answer = json.dumps({"torch": torch.__version__})
    body = f"print(json.dumps({answer} | json.loads(line)), flush=True)"
    worker(tmp_path, monkeypatch, body)
    peer = peers.Peer(2)
    assert peer.call("plan", observation=[1.0])["observation"] == [1.0]
    peer.close()


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("sys.exit(1)", "failed in 'start'"),
        ('print(\'{"torch": "0"}\', flush=True)', "has torch 0"),
    ],
)
def test_a_worker_that_fails_names_the_remedy(tmp_path: Path, monkeypatch, body, message) -> None:
    worker(tmp_path, monkeypatch, body)
    with pytest.raises(peers.PeersUnavailableError, match=message + r"(.|\n)*make bench"):
        peers.Peer(1)


def test_an_environment_that_cannot_be_made(tmp_path: Path, monkeypatch) -> None:
    def failing(*args: object, **kwargs: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(peers, "ENVIRONMENT", tmp_path / "peers")
    monkeypatch.setattr(peers.venv, "create", failing)
    with pytest.raises(peers.PeersUnavailableError, match=r"mbrl==0\.2\.0.*no space left.*make"):
        peers.environment()


def test_rows_may_lack_columns(tmp_path: Path) -> None:
    rows = [{"task": "a"}, {"task": "b", "speed": 2.0}]
    table = Table("stem", "Title", "Caption", rows, {"task": "Task", "speed": "Speed"}, {})
    table.write(tmp_path)
    assert "| a |  |" in (tmp_path / "stem.md").read_text()
    with (tmp_path / "stem.csv").open() as file:
        assert [row["speed"] for row in csv.DictReader(file)] == ["", "2.0"]
