from __future__ import annotations

import torch

from torchrl_l1.control import ActionJacobian, affinize, switching_law


def quadratic(observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    return observation.sin() + (action.square() + action).sum(-1, keepdim=True)


MODEL = ActionJacobian(quadratic)


def point(*batch: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
    u = torch.randn(2, *batch, 2, generator=generator, dtype=torch.float64)
    return x, u[0], u[1]


def test_affine_model_is_the_tangent_at_the_operating_point():
    x, u_bar, u = point(4)
    affinization = affinize(MODEL, x, u_bar)
    drift, jacobian = affinization.affine()
    torch.testing.assert_close(jacobian, (2 * u_bar + 1).unsqueeze(-2).expand(4, 3, 2))
    tangent = quadratic(x, u_bar) + ((2 * u_bar + 1) * (u - u_bar)).sum(-1, keepdim=True)
    torch.testing.assert_close(affinization.change(u), tangent)
    torch.testing.assert_close(drift + (jacobian @ u.unsqueeze(-1)).squeeze(-1), tangent)


def test_switching_law_measures_the_error_of_the_affine_model():
    x, u_bar, u = point(6)
    # The remainder of a quadratic is exact: |u - u_bar|^2 in each of the three coordinates.
    expected = 3**0.5 * (u - u_bar).square().sum(-1, keepdim=True)
    switch, error = switching_law(MODEL, x, u_bar, u, expected.median().item())
    torch.testing.assert_close(error, expected)
    assert torch.equal(switch, error > expected.median().item())
    assert 0 < switch.sum() < 6
    # The same from the affine model itself.
    tangent = affinize(MODEL, x, u_bar).change(u)
    gap = torch.linalg.vector_norm(tangent - quadratic(x, u), dim=-1, keepdim=True)
    torch.testing.assert_close(error, gap)


def test_switching_is_strict_and_ignores_what_is_not_a_number():
    def model(observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        # Flat at zero action, and 5 away from that at an action of one.
        size = action.square()
        return observation * size + torch.cat([3 * size, 4 * size, 0 * size], dim=-1)

    x = torch.tensor([[0.0, 0.0, 0.0], [torch.nan, 0.0, 0.0]])
    u_bar, u = torch.zeros(2, 1), torch.ones(2, 1)
    assert switching_law(ActionJacobian(model), x, u_bar, u, 5.0)[0].tolist() == [[0], [0]]
    assert switching_law(ActionJacobian(model), x, u_bar, u, 4.9)[0].tolist() == [[1], [0]]


def test_switching_law_without_batch_dimensions():
    x, u_bar, u = point()
    switch, error = switching_law(MODEL, x, u_bar, u, 0.0)
    assert switch.shape == error.shape == (1,)
    assert switch.all()
