"""An ensemble whose members are affine in the action by construction."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchrl_l1.dynamics.ensemble import EnsembleMLP
from torchrl_l1.dynamics.model import EnsembleDynamics
from torchrl_l1.dynamics.storage import stored_as


@stored_as("affine")
class ControlAffineDynamics(EnsembleDynamics):
    r"""Control-affine ensemble model, :math:`x_{t+1} - x_t = f(x_t) + G(x_t)\, u_t`.

    Each member is a network of the observation alone, whose outputs are the offset :math:`f` and
    the columns of the gain :math:`G`: ``n + n m`` outputs for the deterministic head, twice as many
    for the Gaussian one, whose raw log-variance is then affine in the action too. In arXiv
    2403.14860, figure 2, whose baseline this is, they are two networks. Everything else is as in
    :class:`EnsembleDynamics`: arguments, normalisers, data box, members, fit. The Jacobian is the
    ensemble's mean gain whatever the action, so the switching law never triggers.

    ``hidden`` is used as it is; :func:`~torchrl_l1.dynamics.make_dynamics` matches the number
    of parameters to that of an :class:`EnsembleDynamics`.

    Examples:
        >>> import torch
        >>> model = ControlAffineDynamics(4, 1, members=3, hidden=(16,))
        >>> x = torch.zeros(7, 4)
        >>> _, at_rest = model.value_and_jacobian(x, torch.zeros(7, 1))
        >>> _, at_full = model.value_and_jacobian(x, torch.ones(7, 1))
        >>> torch.equal(at_rest, at_full)
        True
    """

    affine_in_action = True

    def _make_network(self, hidden: Sequence[int], members: int, activation: str) -> EnsembleMLP:
        n, m = self.observation_dim, self.action_dim
        return EnsembleMLP(n, (1 + m) * self.head.out_features(n), hidden, members, activation)

    def network_inputs(self, inputs: Tensor) -> Tensor:
        """The part of :meth:`normalize_inputs` that the network reads: the observation."""
        return self._split(inputs)[0]

    def raw_from_output(self, output: Tensor, inputs: Tensor) -> Tensor:
        """The head's input: all of it is affine in the action, mean or not."""
        _, action = self._split(inputs)
        return affine_output(*affine_coefficients(output, self.action_dim), action)

    def value_and_jacobian(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Mean predicted change and its derivative with respect to the action, in raw units.

        Both come from the mean coefficients of one forward pass.

        Returns:
            change ``(..., n)`` and Jacobian ``(..., n, m)``.
        """
        inputs = self.normalize_inputs(observation, action)
        flat, scaled_action = self._split(inputs.reshape(-1, inputs.shape[-1]))
        n, m = self.observation_dim, self.action_dim
        offset, gain = affine_coefficients(self._over_elites(self.network(flat)), m)
        value = affine_output(offset, gain, scaled_action)[..., :n]
        jacobian = gain[..., :n].transpose(-2, -1)
        scale = self.change_normalizer.std[:, None] / self.action_normalizer.std
        return (
            self.change_normalizer.denormalize(value).reshape(observation.shape),
            (jacobian * scale).reshape(*observation.shape, m),
        )

    def expansion(
        self, observation: Tensor, u_bar: Tensor, candidate: Tensor, tested: Tensor
    ) -> tuple[Tensor, Callable[[Tensor], tuple[Tensor, Tensor]]]:
        """As in :class:`EnsembleDynamics`; the expansion at ``u_bar`` is exact."""

        def at(moved: Tensor) -> tuple[Tensor, Tensor]:
            return self.value_and_jacobian(observation, torch.where(moved, candidate, u_bar))

        return torch.zeros_like(observation), at

    def taylor_remainder(self, observation: Tensor, u_bar: Tensor, action: Tensor) -> Tensor:
        """Zero ``(..., n)``: the tangent in the action is the model itself."""
        return torch.zeros_like(observation)

    def _split(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        return inputs[..., : self.observation_dim], inputs[..., self.observation_dim :]


def affine_coefficients(output: Tensor, action_dim: int) -> tuple[Tensor, Tensor]:
    """Offset ``(..., out)`` and transposed gain ``(..., m, out)``, from ``(..., (1 + m) out)``."""
    rows = output.unflatten(-1, (1 + action_dim, -1))
    return rows[..., 0, :], rows[..., 1:, :]


def affine_output(offset: Tensor, gain: Tensor, action: Tensor) -> Tensor:
    """Offset plus gain times action ``(..., m)``: ``(..., out)``."""
    return offset + (gain * action.unsqueeze(-1)).sum(-2)
