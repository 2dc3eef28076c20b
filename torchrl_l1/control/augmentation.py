"""One step of L1 around a learned model: affinize, switch, adapt."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_l1.control import law
from torchrl_l1.control.affine import affinize, switching_law
from torchrl_l1.control.jacobian import ActionJacobian
from torchrl_l1.control.law import L1Config, L1Diagnostics, L1State


def augment(
    config: L1Config,
    model: ActionJacobian,
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
) -> tuple[Tensor, L1State, L1Diagnostics]:
    """Turn the policy's action into the executed input (arXiv 2403.14860, Algorithms 1 and 2).

    Where the affine model around the remembered operating point fails the switching law at the
    current observation, the operating point moves to ``u_rl``; the model is affinized at the
    point selected, and the adaptive law takes its step on it. The first step of an environment
    chooses its operating point without counting a switch.

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
    u_rl = law.saturate(config, u_rl)
    u_bar = torch.where(state.started, state.u_bar, u_rl)
    tested = _tested_input(config, model, state, observation, u_rl, u_bar)
    switch, error = switching_law(model, observation, u_bar, tested, config.epsilon)
    # Rounding may separate two evaluations at the same input; a first step never switches.
    switch = switch & state.started
    u_bar = torch.where(switch, u_rl, u_bar)

    drift, jacobian = affinize(model, observation, u_bar).affine()
    restart = switch if config.on_switch == "reset" else None
    u, following, diagnostics = law.step(config, state, observation, u_rl, drift, jacobian, restart)
    finite = following.started
    following = following._replace(
        u_bar=torch.where(finite, u_bar, 0.0), n_switch=state.n_switch + switch
    )
    error = torch.where(finite & state.started, error, 0.0)
    return u, following, diagnostics._replace(switch=switch, affinization_error=error)


def _tested_input(
    config: L1Config,
    model: ActionJacobian,
    state: L1State,
    observation: Tensor,
    u_rl: Tensor,
    u_bar: Tensor,
) -> Tensor:
    """The input at which the switching law tests the affine model ``(..., m)``."""
    if config.switch_on == "policy":
        return u_rl
    if config.filter_input == "current":
        # The executed input depends on the Jacobian, through this step's estimate.
        affine = affinize(model, observation, u_bar).affine()
        return law.step(config, state, observation, u_rl, *affine)[0]
    # It does not depend on the operating point: the filter's next state is known.
    adapted = law.saturate(config, u_rl - law.filtered(config, state.q, state.sigma_m))
    return torch.where(state.started, adapted, u_rl)
