"""Theorem 1 of arXiv 2403.14860 on plants whose every constant is known.

    python docs/results/theorem1.py [--quick] [FOLDER]

Writes runs.csv, slopes.csv, matched.csv, their tables and figures into FOLDER, by default
`theorem1` beside this file. All errors are those of the estimate, in state units per second.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from theorem1_figures import MATCHED, SLOPES, Row, draw_errors, draw_floors, table
from theorem1_plants import (
    Alternating,
    Constants,
    Linear,
    Pendulum,
    Plant,
    Resting,
    Sampled,
    norm,
)
from torch import Tensor

from torchrl_l1.control import ActionJacobian, L1Config, init, solve_matched
from torchrl_l1.control.affine import augment
from torchrl_l1.experiment.files import write_table

SAMPLING_TIMES = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005)
TOLERANCES = (0.0, 0.05, 0.2, 0.8)  # epsilon_a, state units per second
NOISES = (1e-5, 1e-4, 1e-3)
CUTOFF = 5.0  # rad/s, the same at every sampling time; as alpha = 0.35 it would grow as 1 / T
LONGEST_SUBSTEP = 0.005


class Discrete:
    """The model as the law takes it: change per step, by Euler's rule."""

    def __init__(self, plant: Plant, dt: float) -> None:
        self.plant, self.dt = plant, dt

    def mean_change(self, x: Tensor, u: Tensor) -> Tensor:
        """Change of state in one step."""
        return self.dt * self.plant.model(x, u)

    def value_and_jacobian(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """The same and its derivative with respect to the input."""
        return self.mean_change(x, u), self.dt * self.plant.input_matrix(x, u)


def advance(plant: Plant, t: float, x: Tensor, u: Tensor, dt: float) -> Tensor:
    """The state a substep later, by Runge and Kutta's rule of fourth order."""
    first = plant.derivative(t, x, u)
    second = plant.derivative(t + dt / 2, x + dt / 2 * first, u)
    third = plant.derivative(t + dt / 2, x + dt / 2 * second, u)
    fourth = plant.derivative(t + dt, x + dt * third, u)
    return x + dt / 6 * (first + 2 * second + 2 * third + fourth)


def gains(config: L1Config) -> tuple[float, float]:
    """Kappa and rho: an estimate is kappa times the mean uncertainty plus rho times the last."""
    kappa, predictor = config.adaptation_gain, config.predictor_gain
    assert isinstance(kappa, float) and isinstance(predictor, float)
    return kappa, 1 - predictor


def largest_estimate(known: Constants, epsilon: float, config: L1Config) -> tuple[float, float]:
    """Bounds of a step's mean uncertainty and of the estimate."""
    kappa, rho = gains(config)
    uncertainty = known.model_error + epsilon + known.model_by_state * known.speed * config.dt / 2
    return uncertainty, kappa * uncertainty / (1 - abs(rho))


def input_rate(known: Constants, epsilon: float, config: L1Config) -> float:
    """Bound of the executed input's change per second."""
    matched = known.gain * largest_estimate(known, epsilon, config)[1]
    return known.input_rate + config.filter_gain / config.dt * 2 * matched


def proof_bound(known: Constants, epsilon: float, config: L1Config, holds: int = 1) -> float:
    """The theorem's bound with the constant of its proof; ``holds`` is 1 in print."""
    lipschitz = known.by_time + known.by_state * known.speed
    lipschitz += known.by_input and known.by_input * input_rate(known, epsilon, config)
    decay = -math.expm1(-config.dt)
    return 2 * epsilon + decay * (known.model_error + epsilon) + holds * lipschitz * config.dt


def sampled_bound(known: Constants, epsilon: float, config: L1Config) -> float:
    """The bound of the law as it runs, over the whole of every hold (see the page)."""
    kappa, rho = gains(config)
    dt = config.dt
    uncertainty, estimate = largest_estimate(known, epsilon, config)
    drift = 1.5 * (known.by_time + known.by_state * known.speed)
    drift += known.by_input and known.by_input * input_rate(known, epsilon, config)
    drift += known.model_by_state * known.speed / 2
    return 2 * epsilon + drift * dt + (1 - kappa) * uncertainty + abs(rho) * estimate


def simulate(
    plant: Plant,
    dt: float,
    epsilon: float,
    cutoff: float = CUTOFF,
    noise: float = 0.0,
    horizon: float = 1.0,
) -> Row:
    """One closed loop from rest: largest errors of the estimate beside the bounds.

    Args:
        plant: the plant; its phases are the rows of the batch.
        dt: sampling time.
        epsilon: tolerance of the affine model per second; the law's own is ``dt`` times it.
        cutoff: of the filter; 0 estimates without acting.
        noise: standard deviation of what is added to every measured entry.
        horizon: seconds.
    """
    config = L1Config(
        dt,
        epsilon=epsilon * dt,
        cutoff=cutoff,
        action_low=-plant.limit,
        action_high=plant.limit,
    )
    kappa, _ = gains(config)
    model = ActionJacobian(Discrete(plant, dt))
    rows = len(plant.phase)
    x = torch.zeros(rows, plant.n, dtype=torch.float64)
    state = init([rows], plant.n, plant.m, dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    substeps = max(1, math.ceil(dt / LONGEST_SUBSTEP))
    first = sampled = held = missed = fastest = widest = square = 0.0
    steps = round(horizon / dt)
    for k in range(steps):
        measured = x
        if noise:
            measured = x + noise * torch.randn(x.shape, generator=generator, dtype=x.dtype)
        action = plant.policy(k, k * dt, x)
        predicted = state.x_hat if k else measured
        estimate = kappa * (measured - predicted) / dt
        u, state, _ = augment(config, model, state, measured, action)
        step_u = (u - state.u_bar).unsqueeze(-1)

        def affine(x: Tensor, u_bar: Tensor = state.u_bar, step_u: Tensor = step_u) -> Tensor:
            return plant.model(x, u_bar) + (plant.input_matrix(x, u_bar) @ step_u).squeeze(-1)

        missed = max(missed, norm(plant.model(x, u) - affine(x)).max().item())
        for substep in range(substeps + 1):
            t = k * dt + substep * dt / substeps
            rate = plant.derivative(t, x, u)
            error = norm(rate - affine(x) - estimate)
            fastest, widest = (
                max(fastest, norm(rate).max().item()),
                max(widest, norm(x).max().item()),
            )
            if k == 0:
                first = max(first, error.max().item())
            else:
                held = max(held, error.max().item())
                if substep == 0:
                    sampled = max(sampled, error.max().item())
                    square += error.square().mean().item() / (steps - 1)
            if substep < substeps:
                x = advance(plant, t, x, u, dt / substeps)
    known = plant.constants()
    assert widest < known.radius and fastest < known.speed, (plant.name, widest, fastest)
    actual = max(epsilon, missed)
    return {
        "plant": plant.name,
        "acting": float(cutoff > 0),
        "noise": noise,
        "epsilon_a": epsilon,
        "sampling_time": dt,
        "error": held,
        "error_at_samples": sampled,
        "error_rms": math.sqrt(square),
        "first_error": first,
        "first_bound": known.model_error + actual,
        "affinization_error": missed,
        "switches_per_1000": 1000 * state.n_switch.double().mean().item() / steps,
        "speed": fastest,
        "speed_bound": known.speed,
        "bound": sampled_bound(known, actual, config),
        "bound_in_print": proof_bound(known, actual, config),
        "bound_two_holds": proof_bound(known, actual, config, holds=2),
    }


def all_runs(
    times: Sequence[float], tolerances: Sequence[float], noises: Sequence[float], rows: int
) -> list[Row]:
    """Every plant, tolerance, noise and sampling time, for this many phases."""
    phase = torch.linspace(0, 2 * math.pi, rows + 1, dtype=torch.float64)[:-1]
    runs = []
    for dt in times:
        runs.append(simulate(Linear(phase), dt, 0.0))
        for epsilon in tolerances:
            for cutoff in (0.0, CUTOFF):
                runs.append(simulate(Pendulum(phase), dt, epsilon, cutoff))
            if epsilon:
                runs.append(simulate(Alternating(phase, epsilon), dt, epsilon, 0.0))
        runs.append(simulate(Sampled(phase), dt, 0.0, 0.0))
        quiet = simulate(Linear(phase), dt, 0.0, 0.0)
        for noise in noises:
            noisy = simulate(Linear(phase), dt, 0.0, 0.0, noise)
            covariance = residual_covariance(Linear(phase), dt, torch.full((4,), noise).double())
            added = covariance.trace().item() / dt**2
            runs.append(noisy | {"rms_expected": math.hypot(float(quiet["error_rms"]), added**0.5)})
    return runs


def slope(rows: Iterable[Row], column: str = "error") -> float:
    """Exponent of the error as a power of the sampling time."""
    points = np.log([(float(row["sampling_time"]), float(row[column])) for row in rows])
    return float(np.polyfit(points[:, 0], points[:, 1], 1)[0]) if len(points) > 1 else math.nan


def slopes(runs: Sequence[Row]) -> list[Row]:
    """Per plant and tolerance without noise: slope and floor beside the bounds.

    The slope is fitted where the sampling time rules: where the error is above 4 epsilon_a. The
    floor is what a line through the two shortest sampling times gives at 0.
    """
    keys = dict.fromkeys((r["plant"], r["acting"], r["epsilon_a"]) for r in runs if not r["noise"])
    found = []
    for key in keys:
        rows = [
            r for r in runs if (r["plant"], r["acting"], r["epsilon_a"]) == key and not r["noise"]
        ]
        ruled = [r for r in rows if float(r["error"]) > 4 * float(r["epsilon_a"])]
        finest = min(rows, key=lambda r: float(r["sampling_time"]))
        epsilon, error = float(finest["epsilon_a"]), float(finest["error"])
        (fine, at_fine), (coarse, at_coarse) = sorted(
            (float(r["sampling_time"]), float(r["error"])) for r in rows
        )[:2]
        floor = (coarse * at_fine - fine * at_coarse) / (coarse - fine)
        found.append(
            {
                "plant": key[0],
                "acting": key[1],
                "epsilon_a": epsilon,
                "slope": slope(ruled) if len(ruled) > 2 else math.nan,
                "points": len(ruled),
                "smallest_error": error,
                "floor": floor,
                "floor_over_epsilon": floor / epsilon if epsilon else math.nan,
                "affinization_error": max(float(r["affinization_error"]) for r in rows),
                "closest_to_bound": max(float(r["error"]) / float(r["bound"]) for r in rows),
                "loosest_bound": max(float(r["bound"]) / float(r["error"]) for r in rows),
                "closest_to_print": max(
                    float(r["error"]) / float(r["bound_in_print"]) for r in rows
                ),
            }
        )
    return found


def residual_covariance(plant: Linear, dt: float, noise: Tensor) -> Tensor:
    """Of the law's one-step residual, where entries are measured with these deviations.

    The noise of a measurement enters twice, as what is predicted from and as what is compared.
    """
    kappa, rho = gains(L1Config(dt))
    once, through = noise.square().diag(), torch.eye(plant.n).double() + dt * plant.a_hat
    both = through @ once @ through.mT + once - rho * (once @ through.mT + through @ once)
    return kappa**2 / (1 - rho**2) * both


def residuals(plant: Resting, dt: float, noise: Tensor, steps: int, seed: int) -> Tensor:
    """The law's one-step residuals of the resting plant ``(steps, rows, n)``."""
    config = L1Config(dt, alpha=0.0)
    kappa, _ = gains(config)
    model = ActionJacobian(Discrete(plant, dt))
    state = init(plant.rest.shape[:1], plant.n, plant.m, dtype=torch.float64)
    action = torch.zeros(len(plant.rest), plant.m).double()
    generator = torch.Generator().manual_seed(seed)
    found = []
    for _ in range(steps):
        drawn = torch.randn(plant.rest.shape, generator=generator, dtype=torch.float64)
        measured = plant.rest + noise * drawn
        found.append(kappa * (measured - state.x_hat))
        _, state, _ = augment(config, model, state, measured, action)
    return torch.stack(found[10:])  # before, the law settles


def solve_weighted(jacobian: Tensor, residual: Tensor, covariance: Tensor) -> Tensor:
    """Generalised least squares: both sides whitened, then the law's own solver."""
    both = torch.cat([jacobian, residual.unsqueeze(-1)], -1)
    factor = torch.linalg.cholesky(covariance)
    white = torch.linalg.solve_triangular(factor, both, upper=False)
    return solve_matched(white[..., :-1], white[..., -1])[0]


def matched_parts(rows: int, steps: int, dt: float = 0.02) -> list[Row]:
    """Variance and bias of the matched part: ordinary and weighted, beside closed forms."""
    matched = torch.tensor([0.5, -0.3]).double()
    found: list[Row] = []
    for ratio in (1.0, 10.0, 100.0):
        noise = torch.tensor([0.01 / ratio, 0.01 / ratio, 0.01, 0.01]).double()
        undisturbed = residuals(Resting(rows, 0 * matched, 0.0), dt, noise, steps, seed=1)
        plant = Resting(rows, matched, 0.3)
        residual = residuals(plant, dt, noise, steps, seed=2)
        jacobian = dt * plant.b_hat
        exact = residual_covariance(plant, dt, noise)
        kappa, rho = gains(L1Config(dt))
        mean = kappa / (1 - rho) * dt * plant.disturbance
        bound = torch.linalg.inv(jacobian.mT @ torch.linalg.solve(exact, jacobian))
        for name, used, weights in (
            ("ordinary", torch.eye(plant.n).double(), torch.eye(plant.n).double()),
            ("weighted", undisturbed.reshape(-1, plant.n).T.cov(), exact),
        ):
            estimate = solve_weighted(jacobian.expand(*residual.shape, 2), residual, used)
            inverse = torch.linalg.inv(weights)
            left = torch.linalg.solve(jacobian.mT @ inverse @ jacobian, jacobian.mT @ inverse)
            variance = estimate.var((0, 1)).sum().item()
            found.append(
                {
                    "noise_ratio": ratio,
                    "estimator": name,
                    "variance": variance,
                    "variance_expected": (left @ exact @ left.mT).trace().item(),
                    "cramer_rao": bound.trace().item(),
                    "over_cramer_rao": variance / bound.trace().item(),
                    "bias": norm(estimate.mean((0, 1)) - matched).item(),
                    "bias_expected": norm(left @ mean - matched).item(),
                    "gain": torch.linalg.matrix_norm(dt * left, 2).item(),
                }
            )
    return found


def main(folder: Path, quick: bool = False) -> None:
    """Run everything and write it."""
    folder.mkdir(parents=True, exist_ok=True)
    if quick:
        runs = all_runs((0.04, 0.02, 0.01), TOLERANCES[::2], NOISES[-1:], rows=4)
    else:
        runs = all_runs(SAMPLING_TIMES, TOLERANCES, NOISES, rows=16)
    fitted, matched = slopes(runs), matched_parts(256, 60 if quick else 300)
    for name, rows in (("runs", runs), ("slopes", fitted), ("matched", matched)):
        write_table(folder / f"{name}.csv", rows)
    for row in fitted:
        row["acting"] = "yes" if row["acting"] else "no"
    (folder / "slopes.md").write_text(table(fitted, SLOPES) + "\n")
    (folder / "matched.md").write_text(table(matched, MATCHED) + "\n")
    draw_errors(runs, folder / "errors.png")
    draw_floors(runs, folder / "floors.png")
    print(table(fitted, SLOPES), table(matched, MATCHED), sep="\n\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parent / "theorem1")
    parser.add_argument("--quick", action="store_true", help="a few seconds, for the tests")
    main(**vars(parser.parse_args()))
