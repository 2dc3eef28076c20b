from __future__ import annotations

import torch

from torchrl_l1.control import ActionJacobian, Affinization, affinize, reaffinize, switching_law


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
    affinization = affinize(MODEL, x, u_bar)
    switch, error = switching_law(affinization, u, quadratic(x, u), expected.median().item())
    torch.testing.assert_close(error, expected)
    assert torch.equal(switch, error > expected.median().item())
    assert 0 < switch.sum() < 6


def test_switching_is_strict_and_ignores_what_is_not_a_number():
    affinization = Affinization(torch.zeros(2, 1), torch.zeros(2, 3), torch.zeros(2, 3, 1))
    value = torch.tensor([[3.0, 4.0, 0.0], [torch.nan, 0.0, 0.0]])
    assert switching_law(affinization, torch.zeros(2, 1), value, 5.0)[0].tolist() == [[0], [0]]
    assert switching_law(affinization, torch.zeros(2, 1), value, 4.9)[0].tolist() == [[1], [0]]


def test_reaffinize_moves_the_chosen_environments_only():
    for mask in ([0, 0, 0, 0], [1, 0, 0, 1], [1, 1, 1, 1]):
        x, u_bar, u = point(4)
        switch = torch.tensor(mask, dtype=torch.bool).unsqueeze(-1)
        old = affinize(MODEL, x, u_bar)
        kept = [entry.clone() for entry in old]
        moved = reaffinize(MODEL, x, old, u, switch)
        expected = affinize(MODEL, x, torch.where(switch, u, u_bar))
        for value, want in zip(moved, expected, strict=True):
            torch.testing.assert_close(value, want)
        for value, want in zip(old, kept, strict=True):
            torch.testing.assert_close(value, want, atol=0, rtol=0)


def test_reaffinize_without_batch_dimensions():
    x, u_bar, u = point()
    old = affinize(MODEL, x, u_bar)
    assert reaffinize(MODEL, x, old, u, torch.tensor([False])) is old
    moved = reaffinize(MODEL, x, old, u, torch.tensor([True]))
    torch.testing.assert_close(moved.jacobian, affinize(MODEL, x, u).jacobian)


def test_only_what_switched_is_evaluated():
    rows = []

    def counting(observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        rows.append(observation.shape[0])
        return quadratic(observation, action)

    x, u_bar, u = point(5)
    model = ActionJacobian(counting)
    old = affinize(model, x, u_bar)
    rows.clear()
    reaffinize(model, x, old, u, torch.tensor([[0], [1], [0], [0], [1]], dtype=torch.bool))
    assert rows == [2]
