"""Shading and the carried motion against their slow twins."""

import torch
from slow_references import carry_motion_ref, phong_ref

from carts_core.model.scene import Light
from carts_core.rendering.rasterizer import phong
from carts_core.rendering.renderer import carry_motion


def random_points(count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    color = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    point = torch.rand(count, 3, generator=generator, dtype=torch.float64) * 0.05
    point[:, 2] += 0.1
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    return color.T, point.T, normal.T


def test_phong_agrees_with_one_point_at_a_time() -> None:
    color, point, normal = random_points(50)
    light = Light()
    each = [phong_ref(c, p, n, light) for c, p, n in zip(color.T, point.T, normal.T, strict=True)]
    assert torch.allclose(phong(color, point, normal, light), torch.stack(each, 1))


def test_the_gradient_of_phong_agrees_with_finite_differences() -> None:
    color, point, normal = (value.contiguous().requires_grad_() for value in random_points(5))
    assert torch.autograd.gradcheck(lambda c, p, n: phong(c, p, n, Light()), (color, point, normal), atol=1e-4)


def test_carried_motion_changes_no_value() -> None:
    image = torch.rand(2, 1, 5, 6)
    positions = torch.zeros(2, 3, requires_grad=True)
    moved = carry_motion(image, positions, torch.tensor([1, 2, 3]), torch.zeros(1, 5, 6))
    assert torch.equal(moved, image)


def test_carried_motion_has_the_gradient_of_its_pairs_one_by_one() -> None:
    generator = torch.Generator().manual_seed(1)
    height, width = 6, 7
    image = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    inverse_depth = torch.rand(height, width, generator=generator, dtype=torch.float64)
    inverse_depth[:, :2] = 0.0
    weight = torch.randn(height, width, 3, generator=generator, dtype=torch.float64)
    positions = torch.zeros(height, width, 2, dtype=torch.float64, requires_grad=True)
    (expected,) = torch.autograd.grad((carry_motion_ref(image, positions, inverse_depth) * weight).sum(), positions)
    pixels = (inverse_depth.flatten() > 0).nonzero()[:, 0]
    sparse = torch.zeros(2, len(pixels), dtype=torch.float64, requires_grad=True)
    moved = carry_motion(image.permute(2, 0, 1)[:, None], sparse, pixels, inverse_depth[None])
    (gradient,) = torch.autograd.grad((moved[:, 0].permute(1, 2, 0) * weight).sum(), sparse)
    assert torch.allclose(gradient, expected.view(-1, 2)[pixels].T)
