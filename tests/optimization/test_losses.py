"""The losses' forms and what biases them."""

import pytest
import torch

from carts_core.imaging.working_image import attention
from carts_core.optimization.feature_problem import attentional_loss, cosine_similarity
from carts_core.settings import Loss


def square(size: int, half: int) -> torch.Tensor:
    image = torch.zeros(1, size, size)
    image[:, size // 2 - half : size // 2 + half, size // 2 - half : size // 2 + half] = 1
    return image


def test_attention_has_no_gradient() -> None:
    assert not attention(torch.rand(1, 8, 8, requires_grad=True), 2).requires_grad


def test_equal_features_have_similarity_one_and_empty_ones_too() -> None:
    features = torch.rand(1, 4, 5, 5)
    features[..., 0] = 0
    assert torch.allclose(cosine_similarity(features, features), torch.ones(1, 5, 5), atol=1e-4)


@pytest.mark.parametrize(("loss", "expected"), [(Loss.ACS_PAPER, -1), (Loss.ACS_REFERENCE, 1), (Loss.ACS, 0)])
def test_only_the_normalised_form_does_not_depend_on_the_silhouettes_size(loss: Loss, expected: int) -> None:
    similarity = torch.full((1, 40, 40), 0.5)
    small = attentional_loss(similarity, square(40, 5), loss)
    large = attentional_loss(similarity, square(40, 10), loss)
    assert float(torch.sign((large - small).round(decimals=6))) == expected


def test_the_papers_form_is_the_papers_equation() -> None:
    similarity, weight = torch.rand(1, 6, 7), torch.rand(1, 6, 7)
    expected = 1 - (similarity * weight).sum() / (6 * 7)
    assert torch.allclose(attentional_loss(similarity, weight, Loss.ACS_PAPER)[0], expected)


def test_attention_of_any_radius_is_the_dilation_by_a_square() -> None:
    silhouettes = (torch.rand(2, 37, 53, generator=torch.Generator().manual_seed(0)) > 0.995).float()
    for radius in (1, 10, 40):
        size = 2 * radius + 1
        expected = torch.nn.functional.max_pool2d(silhouettes, size, stride=1, padding=radius)
        assert torch.equal(attention(silhouettes, radius), expected)
