"""From a policy to a model: collecting data, fitting, and tuning the switching law."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Bounded, ReplayBuffer, TensorSpec
from torchrl.envs import (
    Compose,
    EnvBase,
    InitTracker,
    TensorDictPrimer,
    Transform,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.utils import get_primers_from_module

from torchrl_l1.algorithms.collection import seed_streams, stream_seed
from torchrl_l1.control.pipeline import transforms_of
from torchrl_l1.dynamics import EnsembleDynamics, read_transitions
from torchrl_l1.dynamics.transitions import check_time_step
from torchrl_l1.envs import EnvironmentSource

FEW_OBSERVATIONS = 5
"""For observations narrower than this, the paper's rule of thumb allows few switches."""

_MEAN_HOLD = 10

_ROWS = 10  # number of rows into which recorded steps are arranged
_ROUNDING = 1e-5  # of a bound


class Acting(TensorDictModuleBase):
    """A policy whose actions are checked: their shape, and how many exceed the bounds.

    Args:
        policy: the policy.
        action: spec of the action, for all environments.

    Attributes:
        steps: steps so far, summed over the environments.
        beyond: number of them with an action beyond the bounds.

    Raises:
        ValueError: if the policy fails at its first call, or returns another shape.
    """

    def __init__(self, policy: TensorDictModuleBase, action: TensorSpec) -> None:
        super().__init__()
        self.policy = policy
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self.shape = action.shape
        self.bounds = None
        if isinstance(action, Bounded):
            low, high = action.space.low, action.space.high
            self.bounds = low - _ROUNDING * low.abs(), high + _ROUNDING * high.abs()
        self.steps = self.beyond = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act."""
        count = tensordict.batch_size.numel()
        try:
            tensordict = self.policy(tensordict)
        except Exception as error:
            if self.steps:
                raise
            # A policy made for something else may raise anything.
            raise ValueError(
                f"the policy failed at its first call, with observations of shape "
                f"{list(tensordict['observation'].shape)} and {tensordict['observation'].dtype}: "
                f"{' '.join(str(error).split())[:200] or type(error).__name__}"
            ) from error
        action = tensordict.get("action")
        if action.shape != self.shape:
            raise ValueError(
                f"the policy returned an action of shape {list(action.shape)} for {count} "
                f"environments side by side, expected {list(self.shape)}: one vector for each"
            )
        self.steps += count
        if self.bounds is not None:
            low, high = self.bounds
            self.beyond += int(((action < low) | (action > high)).any(-1).sum())
        return tensordict

    def warn_of_bounds(self) -> None:
        """Warn if actions lay beyond the bounds."""
        if self.beyond:
            warnings.warn(
                f"{self.beyond} of {self.steps} actions of the policy lie beyond the environment's "
                "bounds: L1 and the oracle clip them, while without L1 disturbances act on the "
                "unclipped actions, so that the rows differ by this too; clip them in the policy",
                stacklevel=2,
            )


class Exploration(TensorDictModuleBase):
    r"""A policy with noise on its action, for data that a model can be fitted to.

    Half of the noise is held for a random number of steps, ten on average: the model must learn
    the effect of an action that is off for a while, as under a disturbance. The other half is new
    in every step. The level of both is drawn together with the held part, between zero and twice
    ``noise``, so that some data are close to the policy itself. Actions stay within their bounds.

    Args:
        policy: the policy.
        action: spec of the action, for all environments.
        noise: standard deviation as a fraction of half the action range, or in action units if the
            action is unbounded.
    """

    def __init__(self, policy: TensorDictModuleBase, action: TensorSpec, noise: float) -> None:
        super().__init__()
        self.policy = Acting(policy, action)
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        bounds = action.space if isinstance(action, Bounded) else None
        self.low = None if bounds is None else bounds.low
        self.high = None if bounds is None else bounds.high
        zero = action.zero()
        half = torch.ones_like(zero)
        if self.low is not None and self.high is not None:
            range_ = self.high - self.low
            half = torch.where(range_.isfinite(), 0.5 * range_, 1.0)
        self.scale = noise * half
        self.held = torch.randn_like(zero)
        self.level = 2 * torch.rand_like(zero[..., :1])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the policy's action with noise added."""
        tensordict = self.policy(tensordict)
        renewed = torch.rand_like(self.level) < 1 / _MEAN_HOLD
        self.held = torch.where(renewed, torch.randn_like(self.held), self.held)
        self.level = torch.where(renewed, 2 * torch.rand_like(self.level), self.level)
        noise = 0.5**0.5 * self.level * (self.held + torch.randn_like(self.held))
        action = tensordict.get("action") + self.scale * noise
        if self.low is not None:
            action = action.clamp(self.low, self.high)
        return tensordict.set("action", action)


