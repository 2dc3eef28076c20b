"""Settings of the L1 controller."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, Literal, get_args

import torch

from torchrl_l1.checks import check_choice

OnSwitch = Literal["keep", "reset"]
SwitchOn = Literal["policy", "executed"]
FilterInput = Literal["current", "previous"]
Estimator = Literal["least_squares", "weighted"]
Filter = Literal["low_pass", "kalman"]
Covariance = Literal["residuals", "heads", "disagreement", "sum"]
Scalars = float | tuple[float, ...]

_NUMBERS = (
    *("dt", "epsilon", "cutoff", "alpha", "dead_zone", "process_noise", "inflation"),
    *("initial_deviation", "forgetting"),
)

DEFAULT_ALPHA = 0.35
"""Filter gain per step when neither ``alpha`` nor ``cutoff`` is given: cutoff = 0.35 / dt."""

_LARGEST_RANGE = 1e9

_CHOICES = {
    "on_switch": get_args(OnSwitch),
    "switch_on": get_args(SwitchOn),
    "filter_input": get_args(FilterInput),
    "estimator": get_args(Estimator),
    "filter": get_args(Filter),
    "covariance": get_args(Covariance),
}


def follows_input(filter: str) -> bool:
    """Whether the operating point follows the executed input in every step, whatever epsilon is.

    Examples:
        >>> follows_input("kalman"), follows_input("low_pass")
        (True, False)
    """
    return filter == "kalman"


@dataclass(frozen=True)
class L1Config:
    r"""Settings of the L1 adaptive controller (arXiv 2403.14860, sections 2.2 and 3.2).

    The defaults are those of the paper's Algorithms 1 and 2. :meth:`reference` gives the settings
    of the authors' released controller. :meth:`robust` gives a controller that weighs the model's
    errors by their covariance and acts only on what is significant.

    Args:
        dt: sampling time :math:`T_s`, the duration of one environment step, in seconds.
        epsilon: largest error of the affine model, Euclidean norm in raw state units, before the
            operating point moves. It depends on the scale of the task: the paper uses 0.3 to 3.
        cutoff: cutoff frequency :math:`\omega` of the low-pass filter, in rad/s.
        alpha: filter gain per step, :math:`\alpha = \omega T_s`, in [0, 1]. Give ``cutoff`` or
            ``alpha`` or neither (the gain is then 0.35); 0 estimates without acting.
        a_s: diagonal of the predictor's Hurwitz matrix :math:`A_s`, in 1/s: one negative number
            or one per observation.
        on_switch: what a switch does to the predictor and the filter: ``"keep"`` them, as in the
            paper, or ``"reset"`` both, as in the released code.
        switch_on: the input at which the switching law tests: the ``"executed"`` one or the
            ``"policy"``'s.
        filter_input: the estimate that the filter takes in: the ``"previous"`` step's, as in the
            paper's control law, or the ``"current"`` one, as in the released code.
        action_low: lower bound of the executed action: a number, or a list, array or tensor with
            one number per action dimension, or the bounded spec of the action; ``None`` for no
            bound.
        action_high: upper bound of the executed action, likewise.
        project: whether the matched estimate that enters the filter is projected, entry by
            entry, onto ``[action_low - action_high, action_high - action_low]`` where both are
            finite. No action cancels a larger matched disturbance, and where the actions have
            almost no effect the estimate has no bound of its own. The predictor takes in the
            whole estimate either way.
        estimator: ``"least_squares"`` in raw state units, as in the paper, or ``"weighted"`` by
            the covariance of the model's one-step residuals (generalised least squares).
        filter: what turns the estimates of single steps into the adaptive input: the paper's
            ``"low_pass"`` filter, or a ``"kalman"`` filter, whose state is the matched
            disturbance as a random walk, see :mod:`torchrl_l1.control.kalman`. The latter weighs
            each step by how well the actions show in it and acts only on what is significant; it
            needs no ``cutoff``, ``alpha``, ``a_s`` or ``filter_input``. Its input is known before
            the model is expanded, so the operating point moves to the executed input in every step,
            and ``epsilon`` and ``switch_on`` have no effect.
        covariance: covariance of the residuals for both of these: ``"residuals"``, measured on the
            model's validation data; or one that depends on state and action, from the model's
            ``"heads"``, the ``"disagreement"`` of its members, or the ``"sum"`` of all three.
        dead_zone: number of posterior standard deviations of the disturbance within which the
            Kalman filter's estimate is not acted on; 0 acts on all of it.
        process_noise: standard deviation of the disturbance's change per step, as a fraction of
            half the range of the action (of one action unit without bounds, or with a range beyond
            1e9). If ``None``, the model's own value, see :func:`~torchrl_l1.control.calibrate`, or
            else 0.01.
        inflation: factor on the covariance, since residuals are neither white nor normal. If
            ``None``, the model's own value, or else 1.
        initial_deviation: standard deviation of the disturbance at a reset, in the units of
            ``process_noise``.
        forgetting: decay factor per step of the running estimate of each state's noise level, which
            detects a sensor that has become noisy; 1 turns it off.
        max_error: largest entry of the prediction error that is believed, in raw state units; may
            be infinite. Beyond it an observation counts as not finite: L1 stands aside and
            restarts.

    Raises:
        ValueError: if a setting is out of its domain, or if settings exclude each other.

    Examples:
        >>> L1Config(0.04).filter_gain
        0.35
        >>> L1Config(0.02, cutoff=10.0).filter_gain
        0.2
        >>> L1Config.reference(0.04, epsilon=3.0).on_switch
        'reset'
    """

    dt: float
    _: KW_ONLY
    epsilon: float = 1.0
    cutoff: float | None = None
    alpha: float | None = None
    a_s: Scalars = -1.0
    on_switch: OnSwitch = "keep"
    switch_on: SwitchOn = "executed"
    filter_input: FilterInput = "previous"
    action_low: Scalars | None = None
    action_high: Scalars | None = None
    project: bool = True
    estimator: Estimator = "least_squares"
    filter: Filter = "low_pass"
    covariance: Covariance = "residuals"
    dead_zone: float = 2.0
    process_noise: float | None = None
    inflation: float | None = None
    initial_deviation: float = 0.3
    forgetting: float = 0.97
    max_error: float = 1e8

    def __post_init__(self) -> None:
        # Numbers, arrays and truth values of NumPy and torch become Python's.
        object.__setattr__(self, "project", _as_number(self.project))
        for name in _NUMBERS:
            value = _as_number(getattr(self, name))
            object.__setattr__(self, name, value)
            if value is not None and not (_is_real(value) and math.isfinite(value)):
                raise ValueError(f"{name} must be a finite number, got {value!r}")
        if self.dt < 1e-15:
            raise ValueError(f"dt must be a positive time in seconds, from 1e-15, got {self.dt}")
        if self.epsilon < 0:
            raise ValueError(f"epsilon must not be negative, got {self.epsilon}")
        for name, choices in _CHOICES.items():
            check_choice(name, getattr(self, name), choices)
        for name in ("a_s", "action_low", "action_high"):
            object.__setattr__(self, name, _as_scalars(name, getattr(self, name)))
        if not isinstance(self.project, bool):
            raise ValueError(f"project must be True or False, got {self.project!r}")
        self._check_filter()
        self._check_kalman()
        object.__setattr__(self, "max_error", _as_number(self.max_error))
        if not (_is_real(self.max_error) and self.max_error > 0):
            raise ValueError(f"max_error must be a positive number, got {self.max_error!r}")
        self._check_predictor()
        self._check_bounds()

    def _check_filter(self) -> None:
        if self.cutoff is not None and self.alpha is not None:
            raise ValueError(
                "give the filter's cutoff (rad/s) or its gain per step alpha, not both: "
                f"got cutoff={self.cutoff} and alpha={self.alpha}"
            )
        if not 0 <= self.filter_gain <= 1:
            source = "alpha" if self.cutoff is None else "cutoff * dt"
            raise ValueError(f"{source} must lie in [0, 1], got {self.filter_gain}")

    def _check_kalman(self) -> None:
        if self.dead_zone < 0:
            raise ValueError(f"dead_zone must not be negative, got {self.dead_zone}")
        if self.process_noise is not None and self.process_noise < 0:
            raise ValueError(f"process_noise must not be negative, got {self.process_noise}")
        if self.inflation is not None and self.inflation <= 0:
            raise ValueError(f"inflation must be positive, got {self.inflation}")
        for name in ("dead_zone", "process_noise", "inflation", "initial_deviation"):
            if (getattr(self, name) or 0) > 1e9:  # their squares and products must not overflow
                raise ValueError(f"{name} must not exceed 1e9, got {getattr(self, name)}")
        if self.initial_deviation <= 0:
            raise ValueError(f"initial_deviation must be positive, got {self.initial_deviation}")
        if not 0 < self.forgetting <= 1:
            raise ValueError(f"forgetting must lie in (0, 1], got {self.forgetting}")
        if not self.needs_calibration:
            if self.process_noise is not None or self.inflation is not None:
                raise ValueError(
                    "process_noise and inflation belong to the Kalman filter: leave them out with "
                    "filter='low_pass'"
                )
            return
        if self.cutoff is not None or self.alpha is not None:
            raise ValueError(
                "cutoff and alpha belong to the low-pass filter: leave them out with "
                "filter='kalman', whose bandwidth follows from process_noise"
            )
        if self.on_switch == "reset":
            raise ValueError("filter='kalman' keeps its state at a switch: use on_switch='keep'")

    def _check_predictor(self) -> None:
        for rate in _tuple(self.a_s):
            if not (rate < 0 and math.isfinite(rate)):
                raise ValueError(f"a_s must be negative (a Hurwitz matrix), got {self.a_s}")
            # The prediction error is multiplied by 1 - gain + T a_s at every step.
            if _adaptation_gain(rate, self.dt) - self.dt * rate >= 2:
                raise ValueError(
                    f"a_s={rate} is too fast for dt={self.dt}: the sampled state predictor would "
                    f"be unstable; keep -a_s * dt below about 1.59"
                )

    def _check_bounds(self) -> None:
        for name, bound in (("action_low", math.inf), ("action_high", -math.inf)):
            if bound in _tuple(getattr(self, name) or 0.0):
                raise ValueError(f"{name} must not be {bound}: no action is within such a bound")
        if self.action_low is None or self.action_high is None:
            return
        low, high = _tuple(self.action_low), _tuple(self.action_high)
        if len(low) > 1 and len(high) > 1 and len(low) != len(high):
            raise ValueError(
                f"action_low has {len(low)} entries and action_high has {len(high)}: give one "
                "number or one per action dimension"
            )
        width = max(len(low), len(high))
        low, high = low * (width // len(low)), high * (width // len(high))
        if not all(a < b for a, b in zip(low, high, strict=True)):
            raise ValueError(
                "action_low must be below action_high, "
                f"got action_low={self.action_low} and action_high={self.action_high}"
            )
        if isinstance(self.action_low, tuple) or isinstance(self.action_high, tuple):
            object.__setattr__(self, "action_low", low)
            object.__setattr__(self, "action_high", high)

    @classmethod
    def paper(cls, dt: float, *, epsilon: float = 1.0, **settings: Any) -> L1Config:
        """The paper's Algorithms 1 and 2: a switch keeps predictor and filter."""
        return cls(dt, epsilon=epsilon, **settings)

    @classmethod
    def reference(cls, dt: float, *, epsilon: float = 1.0, **settings: Any) -> L1Config:
        """The authors' released controller: every switch restarts it, without projection."""
        reference: dict[str, Any] = {
            "on_switch": "reset",
            "switch_on": "policy",
            "filter_input": "current",
            "project": False,
        }
        return cls(dt, epsilon=epsilon, **(reference | settings))

    @classmethod
    def robust(cls, dt: float, **settings: Any) -> L1Config:
        """Kalman filter on covariance-weighted residuals that acts only on what is significant.

        Not in the paper: it addresses the paper's open question about the covariance of
        probabilistic models. Inflation and process noise are the model's own, found by
        :func:`~torchrl_l1.control.calibrate` where there are undisturbed episodes.
        """
        robust: dict[str, Any] = {"estimator": "weighted", "filter": "kalman"}
        return cls(dt, **(robust | settings))

    @property
    def filter_gain(self) -> float:
        r"""Gain :math:`\alpha = \omega T_s` of the discrete low-pass filter."""
        if self.cutoff is not None:
            return self.cutoff * self.dt
        return DEFAULT_ALPHA if self.alpha is None else self.alpha

    @property
    def matched_bound(self) -> Scalars | None:
        """Largest magnitude of the matched estimate that enters the filter, action units.

        ``action_high - action_low``, infinite where either bound is; ``None`` without bounds or
        without projection.
        """
        if not self.project or self.action_low is None or self.action_high is None:
            return None
        low, high = self.action_low, self.action_high
        if isinstance(low, tuple) and isinstance(high, tuple):
            return tuple(b - a for a, b in zip(low, high, strict=True))
        # The configuration expands a number given beside a tuple, so both are numbers here.
        return _tuple(high)[0] - _tuple(low)[0]

    @property
    def follows_input(self) -> bool:
        """Whether the operating point follows the executed input in every step."""
        return follows_input(self.filter)

    @property
    def needs_calibration(self) -> bool:
        """Whether the model's own ``inflation`` and ``process_noise`` may be used."""
        return self.filter == "kalman"

    @property
    def needs_covariance(self) -> bool:
        """Whether the covariance of the model's residuals is used."""
        return self.needs_calibration or self.estimator == "weighted"

    @property
    def covariance_is_late(self) -> bool:
        """Whether that covariance is evaluated one step after the residual's own step."""
        return self.filter == "kalman" and self.covariance == "residuals"

    @property
    def half_range(self) -> Scalars:
        """Half the range of the action, in action units; 1 where a bound is missing or infinite.

        A range beyond 1e9 counts as infinite: some environments write the largest number for
        infinity.
        """
        if self.action_low is None or self.action_high is None:
            return 1.0
        pairs = zip(_tuple(self.action_low), _tuple(self.action_high), strict=True)
        halves = tuple(0.5 * (b - a) if b - a < _LARGEST_RANGE else 1.0 for a, b in pairs)
        return halves if isinstance(self.action_low, tuple) else halves[0]

    @property
    def adaptation_gain(self) -> Scalars:
        r"""Diagonal of :math:`T_s \Phi^{-1} \exp(A_s T_s)`, dimensionless.

        For eigenvalue :math:`\lambda` this is :math:`-\lambda T / (\exp(-\lambda T) - 1)`,
        which tends to 1 as T tends to 0.
        """
        return _map(lambda rate: _adaptation_gain(rate, self.dt), self.a_s)

    @property
    def predictor_gain(self) -> Scalars:
        r"""Diagonal of what multiplies the prediction error in the predictor's step.

        The adaptation gain minus :math:`A_s T_s`: the estimate and the stabilising term together.
        """
        return _map(lambda rate: _adaptation_gain(rate, self.dt) - self.dt * rate, self.a_s)

    def check_dimensions(self, observation_dim: int, action_dim: int) -> None:
        """Raise ``ValueError`` if a setting given per dimension has the wrong length."""
        widths = {"a_s": observation_dim, "action_low": action_dim, "action_high": action_dim}
        for name, width in widths.items():
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) != width:
                raise ValueError(
                    f"{name} has {len(value)} entries, expected one number or {width} "
                    f"(observation width {observation_dim}, action width {action_dim})"
                )


