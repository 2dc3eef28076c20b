from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from torchrl_l1.experiment.verify import verify_traces

REFERENCE = Path(__file__).parents[3] / "shared" / "reference" / "l1_reference_traces.npz"


def recorded_trace(seed: int, steps: int = 30, n: int = 5, m: int = 2, dt: float = 0.04) -> dict:
    """A trace in the file's layout, by the closed form of the reference controller."""
    rng = np.random.default_rng(seed)
    kappa = dt / (np.exp(dt) - 1)
    trace = {
        "obs": rng.normal(size=(steps, n)),
        "drift": 0.1 * rng.normal(size=(steps, n)),
        "jac": rng.normal(size=(steps, n, m)),
        "action": rng.uniform(-1, 1, size=(steps, m)),
        "switch": rng.random(steps) < 0.2,
        "dt": np.array(dt),
        "bound": np.array(0.8),
    }
    rows: dict[str, list] = {"u": [], "sigma_m": [], "x_hat": [], "sigma_um": []}
    x_hat, q = trace["obs"][0], np.zeros(m)
    for t in range(steps):
        x, jac = trace["obs"][t], trace["jac"][t]
        if trace["switch"][t]:
            x_hat, q = x, np.zeros(m)
        error = x_hat - x
        sigma_m = -kappa * np.linalg.pinv(jac) @ error
        rest = -kappa * error - jac @ sigma_m
        q = 0.65 * q + 0.35 * sigma_m
        u = np.clip(np.clip(trace["action"][t], -0.8, 0.8) - q, -0.8, 0.8)
        x_hat = x_hat + trace["drift"][t] + jac @ u - (kappa + dt) * error
        null = np.linalg.svd(jac.T)[2][m:]
        for name, value in (
            ("u", u), ("sigma_m", sigma_m), ("x_hat", x_hat), ("sigma_um", null @ rest / dt)
        ):  # fmt: skip
            rows[name].append(value)
    return trace | {name: np.array(value) for name, value in rows.items()}


def write(path: Path, **traces: dict) -> Path:
    entries = {
        f"{a.replace('__', '/')}/{k}": v for a, trace in traces.items() for k, v in trace.items()
    }
    np.savez(path, **entries)
    return path


@pytest.mark.skipif(not REFERENCE.exists(), reason="no ../shared/reference/l1_reference_traces.npz")
def test_reference_traces_replay_exactly():
    errors = verify_traces(REFERENCE)
    assert len(errors) == 10
    assert max(error for _, error in errors) <= 1e-9


def test_traces_of_any_prefix_replay(tmp_path):
    path = write(
        tmp_path / "traces.npz",
        cartpole__first=recorded_trace(0),
        cartpole__second=recorded_trace(1, n=3, m=1, dt=0.01),
        arm__only=recorded_trace(2, n=2, m=2),
    )
    errors = dict(verify_traces(str(path)))
    assert set(errors) == {"cartpole/first", "cartpole/second", "arm/only"}
    assert max(errors.values()) <= 1e-9


@pytest.mark.parametrize("field", ["u", "sigma_m", "x_hat", "sigma_um"])
def test_a_deviation_is_reported(tmp_path, field):
    good, bad = recorded_trace(0), recorded_trace(0)
    bad[field] = bad[field].copy()
    bad[field][17, 0] += 0.01
    errors = dict(verify_traces(write(tmp_path / "t.npz", a__good=good, a__bad=bad)))
    assert errors["a/good"] <= 1e-9 and errors["a/bad"] > 1e-5
    bad[field][17, 0] = np.nan
    errors = dict(verify_traces(write(tmp_path / "t.npz", a__good=good, a__bad=bad)))
    assert errors["a/good"] <= 1e-9 and errors["a/bad"] > 1e300


def test_unmatched_estimates_are_optional(tmp_path):
    trace = recorded_trace(0)
    del trace["sigma_um"]
    assert verify_traces(write(tmp_path / "t.npz", a__b=trace))[0][1] <= 1e-9


def test_bad_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no trace file at .*missing\.npz"):
        verify_traces(tmp_path / "missing.npz")
    text = tmp_path / "text.npz"
    text.write_text("hello")
    with pytest.raises(ValueError, match=r"text\.npz is not a NumPy \.npz file"):
        verify_traces(text)
    np.save(tmp_path / "array.npy", np.zeros(3))
    with pytest.raises(ValueError, match="holds a single array"):
        verify_traces(tmp_path / "array.npy")
    np.savez(tmp_path / "flat.npz", obs=np.zeros(3))
    with pytest.raises(ValueError, match=r"expected keys <a>/<b>/<field>, found \['obs'\]"):
        verify_traces(tmp_path / "flat.npz")


def test_bad_traces_are_named(tmp_path):
    path = tmp_path / "t.npz"
    trace = recorded_trace(0)
    incomplete = {k: v for k, v in trace.items() if k not in ("jac", "u")}
    with pytest.raises(KeyError, match=r"'a/b' lacks \['jac', 'u'\]"):
        verify_traces(write(path, a__b=incomplete))
    with pytest.raises(ValueError, match=r"'a/b': drift has shape \(30, 4\), expected \(30, 5\)"):
        verify_traces(write(path, a__b=trace | {"drift": trace["drift"][:, 1:]}))
    with pytest.raises(ValueError, match=r"expected \(T, n\) and \(T, m\)"):
        verify_traces(write(path, a__b=trace | {"obs": trace["obs"][:, 0]}))
    with pytest.raises(ValueError, match="dt must be a positive"):
        verify_traces(write(path, a__b=trace | {"dt": np.array(0.0)}))
    with pytest.raises(ValueError, match="no steps"):
        verify_traces(write(path, a__b={k: v[:0] if v.ndim else v for k, v in trace.items()}))
    with pytest.raises(ValueError, match="values that are not numbers"):
        verify_traces(write(path, a__b=trace | {"u": np.full((30, 2), "x")}))
    with pytest.raises(ValueError, match="cannot read a/b/u"):
        verify_traces(write(path, a__b=trace | {"u": np.full((30, 2), None)}))
