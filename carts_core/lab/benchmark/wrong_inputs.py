"""Frames whose image does not belong to their kinematics, or shows no arm: what a verdict has to notice."""

from dataclasses import replace

import numpy as np

from ...recording import Frame
from .sources import Recording

NO_ARM = "no arm"
OTHER_FRAME = "joints of another frame"
OTHER_CAMERA = "image of another camera"
WRONG = (NO_ARM, OTHER_FRAME, OTHER_CAMERA)


def wrong_inputs(frames: int, cameras: int) -> tuple[str, ...]:
    """Those that a recording of so many frames and cameras can have."""
    return tuple(kind for kind, needed in zip(WRONG, (True, frames > 1, cameras > 1), strict=True) if needed)


def misled(recording: Recording, kind: str, index: int, camera: str) -> Frame:
    """A frame in the regular domain with something wrong about it.

    Its masks are those of the image that is shown, so the estimate can be scored as any other.

    Args:
        recording: with masks of its cameras.
        kind: one of `WRONG`.
        index: position of the frame.
        camera: that takes part.
    """
    frame = recording.frame(index, "regular", [camera])
    match kind:
        case "no arm":
            image = recording.background(camera, "regular")
            return replace(frame, images={camera: image}, masks={camera: np.zeros(image.shape[:2], bool)})
        case "joints of another frame":
            other = (index + len(recording) // 2) % len(recording)
            return replace(frame, measured=recording.frame(other, "regular", ()).measured)
        case "image of another camera":
            (other,) = [known.name for known in recording.scene.cameras if known.name != camera][:1]
            seen = recording.frame(index, "regular", [other])
            assert seen.masks is not None
            return replace(frame, images={camera: seen.images[other]}, masks={camera: seen.masks[other]})
    raise AssertionError(f"no such wrong input: {kind}")
