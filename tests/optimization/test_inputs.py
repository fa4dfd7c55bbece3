"""Blurring of many maps at once."""

import torch

from carts_core.optimization.inputs import blurred, smoothed


def test_any_number_of_maps_is_smoothed_like_each_alone() -> None:
    maps = torch.rand(30, 6, 12, 16, generator=torch.Generator().manual_seed(0))
    together = smoothed(maps, 1.5)
    assert together.shape == maps.shape
    torch.testing.assert_close(together, blurred(maps, 1.5), atol=1e-5, rtol=1e-4)
