"""Predictors of surface maps: the network, and given masks."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import SettingsError
from ..imaging.working_image import Window
from ..model.parts import COVERAGE, NORMALS, SURFACE_CHANNELS
from ..networks.extractor import FeatureExtractor
from ..recording import Frame
from .given_masks import GivenMask


class FramePredictor(Protocol):
    """Predictor of the surface maps (`carts_core.model.parts`) of one frame's images."""

    @property
    def masked(self) -> bool:
        """Whether coverage comes from given masks. In this case the whole image is compared, without backgrounds or
        edges."""
        ...

    @property
    def knows_parts(self) -> bool:
        """Whether parts and normals are predicted; otherwise the first channel is the coverage of the whole arm."""
        ...

    @property
    def device(self) -> torch.device:
        """Device of computations and predictions."""
        ...

    @property
    def stride(self) -> int:
        """Stride: width and height of windows and images must be multiples of it [px]."""
        ...

    def predict(
        self,
        images: Float[Tensor, "cameras 3 height width"],
        given: Float[Tensor, "cameras 6 height width"],
        window: Window,
    ) -> Float[Tensor, "cameras 6 h w"]:
        """Predict the surface maps in a window of the images.

        Args:
            images: whole images, RGB in [0, 1].
            given: surface maps of the state on which the prediction is conditioned.
        """
        ...


class SurfacePredictor(Protocol):
    """Provides a predictor for each frame."""

    @property
    def device(self) -> torch.device:
        """Device of all predictors."""
        ...

    def for_frame(self, frame: Frame, cameras: Sequence[str]) -> FramePredictor:
        """Predictor for one frame and a subset of the cameras."""
        ...


class ImagePredictor:
    """Base of predictors that depend only on the images and are shared by all frames."""

    masked = False
    knows_parts = True

    def for_frame(self, frame: Frame, cameras: Sequence[str]) -> Self:
        """See `SurfacePredictor.for_frame`."""
        return self


@dataclass(frozen=True)
class NetworkPredictor(ImagePredictor):
    """Predictor that uses the surface network. Predictors with the same network are equal, so predictions can be
    cached."""

    extractor: FeatureExtractor

    @property
    def device(self) -> torch.device:
        """The CPU, independent of the network's device, since the thousands of small operations per frame are slower on
        a GPU."""
        return torch.device("cpu")

    @property
    def stride(self) -> int:
        """See `FramePredictor.stride`."""
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
    """Return the predictor itself, or wrap networks as a predictor."""
    return NetworkPredictor(source) if isinstance(source, FeatureExtractor) else source


_STRIDE = 8
"""Stride without a network [px]."""


class MaskPredictor:
    """Predictor that uses given masks instead of a network. Implements `SurfacePredictor`.

    Args:
        network: predicts parts and normals inside the masks, and whole surface maps in frames in which the mask of a
            camera is missing; None to use masks only.
        masks: frame index -> camera name -> mask at the camera's size; `Frame.masks` by default.
    """

    def __init__(
        self,
        network: SurfacePredictor | None = None,
        masks: Callable[[int], Mapping[str, GivenMask]] | None = None,
        origin: str = "mask",
    ) -> None:
        self._network, self._masks, self._origin = network, masks, origin
        self.device = torch.device("cpu") if network is None else network.device

    def for_frame(self, frame: Frame, cameras: Sequence[str]) -> FramePredictor:
        """Predictor for one frame.

        Raises:
            SettingsError: a camera has no mask for the frame and there is no network, or a mask has the wrong size.
        """
        network = None if self._network is None else self._network.for_frame(frame, cameras)
        given = (frame.masks or {}) if self._masks is None else self._masks(frame.index)
        # A missing image has no weight, so it needs no mask.
        nothing = {name: np.zeros(frame.images[name].shape[:2], bool) for name in frame.missing if name not in given}
        given = {**nothing, **given}
        missing = [name for name in cameras if name not in given]
        if missing and network is not None:
            return network
        if missing:
            raise SettingsError(
                f"frame {frame.frame_id} has no {self._origin} for camera {missing[0]!r} to fit. Give a mask, leave "
                "out the frame or camera, or observe both masks and the network."
            )
        for name in cameras:
            if given[name].shape != frame.images[name].shape[:2]:
                raise SettingsError(
                    f"the mask of camera {name!r} in frame {frame.frame_id} has shape {given[name].shape}, but its "
                    f"image has {frame.images[name].shape[:2]}. Give a mask of the image's size."
                )
        masks = tuple(np.asarray(given[name], np.float32) for name in cameras)
        return _FrameMasks(masks, network, self.device)


@dataclass(frozen=True, eq=False)
class _FrameMasks:
    """Predictor of one frame: masks as coverage, parts and normals from the network if available."""

    masks: tuple[Float[np.ndarray, "height width"], ...]
    """Masks in the order of the cameras."""
    network: FramePredictor | None
    device: torch.device
    masked: bool = True

    @property
    def knows_parts(self) -> bool:
        """See `FramePredictor.knows_parts`."""
        return self.network is not None

    @property
    def stride(self) -> int:
        """See `FramePredictor.stride`."""
        return _STRIDE if self.network is None else self.network.stride

    def predict(
        self,
        images: Float[Tensor, "cameras 3 height width"],
        given: Float[Tensor, "cameras 6 height width"],
        window: Window,
    ) -> Float[Tensor, "cameras 6 h w"]:
        """See `FramePredictor.predict`."""
        size = images.shape[-1], images.shape[-2]
        reduced = np.stack([cv2.resize(mask, size, interpolation=cv2.INTER_AREA) for mask in self.masks])
        covered = window.of(torch.from_numpy(reduced)).to(self.device)
        if self.network is None:
            maps = covered.new_zeros(len(covered), SURFACE_CHANNELS, *covered.shape[-2:])
        else:
            maps = self.network.predict(images, given, window) * covered[:, None]
        # Mask pixels for which the network predicts no part belong to the first part.
        parts = maps[:, COVERAGE]
        parts = parts * (covered / parts.sum(1).clamp(min=1e-6)).clamp(max=1.0)[:, None]
        parts[:, 0] += covered - parts.sum(1)
        return torch.cat([parts, maps[:, NORMALS]], 1)
