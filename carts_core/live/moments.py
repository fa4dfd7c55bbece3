"""What sources of a stream hand on, and the desk where the newest waits."""

import math
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from jaxtyping import Float

from ..model.scene import Scene
from ..recording import Frame, Sequence
from ..recording.kinematics_table import PLAUSIBLE
from .messages import FrameMessage, StreamError, decoded


@dataclass(frozen=True)
class Moment:
    """A frame of a stream."""

    frame: Frame
    camera_poses: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Camera -> T_camera_world [4 x 4, m], where it is not that of the scene."""
    arrived: float = field(default_factory=time.monotonic)
    """On this machine's clock [s]."""


class Source(Protocol):
    """Where frames come from. Iterated on a thread of its own."""

    def __iter__(self) -> Iterator[Moment]:
        """Frames as they come; ends with the stream, or soon after `close`.

        Raises:
            CartsError: the stream is not usable.
        """
        ...

    def close(self) -> None:
        """End it; may be called from any thread, more than once."""
        ...


def mounts_of(
    scene: Scene, frame: Frame, camera_poses: Mapping[str, Float[np.ndarray, "4 4"]]
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Camera -> T_mount_world [m] of a frame, of the cameras that move; poses that were sent count before the frame's.

    Args:
        scene: with the cameras' places on their mounts.
        frame: of a recording or a stream.
        camera_poses: camera -> T_camera_world [m].
    """
    sent = {
        camera.name: np.linalg.inv(camera.T_camera_world) @ camera_poses[camera.name]
        for camera in scene.cameras
        if camera.name in camera_poses
    }
    return {**frame.mounts, **sent}


class Assembler:
    """Makes frames of the messages of a stream: joints and camera poses stay until they are replaced.

    Args:
        sequence: whose arms and cameras these are.
        cameras: that every frame needs an image of.
    """

    def __init__(self, sequence: Sequence, cameras: tuple[str, ...]) -> None:
        self._sequence, self._cameras = sequence, cameras
        self._joints = {arm: rows[0].copy() for arm, rows in sequence.measured.items()}
        self._known: set[str] = set()
        self._poses: dict[str, np.ndarray] = {}
        self._count = 0
        self._changing = threading.Lock()

    def moment(self, message: FrameMessage) -> Moment | None:
        """The frame that a message completes; None for one without images, or before every arm's joints are known.

        Raises:
            StreamError: it has an unknown arm, joint or camera, lacks an image, or one or the time is not usable.
        """
        if not math.isfinite(message.time):
            raise StreamError(f"a message has the time {message.time}; give seconds.")
        with self._changing:
            self._take_joints(message)
            self._take_poses(message)
            if not message.images or self._known < set(self._joints):
                return None
            self._count += 1
            frame = Frame(
                index=self._count - 1,
                frame_id=message.id or f"{self._count:06d}",
                domain=self._sequence.domains[0],
                images={name: self._image(name, message) for name in self._cameras},
                measured={arm: values.copy() for arm, values in self._joints.items()},
                truth=None,
                masks=None,
                timestamp=message.time,
            )
            return Moment(frame, dict(self._poses))

    def _take_joints(self, message: FrameMessage) -> None:
        for name, joints in message.joints.items():
            if name not in self._joints:
                raise StreamError(f"there is no arm {name!r}; the arms are {', '.join(self._joints)}.")
            robot = self._sequence.scene.arm(name).robot
            names = robot.joint_names
            for joint, value in joints.items():
                largest = PLAUSIBLE[robot.joint_types[names.index(joint)]] if joint in names else -1.0
                if not abs(value) <= largest:
                    raise StreamError(
                        f"{name}: joint {joint!r} at {value}; its joints are {', '.join(names)}, in rad or m, at most "
                        f"{PLAUSIBLE['revolute']:.3g} rad and {PLAUSIBLE['prismatic']:.3g} m."
                    )
                self._joints[name][names.index(joint)] = value
            self._known.add(name)

    def _take_poses(self, message: FrameMessage) -> None:
        known = [camera.name for camera in self._sequence.scene.cameras]
        for name, rows in message.camera_poses.items():
            square = len(rows) == 4 and {len(row) for row in rows} == {4}
            pose = np.array(rows, np.float64) if square else np.zeros((4, 4))
            if name not in known or not _is_rigid(pose):
                raise StreamError(f"camera_poses of {name!r}: give a rigid 4 x 4 matrix for one of {', '.join(known)}.")
            self._poses[name] = pose

    def _image(self, name: str, message: FrameMessage) -> np.ndarray:
        if name not in message.images:
            raise StreamError(f"a frame has no image of camera {name!r}. Send one of each: {', '.join(self._cameras)}.")
        return self.undistorted(name, decoded(name, message.images[name]))

    def undistorted(self, name: str, image: np.ndarray) -> np.ndarray:
        """An image as the scene's camera sees it.

        Raises:
            StreamError: it is of another size than the camera's images.
        """
        camera = self._sequence.recorded_camera(name)
        if image.shape[:2] != (camera.height, camera.width):
            height, width = image.shape[:2]
            raise StreamError(
                f"image of {name} is {width} x {height} px; the camera has {camera.width} x {camera.height}."
            )
        return camera.undistort(image)


def _is_rigid(pose: np.ndarray) -> bool:
    """Whether a 4 x 4 matrix turns and moves, and does nothing else."""
    if not np.isfinite(pose).all() or not np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0]):
        return False
    rotation = pose[:3, :3]
    return bool(np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0)


class Newest:
    """Takes frames from a source on a thread of its own; who asks gets the newest, and those before it are dropped.

    Args:
        source: that is read and, in the end, closed.

    Attributes:
        arrived, dropped: how many frames.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._moment: Moment | None = None
        self._ended, self._error = False, None
        self._changed = threading.Condition()
        self.arrived = self.dropped = 0
        self._thread = threading.Thread(target=self._read, name="carts-live-source", daemon=True)
        self._thread.start()

    def take(self, patience: float) -> Moment | None:
        """The newest frame, waited for; None at the end.

        Args:
            patience: a frame that has waited longer is dropped for the next one, unless it is the last one [s].

        Raises:
            CartsError: what ended the source.
        """
        with self._changed:
            while True:
                moment, self._moment = self._moment, None
                if moment is not None and (self._ended or time.monotonic() - moment.arrived <= patience):
                    return moment
                self.dropped += moment is not None
                if self._ended:
                    if self._error is not None:
                        raise self._error
                    return None
                self._changed.wait(0.5)

    def close(self) -> None:
        """End the source and wait for its thread."""
        self._source.close()
        self._thread.join(5.0)

    def _read(self) -> None:
        error = None
        try:
            for moment in self._source:
                with self._changed:
                    self.arrived += 1
                    self.dropped += self._moment is not None
                    self._moment = moment
                    self._changed.notify()
        except Exception as found:  # Whoever takes frames gets it.
            error = found
        with self._changed:
            self._ended, self._error = True, error
            self._changed.notify()
