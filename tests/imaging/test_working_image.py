"""Filters of working images, and dehazing."""

from pathlib import Path

import torch
from torch.nn.functional import avg_pool2d

from carts_core.imaging.working_image import blurred, box_mean, certainty, dehazed, smoothed, transmission
from carts_core.recording import Sequence


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


def image_of(sequence: Sequence, domain: str) -> torch.Tensor:
    image = sequence.frame(3, domain).images[sequence.scene.cameras[0].name]
    return torch.from_numpy(image).movedim(-1, 0)[None].float() / 255.0


def cleared(images: torch.Tensor, share: float) -> torch.Tensor:
    return dehazed(images, transmission(images, share))


def contrast(image: torch.Tensor) -> float:
    return float((image - image.mean((-2, -1), keepdim=True)).std())


def test_a_smoky_frame_comes_closer_to_the_clear_one(sample_sequence_path: Path) -> None:
    sequence = Sequence.open(sample_sequence_path)
    clear, smoky = image_of(sequence, "regular"), image_of(sequence, "smoke")
    result, reference = cleared(smoky, 0.8), cleared(clear, 0.8)
    left, before = contrast(result - reference) / contrast(reference), contrast(smoky - clear) / contrast(clear)
    assert left < before
    assert contrast(smoky) < 0.8 * contrast(clear)
    assert contrast(result) > 0.9 * contrast(clear)


def test_haze_over_colours_that_are_full_of_contrast_is_taken_off() -> None:
    generator = torch.Generator().manual_seed(0)
    patches = torch.rand(2, 3, 60, 80, generator=generator)
    clear = patches.repeat_interleave(8, -2).repeat_interleave(8, -1)
    haze = torch.linspace(0.0, 0.6, clear.shape[-1])
    whole = cleared(clear * (1.0 - haze) + 0.75 * haze, 1.0)
    torch.testing.assert_close(whole, clear, atol=0.1, rtol=0.0)


def test_without_haze_or_a_share_images_stay_as_they_are() -> None:
    images = torch.rand(1, 3, 60, 80, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(cleared(images, 0.0), images)
    images[:, 2] = 0.0
    torch.testing.assert_close(cleared(images, 1.0), images)


def test_noise_is_not_amplified_without_bounds() -> None:
    white = torch.full((1, 3, 60, 80), 0.74)
    white[:, :, 30, 40] += 0.01
    assert float(cleared(white, 1.0).amax() - cleared(white, 1.0).amin()) <= 0.01 / 0.25 + 1e-5


def test_information_falls_behind_haze_by_as_much_as_noise_grows(sample_sequence_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    through = torch.tensor([1.0, 0.5, 0.25]).view(3, 1, 1, 1)
    noise = 0.01 * torch.randn(3, 3, 200, 200, generator=generator)
    grown = dehazed(0.75 + noise, through).var((1, 2, 3))
    torch.testing.assert_close(grown[0] / grown, certainty(through).flatten(), atol=0.02, rtol=0.0)
    sequence = Sequence.open(sample_sequence_path)
    clear, smoky = (certainty(transmission(image_of(sequence, domain), 0.8)).mean() for domain in ("regular", "smoke"))
    assert smoky < 0.8 * clear
