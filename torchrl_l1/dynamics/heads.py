"""Heads of ensemble members, which turn the raw output of the last layer into a prediction."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, softplus

from torchrl_l1.checks import check_choice, check_count, check_not_negative

HEADS = ("deterministic", "gaussian")


class Head(nn.Module, ABC):
    """Interpretation of a member's raw output for targets of ``dim`` columns, normalised units.

    The predicted mean must be the first ``dim`` columns of the raw output, unchanged, so that the
    Jacobian of the mean is that of those columns. The members of an ensemble share the head, and
    with it any parameters that it has.
    """

    @abstractmethod
    def out_features(self, dim: int) -> int:
        """Width of the raw output."""

    @abstractmethod
    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        """Training loss per sample, ``(..., out)`` and ``(..., dim)`` to ``(...,)``."""

    @abstractmethod
    def standard_deviation(self, raw: Tensor) -> Tensor:
        """Predicted standard deviation of the target, ``(..., out)`` to ``(..., dim)``."""

    def penalty(self) -> Tensor | float:
        """Penalty on the head's own parameters in the objective of a fit, once per ensemble."""
        return 0.0

    def loss_and_gradient(self, raw: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Losses of the members, and the gradients of its objective that a fit needs.

        The objective is the sum of the members' losses and the penalty. Autograd differentiates it;
        a head with closed-form gradients may override this method.

        Args:
            raw: raw outputs ``(E, B, out)``, without a graph.
            target: ``(E, B, dim)``.

        Returns:
            losses ``(E,)`` and the gradient with respect to the raw outputs. The gradients of the
            head's own parameters are in their ``grad``, replacing what was there.
        """
        for parameter in self.parameters():
            parameter.grad = None
        with torch.enable_grad():
            raw = raw.detach().requires_grad_()
            losses = self.loss(raw, target).mean(-1)
            (losses.sum() + self.penalty()).backward()
        assert raw.grad is not None
        return losses.detach(), raw.grad


class DeterministicHead(Head):
    """The raw output is the predicted mean; trained with the mean squared error."""

    def out_features(self, dim: int) -> int:
        """Width of the raw output: that of the target."""
        return dim

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        """Squared error, averaged over the columns (arXiv 2403.14860, section 3.1, sums it)."""
        return (raw - target).square().mean(-1)

    def standard_deviation(self, raw: Tensor) -> Tensor:
        """Zero: the prediction is a point."""
        return torch.zeros_like(raw)

    def loss_and_gradient(self, raw: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Head.loss_and_gradient`."""
        error = raw - target
        losses = error.square().mean(-1).mean(-1)
        rows, columns = error.shape[-2:]
        return losses, error.mul_(2 * (losses.new_ones(()) / rows / columns))


class GaussianHead(Head):
    r"""Means and log-variances of independent normal distributions; trained by likelihood.

    The first ``dim`` columns of the raw output are the mean. The others, :math:`v`, become the
    logarithm of the variance between two learned bounds per column (arXiv 1805.12114, appendix
    A.1):

    .. math::
        \log \sigma^2 = \ell + \mathrm{softplus}(v' - \ell), \quad
        v' = h - \mathrm{softplus}(h - v).

    Far from the data, the bounds keep the variance within what was seen; :meth:`penalty` draws them
    together. The upper bound is exceeded by less than :math:`e^{\ell - h}`.

    The authors' training loss is twice the one here, up to a constant: at their coefficient of
    0.01, the penalty weighs as much as ``bound_penalty=0.005`` does here.

    Args:
        dim: columns of the target, n.
        min_log_variance: initial lower bounds, normalised units.
        max_log_variance: initial upper bounds.
        bound_penalty: coefficient of the distance between the bounds.

    Raises:
        ValueError: for bounds in the wrong order, or a negative or infinite setting.

    Examples:
        >>> import torch
        >>> head = GaussianHead(2)
        >>> raw = torch.tensor([[0.3, -0.1, -3.0, 50.0]])
        >>> head.log_variance(raw).detach()
        tensor([[-3.0288,  0.5000]])
        >>> head.standard_deviation(raw).detach()
        tensor([[0.2199, 1.2840]])
    """

    def __init__(
        self,
        dim: int,
        min_log_variance: float = -10.0,
        max_log_variance: float = 0.5,
        bound_penalty: float = 0.01,
    ) -> None:
        super().__init__()
        check_count("dim", dim)
        if not -math.inf < min_log_variance < max_log_variance < math.inf:
            raise ValueError(
                "min_log_variance must be below max_log_variance, and both finite, got "
                f"{min_log_variance} and {max_log_variance}"
            )
        check_not_negative("bound_penalty", bound_penalty)
        self.dim = dim
        self.bound_penalty = bound_penalty
        self.min_log_variance = nn.Parameter(torch.full((dim,), float(min_log_variance)))
        self.max_log_variance = nn.Parameter(torch.full((dim,), float(max_log_variance)))

    def out_features(self, dim: int) -> int:
        """Width of the raw output: twice that of the target.

        Raises:
            ValueError: if the head was made for another width.
        """
        if dim != self.dim:
            raise ValueError(f"the head is for targets of width {self.dim}, the model's have {dim}")
        return 2 * dim

    def log_variance(self, raw: Tensor) -> Tensor:
        """Bounded logarithm of the variance, ``(..., 2 dim)`` to ``(..., dim)``."""
        below = self.max_log_variance - softplus(self.max_log_variance - raw[..., self.dim :])
        return self.min_log_variance + softplus(below - self.min_log_variance)

    def variance(self, raw: Tensor) -> Tensor:
        r"""Predicted variance, ``(..., 2 dim)`` to ``(..., dim)``.

        The exponential of :meth:`log_variance` without its logarithms, which would take most of the
        time in planning and fitting: :math:`e^\ell + e^h / (1 + e^{h - v})`.
        """
        share = torch.sigmoid(raw[..., self.dim :] - self.max_log_variance)
        return share * self.max_log_variance.exp() + self.min_log_variance.exp()

    def standard_deviation(self, raw: Tensor) -> Tensor:
        """Predicted standard deviation, ``(..., 2 dim)`` to ``(..., dim)``."""
        return self.variance(raw).sqrt()

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        """Negative log-likelihood in nats, averaged over the target's columns."""
        share = torch.sigmoid(raw[..., self.dim :] - self.max_log_variance)
        variance = torch.addcmul(self.min_log_variance.exp(), share, self.max_log_variance.exp())
        error = target - raw[..., : self.dim]
        squared = error * (error * variance.reciprocal())
        return _nats(squared, variance)

    def loss_and_gradient(self, raw: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        r"""See :meth:`Head.loss_and_gradient`.

        With :math:`s = 1 / (1 + e^{h - v})`, variance :math:`V = e^\ell + s e^h` and error
        :math:`d` the gradients are

        .. math::
            \frac{\partial}{\partial \mu} = -\frac{d}{V}, \quad
            \frac{\partial}{\partial V} = \frac{1 - d^2 / V}{2 V}, \quad
            \frac{\partial V}{\partial v} = s (1 - s) e^h, \quad
            \frac{\partial V}{\partial h} = s^2 e^h, \quad
            \frac{\partial V}{\partial \ell} = e^\ell.

        With autograd, the dozen small operations of the loss would take a tenth of a fit's time.
        """
        low, high = self.min_log_variance.detach(), self.max_log_variance.detach()
        share = torch.sigmoid(raw[..., self.dim :] - high)
        least, scale = low.exp(), high.exp()
        variance = torch.addcmul(least, share, scale)
        precision = variance.reciprocal()
        error = target - raw[..., : self.dim]
        weighted = error * precision
        squared = error * weighted
        losses = _nats(squared, variance).mean(-1)
        each = losses.new_ones(()) / raw.shape[-2] / self.dim
        by_variance = (1 - squared) * precision * (0.5 * each)
        by_share = by_variance * share * scale
        by_raw = by_share - by_share * share
        own = {
            self.min_log_variance: by_variance.sum((0, 1)) * least - self.bound_penalty,
            self.max_log_variance: (by_share - by_raw).sum((0, 1)) + self.bound_penalty,
        }
        for parameter, gradient in own.items():
            parameter.grad = gradient if parameter.requires_grad else None
        return losses, torch.cat([weighted * -each, by_raw], -1)

    def penalty(self) -> Tensor:
        """``bound_penalty`` times the sum of the distances between upper and lower bounds."""
        return self.bound_penalty * (self.max_log_variance.sum() - self.min_log_variance.sum())


class BernoulliHead(Head):
    """The raw output is the log-odds of an event; trained with the cross-entropy.

    Attributes:
        weight: factor on the loss of an event, relative to that of a non-event, ``()``.
    """

    weight: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("weight", torch.ones(()))

    def out_features(self, dim: int) -> int:
        """Width of the raw output: that of the target."""
        return dim

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        """Cross-entropy in nats, events weighted, averaged over the target's columns."""
        each = binary_cross_entropy_with_logits(
            raw, target.expand_as(raw), pos_weight=self.weight, reduction="none"
        )
        return each.mean(-1)

    def standard_deviation(self, raw: Tensor) -> Tensor:
        """Standard deviation of an event that is one or zero."""
        probability = raw.sigmoid()
        return (probability * (1 - probability)).sqrt()


def _nats(squared: Tensor, variance: Tensor) -> Tensor:
    """Negative log-likelihood in nats, from squared errors in units of the variance."""
    return 0.5 * ((squared + variance.log()).mean(-1) + math.log(2 * math.pi))


def make_head(name: str, dim: int) -> Head:
    """The head that a recipe names, with its default settings.

    Args:
        name: ``"deterministic"`` or ``"gaussian"``.
        dim: columns of the target.

    Raises:
        ValueError: for an unknown name.

    Examples:
        >>> make_head("gaussian", 3).out_features(3)
        6
    """
    check_choice("head", name, tuple(HEADS))
    return GaussianHead(dim) if name == "gaussian" else DeterministicHead()
