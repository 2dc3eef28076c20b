from __future__ import annotations

import pickle
import shutil
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch._dynamo.exc import TorchDynamoException

from torchrl_l1.dynamics import ControlAffineDynamics, EnsembleDynamics, GaussianHead
from torchrl_l1.planning import (
    TrajectorySampler,
    compiled_motion,
    evaluate,
    resolve_compilation,
    trajectory_sampling,
)

HEADERS = Path(sysconfig.get_path("include")) / "Python.h"
needs_compiler = pytest.mark.skipif(
    shutil.which("g++") is None or not HEADERS.exists() or sys.platform == "win32",
    reason="no working C++ compiler",
)


@pytest.fixture(autouse=True)
def nothing_compiled_yet():
    compiled_motion._compiled.cache_clear()
    yield
    compiled_motion._compiled.cache_clear()


@pytest.fixture
def graphs(monkeypatch) -> list[torch.fx.GraphModule]:
    """The graphs that are captured, which run without a compiler."""
    found: list[torch.fx.GraphModule] = []

    def backend(graph, inputs):
        found.append(graph)
        return graph

    real = torch.compile
    monkeypatch.setattr(
        torch, "compile", lambda function, **options: real(function, backend=backend, **options)
    )
    return found


def make_model(head: str = "gaussian", kind: type = EnsembleDynamics, seed: int = 0):
    torch.manual_seed(seed)
    gaussian = GaussianHead(3, -8.0 - seed, 0.1 * seed) if head == "gaussian" else None
    model = kind(3, 2, members=5, hidden=(24, 24), activation="silu", head=gaussian)
    model.fit_statistics(torch.randn(99, 3), torch.randn(99, 2), 0.3 * torch.randn(99, 3))
    return model


def reward(x, u, successor):
    return x[..., 0] - successor.square().sum(-1) - 0.1 * u.square().sum(-1)


def returns(model, compile, candidates: int = 9, environments: int = 2, **settings):
    generator = torch.Generator().manual_seed(4)
    x = torch.randn(environments, 3, generator=generator)
    actions = torch.randn(environments, candidates, 6, 2, generator=generator)
    settings = {"particles": 7, "common_noise": True, **settings}
    return evaluate(model, x, actions, reward, compile=compile, generator=generator, **settings)


def check_close(compiled: torch.Tensor, eager: torch.Tensor) -> None:
    # Sums in another order, over six steps.
    torch.testing.assert_close(compiled, eager, rtol=2e-5, atol=2e-5)


@needs_compiler
@pytest.mark.parametrize("propagation", ["tsinf", "mean"])
def test_compiled_plans_have_the_same_returns(propagation):
    model = make_model()
    for candidates in (9, 4):
        check_close(
            returns(model, True, candidates, propagation=propagation),
            returns(model, False, candidates, propagation=propagation),
        )


@pytest.mark.parametrize("kind", [EnsembleDynamics, ControlAffineDynamics])
@pytest.mark.parametrize("head", ["deterministic", "gaussian"])
def test_the_graph_is_the_same_function_for_any_model(graphs, kind, head):
    model = make_model(head, kind)
    check_close(returns(model, True), returns(model, False))
    assert len(graphs) == 1


@pytest.mark.parametrize(
    "settings",
    [
        {"particles": 1},
        {"particles": 3},
        {"particles": 5, "common_noise": False},
        {"particles": 7, "block": 40},
        {"propagation": "mean"},
    ],
)
def test_the_graph_is_the_same_function_for_any_particles(graphs, settings):
    model = make_model()
    model.set_elites([0, 1, 3, 4])
    check_close(returns(model, True, **settings), returns(model, False, **settings))
    assert len(graphs) == 1


def test_the_graph_rounds_where_bfloat16_does(graphs):
    model = make_model()
    exact = returns(model, False)
    rounded = returns(model, True, precision="bfloat16")
    assert not torch.equal(rounded, exact)
    error = (rounded - returns(model, False, precision="bfloat16")).abs().max()
    assert error <= 0.1 * (rounded - exact).abs().max()


