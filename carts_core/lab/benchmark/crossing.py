"""Frames in which one arm crosses the other: both rendered at other joints before the recording's empty background."""

from dataclasses import replace

import cv2
import numpy as np

from ...errors import SettingsError
from ...model.scene import Scene
from ...recording import Frame
from ...rendering import Renderer
from .sources import Recording

CROSSING = "crossing arms"
"""Name of the domain."""
_HIDDEN = 0.15, 0.9
"""Share of an arm that the other one hides [1]."""
_SHOWN = 0.02, 0.25
"""Share of the image that each arm covers [1]."""
_TURN, _REACH = 0.2, 0.008
"""Deviation of the drawn yaw and pitch [rad], and of the insertion [m]."""
_DRAWS = 2000
_COARSE = 160
"""Width in which draws are compared [px]."""
_BLUR, _NOISE = 0.65, 2.0
"""Deviations of lens blur [px] and noise [grey levels]."""


def crossed(recording: Recording, index: int, camera: str, seed: int = 0) -> Frame:
    """A frame of the regular domain with its arms moved so that one crosses the other.

    Measured joints keep the errors of that frame. Arms may pass through each other where they cross.

    Args:
        recording: of two arms with known joints.
        index: position of the frame.
        camera: that takes part.
        seed: of the draws and of the noise.

    Raises:
        SettingsError: no draw crosses, or the recording has no two arms or no truth.
    """
    frame, scene = recording.frame(index, "regular", [camera]), recording.scene.with_cameras([camera])
    if len(scene.arms) != 2 or not frame.truth:
        raise SettingsError(f"{CROSSING} need a recording of two arms with known joints; this one has no such.")
    rng = np.random.default_rng((seed, index))
    truth = _crossing_joints(scene, dict(frame.truth), rng)
    with_error = {name: truth[name] + frame.measured[name] - frame.truth[name] for name in truth}
    rendering = Renderer(scene)(scene.state(truth))
    arms = rendering.silhouette[0].numpy()[..., None]
    image = 255.0 * rendering.image[0].movedim(0, -1).numpy()
    picture = arms * image + (1.0 - arms) * recording.background(camera, "regular")
    picture = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), _BLUR) + rng.normal(0.0, _NOISE, picture.shape)
    return replace(
        frame,
        images={camera: np.rint(picture.clip(0, 255)).astype(np.uint8)},
        masks={camera: arms[..., 0] > 0.5},
        measured=with_error,
        truth=truth,
    )


def _crossing_joints(scene: Scene, around: dict[str, np.ndarray], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Joint positions of both arms [rad, m] near others, at which they cross."""
    width, height = _COARSE, round(_COARSE * scene.cameras[0].height / scene.cameras[0].width)
    both = Renderer(scene, width=width, height=height)
    alone = {arm.name: scene.with_arms([arm.name]) for arm in scene.arms}
    renderers = {name: Renderer(part, width=width, height=height) for name, part in alone.items()}
    for _ in range(_DRAWS):
        drawn = {}
        for arm in scene.arms:
            low, high = arm.robot.joint_limits[:3].numpy().T
            step = rng.normal(0.0, [_TURN, _TURN, _REACH])
            drawn[arm.name] = around[arm.name].copy()
            drawn[arm.name][:3] = np.clip(around[arm.name][:3] + step, low, high)
        labels = both.segment(scene.state(drawn))[0]
        seen = np.array([(labels == arm).mean() for arm in range(2)])
        if not (_SHOWN[0] <= seen.min() and seen.max() <= _SHOWN[1]):
            continue
        whole = [
            (renderers[name].segment(part.state({name: drawn[name]}))[0] >= 0).mean() for name, part in alone.items()
        ]
        if _HIDDEN[0] <= float((1.0 - seen / np.array(whole)).max()) <= _HIDDEN[1]:
            return drawn
    raise SettingsError(f"none of {_DRAWS} draws makes these arms cross in camera {scene.cameras[0].name!r}.")
