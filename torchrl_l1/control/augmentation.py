"""One step of L1 around a learned model: affinize, switch, adapt."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_l1.control import law
from torchrl_l1.control.affine import Affinization, affinize, reaffinize, switching_law
from torchrl_l1.control.jacobian import ActionJacobian
from torchrl_l1.control.law import L1Config, L1Diagnostics, L1State


class Assessment(NamedTuple):
    """Outcome of the switching law, before the operating point moves.

    Attributes:
        u_rl: the policy's action within its bounds ``(..., m)``.
        current: the model around the remembered operating point.
        switch: whether that point must move ``(..., 1)``, bool.
        error: error of the affine model at the tested input ``(..., 1)``, state units.
    """

    u_rl: Tensor
    current: Affinization
    switch: Tensor
    error: Tensor


def augment(
    config: L1Config,
    model: ActionJacobian,
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
) -> tuple[Tensor, L1State, L1Diagnostics]:
    """Turn the policy's action into the executed input (arXiv 2403.14860, Algorithms 1 and 2).

    The model is affinized at the remembered operating point and the current observation; where
    the affine model fails the switching law, the operating point moves to ``u_rl``; then the
    adaptive law takes its step. The first step of an environment chooses its operating point
    without counting a switch.

    Args:
        config: the settings.
        model: the learned dynamics.
        state: from :func:`torchrl_l1.control.law.init` or the previous step.
        observation: ``(..., n)``, raw units.
        u_rl: the policy's action ``(..., m)``; clipped to the bounds first.

    Returns:
        the executed input ``(..., m)``, the next state and the diagnostics.

    Examples:
        >>> model = ActionJacobian(lambda x, u: -0.1 * x + 0.2 * u.sin())
        >>> state = law.init([3], observation_dim=1, action_dim=1)
        >>> config = L1Config(0.05, epsilon=0.1)
        >>> u, state, diagnostics = augment(
        ...     config, model, state, torch.ones(3, 1), torch.zeros(3, 1)
        ... )
        >>> state.x_hat.squeeze(-1)
        tensor([0.9000, 0.9000, 0.9000])
    """
    assessment = assess(config, model, state, observation, u_rl)
    selected = reaffinize(
        model, observation, assessment.current, assessment.u_rl, assessment.switch
    )
    return conclude(config, state, observation, assessment, selected)


def assess(
    config: L1Config,
    model: ActionJacobian,
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
) -> Assessment:
    """First part of :func:`augment`: affinize at the remembered point and test the result."""
    u_rl = law.saturate(config, u_rl)
    u_bar = torch.where(state.started, state.u_bar, u_rl)
    current = affinize(model, observation, u_bar)
    if config.switch_on == "executed" and config.filter_input == "current":
        # The executed input depends on the Jacobian, through this step's estimate.
        tested = law.step(config, state, observation, u_rl, *current.affine())[0]
    else:
        tested = u_rl
        if config.switch_on == "executed":
            # It does not depend on the operating point: the filter's next state is known.
            adapted = law.saturate(config, u_rl - law.filtered(config, state.q, state.sigma_m))
            tested = torch.where(state.started, adapted, u_rl)
    value = model.value(observation, tested)
    switch, error = switching_law(current, tested, value, config.epsilon)
    # Rounding may separate two evaluations at the same input; a first step never switches.
    return Assessment(u_rl, current, switch & state.started, error)


def conclude(
    config: L1Config,
    state: L1State,
    observation: Tensor,
    assessment: Assessment,
    selected: Affinization,
) -> tuple[Tensor, L1State, L1Diagnostics]:
    """Last part of :func:`augment`: the adaptive law around the selected operating point."""
    restart = assessment.switch if config.on_switch == "reset" else None
    u, following, diagnostics = law.step(
        config, state, observation, assessment.u_rl, *selected.affine(), restart
    )
    finite = following.started
    following = following._replace(
        u_bar=torch.where(finite, selected.u_bar, 0.0),
        n_switch=state.n_switch + assessment.switch,
    )
    error = torch.where(finite & state.started, assessment.error, 0.0)
    return u, following, diagnostics._replace(switch=assessment.switch, affinization_error=error)
