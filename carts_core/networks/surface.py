"""Surface networks: the shipped U-Net (`UNetSurface`), and a pretrained encoder with a decoder (`SurfaceNetwork`).

The encoder is EfficientNet-Lite0 up to stride 16, trained on ImageNet. The measured kinematics have errors of a few
degrees but provide a prior pose, which the network corrects.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from ..model.parts import PARTS, SURFACE_CHANNELS
from ..settings import Architecture, SurfaceArchitecture
from ..threads import one_thread
from .network import ImageNetwork, UNet, standardize

_CLASSES = len(PARTS) + 1
_OUTPUTS = _CLASSES + 3


@dataclass(frozen=True)
class SurfaceLogits:
    """Predicted surface map with coverage as logits; see `carts_core.model.parts`."""

    coverage: Float[Tensor, "batch parts+1 h w"]
    """Log odds of background and of each part."""
    normals: Float[Tensor, "batch 3 h w"]
    """Mean unit normals times coverage."""

    @one_thread()
    def parts(self) -> Float[Tensor, "batch parts h w"]:
        """Coverage of each part as probability."""
        return self.coverage.softmax(1)[:, 1:]

    @one_thread()
    def map(self) -> Float[Tensor, "batch 6 h w"]:
        """Surface map, with coverage as probabilities."""
        return torch.cat([self.parts(), self.normals], 1)


STAGES = ((1, 16, 1, 1, 3), (6, 24, 2, 2, 3), (6, 40, 2, 2, 5), (6, 80, 3, 2, 3), (6, 112, 3, 1, 5))
"""Expansion, channels, blocks, stride of the first block and kernel size of each stage of EfficientNet-Lite0 (Tan and
Le 2019, without squeeze-and-excitation) up to stride 16."""
STEM = 32
"""Channels of the stem, at stride 2."""


class InvertedResidual(nn.Module):
    """Block of EfficientNet-Lite: expansion, depthwise convolution and projection; batch norms are folded into them."""

    def __init__(self, inputs: int, outputs: int, expansion: int, kernel: int, stride: int) -> None:
        super().__init__()
        middle = inputs * expansion
        self.expand = nn.Conv2d(inputs, middle, 1) if expansion > 1 else None
        self.depthwise = nn.Conv2d(middle, middle, kernel, stride, kernel // 2, groups=middle)
        self.project = nn.Conv2d(middle, outputs, 1)
        self._skips = inputs == outputs and stride == 1

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        y = x if self.expand is None else functional.relu6(self.expand(x))
        y = self.project(functional.relu6(self.depthwise(y)))
        return x + y if self._skips else y


class Encoder(nn.Module):
    """EfficientNet-Lite0 up to stride 16, without batch norms."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3, STEM, 3, 2, 1)
        self.stages = nn.ModuleList()
        inputs = STEM
        for expansion, outputs, blocks, stride, kernel in STAGES:
            stage = nn.Sequential()
            for block in range(blocks):
                first = block == 0
                stage.append(
                    InvertedResidual(inputs if first else outputs, outputs, expansion, kernel, stride if first else 1)
                )
            self.stages.append(stage)
            inputs = outputs
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight)
                assert module.bias is not None
                nn.init.zeros_(module.bias)

    def freeze(self, stages: int) -> None:
        """Exclude the stem and a number of stages from training; 0 excludes nothing."""
        if stages:
            self.stem.requires_grad_(False)
            self.stages[:stages].requires_grad_(False)


_LOCAL_CONTRAST, _BLOCK = 0.8, 16
"""Normalization of images, as in the shipped network; see `standardize`."""
_SPREAD = 0.5
"""Standard deviation of the input for which the encoder was pretrained [1]."""
_PRIOR_STRIDE = 4


