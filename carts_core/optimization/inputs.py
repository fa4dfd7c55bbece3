"""Camera images as an objective takes them: checked, in the working size, stacked."""

import math
from collections.abc import Mapping
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..errors import SettingsError
from ..model.scene import Scene


def stacked_images(
    scene: Scene, images: Mapping[str, UInt8[np.ndarray, "h w 3"]], size: tuple[int, int], what: str
) -> Float[Tensor, "cameras 3 height width"]:
    """Images of the scene's cameras, reduced to a size (width, height) [px], RGB in [0, 1].

    Raises:
        SettingsError: one is missing, or of another size than its camera.
    """
    resized = []
    for camera in scene.cameras:
        if camera.name not in images:
            raise SettingsError(f"no {what} of camera {camera.name!r} was given; given are: {', '.join(images)}.")
        image = images[camera.name]
        if image.shape != (camera.height, camera.width, 3):
            raise SettingsError(
                f"the {what} of camera {camera.name!r} has shape {image.shape}, but its camera says "
                f"({camera.height}, {camera.width}, 3)."
            )
        resized.append(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    return torch.from_numpy(np.stack(resized)).permute(0, 3, 1, 2).float() / 255.0


def pixel_weights(
    scene: Scene, ignore: Mapping[str, Bool[np.ndarray, "h w"]], size: tuple[int, int]
) -> Float[Tensor, "cameras 1 h w"]:
    """0 where an occluder is known to be, 1 elsewhere, at a size (width, height) [px].

    Raises:
        SettingsError: a mask is of another size than its camera.
    """
    weight = np.ones((len(scene.cameras), 1, size[1], size[0]), np.float32)
    for index, camera in enumerate(scene.cameras):
        mask = ignore.get(camera.name)
        if mask is None:
            continue
        if mask.shape != (camera.height, camera.width):
            raise SettingsError(
                f"the ignore mask of camera {camera.name!r} has shape {mask.shape}, but its camera says "
                f"({camera.height}, {camera.width})."
            )
        weight[index, 0] = 1.0 - cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(weight)


def working_size(scene: Scene, width: int, stride: int) -> tuple[int, int]:
    """Width and height [px] of the compared images: the first camera's shape, in multiples of the network's stride."""
    camera = scene.cameras[0]
    width = max(round(min(width, camera.width) / stride), 1) * stride
    return width, max(round(width * camera.height / camera.width / stride), 1) * stride


def blurred(images: Float[Tensor, "n channels h w"], deviation: float) -> Float[Tensor, "n channels h w"]:
    """Images under a Gaussian of that deviation [px]; 0 leaves them as they are."""
    if deviation == 0:
        return images
    from kornia.filters import filter2d_separable  # noqa: PLC0415 - as below

    kernel = _kernel(deviation, images.device)
    return filter2d_separable(images, kernel, kernel, border_type="replicate")


@lru_cache(maxsize=32)
def _kernel(deviation: float, device: torch.device) -> Float[Tensor, "1 n"]:
    from kornia.filters import get_gaussian_kernel1d  # noqa: PLC0415 - takes 0.1 s, and the viewer starts without

    return get_gaussian_kernel1d(2 * kernel_radius(deviation) + 1, deviation, device=device)


def smoothed(images: Float[Tensor, "*batch h w"], deviation: float) -> Float[Tensor, "*batch h w"]:
    """The same as `blurred`, without autograd, for any number of channels, and much faster on a CPU."""
    flat = images.reshape(-1, *images.shape[-2:])
    if deviation == 0 or images.device.type != "cpu":
        return blurred(flat[None], deviation).view(images.shape)
    kernel = cv2.getGaussianKernel(2 * kernel_radius(deviation) + 1, deviation, cv2.CV_32F)
    planes = flat.numpy()
    result = np.empty(planes.shape, np.float32)
    for plane, target in zip(planes, result, strict=True):
        cv2.sepFilter2D(plane, cv2.CV_32F, kernel, kernel, dst=target, borderType=cv2.BORDER_REPLICATE)
    return torch.from_numpy(result).view(images.shape)


def box_mean(image: Float[Tensor, "1 h w"], side: int) -> Float[Tensor, "1 h w"]:
    """The mean around each pixel, over what a square of an odd side [px] has in common with the image."""
    if image.device.type != "cpu":
        return avg_pool2d(image, side, stride=1, padding=side // 2, count_include_pad=False)
    sums, counts = (
        cv2.boxFilter(values, cv2.CV_32F, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for values in (image[0].contiguous().numpy(), np.ones(image.shape[1:], np.float32))
    )
    return torch.from_numpy(sums / counts)[None]


def kernel_radius(deviation: float) -> int:
    """How far a blur of that deviation [px] reaches [px]."""
    return math.ceil(2.5 * deviation)
