"""Feature network: a small U-Net; ACS compares the features of its last layer before the 1x1 head."""

import copy
from contextlib import AbstractContextManager, nullcontext
from itertools import pairwise
from typing import Any, ClassVar, Self, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from ..errors import SettingsError
from ..settings import Architecture
from ..threads import one_thread

CONTRAST_FLOOR = 0.02
"""Lower bound of the standard deviation by which images are normalized [1], so that noise is not amplified."""

_SMOOTHINGS = 2
_CONTRAST_SMOOTHINGS = 5

Network = TypeVar("Network", bound=nn.Module)


class ImageNetwork(nn.Module):
    """Base of the networks: checks of inputs, and a folded copy for inference."""

    kind: ClassVar[str]
    """Name of the network in weights files."""
    architecture: Any
    """`Architecture` or `SurfaceArchitecture`."""

    def check_input(self, x: Tensor, channels: int) -> None:
        """Check the number of channels, and that the size is divisible by the stride.

        Raises:
            SettingsError: the number of channels or the size is wrong.
        """
        stride = self.architecture.stride
        if x.ndim != 4 or x.shape[1] != channels or x.shape[2] % stride or x.shape[3] % stride:
            raise SettingsError(
                f"the input of the {self.kind} network has shape {tuple(x.shape)}. Give [batch, {channels}, height, "
                f"width] with height and width multiples of {stride}; pad or crop the image."
            )

    def folded(self) -> Self:
        """Frozen copy for inference: batch norms folded into the convolutions, channels-last, no gradients."""
        folded = copy.deepcopy(self).eval()
        for block in folded.modules():
            if isinstance(block, nn.Sequential):
                _fold(block)
        return channels_last(folded).requires_grad_(False)


def _one_thread(level: int) -> AbstractContextManager[None]:
    """Single thread for the coarse levels: for few pixels, oneDNN selects kernels by the number of threads."""
    return one_thread() if level >= 3 else nullcontext()


class UNet(ImageNetwork):
    """U-Net of convolution, batch norm and ReLU; skip connections are added, at half the cost of concatenation."""

    architecture: Architecture

    def __init__(self, architecture: Architecture, inputs: int) -> None:
        super().__init__()
        self.architecture = architecture
        self.inputs = inputs
        widths = architecture.widths
        channels = (inputs, *widths[:-1])
        counts = architecture.encoder_convolutions
        self.encoder = nn.ModuleList(_block(i, o, n) for i, o, n in zip(channels, widths, counts, strict=True))
        counts = architecture.decoder_convolutions
        self.reduce = nn.ModuleList(nn.Conv2d(i, o, 1) for o, i in pairwise(widths))
        self.decoder = nn.ModuleList(_block(o, o, n) for o, n in zip(widths[:-1], counts, strict=True))

    def decoded(self, x: Float[Tensor, "batch inputs h w"]) -> tuple[Tensor, Tensor]:
        """Features at full resolution, and the features at half the resolution from which they are computed.

        Raises:
            SettingsError: the number of channels is wrong, or the size is not a multiple of `architecture.stride`.
        """
        self.check_input(x, self.inputs)
        skips: list[Tensor] = []
        for level, encode in enumerate(self.encoder):
            with _one_thread(level):
                x = encode(functional.max_pool2d(x, 2) if level else x)
            skips.append(x)
        coarse = skips.pop()
        for level, (reduce, decode) in reversed([*enumerate(zip(self.reduce, self.decoder, strict=True))]):
            coarse = x
            with _one_thread(level):
                x = functional.interpolate(reduce(x), scale_factor=2, mode="bilinear", align_corners=False)
                x = decode(x + skips.pop())
        return x, coarse

    def standardized(self, images: Float[Tensor, "batch 3 h w"]) -> Float[Tensor, "batch 3 h w"]:
        """Standardized images, the input of the first convolution; see `standardize`."""
        self.check_input(images, 3)
        block = self.architecture.stride if self.architecture.local_mean else None
        return standardize(images, block, self.architecture.local_contrast)


class FeatureNetwork(UNet):
    """Feature network of the paper: mask logits are a linear function of its features, which ACS compares.

    Images are standardized: their local mean is subtracted, and the difference is scaled to unit standard deviation.
    The input is therefore nearly invariant to exposure, colour casts and smooth haze, without training on such images.
    """

    kind = "feature"

    def __init__(self, architecture: Architecture | None = None) -> None:
        super().__init__(architecture or Architecture(), 3)
        self.head = nn.Conv2d(self.architecture.widths[0], 1, 1)

    def features(self, images: Float[Tensor, "batch 3 h w"]) -> Float[Tensor, "batch channels h w"]:
        """Features of the last layer before the head, F_I in the paper.

        Args:
            images: RGB in [0, 1]; h and w are multiples of `architecture.stride`.

        Raises:
            SettingsError: the number of channels or the size is not allowed.
        """
        return self.decoded(self.standardized(images))[0]

    def logits(self, images: Float[Tensor, "batch 3 h w"]) -> Float[Tensor, "batch 1 h w"]:
        """Log odds of an instrument in each pixel. Arguments and errors are those of `features`."""
        return self.head(self.features(images))

    def forward(self, images: Float[Tensor, "batch 3 h w"]) -> Float[Tensor, "batch 1 h w"]:
        """Same as `logits`."""
        return self.logits(images)


def channels_last(network: Network) -> Network:
    """Convert the weights to channels-last order, which is faster on CPUs and recent GPUs; returns the network."""
    for parameter in network.parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return network


@one_thread()
def standardize(
    images: Float[Tensor, "batch 3 h w"], block: int | None, local_contrast: float = 0.0
) -> Float[Tensor, "batch 3 h w"]:
    """Subtract the mean of each channel, and divide by the standard deviation over all pixels and channels.

    Args:
        images: RGB in [0, 1]; h and w are multiples of `block`.
        block: block size of a local mean, smooth over about four blocks [px]; None subtracts the mean of the image.
        local_contrast: exponent of the local standard deviation (over about six blocks) in the divisor; the exponent of
            the global standard deviation is `1 - local_contrast`.
    """
    if block is None:
        detail = images - images.mean(dim=(2, 3), keepdim=True)
    else:
        detail = images - _local(images, block, _SMOOTHINGS)
    squares = detail.square().mean(1, keepdim=True)
    variance = squares.mean(dim=(2, 3), keepdim=True) + CONTRAST_FLOOR**2
    if block is not None and local_contrast > 0:
        local = _local(squares, block, _CONTRAST_SMOOTHINGS) + CONTRAST_FLOOR**2
        variance = variance ** (1.0 - local_contrast) * local**local_contrast
    return detail * torch.rsqrt(variance)


def _local(images: Float[Tensor, "batch channels h w"], block: int, smoothings: int) -> Tensor:
    """Block means, smoothed `smoothings` times over 3 x 3 blocks and interpolated to full size."""
    mean = functional.avg_pool2d(images, block)
    for _ in range(smoothings):
        mean = functional.avg_pool2d(mean, 3, stride=1, padding=1, count_include_pad=False)
    return functional.interpolate(mean, scale_factor=block, mode="bilinear", align_corners=False)


def _block(inputs: int, outputs: int, convolutions: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for index in range(convolutions):
        layers += [
            nn.Conv2d(outputs if index else inputs, outputs, 3, padding=1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        ]
    return nn.Sequential(*layers)


def _fold(block: nn.Sequential) -> None:
    for index, (layer, norm) in enumerate(pairwise(list(block))):
        if isinstance(layer, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
            block[index] = fuse_conv_bn_eval(layer, norm)
            block[index + 1] = nn.Identity()
