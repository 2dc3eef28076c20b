"""Theorem 1 of arXiv 2403.14860 on plants whose every constant is known.

    python docs/results/theorem1.py [--quick] [FOLDER]

Writes runs.csv, slopes.csv, matched.csv, their tables and figures into FOLDER, by default
`theorem1` beside this file. All errors are those of the estimate, in state units per second.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from matplotlib.ticker import NullLocator
from torch import Tensor

from torchrl_l1.control import ActionJacobian, L1Config, init, solve_matched
from torchrl_l1.control.affine import augment
from torchrl_l1.experiment.files import write_table
from torchrl_l1.report.page import markdown
from torchrl_l1.report.style import color, grid, legend_below, save

SAMPLING_TIMES = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005)
TOLERANCES = (0.0, 0.05, 0.2, 0.8)  # epsilon_a, state units per second
NOISES = (1e-5, 1e-4, 1e-3)
CUTOFF = 5.0  # rad/s, the same at every sampling time; as alpha = 0.35 it would grow as 1 / T
LONGEST_SUBSTEP = 0.005
Row = dict[str, str | float]


@dataclass(frozen=True)
class Constants:
    """What the theorem assumes known, over the plant's sets of states and inputs.

    Attributes:
        radius: of the ball of states.
        speed: largest norm of the state's derivative.
        model_error: largest norm of what the model misses, epsilon_l.
        by_time: Lipschitz constant of what the model misses, in time.
        by_state: the same in the state.
        by_input: the same in the input.
        model_by_state: Lipschitz constant of the model, affine or not, in the state.
        input_rate: of the policy's action in the closed loop, action units per second.
        gain: largest norm of the pseudo-inverse of the model's input matrix.
    """

    radius: float
    speed: float
    model_error: float
    by_time: float
    by_state: float
    by_input: float
    model_by_state: float
    input_rate: float
    gain: float


def vector(*entries: Tensor) -> Tensor:
    """Numbers of a batch side by side."""
    return torch.stack(entries, dim=-1)


def norm(value: Tensor) -> Tensor:
    """Euclidean norms over the last dimension."""
    return torch.linalg.vector_norm(value, dim=-1)


class Linear:
    """Two coupled masses; every entry of the state sees an input. Affine: epsilon_a is zero."""

    name, n, m, limit = "linear", 4, 2, 2.0

    def __init__(self, phase: Tensor) -> None:
        def system(stiffness: float, coupling: float, damping: float) -> Tensor:
            spring = torch.tensor([[stiffness, -coupling], [-coupling, stiffness]])
            top = torch.cat([torch.zeros(2, 2), torch.eye(2)], 1)
            return torch.cat([top, torch.cat([-spring, -damping * torch.eye(2)], 1)]).double()

        self.phase = phase
        self.a, self.a_hat = system(4.0, 1.0, 1.2), system(3.5, 0.8, 1.0)
        self.b_hat = torch.tensor([[0.2, 0.0], [0.0, 0.2], [1.0, 0.3], [-0.2, 1.2]]).double()
        self.b = self.b_hat * torch.tensor([1.1, 0.9]).double()
        # A direction that no input of the model moves.
        self.across = torch.linalg.svd(self.b_hat)[0][:, 3]
        self.feedback = torch.tensor([[0.5, 0.0, 0.3, 0.0], [0.0, 0.5, 0.0, 0.3]]).double()

    def model(self, x: Tensor, u: Tensor) -> Tensor:
        """Learned rate of change, state units per second."""
        return x @ self.a_hat.mT + u @ self.b_hat.mT

    def input_matrix(self, x: Tensor, u: Tensor) -> Tensor:
        """Its derivative with respect to the input ``(..., n, m)``."""
        return self.b_hat.expand(*x.shape, self.m)

    def derivative(self, t: float, x: Tensor, u: Tensor) -> Tensor:
        """True rate of change at a time, a state and an input."""
        time = t + self.phase
        first = 0.5 * (2 * time + x[..., 0]).sin()
        second = 0.3 * (3 * time).cos() + 0.2 * x[..., 3].sin()
        across = 0.3 * (time + x[..., 1]).sin()
        matched = vector(first, second)
        return x @ self.a.mT + (u + matched) @ self.b.mT + across.unsqueeze(-1) * self.across

    def policy(self, k: int, t: float, x: Tensor) -> Tensor:
        """Action of step ``k`` at a time and a state."""
        wave = (1.5 * (t + self.phase)).sin()
        return vector(wave, wave) - x @ self.feedback.mT

    def constants(self) -> Constants:
        """Bounds over the ball of states and the box of inputs."""

        def largest(matrix: Tensor) -> float:
            return torch.linalg.matrix_norm(matrix, 2).item()

        radius, inputs = 2.0, self.limit * math.sqrt(2)
        b, by_input = largest(self.b), largest(self.b - self.b_hat)
        disturbance = b * math.hypot(0.5, 0.3 + 0.2) + 0.3
        speed = largest(self.a) * radius + b * inputs + disturbance
        return Constants(
            radius=radius,
            speed=speed,
            model_error=largest(self.a - self.a_hat) * radius + by_input * inputs + disturbance,
            by_time=b * math.hypot(2 * 0.5, 3 * 0.3) + 0.3,
            by_state=largest(self.a - self.a_hat) + b * 0.5 + 0.3,
            by_input=by_input,
            model_by_state=largest(self.a_hat),
            input_rate=1.5 * math.sqrt(2) + largest(self.feedback) * speed,
            gain=largest(torch.linalg.pinv(self.b_hat)),
        )


def torque(u: Tensor) -> Tensor:
    """A motor that is not affine: slope from 0.5 to 1.5, curvature at most 1."""
    return u + 0.25 * (2 * u).sin()


class Pendulum:
    """A damped pendulum behind such a motor; the model has other constants.

    Args:
        phase: of disturbance and policy, one per row of the batch.
        motor: factor of the true motor; the model's is 1.6.
    """

    name, n, m, limit = "non-affine", 2, 1, 2.0
    gravity, damping, motor_hat, gravity_hat, damping_hat = 4.0, 1.0, 1.6, 3.0, 0.8

    def __init__(self, phase: Tensor, motor: float = 2.0) -> None:
        self.phase, self.motor = phase, motor

    def model(self, x: Tensor, u: Tensor) -> Tensor:
        """Learned rate of change, state units per second."""
        restoring = self.gravity_hat * x[..., 0].sin() + self.damping_hat * x[..., 1]
        return vector(x[..., 1], self.motor_hat * torque(u[..., 0]) - restoring)

    def input_matrix(self, x: Tensor, u: Tensor) -> Tensor:
        """Its derivative with respect to the input ``(..., n, m)``."""
        slope = self.motor_hat * (1 + 0.5 * (2 * u).cos())
        return torch.cat([torch.zeros_like(slope), slope], -1).unsqueeze(-1)

    def derivative(self, t: float, x: Tensor, u: Tensor) -> Tensor:
        """True rate of change at a time, a state and an input."""
        time = t + self.phase
        across = 0.1 * (3 * time + x[..., 0]).sin()
        matched = 0.4 * (2 * time).sin() + 0.2 * x[..., 1].cos()
        restoring = self.gravity * x[..., 0].sin() + self.damping * x[..., 1]
        push = self.motor * torque(u[..., 0])
        return vector(x[..., 1] + across, push - restoring + matched)

    def policy(self, k: int, t: float, x: Tensor) -> Tensor:
        """Action of step ``k`` at a time and a state."""
        return vector(1.2 * (1.5 * (t + self.phase)).sin() - 0.2 * x[..., 0])

    def constants(self) -> Constants:
        """Bounds over the ball of states and the box of inputs."""
        radius = 4.0
        push = torque(torch.tensor(self.limit)).item()  # the torque increases everywhere
        wrong = [abs(self.gravity - self.gravity_hat), abs(self.damping - self.damping_hat)]
        motor = abs(self.motor - self.motor_hat)
        forces = self.gravity + self.damping * radius + self.motor * push + 0.6
        speed = math.hypot(radius + 0.1, forces)
        return Constants(
            radius=radius,
            speed=speed,
            model_error=math.hypot(0.1, wrong[0] + wrong[1] * radius + motor * push + 0.6),
            by_time=math.hypot(3 * 0.1, 2 * 0.4),
            by_state=math.hypot(0.1, wrong[0], wrong[1] + 0.2),
            by_input=1.5 * motor,
            model_by_state=math.hypot(1.0, self.gravity_hat, self.damping_hat),
            input_rate=1.5 * 1.2 + 0.2 * speed,
            gain=1 / (0.5 * self.motor_hat),
        )


class Alternating(Pendulum):
    """The worst case: inputs that jump between both edges of the affine model's range.

    The model's motor is the true one, so that jumps of the input change no uncertainty.
    """

    name = "alternating"

    def __init__(self, phase: Tensor, epsilon: float) -> None:
        super().__init__(phase, self.motor_hat)
        self.amplitude = edge(0.999 * epsilon / self.motor_hat)

    def policy(self, k: int, t: float, x: Tensor) -> Tensor:
        """Action of step ``k`` at a time and a state."""
        # The first input is the operating point.
        return torch.full((len(x), 1), self.amplitude * (0 if k == 0 else (-1) ** k)).double()


def edge(error: float) -> float:
    """Where the tangent at 0 misses the torque by this much."""
    low, high = 0.0, 2.0
    for _ in range(60):
        middle = (low + high) / 2
        missed = 0.5 * middle - 0.25 * math.sin(2 * middle)
        low, high = (middle, high) if missed < error else (low, middle)
    return low


class Sampled(Pendulum):
    """Actions drawn anew at every step, as in training: no Lipschitz input."""

    name = "sampled actions"

    def __init__(self, phase: Tensor) -> None:
        super().__init__(phase)
        self.generator = torch.Generator().manual_seed(0)

    def policy(self, k: int, t: float, x: Tensor) -> Tensor:
        """Action of step ``k`` at a time and a state."""
        drawn = torch.rand(len(x), 1, generator=self.generator, dtype=torch.float64)
        return super().policy(k, t, x) + 0.6 * (drawn - 0.5)


Plant = Linear | Pendulum


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


class Resting(Linear):
    """The model is right; constant disturbances hold the plant away from the origin."""

    def __init__(self, rows: int, matched: Tensor, across: float) -> None:
        super().__init__(torch.zeros(rows).double())
        self.disturbance = self.b_hat @ matched + across * self.across
        self.rest = -torch.linalg.solve(self.a_hat, self.disturbance).expand(rows, self.n)


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


def selected(runs: Sequence[Row], **values: str | float) -> list[Row]:
    """The runs with these values, in order of sampling time."""
    rows = [r for r in runs if all(r[key] == value for key, value in values.items())]
    return sorted(rows, key=lambda r: float(r["sampling_time"]))


def unique(runs: Sequence[Row], column: str) -> list[float]:
    """Values of a column, ascending."""
    return sorted({float(run[column]) for run in runs})


def columns(rows: Sequence[Row], *names: str) -> list[list[float]]:
    """Columns as lists of numbers."""
    return [[float(row[name]) for row in rows] for name in names]


def draw_errors(runs: Sequence[Row], file: Path) -> None:
    """Error against sampling time, the bounds around it."""
    panels = {
        "linear": ("linear, L1 acts", 1.0),
        "non-affine": ("non-affine, L1 acts", 1.0),
        "alternating": ("non-affine, alternating input", 0.0),
    }
    figure, axes = grid(len(panels), 3, 3.7, 3.6)
    for axis, (plant, (title, acting)) in zip(axes, panels.items(), strict=True):
        for index, epsilon in enumerate(unique(runs, "epsilon_a")):
            rows = selected(runs, plant=plant, acting=acting, epsilon_a=epsilon, noise=0.0)
            if not rows:
                continue
            draw = partial(axis.plot, color=color(index), linewidth=1)
            times, error, bound, printed = columns(
                rows, "sampling_time", "error", "bound", "bound_in_print"
            )
            draw(times, error, marker="o", markersize=3, label=f"$\\epsilon_a$ = {epsilon:g}")
            draw(times, bound, linestyle="--")
            draw(times, printed, linestyle=":")
        axis.set(xscale="log", yscale="log", title=title, xlabel="sampling time (s)")
    axes[0].set_ylabel("largest error of the estimate (1/s)")
    axes[0].plot([], [], color="grey", linestyle="--", label="bound of the sampled law")
    axes[0].plot([], [], color="grey", linestyle=":", label="bound as the proof prints it")
    legend_below(figure, axes, last=("bound",))
    save(figure, file)


def draw_floors(runs: Sequence[Row], file: Path) -> None:
    """What stays as the sampling time shrinks; and what noise on the state does."""
    figure, (floors, noises) = grid(2, 2, 4.6, 3.6)
    finest = min(float(run["sampling_time"]) for run in runs)
    curves = {
        "alternating input": ("alternating", 0.0),
        "L1 acts": ("non-affine", 1.0),
        "L1 estimates only": ("non-affine", 0.0),
    }
    for index, (label, (plant, acting)) in enumerate(curves.items()):
        rows = selected(runs, plant=plant, acting=acting, sampling_time=finest, noise=0.0)
        epsilon, error = columns([r for r in rows if r["epsilon_a"]], "epsilon_a", "error")
        floors.plot(epsilon, error, marker="o", markersize=4, color=color(index), label=label)
    ends = np.array([min(epsilon), max(epsilon)])
    floors.plot(ends, 2 * ends, color="black", linestyle="--", label=r"$2\epsilon_a$")
    floors.plot(ends, ends, color="black", linestyle=":", label=r"$\epsilon_a$")
    floors.set(xlabel=r"$\epsilon_a$ (1/s)", ylabel=f"largest error at {finest:g} s (1/s)")
    floors.legend(frameon=False, fontsize=8)
    for index, noise in enumerate(unique(runs, "noise")[1:]):
        rows = selected(runs, plant="linear", noise=noise)
        times, error, expected = columns(rows, "sampling_time", "error_rms", "rms_expected")
        noises.plot(times, expected, color=color(index), linewidth=1)
        noises.plot(times, error, "o", markersize=4, color=color(index), label=f"noise {noise:g}")
    noises.plot([], [], color="grey", linewidth=1, label="closed form")
    noises.set(xlabel="sampling time (s)", ylabel="root mean square error (1/s)")
    noises.legend(frameon=False, fontsize=8)
    for axis in (floors, noises):
        axis.set(xscale="log", yscale="log")
    floors.set_xticks(list(epsilon), labels=[f"{value:g}" for value in epsilon])
    floors.xaxis.set_minor_locator(NullLocator())
    save(figure, file)


def shown(value: str | float) -> str:
    """A cell of a table."""
    if isinstance(value, str):
        return value
    return "–" if math.isnan(value) else f"{value:.3g}"


def table(rows: Sequence[Row], headings: dict[str, str]) -> str:
    """Some columns as a Markdown table."""
    return markdown([{head: shown(row[key]) for key, head in headings.items()} for row in rows])


SLOPES = {
    "plant": "plant",
    "acting": "L1 acts",
    "epsilon_a": "epsilon_a",
    "slope": "slope",
    "smallest_error": "error at the shortest T",
    "floor": "floor",
    "floor_over_epsilon": "floor / epsilon_a",
    "affinization_error": "largest affine error",
    "closest_to_bound": "largest error / bound",
    "closest_to_print": "largest error / printed bound",
}
MATCHED = {
    "noise_ratio": "noise ratio",
    "estimator": "estimator",
    "variance": "variance",
    "variance_expected": "closed form",
    "cramer_rao": "Cramér-Rao",
    "over_cramer_rao": "variance / Cramér-Rao",
    "bias": "bias",
    "bias_expected": "its closed form",
    "gain": "gain",
}


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
