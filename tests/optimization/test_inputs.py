"""Blurring of many maps at once."""

import torch
from torch.nn.functional import avg_pool2d

from carts_core.imaging.working_image import blurred, box_mean, smoothed


def test_any_number_of_maps_is_smoothed_like_each_alone() -> None:
    maps = torch.rand(30, 6, 12, 16, generator=torch.Generator().manual_seed(0))
    together = smoothed(maps, 1.5)
    assert together.shape == maps.shape
    torch.testing.assert_close(together, blurred(maps, 1.5), atol=1e-5, rtol=1e-4)


def test_the_mean_around_a_pixel_is_that_of_what_is_in_the_image() -> None:
    image = torch.rand(1, 20, 31, generator=torch.Generator().manual_seed(0))
    expected = avg_pool2d(image, 7, stride=1, padding=3, count_include_pad=False)
    torch.testing.assert_close(box_mean(image, 7), expected, atol=1e-5, rtol=1e-5)
    assert torch.equal(box_mean(image, 1), image)
