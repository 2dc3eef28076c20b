"""A learned model of the dynamics: normalisers around an ensemble."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any, Self

import torch
from torch import Tensor, nn

from torchrl_l1.checks import check_choice
from torchrl_l1.control import ResidualStatistics
from torchrl_l1.dynamics.ensemble import EnsembleMLP
from torchrl_l1.dynamics.heads import DeterministicHead, Head
from torchrl_l1.dynamics.normalizer import DataBox, Normalizer
from torchrl_l1.dynamics.quality import FitQuality
from torchrl_l1.dynamics.residuals import Residuals
from torchrl_l1.dynamics.storage import load_dynamics, save_dynamics, stored_as


@stored_as("nonlinear")
class EnsembleDynamics(nn.Module):
    r"""Ensemble model of the change of state, :math:`x_{t+1} - x_t = \hat f(x_t, u_t)`.

    Inputs and targets are normalised; all public methods use raw units. The ensemble's mean
    is the :math:`\hat f_\theta` on which the L1 controller is built (arXiv 2403.14860,
    section 3.2), and :meth:`value_and_jacobian` gives it together with its derivative with
    respect to the action in one pass.

    Args:
        observation_dim: number of observations, n.
        action_dim: number of actions, m.
        members: number of networks, E.
        hidden: widths of the hidden layers.
        activation: ``"relu"``, ``"tanh"`` or ``"silu"``.
        std_floor: smallest standard deviation of the normalisers, in raw units.
        box_margin: widening of the box around the data, see :class:`DataBox`.
        head: interpretation of a member's raw output, and its loss; a :class:`DeterministicHead` if
            ``None``.

    Attributes:
        elites: indices of the members over which the ensemble's mean is taken, ascending, ``(k,)``;
            all members until :meth:`set_elites` is called.
        affine_in_action: whether members give the coefficients of a function that is affine in the
            action, which their networks then do not read, as in a :class:`ControlAffineDynamics`.
            Planning networks and fits rely on it.
        residuals: covariance of the one-step residuals, measured at each fit.
        quality: the quality that :func:`~torchrl_l1.dynamics.fit_dynamics` measured; ``None`` for
            other models.

    Examples:
        >>> import torch
        >>> model = EnsembleDynamics(4, 1, members=3, hidden=(16,))
        >>> change, jacobian = model.value_and_jacobian(torch.zeros(7, 4), torch.zeros(7, 1))
        >>> change.shape, jacobian.shape
        (torch.Size([7, 4]), torch.Size([7, 4, 1]))
    """

    elites: Tensor
    affine_in_action: bool = False

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        members: int = 5,
        hidden: Sequence[int] = (256, 256),
        activation: str = "relu",
        std_floor: float = 1e-4,
        box_margin: float = 0.5,
        head: Head | None = None,
    ) -> None:
        super().__init__()
        self.quality: FitQuality | None = None
        self.observation_dim = observation_dim
        self.action_dim = action_dim
        self.head: Head = DeterministicHead() if head is None else head
        self.network = self._make_network(hidden, members, activation)
        self.register_buffer("elites", torch.arange(members))
        self.observation_normalizer = Normalizer(observation_dim, std_floor)
        self.action_normalizer = Normalizer(action_dim, std_floor)
        self.change_normalizer = Normalizer(observation_dim, std_floor)
        self.box = DataBox(observation_dim, box_margin)
        self.residuals = Residuals(observation_dim)

    def _make_network(self, hidden: Sequence[int], members: int, activation: str) -> EnsembleMLP:
        n, m = self.observation_dim, self.action_dim
        return EnsembleMLP(n + m, self.head.out_features(n), hidden, members, activation)

    @property
    def members(self) -> int:
        """Number of networks in the ensemble, elites or not."""
        return self.network.members

    @property
    def device(self) -> torch.device:
        """Device of the model."""
        return self.change_normalizer.mean.device

    def set_elites(self, index: Sequence[int] | Tensor) -> None:
        """Choose the members over which the ensemble's mean is taken and from which one is drawn.

        Args:
            index: indices of the members, in any order.

        Raises:
            ValueError: if there are none, or one occurs twice or does not exist, or for a mask.
        """
        kind = torch.as_tensor(index).dtype
        if len(index) and (kind == torch.bool or kind.is_floating_point):
            raise ValueError(f"elites must be indices of members, got numbers of {kind}")
        chosen = sorted(int(member) for member in index)
        if not chosen or len(set(chosen)) < len(chosen):
            raise ValueError(f"elites must be one or more members, each once, got {chosen}")
        if chosen[0] < 0 or chosen[-1] >= self.members:
            raise ValueError(f"elites must be in 0 to {self.members - 1}, got {chosen}")
        if len(chosen) == len(self.elites):
            self.elites.copy_(torch.tensor(chosen))  # in place, so that other processes see it too
        else:
            self.elites = torch.tensor(chosen, device=self.elites.device)

    def fit_statistics(self, observation: Tensor, action: Tensor, change: Tensor) -> None:
        """Set the normalisers and the data box from samples ``(N, n)``, ``(N, m)``, ``(N, n)``.

        Inputs that never vary in them are ignored, whatever values they take later: nothing can be
        learned about their effect, and their weights keep their initial values.
        """
        self.observation_normalizer.fit(observation)
        self.action_normalizer.fit(action)
        self.change_normalizer.fit(change)
        self.box.fit(observation)
        self.observation_normalizer.ignore(self.box.fixed)
        self.action_normalizer.ignore((action == action[:1]).all(0))

    def normalize_inputs(self, observation: Tensor, action: Tensor) -> Tensor:
        """Network inputs ``(..., n + m)`` from raw observations and actions."""
        if observation.shape[-1] != self.observation_dim or action.shape[-1] != self.action_dim:
            raise ValueError(
                f"the model takes observations of width {self.observation_dim} and actions of "
                f"width {self.action_dim}, got {observation.shape[-1]} and {action.shape[-1]}"
            )
        return torch.cat(
            [
                self.observation_normalizer.normalize(observation),
                self.action_normalizer.normalize(action),
            ],
            dim=-1,
        )

    def raw(self, inputs: Tensor) -> Tensor:
        """The head's input for all members, from :meth:`normalize_inputs`.

        Args:
            inputs: shared by the members ``(B, n + m)``, or one batch per member ``(E, B, n + m)``.

        Returns:
            ``(E, B, out)``, normalised units.
        """
        return self.raw_from_output(self.network(self.network_inputs(inputs)), inputs)

    def raw_member(self, inputs: Tensor, member: int) -> Tensor:
        """As :meth:`raw` for one member: ``(B, n + m)`` to ``(B, out)``."""
        output = self.network.forward_member(self.network_inputs(inputs), member)
        return self.raw_from_output(output, inputs)

    def network_inputs(self, inputs: Tensor) -> Tensor:
        """The part of :meth:`normalize_inputs` that the network reads: all of it."""
        return inputs

    def raw_from_output(self, output: Tensor, inputs: Tensor) -> Tensor:
        """The head's input, from the network's output: the same."""
        return output

    def member_changes(self, observation: Tensor, action: Tensor) -> Tensor:
        """Predicted change of every member: ``(..., n)`` and ``(..., m)`` to ``(E, ..., n)``."""
        inputs = self.normalize_inputs(observation, action)
        raw = self.raw(inputs.reshape(-1, inputs.shape[-1]))[..., : self.observation_dim]
        changes = self.change_normalizer.denormalize(raw)
        return changes.reshape(self.members, *observation.shape)

    def member_distribution(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The prediction of every member, elite or not, as independent normal distributions.

        Args:
            observation: ``(..., n)``, raw units.
            action: ``(..., m)``, raw units.

        Returns:
            mean change and its standard deviation, both ``(E, ..., n)`` in raw units; the latter
            is zero for a deterministic head.
        """
        inputs = self.normalize_inputs(observation, action)
        raw = self.raw(inputs.reshape(-1, inputs.shape[-1]))
        mean = self.change_normalizer.denormalize(raw[..., : self.observation_dim])
        std = self.head.standard_deviation(raw) * self.change_normalizer.std
        shape = (self.members, *observation.shape)
        return mean.reshape(shape), std.reshape(shape)

    def member_change(self, observation: Tensor, action: Tensor, member: int) -> Tensor:
        """Predicted change of one member: ``(B, n)`` and ``(B, m)`` to ``(B, n)``."""
        inputs = self.normalize_inputs(observation, action)
        raw = self.raw_member(inputs, member)[..., : self.observation_dim]
        return self.change_normalizer.denormalize(raw)

    def mean_change(self, observation: Tensor, action: Tensor) -> Tensor:
        """Mean predicted change of the elites: ``(..., n)`` and ``(..., m)`` to ``(..., n)``."""
        return self._over_elites(self.member_changes(observation, action))

    forward = mean_change

    def value_and_jacobian(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        r"""Mean predicted change and its derivative with respect to the action, in raw units.

        The chain rule through the normalisers is :math:`J = D_{\Delta x} J' D_{u}^{-1}` with the
        floored standard deviations (arXiv 2403.14860, appendix, technical remarks on METRPO).

        Returns:
            change ``(..., n)`` and Jacobian ``(..., n, m)``.
        """
        inputs = self.normalize_inputs(observation, action)
        n, m = self.observation_dim, self.action_dim
        value, tangent = self.network.value_and_directional_derivatives(
            inputs.reshape(-1, n + m), n, n + m
        )
        return self._in_raw_units(value, tangent, observation.shape)

    def _in_raw_units(
        self, value: Tensor, tangent: Tensor, shape: torch.Size
    ) -> tuple[Tensor, Tensor]:
        """Mean change and Jacobian of the elites, from ``(E, B, out)`` and ``(E, B, m, out)``."""
        n, m = self.observation_dim, self.action_dim
        mean, std = self.change_normalizer.mean, self.change_normalizer.std
        change = self._over_elites(value)[:, :n] * std + mean
        jacobian = self._over_elites(tangent)[..., :n].transpose(-2, -1)
        scale = std[:, None] / self.action_normalizer.std
        return change.reshape(shape), (jacobian * scale).reshape(*shape, m)

    def taylor_remainder(self, observation: Tensor, u_bar: Tensor, action: Tensor) -> Tensor:
        r"""Error of the tangent in the action at ``u_bar`` for the mean change at ``action``.

        Args:
            observation: ``(..., n)``, raw units.
            u_bar: where the model is expanded ``(..., m)``.
            action: where the expansion is compared with the model ``(..., m)``.

        Returns:
            :math:`\hat f(x, u) - \hat f(x, \bar u) - J(x, \bar u) (u - \bar u)`, state units
            ``(..., n)``.
        """
        inputs = self.normalize_inputs(observation, u_bar)
        step = (action - u_bar) / self.action_normalizer.std
        step = torch.cat([torch.zeros_like(observation), step], dim=-1)
        width = inputs.shape[-1]
        remainder = self.network.taylor_remainder(
            inputs.reshape(-1, width), step.reshape(-1, width)
        )
        mean = self._over_elites(remainder)[:, : self.observation_dim]
        return (mean * self.change_normalizer.std).reshape(observation.shape)

    def expansion(
        self, observation: Tensor, u_bar: Tensor, candidate: Tensor, tested: Tensor
    ) -> tuple[Tensor, Callable[[Tensor], tuple[Tensor, Tensor]]]:
        """The mean change expanded in the action, at ``u_bar`` or at another action.

        One pass through the network gives all that the switching law and the affinization need.

        Args:
            observation: ``(..., n)``, raw units.
            u_bar: where the model is expanded ``(..., m)``.
            candidate: where it is expanded instead if the expansion at ``u_bar`` fails.
            tested: where the expansion at ``u_bar`` is compared with the model ``(..., m)``.

        Returns:
            :meth:`taylor_remainder` of ``u_bar`` and ``tested``, and a function of a mask ``(...,
            1)``, true where the candidate is selected, which returns :meth:`value_and_jacobian`
            there. Both equal the methods' results up to rounding.
        """
        n, m = self.observation_dim, self.action_dim
        actions = torch.stack([u_bar, candidate, tested])
        inputs = self.normalize_inputs(observation.expand(3, *observation.shape), actions)
        remainder, tangents_at = self.network.expansion(inputs.reshape(3, -1, n + m), n, n + m)
        mean = self._over_elites(remainder)[:, :n] * self.change_normalizer.std

        def at(moved: Tensor) -> tuple[Tensor, Tensor]:
            return self._in_raw_units(*tangents_at(moved.reshape(-1)), observation.shape)

        return mean.reshape(observation.shape), at

    def residual_covariance(
        self, observation: Tensor, action: Tensor, source: str = "residuals"
    ) -> Tensor:
        r"""Covariance of the change of state around :meth:`mean_change`.

        Args:
            observation: ``(..., n)``, raw units.
            action: ``(..., m)``, raw units.
            source: ``"residuals"``, the covariance on the fit's validation data; ``"heads"``, the
                elites' mean predicted variance; ``"disagreement"``, the covariance of their means;
                or ``"sum"``, all three. The middle two, which may be singular, get a hundredth of
                the first added.

        Returns:
            ``(n, n)`` for ``"residuals"``, else ``(..., n, n)``; state units squared.

        Raises:
            ValueError: for an unknown source.
        """
        check_choice("source", source, ("residuals", "heads", "disagreement", "sum"))
        measured = self.residuals.covariance
        if source == "residuals":
            return measured
        mean, std = self.member_distribution(observation, action)
        mean, std = mean[self.elites], std[self.elites]
        covariance = measured if source == "sum" else 0.01 * measured
        if source in ("heads", "sum"):
            covariance = covariance + torch.diag_embed(std.square().mean(0))
        if source in ("disagreement", "sum"):
            apart = (mean - mean.mean(0)).movedim(0, -1)
            covariance = covariance + apart @ apart.mT / max(1, len(self.elites) - 1)
        return covariance

    def residual_statistics(
        self, observation: Tensor, action: Tensor, source: str = "residuals"
    ) -> ResidualStatistics:
        """:meth:`residual_covariance` in the form that the L1 controller takes."""
        return ResidualStatistics(
            self.residual_covariance(observation, action, source),
            self.residuals.inflation,
            self.residuals.process_noise,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write weights, normalisers, head, elites, residual statistics and quality to one file.

        The format is that of safetensors: tensors, and settings as JSON; reading it executes
        nothing. The file is written completely or not at all.

        Args:
            path: path of the file, such as ``"model.safetensors"``; an existing file is replaced.

        Raises:
            TypeError: for a user-defined class of model or head.

        Examples:
            >>> from tempfile import mkdtemp
            >>> file = f"{mkdtemp()}/model.safetensors"
            >>> model = EnsembleDynamics(4, 1, members=3, hidden=(16,))
            >>> model.save(file)
            >>> x, u = torch.randn(7, 4), torch.randn(7, 1)
            >>> torch.equal(EnsembleDynamics.load(file)(x, u), model(x, u))
            True
        """
        save_dynamics(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str], device: torch.device | str = "cpu") -> Self:
        """Read a model that :meth:`save` wrote, in evaluation mode.

        Args:
            path: path of the file.
            device: device for the model.

        Returns:
            the model, of the class that was saved; its predictions are identical bit for bit.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is damaged, or holds something else.
        """
        loaded = load_dynamics(path, device)
        if not isinstance(loaded, cls):
            raise ValueError(f"{path} holds a {type(loaded).__name__}, not a {cls.__name__}")
        return loaded

    def _over_elites(self, per_member: Tensor) -> Tensor:
        """Mean of ``(E, ...)`` over the elites."""
        elites = self.elites
        if elites.shape[0] < per_member.shape[0]:
            per_member = per_member[elites]
        return per_member.mean(0)

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        # The number of elites may differ from this module's, and older checkpoints have none.
        stored = state_dict.setdefault(prefix + "elites", torch.arange(self.members))
        if stored.shape != self.elites.shape:
            self.elites = self.elites.new_empty(stored.shape)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
