"""A NumPy float64 controller written from the paper's formulas, to compare with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import scipy.linalg


@dataclass
class NumpyL1:
    """One environment's controller with explicit matrix functions and an explicit h_perp.

    Continuous-time units inside: h = J / T, sigma in state units per second.
    """

    dt: float
    omega: float
    rates: np.ndarray
    low: float = -np.inf
    high: float = np.inf
    epsilon: float = np.inf
    on_switch: str = "keep"
    switch_on: str = "executed"
    filter_input: str = "previous"
    project: bool = True
    x_hat: np.ndarray | None = None
    u_bar: np.ndarray | None = None
    q: Any = 0.0
    sigma_m: Any = 0.0
    sigma_um: Any = 0.0
    n_switch: int = 0
    log: dict[str, Any] = field(default_factory=dict)

    def estimate(self, x: np.ndarray, jac: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        n, m = jac.shape
        a = np.diag(self.rates)
        phi = np.linalg.inv(a) @ (scipy.linalg.expm(a * self.dt) - np.eye(n))
        mu = scipy.linalg.expm(a * self.dt) @ (self.x_hat - x)
        sigma_hat = -np.linalg.inv(phi) @ mu
        h = jac / self.dt
        h_perp = scipy.linalg.null_space(h.T)
        parts = np.linalg.lstsq(np.hstack([h, h_perp]), sigma_hat, rcond=None)[0]
        return sigma_hat, parts[:m], parts[m:]

    def start(self, x: np.ndarray, m: int) -> None:
        self.x_hat, self.q, self.sigma_m = x.copy(), np.zeros(m), np.zeros(m)

    def control(
        self, x: np.ndarray, u_rl: np.ndarray, drift: np.ndarray, jac: np.ndarray, dry: bool = False
    ) -> np.ndarray:
        """Algorithm 1 with the affine model x' = x + drift + jac u."""
        sigma_hat, sigma_m, sigma_um = self.estimate(x, jac)
        if self.project:
            # A matched disturbance of more than the range of the actions cannot be cancelled.
            width = self.high - self.low
            sigma_m = np.clip(sigma_m, -width, width)
        source = self.sigma_m if self.filter_input == "previous" else sigma_m
        gain = self.omega * np.eye(jac.shape[1])
        q = self.q + (-gain @ self.q + gain @ source) * self.dt
        u = np.clip(u_rl - q, self.low, self.high)
        if not dry:
            rate = (drift + jac @ u) / self.dt + sigma_hat + np.diag(self.rates) @ (self.x_hat - x)
            self.x_hat = self.x_hat + self.dt * rate
            self.q, self.sigma_m, self.sigma_um = q, sigma_m, sigma_um
        return u

    def augment(
        self,
        x: np.ndarray,
        u_rl: np.ndarray,
        model: Callable[[np.ndarray, np.ndarray], np.ndarray],
        gradient: Callable[[np.ndarray, np.ndarray], np.ndarray],
    ) -> np.ndarray:
        """Algorithm 2: one step with the switching law."""
        a = np.clip(u_rl, self.low, self.high)
        if self.u_bar is None:
            self.u_bar = a
            self.start(x, len(a))
        else:
            f, jac = model(x, self.u_bar), gradient(x, self.u_bar)
            if self.switch_on == "policy":
                tested = a
            else:
                tested = self.control(x, a, f - jac @ self.u_bar, jac, dry=True)
            error = np.linalg.norm(model(x, tested) - (f + jac @ (tested - self.u_bar)))
            self.log["error"] = error
            if error > self.epsilon:
                self.u_bar = a
                self.n_switch += 1
                if self.on_switch == "reset":
                    self.start(x, len(a))
        f, jac = model(x, self.u_bar), gradient(x, self.u_bar)
        return self.control(x, a, f - jac @ self.u_bar, jac)


@pytest.fixture(scope="session")
def numpy_l1() -> type[NumpyL1]:
    return NumpyL1
