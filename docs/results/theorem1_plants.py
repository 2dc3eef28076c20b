"""The plants of theorem1.py, with every constant that the theorem takes as known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


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


class Resting(Linear):
    """The model is right; constant disturbances hold the plant away from the origin."""

    def __init__(self, rows: int, matched: Tensor, across: float) -> None:
        super().__init__(torch.zeros(rows).double())
        self.disturbance = self.b_hat @ matched + across * self.across
        self.rest = -torch.linalg.solve(self.a_hat, self.disturbance).expand(rows, self.n)


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