def with_open_bounds(config: L1Config, low: Scalars | None, high: Scalars | None) -> L1Config:
    """The settings with open action bounds filled in, for example from an action spec.

    Args:
        config: the settings, whose own bounds take precedence.
        low: lower bound; ``None`` leaves it open.
        high: upper bound, likewise.
    """
    low = low if config.action_low is None else config.action_low
    high = high if config.action_high is None else config.action_high
    return replace(config, action_low=low, action_high=high)


def _adaptation_gain(rate: float, dt: float) -> float:
    # expm1, because exp(z) - 1 loses half the digits at the small z of a fast controller.
    z = -rate * dt
    if not 0 < z < 700:  # beyond these the quotient overflows or is 0 / 0: take the limits
        return 1.0 if z == 0 else 0.0
    return z / math.expm1(z)


def _is_real(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _as_number(value: Any) -> Any:
    """A NumPy or torch number, or an array that holds one, as a Python number; else unchanged."""
    if type(value) in (int, float, bool) or not hasattr(value, "item"):
        return value
    return value.item() if math.prod(getattr(value, "shape", ())) == 1 else value


def _as_scalars(name: str, value: Any) -> Scalars | None:
    if value is None:
        return None
    value = _as_list(name, value)
    entries = value if isinstance(value, Sequence) and not isinstance(value, str) else (value,)
    entries = [_as_number(entry) for entry in entries]
    if not entries or not all(_is_real(entry) and not math.isnan(entry) for entry in entries):
        raise ValueError(f"{name} must be a number or a non-empty list of numbers, got {value!r}")
    scalar = not isinstance(value, Sequence)
    return float(entries[0]) if scalar else tuple(float(entry) for entry in entries)


def _as_list(name: str, value: Any) -> Any:
    """Bounds from specs, arrays and tensors as a list; batched ones must have equal rows."""
    if name != "a_s":
        space = getattr(value, "space", value)
        value = getattr(space, name.removeprefix("action_"), value)
    if not hasattr(value, "tolist"):
        return value
    array = torch.as_tensor(value)
    if array.ndim < 2:
        return array.tolist()
    rows = array.reshape(-1, array.shape[-1])
    if not len(rows) or (rows != rows[0]).any():
        raise ValueError(f"{name} must have the same entries for all environments, got {value!r}")
    return rows[0].tolist()


def _tuple(value: Scalars) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,)


def _map(function: Callable[[float], float], value: Scalars) -> Scalars:
    return tuple(map(function, value)) if isinstance(value, tuple) else function(value)
