"""Trying a recipe's environment for a minute before spending hours in it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_l1.algorithms import Algorithm
from torchrl_l1.algorithms.collection import Collection, episode_lengths, episode_returns
from torchrl_l1.dynamics import EnsembleDynamics, fit_dynamics
from torchrl_l1.envs import AnyTask, ExternalTask, Task, action_bounds, make_env
from torchrl_l1.experiment.settings import RunSettings

STEPS = 1500
"""Approximate number of real steps with random actions."""

# Steps within which an action must have an effect.
_EFFECT_STEPS = 5
_FEWEST_EPISODES, _MOST_EPISODES = 8, 25

# A reward function agrees if it explains this share of the variance of the rewards, and agrees
# exactly if it is this close to them, in standard deviations.
_AGREES, _EXACT = 0.95, 1e-3

# Explained share of the variance of an entry's changes below which a model is of little use.
_POOR = 0.2


@dataclass(frozen=True)
class Finding:
    """One finding of a trial.

    Attributes:
        text: what was found.
        fix: what to do about it; empty if nothing.
    """

    text: str
    fix: str = ""

    def __str__(self) -> str:
        """The finding as one line."""
        return f"fix  {self.text}: {self.fix}" if self.fix else f"ok   {self.text}"


def describe(task: AnyTask) -> list[str]:
    """The facts of a task, as lines.

    Examples:
        >>> from torchrl_l1.envs import get_task
        >>> print(describe(get_task("gymnasium/Pendulum-v1"))[0])
        observation of 3 entries, action of 1 entry from -2 to 2
    """
    entries = "entry" if task.action_dim == 1 else "entries"
    lines = [
        f"observation of {task.observation_dim} entries, action of {task.action_dim} {entries} "
        f"from {_numbers(task.action_low)} to {_numbers(task.action_high)}",
        f"a step takes {task.dt:g} s, an episode {task.horizon} steps",
    ]
    if isinstance(task, ExternalTask):
        known = "reward and termination are known functions of the observation"
        if task.outcome is None:
            known = "reward and termination are not known as functions of the observation"
        elif task.outcome.note:
            known += f", where {task.outcome.note}"
        lines.append(known)
    return lines


def _numbers(bound: float | tuple[float, ...]) -> str:
    entries = bound if isinstance(bound, tuple) else (bound,)
    return ", ".join(f"{value:g}" for value in entries)


def trial(recipe: RunSettings, steps: int = STEPS) -> Iterator[Finding]:
    """Try a recipe's environment; yields one finding at a time.

    Args:
        recipe: the settings.
        steps: approximate number of real steps with random actions.

    Raises:
        KeyError: for an unknown task.
        ValueError: for an environment that cannot be used at all.
    """
    task = recipe.real_task()
    for line in describe(task):
        yield Finding(line)
    algorithm = recipe.build()
    yield Finding(f"{recipe.algorithm} can be built")
    horizon = algorithm.horizon
    count = min(_MOST_EPISODES, max(_FEWEST_EPISODES, round(steps / min(horizon, steps))))
    length = min(horizon, max(1, steps // count))
    data = _random(algorithm, count, length, recipe.seed)
    yield from _about_data(task, data, horizon)
    if not len(_flat(data)):
        return  # as the first finding about the data reports
    seeded = _about_seeds(algorithm, data, count, length, recipe.seed)
    yield seeded
    if not seeded.fix:  # otherwise it cannot be judged
        yield from _about_actions(task, data, recipe.seed)
    yield from _about_rewards(algorithm, data)
    yield from _about_terminations(algorithm, data)
    yield from _about_model(data, recipe)


def _random(algorithm: Algorithm, count: int, length: int, seed: int) -> TensorDictBase:
    collection: Collection = algorithm.real(
        policy=next(iter(algorithm.policies.values())), episodes=count, horizon=length, l1=None
    )
    return collection.random(seed)


def _about_data(task: AnyTask, data: TensorDictBase, horizon: int) -> Iterator[Finding]:
    lost = int(data["next", "non_finite"].sum())
    if lost:
        yield Finding(
            f"{lost} of {data.numel()} steps gave observations or rewards that are not finite",
            "check the environment's step; these steps are left out of the data",
        )
    returns, lengths = episode_returns(data), episode_lengths(data)
    text = f"{data.numel()} random steps"
    if len(returns):
        text += f", returns {returns.min():.4g} to {returns.max():.4g}"
    yield Finding(f"{text}, episodes of {int(lengths.min())} to {int(lengths.max())} steps")
    if lengths.float().mean() < 0.1 * min(horizon, data.shape[1]):
        yield Finding(
            "random actions end an episode at once",
            "set random_steps or episode_steps to a few times that length",
        )
    observation = data["observation"].flatten(0, 1).double()
    still = (observation.std(0) == 0).nonzero().flatten().tolist()
    if still:
        yield Finding(f"entries {still} of the observation never change: they carry no information")
    spread = observation.std(0)
    large = (spread > 1e4).nonzero().flatten().tolist()
    if large:
        yield Finding(
            f"entries {large} of the observation spread over more than 10 000 units",
            "rescale them in the environment: they are too large for single precision and "
            "model.std_floor",
        )


def _about_seeds(
    algorithm: Algorithm, data: TensorDictBase, count: int, length: int, seed: int
) -> Finding:
    again = _random(algorithm, count, length, seed)
    if torch.equal(data["next", "observation"], again["next", "observation"]):
        return Finding("the same seed gives the same episodes")
    return Finding(
        "the same seed does not give the same episodes",
        "draw all random numbers of the environment from the generator seeded by reset(seed=...), "
        "or a resumed run will differ from an uninterrupted one",
    )


def _about_actions(task: AnyTask, data: TensorDictBase, seed: int) -> Iterator[Finding]:
    """The effect of each entry of the action: its two bounds, from the same resets."""
    low, high = action_bounds(task)
    middle = (low + high) / 2
    changes = data["next", "observation"] - data["observation"]
    scale = changes.flatten(0, 1).double().std(0).clamp_min(1e-9)
    without = []
    for entry in range(task.action_dim):
        ends = []
        for bound in (low, high):
            action = middle.clone()
            action[entry] = bound[entry]
            ends.append(_held(task, action, seed))
        shared = min(len(end) for end in ends)
        apart = (ends[0][:shared] - ends[1][:shared]).double().abs() / scale
        if not bool((apart > 1e-3).any()):
            without.append(entry)
    if without:
        yield Finding(
            f"entries {without} of the action have no effect within {_EFFECT_STEPS} steps",
            "L1 and planners need actions with an effect; leave these out of the action space",
        )
    else:
        yield Finding("every entry of the action has an effect")


def _held(task: AnyTask, action: Tensor, seed: int) -> Tensor:
    """Observations ``(T, n)`` of one environment under a constant action."""
    env = make_env(task, 1, seed=seed)
    state, seen = env.reset(), []
    for _ in range(_EFFECT_STEPS):
        data = env.step(state.set("action", action[None]))
        seen.append(data["next", "observation"][0])
        if bool(data["next", "done"].any()):
            break
        state = data["next"].select("observation").set("non_finite", data["next", "non_finite"])
    env.close(raise_if_closed=False)
    return torch.stack(seen)


def _flat(data: TensorDictBase) -> TensorDictBase:
    flat = data.reshape(-1)
    return flat[~flat["next", "non_finite"].squeeze(-1)]


def _about_rewards(algorithm: Algorithm, data: TensorDictBase) -> Iterator[Finding]:
    """Compare the reward of imagined steps with that of the environment."""
    function = reward_function(algorithm)
    flat = _flat(data)
    real = flat["next", "reward"].squeeze(-1).double()
    spread = float(real.std())
    if spread == 0:
        yield Finding(
            f"random actions always earn {float(real[0]):g}",
            "a reward that random actions never change teaches nothing: shape it, or collect "
            "more random data",
        )
    if function is None:
        yield Finding("the reward of imagined steps is learned from data")
        return
    with torch.no_grad():
        given = function(flat["observation"], flat["action"], flat["next", "observation"]).double()
    error = (given - real).abs()
    if float(error.max()) <= _EXACT * max(spread, float(real.abs().max()), 1e-9):
        yield Finding("the reward function reproduces the environment's rewards")
        return
    share = 1 - float((given - real).square().mean()) / max(spread**2, 1e-12)
    text = (
        f"the reward function explains {100 * share:.2f} % of the rewards' variance, largest error "
        f"{float(error.max()):.4g}"
    )
    worst = int(error.argmax())
    place = f"observation {_row(flat['observation'][worst])}, action {_row(flat['action'][worst])}"
    wrong = f"the environment gives {float(real[worst]):.5g} and the function "
    wrong += f"{float(given[worst]):.5g} at {place}; correct it, or set reward=learned"
    # A built-in task may be imagined differently on purpose, as its authors did.
    agrees = share >= _AGREES or isinstance(algorithm.task, Task)
    yield Finding(text, "" if agrees else wrong)


def _row(values: Tensor) -> str:
    shown = ", ".join(f"{value:.4g}" for value in values[:8].tolist())
    return f"({shown}{', ...' if len(values) > 8 else ''})"


def _about_terminations(algorithm: Algorithm, data: TensorDictBase) -> Iterator[Finding]:
    known, function = termination_function(algorithm)
    flat = _flat(data)
    ended = flat["next", "terminated"].squeeze(-1)
    count = int(ended.sum())
    if not known:
        yield Finding(f"termination is learned from data, {count} of {len(ended)} steps terminate")
        return
    given = torch.zeros_like(ended)
    if function is not None:
        with torch.no_grad():
            given = function(flat["next", "observation"])
    missed, false = int((ended & ~given).sum()), int((given & ~ended).sum())
    if not missed and not false:
        yield Finding(f"terminations are those of the environment, {count} of {len(ended)} steps")
        return
    yield Finding(
        f"termination: {missed} of {count} are missed, and {false} of {len(ended) - count} other "
        "steps are called terminal",
        "correct the function, or set termination=learned"
        if function is not None
        else "imagined episodes never end: set termination=learned, or give a function",
    )


def _about_model(data: TensorDictBase, recipe: RunSettings) -> Iterator[Finding]:
    settings: Any = getattr(recipe, "model", None)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        dynamics: EnsembleDynamics = fit_dynamics(
            data,
            seed=recipe.seed,
            hidden=settings.hidden,
            activation=settings.activation,
            std_floor=settings.std_floor,
            max_epochs=60,
            max_gradient_steps=1500,
        )
    # Other warnings of the fit are covered by the findings below.
    for words in (str(one.message) for one in told if "std_floor" in str(one.message)):
        text, _, fix = words.partition(": ")
        yield Finding(text, fix.replace("a std_floor of ", "model.std_floor="))
    quality = dynamics.quality
    assert quality is not None
    explained = [share for share in quality.explained if share == share]
    poor = [entry for entry, share in enumerate(quality.explained) if share < _POOR]
    text = (
        f"a model of {quality.training} steps explains {100 * min(explained):.1f} % to "
        f"{100 * max(explained):.1f} % of the changes of an entry"
        if explained
        else "no entry of the observation ever changes"
    )
    fix = ""
    if poor:
        fix = (
            f"entries {poor} are hardly predicted: they jump, or depend on what is not observed; "
            "leave them out (observation_keys), or collect more data"
        )
    yield Finding(text, fix)


def reward_function(algorithm: Algorithm) -> Any:
    """The reward function of imagined steps; ``None`` if it is learned."""
    learned = "reward_model" in algorithm.outcomes.models
    return None if learned else algorithm.outcomes.reward


def termination_function(algorithm: Algorithm) -> tuple[bool, Any]:
    """Whether the termination of imagined steps is known, and the function, if there is one."""
    outcomes = algorithm.outcomes
    return not outcomes.learns_terminations, outcomes.termination()


def failures(findings: Sequence[Finding]) -> int:
    """Number of findings with something to fix."""
    return sum(bool(finding.fix) for finding in findings)
