"""What predicts the surface maps of an image: the surface network, given masks, or in tests the truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import torch
from jaxtyping import Float
from torch import Tensor

from ..imaging.window import Window
from ..networks.extractor import FeatureExtractor
from ..recording import Frame


class FramePredictor(Protocol):
    """Predicts the surface maps of one frame's images (`carts_core.model.parts`)."""

    @property
    def masked(self) -> bool:
        """Whether given masks say where arms are. Then haze, empty backgrounds and edges of the images do not count,
        and the whole image does."""
        ...

    @property
    def knows_parts(self) -> bool:
        """Whether it predicts parts and normals, and not only the coverage of the whole arm, which is then in the
        first channel."""
        ...

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


class SurfacePredictor(Protocol):
    """Has a predictor for each frame."""

    @property
    def device(self) -> torch.device:
        """Where all of them compute."""
        ...

    def for_frame(self, frame: Frame, cameras: Sequence[str]) -> FramePredictor:
        """The predictor of one frame, as some cameras see it."""
        ...


class ImagePredictor:
    """Base of predictors that need nothing but images, so that one serves all frames."""

    masked = False
    knows_parts = True

    def for_frame(self, frame: Frame, cameras: Sequence[str]) -> Self:
        """See `SurfacePredictor.for_frame`."""
        return self


@dataclass(frozen=True)
class NetworkPredictor(ImagePredictor):
    """The surface network. Two of the same networks are equal, so that what they predict once can be kept."""

    extractor: FeatureExtractor

    @property
    def device(self) -> torch.device:
        """The CPU, wherever the network runs. The rest of a frame is thousands of small operations; a GPU would wait
        between them."""
        return torch.device("cpu")

    @property
    def stride(self) -> int:
        """See `FramePredictor`."""
        return self.extractor.stride

    def predict(
        self,
        images: Float[Tensor, "cameras 3 height width"],
        given: Float[Tensor, "cameras 6 height width"],
        window: Window,
    ) -> Float[Tensor, "cameras 6 h w"]:
        """See `FramePredictor.predict`."""
        return self.extractor.surface(window.of(images), window.of(given))


def predictor_of(source: "FeatureExtractor | SurfacePredictor") -> SurfacePredictor:
    """A predictor as it is; the networks as one."""
    return NetworkPredictor(source) if isinstance(source, FeatureExtractor) else source
