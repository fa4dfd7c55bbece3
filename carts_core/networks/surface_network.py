"""The surface network: an image and where the arms are expected in, a surface map of where they are out."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from ..model.parts import PARTS
from ..model.surface import SURFACE_CHANNELS
from ..settings import Architecture
from ..threads import one_thread
from .network import UNet

_HIDDEN = 24


@dataclass(frozen=True)
class SurfaceLogits:
    """A predicted surface map before its coverage is made one of shares; see `carts_core.model.surface`."""

    coverage: Float[Tensor, "batch parts+1 h w"]
    """Log odds of background and of each part."""
    normals: Float[Tensor, "batch 3 h w"]
    """Mean unit normal times coverage."""

    @one_thread()
    def map(self) -> Float[Tensor, "batch 6 h w"]:
        """The surface map."""
        return torch.cat([self.coverage.softmax(1)[:, 1:], self.normals], 1)


class SurfaceNetwork(UNet):
    """U-Net over a standardised image and the surface map of the measured kinematics.

    The measured kinematics are wrong by a few degrees, but they say which arms are there, roughly where, and which way
    they point. The network only has to say where they are instead.
    """

    kind = "surface"

    def __init__(self, architecture: Architecture | None = None) -> None:
        super().__init__(architecture or Architecture(), 3 + SURFACE_CHANNELS)
        fine, coarse = self.architecture.widths[:2]
        self.coarse = nn.Conv2d(coarse, _HIDDEN, 3, padding=1)
        self.fine = nn.Conv2d(fine, _HIDDEN, 1)
        self.out = nn.Conv2d(_HIDDEN, len(PARTS) + 1 + 3, 1)

    def forward(self, images: Float[Tensor, "batch 3 h w"], given: Float[Tensor, "batch 6 h w"]) -> SurfaceLogits:
        """What the images show.

        Args:
            images: RGB in [0, 1]; h and w are multiples of `architecture.stride`.
            given: surface maps of the kinematics as they are known; zero throughout where nothing is known.

        Raises:
            SettingsError: another number of channels, or a size that is no such multiple.
        """
        fine, coarse = self.decoded(torch.cat([self.standardized(images), given], 1))
        grown = functional.interpolate(self.coarse(coarse), scale_factor=2, mode="bilinear", align_corners=False)
        hidden = (grown + self.fine(fine)).relu()
        with one_thread():
            out = self.out(hidden)
        return SurfaceLogits(out[:, : len(PARTS) + 1], out[:, len(PARTS) + 1 :])
