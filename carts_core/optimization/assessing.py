"""The verdict on an estimate that was not found by optimizing its frame alone."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool

from ..model.scene import Scene, SceneState
from ..networks.extractor import FeatureExtractor
from ..recording import Frame
from ..settings import SurfaceSolver
from .counterfactual import Backgrounds
from .frame_images import FrameImages
from .predictor import SurfacePredictor, predictor_of
from .verdict import Assessment, assess, evidence


def assess_estimate(
    scene: Scene,
    frame: Frame,
    state: SceneState,
    networks: FeatureExtractor | SurfacePredictor,
    loss: float,
    *,
    settings: SurfaceSolver | None = None,
    backgrounds: Backgrounds | None = None,
    ignore: Mapping[str, Bool[np.ndarray, "h w"]] | None = None,
) -> Assessment:
    """How far an estimate of a frame can be relied on; runs the predictor twice.

    Args:
        scene: with the cameras that take part.
        frame: images and measured joint positions.
        state: the estimate.
        networks: the networks, or another predictor of surface maps.
        loss: of the estimate [1].
        settings: working size, and how much haze is taken off.
        backgrounds: of the cameras, where they are known.
        ignore: camera name -> pixels that show an occluder.

    Raises:
        SettingsError: an image is missing, or an image or a mask is of another size than its camera.
    """
    settings = settings or SurfaceSolver()
    predictor = predictor_of(networks).for_frame(frame, [camera.name for camera in scene.cameras])
    images = FrameImages.of(
        scene,
        frame.images,
        ignore or {},
        scale=1.0,
        working_width=settings.working_width,
        dehaze=settings.dehaze,
        predictor=predictor,
        backgrounds=backgrounds,
    )
    return assess(evidence(images, scene.state(frame.measured, predictor.device), state, predictor, loss))