def policy_transforms(
    policy: TensorDictModuleBase, make_env: Callable[[], EnvBase]
) -> list[Transform]:
    """Transforms that an environment needs for a policy with a memory, at any depth in the policy.

    Args:
        policy: the policy.
        make_env: makes such an environment; what it already has is not added again.
    """
    primers = get_primers_from_module(policy, warn=False)
    tracked = "is_init" in policy.in_keys
    if primers is None and not tracked:
        return []
    there = set(make_env().full_observation_spec.keys(True, True))
    found: list[Transform] = []
    if tracked and "is_init" not in there:
        found.append(InitTracker())
    for primer in () if primers is None else primers.modules():
        if isinstance(primer, TensorDictPrimer) and set(primer.primers.keys(True, True)) - there:
            found.append(primer.clone() if isinstance(primers, Compose) else primer)
    return found


def collect(
    source: EnvironmentSource,
    policy: TensorDictModuleBase,
    steps: int,
    environments: int,
    noise: float,
    seed: int,
    on_step: Callable[[int], object] | None = None,
) -> TensorDictBase:
    """Undisturbed steps of a policy with exploration noise.

    Args:
        source: makes the environments.
        policy: the policy.
        steps: minimum number of steps, all environments together.
        environments: number of environments stepped at once.
        noise: see :class:`Exploration`.
        seed: seed of resets and noise.
        on_step: called with the number of new steps, for progress bars.

    Returns:
        ``[environments, T]``; within a row, episodes follow each other.
    """
    env = source.several(environments, control=policy_transforms(policy, source.one))
    env.set_seed(stream_seed(seed, "collect") % 2**31)
    seed_streams(seed, "collect")
    rows = env.batch_size.numel()
    exploring = Exploration(policy, env.full_action_spec["action"], noise)

    def progress(*_: object) -> None:
        if on_step is not None:
            on_step(rows)

    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        data = env.rollout(
            -(-steps // rows), exploring, callback=progress, break_when_any_done=False
        )
    env.close()
    return data if data.ndim == 2 else data.reshape(rows, -1)


def check_surroundings(env: EnvBase) -> None:
    """Refuse an environment that already has a controller.

    Raises:
        ValueError: naming it.
    """
    for transform in transforms_of(env):
        if getattr(transform, "controls", False):
            raise ValueError(
                f"the environment already has {type(transform).__name__}, and a second controller "
                "would act beside it: give the environment without it"
            )


def warn_of_disturbances(env: EnvBase) -> None:
    """Warn of disturbances in the data: the model would take a bias for nominal dynamics."""
    for transform in transforms_of(env):
        if callable(getattr(transform, "compensate", None)):
            warnings.warn(
                f"the environment already has {type(transform).__name__}: the model takes it for "
                "part of the plant, and L1 will not cancel it; give robustify the undisturbed "
                "environment, and disturb it in the evaluation",
                stacklevel=3,
            )


def agreed_time_step(source: EnvironmentSource, dt: float | None) -> float:
    """Time of a step in seconds, as given or else as told by the environment.

    Raises:
        ValueError: if it is unknown, or differs from the environment's.
    """
    name, told = source.name or "the environment", source.time_step()
    if dt is None:
        if told is None:
            raise ValueError(f"{name} does not tell its time step: give dt (--dt), in seconds")
        return told
    if told is not None and abs(dt - told) > 1e-4 * told:
        raise ValueError(
            f"dt={dt:.6g} was given, but a step of {name} takes {told:.6g} s: leave dt out"
        )
    return dt


def recorded(
    data: TensorDictBase | ReplayBuffer | Sequence[TensorDictBase], env: EnvBase, dt: float
) -> TensorDictBase:
    """Recorded steps in the form of :func:`collect`'s, with everything but transitions left out.

    Args:
        data: undisturbed transitions, see :func:`~torchrl_l1.dynamics.read_transitions`.
        env: the environment that they come from.
        dt: time of its steps in seconds; if the data include a time step, it may differ by 2 %, as
            clocks do.

    Returns:
        ``[rows, T]``, float32.

    Raises:
        ValueError: if widths or time step are not the environment's, or there are too few
            transitions.
    """
    check_time_step(data, dt, "the environment")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the fit reads them too and warns of what it drops
        found = read_transitions(data, dtype=torch.float32)
    count = len(found.data)
    for name, spec in (
        ("observation", env.full_observation_spec["observation"]),
        ("action", env.full_action_spec["action"]),
    ):
        width = found.data[name].shape[-1] if count else 0
        if count < 2 or width != spec.shape[-1]:
            raise ValueError(
                f"the data hold {count} transitions with an {name} of width {width}, but the "
                f"environment's has width {spec.shape[-1]}: are they from this environment?"
            )
    steps = found.data.set(("next", "done"), ~found.joined[:, None])
    rows = max(1, min(_ROWS, count // _ROWS))
    return steps[: count // rows * rows].reshape(rows, -1)


def target_switch_rate(observation_dim: int) -> float:
    """Switches per 1000 steps in the middle of the paper's rule of thumb.

    It asks for 0 to 100 where the observation has fewer than five entries, and for 200 to 500
    where it has more (arXiv 2403.14860, appendix).

    Examples:
        >>> target_switch_rate(4), target_switch_rate(17)
        (50.0, 350.0)
    """
    return 50.0 if observation_dim < FEW_OBSERVATIONS else 350.0


@torch.no_grad()
def switch_rates(
    model: EnsembleDynamics, observation: Tensor, action: Tensor, started: Tensor, epsilon: Tensor
) -> Tensor:
    """Switches per 1000 steps that the switching law would make along recorded steps.

    Args:
        model: the learned dynamics.
        observation: ``(N, T, n)``.
        action: ``(N, T, m)``, where the affine model is tested.
        started: ``(N, T)`` bool, false where an episode begins.
        epsilon: tolerances ``(K,)``, state units.

    Returns:
        ``(K,)``.

    Examples:
        >>> _ = torch.manual_seed(0)
        >>> model = EnsembleDynamics(2, 1, hidden=(8,))
        >>> x, u = torch.randn(1, 50, 2), torch.randn(1, 50, 1)
        >>> started = torch.ones(1, 50, dtype=torch.bool)
        >>> rates = switch_rates(model, x, u, started, torch.tensor([0.0, 1e9]))
        >>> bool(rates[0] > 900), float(rates[1])
        (True, 0.0)
    """
    rows, count = observation.shape[0], len(epsilon)
    u_bar = action[:, 0].expand(count, *action[:, 0].shape)
    switches = torch.zeros(count, dtype=torch.float64)
    for step in range(observation.shape[1]):
        x = observation[:, step].expand(count, rows, -1)
        u = action[:, step].expand(count, rows, -1)
        u_bar = torch.where(started[:, step, None], u_bar, u)
        error = torch.linalg.vector_norm(model.taylor_remainder(x, u_bar, u), dim=-1)
        switch = (error > epsilon[:, None]) & started[:, step]
        u_bar = torch.where(switch[..., None], u, u_bar)
        switches += switch.sum(1)
    return 1000 * switches / max(1, int(started.sum()))


def epsilon_for(
    model: EnsembleDynamics, data: TensorDictBase, rate: float, most_steps: int = 2000
) -> tuple[float, float]:
    """The tolerance at which the operating point switches at a given rate along recorded steps.

    The switch rate falls as the tolerance grows; the interval that contains the solution is refined
    repeatedly, with sixteen tolerances at a time.

    Args:
        model: the learned dynamics.
        data: undisturbed steps ``[N, T]``.
        rate: switches per 1000 steps.
        most_steps: maximum number of steps used.

    Returns:
        epsilon in state units, and the rate that it gives.
    """
    length = max(2, min(data.shape[1], most_steps // data.shape[0]))
    part = data[:, :length]
    observation, action = part["observation"].float(), part["action"].float()
    done = part["next", "done"].squeeze(-1)
    started = torch.cat([torch.zeros_like(done[:, :1]), ~done[:, :-1]], 1)
    scale = torch.linalg.vector_norm(model.change_normalizer.std).item()
    low, high = 1e-6 * scale, 1e2 * scale
    for _ in range(3):
        epsilon = torch.logspace(math.log10(low), math.log10(high), 16)
        rates = switch_rates(model, observation, action, started, epsilon)
        above = int((rates > rate).sum())  # they fall
        low = float(epsilon[max(above - 1, 0)])
        high = float(epsilon[min(above, 15)])
        if high <= low:
            break
    best = int((rates - rate).abs().argmin())
    return float(epsilon[best]), float(rates[best])
