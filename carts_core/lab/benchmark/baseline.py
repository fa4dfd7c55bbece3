"""One run of a network that gives a mask by itself: one of others, or the surface network given the rendering."""

import time

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ...model.scene import Scene
from ...model.surface import COVERAGE
from ...networks.extractor import FeatureExtractor
from ...recording import Frame
from ...rendering import Renderer
from ..baselines.networks import TrainedBaseline
from .frame import Truth
from .measurement import Measurement
from .scope import Run
from .timing import machine


def segment_with(
    trained: TrainedBaseline, run: Run, scene: Scene, frame: Frame, truth: Truth, device: torch.device
) -> Measurement:
    """The mask of one image, at the size that the network was trained for; what it is given counts for its time.

    Args:
        trained: the network.
        run: which.
        scene: with the camera that is scored.
        frame: its image, and the measured joint positions.
        truth: what the mask is compared with.
        device: where the network runs.
    """
    network = trained.network.to(device)
    size = network.settings.size
    rendering = _Rendering(scene, truth.camera, size) if network.settings.looks_at_kinematics else None
    image = frame.images[truth.camera]
    began = time.perf_counter()
    given = rendering.of(frame).to(device) if rendering else None
    with torch.no_grad():
        probability = network(_tensor(image, size, device), given).sigmoid()
    return _measured(run, probability, image, began, truth)


def segment_rendered(run: Run, scene: Scene, frame: Frame, extractor: FeatureExtractor, truth: Truth) -> Measurement:
    """The surface network's mask, given the rendering at the measured joint positions."""
    rendering = _Rendering(scene, truth.camera, extractor.working_size)
    image = frame.images[truth.camera]
    began = time.perf_counter()
    tensor = _tensor(image, extractor.working_size, extractor.device)
    surface = extractor.surface(tensor, rendering.of(frame).to(extractor.device))
    return _measured(run, surface[:, COVERAGE].sum(1, keepdim=True), image, began, truth)


class _Rendering:
    """What is rendered of the measured joint positions, at the network's size."""

    def __init__(self, scene: Scene, camera: str, size: tuple[int, int]) -> None:
        self._scene = scene.with_cameras([camera])
        self._renderer = Renderer(self._scene, width=size[0], height=size[1])

    def of(self, frame: Frame) -> Float[Tensor, "1 6 h w"]:
        return self._renderer.surface_maps(self._scene.state(frame.measured, mounts=frame.mounts))


def _tensor(image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int], device: torch.device) -> Float[Tensor, "1 3 h w"]:
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(small).to(device).permute(2, 0, 1)[None].float() / 255.0


def _measured(
    run: Run, probability: Float[Tensor, "1 1 h w"], image: UInt8[np.ndarray, "h w 3"], began: float, truth: Truth
) -> Measurement:
    full = cv2.resize(probability[0, 0].cpu().numpy(), image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    seconds = time.perf_counter() - began
    mask = full >= 0.5
    return Measurement(run, truth.score_mask(mask, seconds), (), (), "not iterative", machine(probability.device))
