"""Who says what an image shows: the surface network, given masks, or in tests somebody who is always right."""

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from ..features.extractor import FeatureExtractor
from .window import Window


class SurfacePredictor(Protocol):
    """Predicts the surface maps of images (`carts_core.surface`)."""

    @property
    def device(self) -> torch.device:
        """Where it computes, and where its predictions are."""
        ...

    @property
    def stride(self) -> int:
        """Windows and images are multiples of this wide and high [px]."""
        ...

    def predict(
        self,
        images: Float[Tensor, "cameras 3 height width"],
        given: Float[Tensor, "cameras 6 height width"],
        window: Window,
    ) -> Float[Tensor, "cameras 6 h w"]:
        """The surface maps in a window of the images.

        Args:
            images: RGB in [0, 1], whole.
            given: surface maps of the state that the prediction is conditioned on.
            window: which part is wanted.
        """
        ...


@dataclass(frozen=True)
class NetworkPredictor:
    """The surface network. Two of the same networks are equal, so that what they predict once can be kept."""

    extractor: FeatureExtractor

    @property
    def device(self) -> torch.device:
        """See `SurfacePredictor`."""
        return self.extractor.device

    @property
    def stride(self) -> int:
        """See `SurfacePredictor`."""
        return self.extractor.stride

    def predict(
        self,
        images: Float[Tensor, "cameras 3 height width"],
        given: Float[Tensor, "cameras 6 height width"],
        window: Window,
    ) -> Float[Tensor, "cameras 6 h w"]:
        """See `SurfacePredictor.predict`."""
        return self.extractor.surface(window.of(images), window.of(given))


def predictor_of(source: "FeatureExtractor | SurfacePredictor") -> SurfacePredictor:
    """A predictor as it is; the networks as one."""
    return NetworkPredictor(source) if isinstance(source, FeatureExtractor) else source
