"""What is done to training images: simulated smoke, as in the paper, and what SegSTRONG-C compares."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ...settings.baseline import Augmentation
from .libraries import segmentation_models

Change = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""From an image [3, h, w], uint8, and its mask [1, h, w] to those that are learned from."""

SMOKE_SHARE, SMOKE_STRENGTH = 0.2, 0.3
"""Share of images with smoke and its largest opacity: `p` and `smoke_aug` of the paper's released configuration."""
_SMOKE_WHITE = 255.0
_GEOMETRIC = {"ShearX", "ShearY", "TranslateX", "TranslateY", "Rotate"}


def augmentation(name: Augmentation, rng: np.random.Generator) -> Change:
    """The change of that name; torchvision's draw from torch's own random numbers."""
    match name:
        case "none":
            return lambda image, mask: (image, mask)
        case "smoke":
            return lambda image, mask: (smoked(image, rng), mask)
        case "autoaugment":
            return _AutoAugment()
        case "elastic" | "projective":
            return _warped(name)


def smoked(image: UInt8[Tensor, "3 h w"], rng: np.random.Generator) -> UInt8[Tensor, "3 h w"]:
    """An image of five with a flat layer of smoke from the diamond-square algorithm, the others as they are."""
    if rng.random() >= SMOKE_SHARE:
        return image
    height, width = image.shape[1:]
    side = 2 ** int(np.ceil(np.log2(max(height, width)))) + 1
    opacity = SMOKE_STRENGTH * torch.from_numpy(diamond_square(side, rng)[:height, :width])
    return ((1 - opacity) * image + opacity * _SMOKE_WHITE).round().to(torch.uint8)


def diamond_square(side: int, rng: np.random.Generator, roughness: float = 0.6) -> Float[np.ndarray, "side side"]:
    """A plasma fractal, scaled to [0, 1].

    Args:
        side: one more than a power of two.
        rng: source of randomness.
        roughness: amplitude of each level relative to the one before.
    """
    field = np.zeros((side, side), np.float32)
    step, amplitude = side - 1, 1.0
    field[::step, ::step] = rng.normal(size=(2, 2))
    while step > 1:
        half = step // 2
        corners = field[::step, ::step]
        squares = (corners[:-1, :-1] + corners[1:, :-1] + corners[:-1, 1:] + corners[1:, 1:]) / 4
        field[half::step, half::step] = squares + amplitude * rng.normal(size=squares.shape)
        # Each diamond's middle is the mean of its neighbours at half a step, of which the border has three.
        padded = np.pad(field, half, constant_values=np.nan)
        for rows, columns in (
            (slice(0, None, step), slice(half, None, step)),
            (slice(half, None, step), slice(0, None, step)),
        ):
            target = field[rows, columns]
            top, left = rows.start, columns.start
            around = [
                padded[top + half + dy :: step, left + half + dx :: step][: target.shape[0], : target.shape[1]]
                for dy, dx in ((-half, 0), (half, 0), (0, -half), (0, half))
            ]
            field[rows, columns] = np.nanmean(around, axis=0) + amplitude * rng.normal(size=target.shape)
        step, amplitude = half, amplitude * roughness
    low, high = float(field.min()), float(field.max())
    return (field - low) / max(high - low, 1e-6)


class _AutoAugment:
    """torchvision's AutoAugment with ImageNet's policy; what moves the image moves the mask with it."""

    def __init__(self) -> None:
        segmentation_models()
        from torchvision.transforms import autoaugment  # noqa: PLC0415

        self._module, self._policy = autoaugment, autoaugment.AutoAugment()

    def __call__(self, image: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        policy = self._policy
        chosen, chances, signs = policy.get_params(len(policy.policies))
        space = policy._augmentation_space(10, (image.shape[1], image.shape[2]))
        for place, (name, chance, level) in enumerate(policy.policies[chosen]):
            if float(chances[place]) > chance:
                continue
            values, signed = space[name]
            magnitude = float(values[level]) if level is not None else 0.0
            if signed and int(signs[place]) == 0:
                magnitude = -magnitude
            image = self._applied(image, name, magnitude)
            if name in _GEOMETRIC:
                mask = self._applied(mask, name, magnitude)
        return image, mask

    def _applied(self, picture: Tensor, name: str, magnitude: float) -> Tensor:
        return self._module._apply_op(picture, name, magnitude, self._policy.interpolation, None)


def _warped(name: Augmentation) -> Change:
    segmentation_models()
    from torchvision import tv_tensors  # noqa: PLC0415
    from torchvision.transforms import v2  # noqa: PLC0415

    transform = v2.ElasticTransform() if name == "elastic" else v2.RandomPerspective()

    def change(image: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        image, mask = transform(tv_tensors.Image(image), tv_tensors.Mask(mask))
        return image.as_subclass(Tensor), mask.as_subclass(Tensor)

    return change