def test_one_graph_serves_all_plans(graphs):
    for number in range(5):
        sampler = TrajectorySampler(
            make_model(seed=number), reward, particles=7, precision="float32", compile=True
        )
        x = torch.randn(1 + number % 3, 3)
        evaluate = pickle.loads(pickle.dumps(sampler)).evaluator(x)
        for candidates in (2 + number, 50):
            actions = torch.randn(len(x), candidates, 4 + number, 2)
            torch.manual_seed(0)
            compiled = evaluate(actions)
            torch.manual_seed(0)
            eager = TrajectorySampler(sampler.dynamics, reward, particles=7, precision="float32")
            check_close(compiled, eager.evaluator(x)(actions))
    assert len(graphs) == 1


def test_many_kinds_of_ensembles_compile_in_one_process(graphs):
    # torch refuses more graphs than this, eight by default, for one code object.
    with torch._dynamo.config.patch(recompile_limit=2):
        for particles in range(1, 4):
            returns(make_model("deterministic"), True, particles=particles)
    assert len(graphs) == 3


def test_eager_plans_do_not_touch_the_compiler(monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError("torch.compile was called")

    monkeypatch.setattr(torch, "compile", refuse)
    model = make_model()
    # On the CPU, automatic plans are eager ones, bit by bit.
    assert torch.equal(returns(model, "auto"), returns(model, False))
    with pytest.raises(AssertionError, match=r"torch\.compile was called"):
        returns(model, True)


def test_auto_runs_the_operations_one_by_one_where_compiling_fails(monkeypatch):
    def broken(function, **options) -> Callable[..., None]:
        def call(*arguments):
            raise TorchDynamoException("no compiler")

        return call

    monkeypatch.setattr(torch, "compile", broken)
    model = make_model()
    expected = returns(model, False)
    with pytest.raises(TorchDynamoException, match="no compiler"):
        returns(model, True)
    # As on a GPU.
    monkeypatch.setattr(trajectory_sampling, "resolve_compilation", lambda *settings, **more: True)
    with pytest.warns(RuntimeWarning, match="which failed: no compiler") as one:
        check_close(returns(model, "auto"), expected)
        check_close(returns(model, "auto"), expected)
    assert len(one) == 1


def test_a_choice_tells_what_is_known_before_the_first_plan(monkeypatch):
    def plans(mode) -> str:
        return TrajectorySampler(model, reward, compile=mode).choices()["plans"]

    model = make_model()
    assert (plans(True), plans(False), plans("auto")) == ("compiled", "eager", "eager")
    # As on a GPU.
    monkeypatch.setattr(
        trajectory_sampling, "resolve_compilation", lambda mode, *_, **__: bool(mode)
    )
    assert (plans(True), plans(False)) == ("compiled", "eager")
    assert plans("auto") == "compiled, or eager if compiling fails"


@pytest.mark.parametrize("compiler", [True, False])
def test_auto_chooses_by_device_and_compiler(monkeypatch, compiler):
    monkeypatch.setattr(compiled_motion, "_has_compiler", lambda: compiler)
    assert resolve_compilation("auto", "cuda", "tsinf") == compiler
    assert resolve_compilation("auto", "cuda:1", "mean") == compiler
    assert not resolve_compilation("auto", "cuda", "ts1")
    assert not resolve_compilation("auto", "cpu", "tsinf")
    for device in ("cpu", "cuda"):
        assert resolve_compilation(True, device) and not resolve_compilation(False, device, "ts1")


def test_a_compiler_is_triton_and_what_starts_its_kernels(monkeypatch):
    monkeypatch.delenv("CC", raising=False)
    for triton in (None, "found"):
        for installed in (set(), {"clang"}):
            monkeypatch.setattr(compiled_motion, "find_spec", lambda name, found=triton: found)
            monkeypatch.setattr(
                shutil, "which", lambda name, found=installed: name if name in found else None
            )
            assert compiled_motion._has_compiler() == bool(triton and installed)
