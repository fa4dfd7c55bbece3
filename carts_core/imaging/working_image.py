"""Images at the working size: checks, stacking, filters, windows, and removal of smoke and haze.

Haze adds a grey value that varies slowly over the image, and reduces contrast in proportion. Tissue reflects little
light in at least one colour, so the minimum over colours and nearby pixels is an estimate of the added value: the dark
channel prior of He, Sun and Tang, "Single Image Haze Removal Using Dark Channel Prior" (CVPR 2009).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from ..errors import SettingsError
from ..model.scene import Scene


@dataclass(frozen=True)
class Window:
    """Rectangular part of the working image [px]."""

    left: int
    top: int
    width: int
    height: int

    @property
    def area(self) -> int:
        """Number of pixels."""
        return self.width * self.height

    @staticmethod
    def around(silhouette: Float[Tensor, "cameras h w"], margin: int, multiple: int, size: tuple[int, int]) -> "Window":
        """Bounding box of all silhouettes with a margin, aligned to multiples of a size; the whole image for empty
        silhouettes."""
        covered = silhouette.amax(0) > 0
        columns, rows = covered.any(0).nonzero()[:, 0], covered.any(1).nonzero()[:, 0]
        if not len(columns):
            return Window(0, 0, *size)
        spans = []
        for index, length in ((columns, size[0]), (rows, size[1])):
            first = max(int(index[0]) - margin, 0) // multiple * multiple
            last = min(-(-(int(index[-1]) + 1 + margin) // multiple) * multiple, length)
            spans.append((first, last - first))
        return Window(spans[0][0], spans[1][0], spans[0][1], spans[1][1])

    def holds(self, other: "Window") -> bool:
        """Whether another window lies within this window."""
        return (
            self.left <= other.left
            and self.top <= other.top
            and self.left + self.width >= other.left + other.width
            and self.top + self.height >= other.top + other.height
        )

    def intersection(self, other: "Window") -> "Window | None":
        """Intersection with another window; None if empty."""
        left, top = max(self.left, other.left), max(self.top, other.top)
        right = min(self.left + self.width, other.left + other.width)
        bottom = min(self.top + self.height, other.top + other.height)
        return Window(left, top, right - left, bottom - top) if left < right and top < bottom else None

    def inside(self, outer: "Window") -> "Window":
        """This window relative to a window that contains it."""
        return Window(self.left - outer.left, self.top - outer.top, self.width, self.height)

    def reduced(self, factor: int) -> "Window":
        """This window in an image downscaled by a factor."""
        return Window(self.left // factor, self.top // factor, self.width // factor, self.height // factor)

    def of(self, image: Float[Tensor, "*batch h w"]) -> Float[Tensor, "*batch {self.height} {self.width}"]:
        """Crop of an image."""
        return image[..., self.top : self.top + self.height, self.left : self.left + self.width]

    def paste(self, part: Float[Tensor, "*batch h w"], whole: Float[Tensor, "*batch H W"]) -> Tensor:
        """Replace this part of `whole` in place; returns `whole`."""
        self.of(whole)[...] = part
        return whole


def resized_images(
    scene: Scene, images: Mapping[str, UInt8[np.ndarray, "h w 3"]], size: tuple[int, int], what: str
) -> UInt8[np.ndarray, "cameras height width 3"]:
    """Images of the scene's cameras, downscaled to a size (width, height) [px].

    Raises:
        SettingsError: an image is missing, or its size differs from that of its camera.
    """
    resized = []
    for camera in scene.cameras:
        if camera.name not in images:
            raise SettingsError(f"the {what} of camera {camera.name!r} is missing; given: {', '.join(images)}.")
        image = images[camera.name]
        _check_shape(image, (camera.height, camera.width, 3), f"{what} of camera {camera.name!r}")
        resized.append(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    return np.stack(resized)


def stacked_images(
    scene: Scene, images: Mapping[str, UInt8[np.ndarray, "h w 3"]], size: tuple[int, int], what: str
) -> Float[Tensor, "cameras 3 height width"]:
    """Like `resized_images`, as a tensor of RGB in [0, 1]."""
    return torch.from_numpy(resized_images(scene, images, size, what)).permute(0, 3, 1, 2).float() / 255.0


def _check_shape(image: np.ndarray, shape: tuple[int, ...], what: str) -> None:
    if image.shape != shape:
        raise SettingsError(f"the {what} has shape {image.shape}, but its camera's images have {shape}.")


def pixel_weights(
    scene: Scene, ignore: Mapping[str, Bool[np.ndarray, "h w"]], size: tuple[int, int]
) -> Float[Tensor, "cameras 1 h w"]:
    """Pixel weights at a size (width, height) [px]: 0 at known occluders, 1 elsewhere.

    Raises:
        SettingsError: the size of a mask differs from that of its camera.
    """
    weight = np.ones((len(scene.cameras), 1, size[1], size[0]), np.float32)
    for index, camera in enumerate(scene.cameras):
        mask = ignore.get(camera.name)
        if mask is None:
            continue
        _check_shape(mask, (camera.height, camera.width), f"ignore mask of camera {camera.name!r}")
        weight[index, 0] = 1.0 - cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(weight)


def working_size(scene: Scene, width: int, stride: int) -> tuple[int, int]:
    """Width and height [px] of the compared images: multiples of the stride, with the aspect ratio of the first
    camera."""
    camera = scene.cameras[0]
    width = max(round(min(width, camera.width) / stride), 1) * stride
    return width, max(round(width * camera.height / camera.width / stride), 1) * stride


def blurred(images: Float[Tensor, "n channels h w"], deviation: float) -> Float[Tensor, "n channels h w"]:
    """Blur images by a Gaussian of a standard deviation [px]; unchanged for 0."""
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
    """Like `blurred`, but without autograd, for any number of channels, and much faster on a CPU."""
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
    """Mean over a square of odd side [px] around each pixel, clipped to the image."""
    if image.device.type != "cpu":
        return functional.avg_pool2d(image, side, stride=1, padding=side // 2, count_include_pad=False)
    sums, counts = (
        cv2.boxFilter(values, cv2.CV_32F, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for values in (image[0].contiguous().numpy(), np.ones(image.shape[1:], np.float32))
    )
    return torch.from_numpy(sums / counts)[None]


def kernel_radius(deviation: float) -> int:
    """Radius of the kernel of a Gaussian blur [px]."""
    return math.ceil(2.5 * deviation)


def attention(silhouette: Float[Tensor, "*batch h w"], radius: int) -> Float[Tensor, "*batch h w"]:
    """Attention map (Att of the paper): silhouette dilated by `radius` [px], without gradient."""
    flat = silhouette.detach().reshape(-1, *silhouette.shape[-2:])
    size = 2 * radius + 1
    if flat.device.type == "cpu":
        # The computation time of this dilation does not depend on the radius.
        square = np.ones((size, size), np.uint8)
        flat = torch.from_numpy(np.stack([cv2.dilate(image, square) for image in flat.contiguous().numpy()]))
    else:
        flat = functional.max_pool2d(flat, (size, 1), stride=1, padding=(radius, 0))
        flat = functional.max_pool2d(flat, (1, size), stride=1, padding=(0, radius))
    return flat.view(silhouette.shape)


_REACH = 1 / 32
"""Radius of the dark channel, and standard deviation of the smoothing of haze [image widths]."""

_COARSER = 4
"""Downscaling factor for the estimate of haze [1]."""

_AIRLIGHT = 0.75
"""Colour value of opaque haze [1]."""

_LEAST = 0.25
"""Minimum transmission [1]; dehazing amplifies noise by its inverse."""


def transmission(images: Float[Tensor, "n 3 h w"], share: float) -> Float[Tensor, "n 1 h w"]:
    """Estimate the transmission of haze at each pixel, from `_LEAST` to 1.

    Args:
        images: RGB in [0, 1].
        share: share of the estimated haze to remove [1]; 0 for none.
    """
    if share == 0:
        return torch.ones_like(images[:, :1])
    darkest = functional.interpolate(images.amin(1, keepdim=True), scale_factor=1 / _COARSER, mode="area")
    reach = max(round(_REACH * darkest.shape[-1]), 1)
    haze = smoothed(-attention(-darkest, reach), reach)
    haze = functional.interpolate(haze, images.shape[-2:], mode="bilinear")
    return (1.0 - share * haze / _AIRLIGHT).clamp(min=_LEAST)


def dehazed(images: Float[Tensor, "n 3 h w"], through: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Remove haze of a given transmission from images, RGB in [0, 1]."""
    return ((images - _AIRLIGHT) / through + _AIRLIGHT).clamp(0.0, 1.0)


def certainty(through: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n 1 h w"]:
    """Information of each pixel of a dehazed image, relative to an image without haze [1].

    Dehazing amplifies noise by the inverse of the transmission, and information is inversely proportional to the square
    of the noise.
    """
    return through.square()
