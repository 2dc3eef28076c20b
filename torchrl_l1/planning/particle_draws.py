"""What particles draw: members of the ensemble and noise, each its own or common to candidates."""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_l1.planning.network import PlanningNetwork

Scenarios = tuple[Tensor, Tensor]
"""Members ``(H, P)`` and noise ``(H, n, P)`` that the particles of all candidates draw."""


def scenarios(
    network: PlanningNetwork,
    particles: int,
    horizon: int,
    generator: torch.Generator | None,
    like: Tensor,
) -> Scenarios:
    """Draw what the particles of all candidates meet, on the device of ``like``."""
    size, device = (horizon, network.observation_dim, particles), like.device
    members = torch.randint(
        network.members, (horizon, particles), generator=generator, device=device
    )
    return members, torch.randn(size, generator=generator, device=device)


class Draws:
    """Random numbers of B trajectories, sorted by member, candidate and particle.

    Args:
        network: the members.
        shares: particles of each member, see
            :func:`torchrl_l1.planning.particle_motion.member_shares`.
        count: number of trajectories, B.
        horizon: number of steps.
        common: what all candidates draw; each draws its own if ``None``.
        generator: source of randomness; torch's global one if ``None``.
    """

    def __init__(
        self,
        network: PlanningNetwork,
        shares: list[int],
        count: int,
        horizon: int,
        common: Scenarios | None,
        generator: torch.Generator | None,
    ) -> None:
        self._network, self._count, self._horizon = network, count, horizon
        self._common, self._generator = common, generator
        self.device = network.bias.device
        if common is not None:
            every = torch.arange(sum(shares), device=self.device).split(shares)
            candidates = count // sum(shares)
            self._particle = torch.cat([own.repeat(candidates) for own in every])

    def members(self) -> Tensor:
        """A member for every step and trajectory ``(H, B)``."""
        if self._common is not None:
            return self._common[0][:, self._particle]
        return torch.randint(
            self._network.members,
            (self._horizon, self._count),
            generator=self._generator,
            device=self.device,
        )

    def noise(self, step: int, order: Tensor | None = None) -> Tensor | None:
        """Standard normal numbers ``(B, n)`` of a step, column by column in memory.

        ``order`` says which trajectories they are for; ``None`` if none are needed.
        """
        if self._network.standard_deviation is None:
            return None
        if self._common is not None:
            particle = self._particle if order is None else self._particle[order]
            return self._common[1][step].index_select(1, particle).t()
        size = (self._network.observation_dim, self._count)
        return torch.randn(size, generator=self._generator, device=self.device).t()
