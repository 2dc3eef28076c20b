"""From a policy to a robust controller: collect, fit, calibrate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from torchrl.data import ReplayBuffer

from torchrl_l1.checks import check_choice, check_count, check_not_negative, check_positive
from torchrl_l1.control import L1Config
from torchrl_l1.control.layout import Layout
from torchrl_l1.deployment.controller_folder import code_of
from torchrl_l1.deployment.learning import (
    agreed_time_step,
    check_surroundings,
    collect,
    epsilon_for,
    recorded,
    target_switch_rate,
    warn_of_disturbances,
)
from torchrl_l1.deployment.policies import Policy, load_policy
from torchrl_l1.deployment.robust_controller import (
    PRESETS,
    RobustController,
    private_randomness,
    progress_bar,
    source_for,
)
from torchrl_l1.dynamics import FitConfig, calibrate_filter, fit_dynamics
from torchrl_l1.envs.references import folders_of
from torchrl_l1.envs.sources import MakeEnv

MODEL: Mapping[str, Any] = {"hidden": (128, 128)}
"""Default arguments of :func:`~torchrl_l1.dynamics.make_dynamics`."""

FIT = FitConfig(max_epochs=200, max_gradient_steps=2000, patience=10, batch_size=256)
"""Default settings for fitting the model."""


def robustify(
    make_env: MakeEnv,
    policy: Policy,
    steps: int = 20_000,
    *,
    preset: str = PRESETS[0],
    dt: float | None = None,
    epsilon: float | None = None,
    switch_rate: float | None = None,
    data: TensorDictBase | ReplayBuffer | Sequence[TensorDictBase] | None = None,
    normalization: str | None = None,
    weights: str | None = None,
    environments: int = 10,
    noise: float = 0.3,
    model: Mapping[str, Any] | None = None,
    fit: FitConfig | None = None,
    seed: int = 0,
    progress: bool | None = None,
) -> RobustController:
    """Put L1 around a policy: collect data with it, fit a model, calibrate the controller.

    The policy stays as it is. The disturbances need not be known, and the data are undisturbed.

    Args:
        make_env: an environment by name, or a function that makes one, see
            :func:`environment_source`.
        policy: a source, a module or a function, see :func:`load_policy`.
        steps: number of environment steps to collect, with exploration noise.
        preset: ``"robust"`` or ``"paper"``, the default settings of L1; both are calibrated and
            evaluated.
        dt: time of a step in seconds; the environment's own if ``None``.
        epsilon: tolerance of the paper's switching law, in state units; if ``None``, found from
            ``switch_rate``.
        switch_rate: target for epsilon, in switches per 1000 steps; if ``None``, the middle of the
            paper's rule of thumb, see :func:`target_switch_rate`.
        data: undisturbed transitions to learn from instead of collecting steps, see
            :func:`~torchrl_l1.dynamics.fit_dynamics`; the environment is then only used for tests.
        normalization: statistics of VecNormalize, see :func:`load_policy`.
        weights: state dict of the policy, see :func:`load_policy`.
        environments: number of environments stepped at once.
        noise: exploration noise as a fraction of half the action range, see :class:`Exploration`.
        model: arguments of :func:`~torchrl_l1.dynamics.make_dynamics` except the widths.
        fit: settings for fitting the model.
        seed: seed of data and weights; torch's global generator is left untouched.
        progress: whether to show bars; if ``None``, only on a terminal. Unless it is false, the
            quality of the model is printed.

    Raises:
        ValueError: for an invalid setting, an environment whose time step is unknown or differs
            from ``dt``, or that already has a controller, observations or actions that are not
            vectors, or a policy whose actions do not fit.

    Examples:
        >>> from torchrl_l1.dynamics import FitConfig
        >>> robust = robustify(
        ...     "inverted_pendulum", lambda x: 10 * x[..., 1:2], steps=1000, progress=False,
        ...     model={"hidden": [32]}, fit=FitConfig(max_gradient_steps=400, max_epochs=400),
        ... )
        >>> robust.config.dt, robust.preset
        (0.04, 'robust')
    """
    check_choice("preset", preset, PRESETS)
    check_count("steps", steps)
    check_count("environments", environments)
    check_not_negative("noise", noise)
    if dt is not None:
        check_positive("dt", dt)
    if epsilon is not None:
        check_not_negative("epsilon", epsilon)
    search_path = folders_of([n for n in (make_env, policy) if isinstance(n, str)], [Path.cwd()])
    code = code_of((make_env, policy), search_path)
    with private_randomness():  # environments may draw a seed on creation
        source = source_for(make_env, policy)
        dt = agreed_time_step(source, dt)
    with private_randomness():
        env = source.one()
        check_surroundings(env)
        acting = load_policy(policy, env, normalization, weights)
        if data is None:
            with progress_bar("collect", "step", progress) as bar:
                bar.total = steps
                found = collect(source, acting, steps, environments, noise, seed, bar.update)
            warn_of_disturbances(env)
            data = found
        else:
            found = recorded(data, env, dt)
        with progress_bar("fit", "epoch", progress) as bar:
            dynamics = fit_dynamics(
                data, config=fit or FIT, seed=seed, on_epoch=lambda _: bar.update(),
                **{**MODEL, **(model or {})},
            )  # fmt: skip
    if progress is not False:
        print(dynamics.quality)
    if epsilon is None:
        n = dynamics.observation_dim
        rate = target_switch_rate(n) if switch_rate is None else switch_rate
        epsilon, _ = epsilon_for(dynamics, found, rate)
    origin = {
        "policy": policy if isinstance(policy, str) else None,
        "search_path": search_path,
        "code": code,
        "normalization": normalization,
        "weights": weights,
    }
    layout = Layout.of(env, "observation", "action")
    configs = {
        "robust": layout.bounded(L1Config.robust(dt)),
        "paper": layout.bounded(L1Config.paper(dt, epsilon=epsilon)),
    }
    calibrate_filter(
        dynamics.residuals,
        dynamics.value_and_jacobian,
        found.reshape(-1).select("observation", "action", ("next", "observation")).float(),
        configs["robust"],
    )
    order = [preset, *(name for name in PRESETS if name != preset)]
    return RobustController(
        source, acting, dynamics, {name: configs[name] for name in reversed(order)},
        preset, origin,
    )  # fmt: skip
