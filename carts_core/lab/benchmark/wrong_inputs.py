"""Frames whose image does not belong to their kinematics, or shows no arm: what a verdict has to notice."""

from dataclasses import replace

import numpy as np

from ...model.robot import Robot
from ...model.scene import Scene
from ...recording import Frame
from .sources import Recording

NO_ARM = "no arm"
OTHER_FRAME = "joints of another frame"
OTHER_CAMERA = "image of another camera"
OTHER_INSTRUMENT = "another instrument"
WRONG = (NO_ARM, OTHER_FRAME, OTHER_CAMERA, OTHER_INSTRUMENT)
_STAND_INS = ("double_fenestrated_grasper", "clip_applier", "maryland_bipolar_forceps", "curved_scissors")
"""Built-in instruments that are rendered in the place of the one in the image, one frame after the other."""


def wrong_inputs(frames: int, cameras: int, *, built_in: bool) -> tuple[str, ...]:
    """Those that a recording can have.

    Args:
        frames: of the recording.
        cameras: of the recording.
        built_in: whether its arms are built-in instruments, whose base frames and joints others share.
    """
    possible = (True, frames > 1, cameras > 1, built_in)
    return tuple(kind for kind, needed in zip(WRONG, possible, strict=True) if needed)


def with_other_instruments(scene: Scene, index: int) -> Scene:
    """The scene with an instrument in the place of each arm's that is not in the image.

    Args:
        scene: whose arms are built-in instruments.
        index: position of the frame, which decides the instrument.
    """
    robot = Robot.load(f"builtin:{_STAND_INS[index % len(_STAND_INS)]}")
    return replace(scene, arms=tuple(replace(arm, robot=robot) for arm in scene.arms))


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
        case "another instrument":
            # Its joints cannot be compared with those of the one in the image.
            return replace(frame, truth=None)
    raise AssertionError(f"no such wrong input: {kind}")
