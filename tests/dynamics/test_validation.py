from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from torchrl_l1.dynamics import EnsembleDynamics, Transitions, measure_quality, read_transitions


class Known(EnsembleDynamics):
    """A model that predicts x' = A x + B u."""

    def __init__(self, a: torch.Tensor, b: torch.Tensor) -> None:
        super().__init__(a.shape[0], b.shape[1], members=2, hidden=(4,))
        self.a, self.b = a, b

    def mean_change(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return observation @ self.a.T + action @ self.b.T - observation


A, B = torch.tensor([[1.0, 0.1], [-0.1, 0.9]]), torch.tensor([[0.0], [0.1]])


def recorded(*lengths: int) -> TensorDict:
    """Trajectories of x' = A x + B u."""
    torch.manual_seed(0)
    parts = []
    for length in lengths:
        x, u = [torch.randn(2)], torch.randn(length, 1)
        for action in u:
            x.append(A @ x[-1] + B @ action)
        parts.append(
            TensorDict(
                {
                    "observation": torch.stack(x[:-1]),
                    "action": u,
                    "next": {"observation": torch.stack(x[1:])},
                },
                batch_size=[length],
            )
        )
    return torch.cat(parts)


def test_a_perfect_model_misses_nothing() -> None:
    quality = measure_quality(Known(A, B), read_transitions(recorded(*[60] * 10)))
    assert max(quality.rmse) < 1e-6 and min(quality.explained) > 1 - 1e-9
    assert max(quality.open_loop[50]) < 1e-4
    assert (quality.training, quality.validation, quality.dropped) == (540, 60, 0)


def test_errors_are_those_of_the_numbers_written_out() -> None:
    model = Known(A + 0.01, B * 1.1)
    read = read_transitions(recorded(60, 30, 60, 30, 30), validation_fraction=0.7, seed=1)
    quality = measure_quality(model, read, horizons=(3, 40))
    data, errors, loops = read.data, [], {3: [], 40: []}
    x, u, after = (data[key] for key in ("observation", "action", ("next", "observation")))
    for row in read.validation.nonzero().flatten().tolist():
        errors.append(model.mean_change(x[row], u[row]) + x[row] - after[row])
        for horizon, found in loops.items():
            rows = range(row, row + horizon)
            if rows[-1] >= len(data) or not read.validation[row : row + horizon].all():
                continue
            if not read.joined[row : row + horizon - 1].all():
                continue
            predicted = x[row]
            for one in rows:
                predicted = predicted + model.mean_change(predicted, u[one])
            found.append(predicted - after[rows[-1]])
    expected = torch.stack(errors).square().mean(0).sqrt()
    torch.testing.assert_close(torch.tensor(quality.rmse), expected)
    held_out = data[read.validation]
    change = held_out["next", "observation"] - held_out["observation"]
    share = 1 - expected**2 / change.var(0, correction=0)
    torch.testing.assert_close(torch.tensor(quality.explained), share)
    torch.testing.assert_close(
        torch.tensor(quality.spread), held_out["observation"].std(0, correction=0)
    )
    for horizon, found in loops.items():
        assert found
        expected = torch.stack(found).square().mean(0).sqrt()
        torch.testing.assert_close(torch.tensor(quality.open_loop[horizon]), expected)


def test_what_is_too_short_is_said() -> None:
    quality = measure_quality(Known(A, B), read_transitions(recorded(*[20] * 10)))
    assert all(map(math.isnan, quality.open_loop[50])) and not math.isnan(quality.open_loop[10][0])
    text = str(quality)
    assert "no trajectory kept out of training has 50 steps" in text
    assert "has 10 steps" not in text


def test_a_trajectory_of_training_is_no_open_loop() -> None:
    read = read_transitions(recorded(*[60] * 4))
    single = torch.zeros(240, dtype=torch.bool)
    single[::5] = True
    shuffled = Transitions(read.data, single, read.joined, 0)
    quality = measure_quality(Known(A, B), shuffled)
    assert all(map(math.isnan, quality.open_loop[2]))


def test_a_table_in_units() -> None:
    data = recorded(*[60] * 10)
    data["next", "observation"][:, 0] = data["observation"][:, 0] = 2.0
    quality = measure_quality(
        Known(A * 3, B), read_transitions(data), names=["angle", "rate"], units=["rad", "rad/s"]
    )
    lines = str(quality).splitlines()
    assert lines[0].startswith("540 transitions trained on, 60 kept out of training")
    assert lines[1].split()[:4] == ["entry", "unit", "spread", "change"]
    angle, rate = (line.split() for line in lines[2:4])
    assert angle[:5] == ["angle", "rad", "0", "0", f"{quality.rmse[0]:.3g}"] and "constant" in angle
    assert rate[1] == "rad/s" and f"{quality.explained[1]:.2%}".replace("%", " %") in lines[3]
    assert len({len(line) for line in lines[1:4]}) == 1


def test_a_model_that_diverges_is_told() -> None:
    quality = measure_quality(Known(A * 1e9, B), read_transitions(recorded(*[60] * 10)))
    assert quality.open_loop[50] == (math.inf, math.inf)
    assert "diverges" in str(quality)


class Disagreeing(Known):
    """Members whose gains are the mean's, less or more of a share."""

    def __init__(self, share: float) -> None:
        super().__init__(A, B)
        self.factors = torch.tensor([1 - share, 1 + share])[:, None, None]

    def member_changes(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return observation @ (A.T - torch.eye(2)) + self.factors * (action @ B.T)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_members_that_disagree_on_the_gain_are_no_model_for_l1(share: float) -> None:
    quality = measure_quality(Disagreeing(share), read_transitions(recorded(*[60] * 10)))
    assert quality.gain_spread == pytest.approx(share, abs=1e-3)
    assert bool(quality.warning) is (share > 0.3)
    assert f"members differ by {100 * share:.1f} %" in str(quality)
    if share > 0.3:
        assert "differ by 50 % (more than 30 %) in what the action does" in quality.warning
        assert quality.warning in str(quality)


def test_a_single_member_agrees_with_nobody() -> None:
    model = EnsembleDynamics(2, 1, members=1, hidden=(4,))
    quality = measure_quality(model, read_transitions(recorded(*[60] * 10)))
    assert math.isnan(quality.gain_spread) and not quality.warning
    assert "members" not in str(quality) and "look like an input of" in str(quality)


def test_an_error_is_given_as_the_input_that_looks_like_it() -> None:
    data = recorded(*[60] * 10)
    data["next", "observation"] += 0.7 * B.squeeze(-1)
    quality = measure_quality(Disagreeing(0.0), read_transitions(data))
    assert quality.input_error == (pytest.approx(0.7, rel=1e-3),)


@pytest.mark.parametrize("given", [{"names": ["a"]}, {"units": ["m", "s", "kg"]}, {"names": "ab"}])
def test_names_and_units_are_as_many_as_entries(given: dict[str, list[str]]) -> None:
    with pytest.raises(ValueError, match="must hold one for each of the observation's 2 entries"):
        measure_quality(Known(A, B), read_transitions(recorded(20)), **given)