class SurfaceNetwork(ImageNetwork):
    """Surface network on the pretrained encoder.

    The prior surface map is added to the encoder's features at strides 4 and 8 only, so that outlines are those of the
    image.
    """

    kind: ClassVar[str] = "surface"
    architecture: SurfaceArchitecture

    def __init__(self, architecture: SurfaceArchitecture | None = None) -> None:
        super().__init__()
        self.architecture = architecture or SurfaceArchitecture()
        at2, at4, at8, at16 = self.architecture.decoder
        prior4, prior8 = self.architecture.conditioning
        of2, of4, of8, _, of16 = (stage[1] for stage in STAGES)
        self.encoder = Encoder()
        self.prior = nn.ModuleList([_normalized(SURFACE_CHANNELS, prior4, 1), _normalized(prior4, prior8, 2)])
        self.conditioning = nn.ModuleList([nn.Conv2d(prior4, of4, 1), nn.Conv2d(prior8, of8, 1)])
        for layer in self.conditioning.parameters():
            nn.init.zeros_(layer)  # The pretrained encoder starts unconditioned.
        widths = ((at16, of16), (at8, of8), (at4, of4), (at2, of2 + STEM))
        self.skips = nn.ModuleList(nn.Conv2d(features, width, 1, bias=False) for width, features in widths)
        self.reduce = nn.ModuleList(nn.Conv2d(*pair, 1, bias=False) for pair in ((at16, at8), (at8, at4), (at4, at2)))
        counts = reversed(self.architecture.convolutions)
        self.decoder = nn.ModuleList(_refining(width, n) for (width, _), n in zip(widths, counts, strict=True))
        # Each position at stride 2 covers four pixels.
        self.out = nn.Conv2d(at2, 4 * _OUTPUTS, 1)

    def forward(self, images: Float[Tensor, "batch 3 h w"], given: Float[Tensor, "batch 6 h w"]) -> SurfaceLogits:
        """Predict surface maps of images.

        Args:
            images: RGB in [0, 1]; h and w are multiples of `architecture.stride`.
            given: surface maps of the prior poses; zero without prior.

        Raises:
            SettingsError: the number of channels or the size is not allowed.
        """
        self.check_input(images, 3)
        stage2, stage4, stage8, *deep = self.encoder.stages
        prior4 = self.prior[0](functional.avg_pool2d(given, _PRIOR_STRIDE))
        prior8 = self.prior[1](prior4)
        stem = functional.relu6(self.encoder.stem(_SPREAD * standardize(images, _BLOCK, _LOCAL_CONTRAST)))
        at2 = stage2(stem)
        at4 = stage4(at2) + self.conditioning[0](prior4)
        at8 = x = stage8(at4) + self.conditioning[1](prior8)
        for stage in deep:
            x = stage(x)
        x = self.decoder[0](self.skips[0](x))
        for level, features in enumerate((at8, at4, torch.cat([at2, stem], 1)), start=1):
            grown = functional.interpolate(
                self.reduce[level - 1](x), scale_factor=2, mode="bilinear", align_corners=False
            )
            x = self.decoder[level](grown + self.skips[level](features))
        with one_thread():
            out = functional.pixel_shuffle(self.out(x), 2)
        return SurfaceLogits(out[:, :_CLASSES], out[:, _CLASSES:])


def _normalized(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    """3x3 convolution with batch norm and ReLU."""
    convolution = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


def _refining(channels: int, convolutions: int) -> nn.Sequential:
    """3x3 convolutions with batch norm and ReLU."""
    return nn.Sequential(*(layer for _ in range(convolutions) for layer in _normalized(channels, channels, 1)))


_HIDDEN = 24


class UNetSurface(UNet):
    """Surface network of the shipped weights: a U-Net on a standardized image and the prior surface map."""

    kind: ClassVar[str] = "surface"

    def __init__(self, architecture: Architecture | None = None) -> None:
        super().__init__(architecture or Architecture(), 3 + SURFACE_CHANNELS)
        fine, coarse = self.architecture.widths[:2]
        self.coarse = nn.Conv2d(coarse, _HIDDEN, 3, padding=1)
        self.fine = nn.Conv2d(fine, _HIDDEN, 1)
        self.out = nn.Conv2d(_HIDDEN, _OUTPUTS, 1)

    def forward(self, images: Float[Tensor, "batch 3 h w"], given: Float[Tensor, "batch 6 h w"]) -> SurfaceLogits:
        """Predict surface maps of images. Arguments and errors are those of `SurfaceNetwork.forward`."""
        fine, coarse = self.decoded(torch.cat([self.standardized(images), given], 1))
        grown = functional.interpolate(self.coarse(coarse), scale_factor=2, mode="bilinear", align_corners=False)
        hidden = (grown + self.fine(fine)).relu()
        with one_thread():
            out = self.out(hidden)
        return SurfaceLogits(out[:, :_CLASSES], out[:, _CLASSES:])


AnySurfaceNetwork = SurfaceNetwork | UNetSurface
"""Surface network of either architecture."""
