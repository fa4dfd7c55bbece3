"""Messages of a stream, and frames (`StreamFrame`) assembled from messages."""

import math
import socket
import statistics
import struct
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

import cv2
import msgspec
import numpy as np
from jaxtyping import Float, UInt8

from ..errors import CartsError, SequenceError, SettingsError
from ..model.camera import rigid_transform
from ..model.scene import Scene
from ..recording import Frame, Sequence
from ..recording.kinematics_table import PLAUSIBLE

LARGEST = 64 * 2**20
"""Maximum size of a message [bytes]."""
_LENGTH = struct.Struct(">I")
_NEXT = 0.5
"""Maximum time for which an outdated frame is held back until the next one arrives [s]."""


class StreamError(CartsError):
    """Invalid message of a live stream."""


class ImageMessage(msgspec.Struct, forbid_unknown_fields=True):
    """Image as recorded by the camera."""

    data: bytes
    encoding: Literal["jpeg", "png", "rgb8"] = "jpeg"
    """Encoding of the image; `rgb8` has three bytes per pixel, row by row."""
    width: int = 0
    height: int = 0
    """Size of an `rgb8` image, `width` and `height` [px]."""


class FrameMessage(msgspec.Struct, tag="frame", forbid_unknown_fields=True):
    """Message with images, joint positions, or both."""

    time: float
    """Timestamp on the sender's clock [s]."""
    joints: dict[str, dict[str, float]] = {}
    """Arm -> joint -> position [rad, m]; omitted joints keep their value."""
    images: dict[str, ImageMessage] = {}
    """Camera -> image; a message without images only updates joints."""
    camera_poses: dict[str, list[list[float]]] = {}
    """Camera -> T_camera_world [4 x 4, m] of moving cameras; a pose is valid until the next pose."""
    id: str = ""
    """Identifier that is returned with the result."""


class ResultMessage(msgspec.Struct, tag="result"):
    """Result of a frame."""

    id: str
    time: float
    """Timestamp of the frame [s]."""
    age: float
    """Time from the frame's arrival to this message [s]."""
    verdict: str
    """`good`, `doubtful` or `lost`."""
    effort: str
    loss: float
    joints: dict[str, dict[str, tuple[float, float | None]]]
    """Arm -> joint -> corrected position and its standard deviation [rad, m]."""
    base_frames: dict[str, dict[str, list[list[float]]]]
    """Arm -> camera -> T_camera_base [4 x 4, m]."""
    current: bool = True
    """Whether the age is at most two frame intervals of the stream."""
    masks: dict[str, bytes] = {}
    """Camera -> PNG mask, 255 for arms; base64 in JSON lines."""


class ErrorMessage(msgspec.Struct, tag="error"):
    """Reason for closing the connection."""

    message: str


_decoder = msgspec.msgpack.Decoder(FrameMessage)


def packed(message: msgspec.Struct) -> bytes:
    """Encode a message with its length prefix, for a socket."""
    content = msgspec.msgpack.encode(message)
    return _LENGTH.pack(len(content)) + content


def receive(connection: socket.socket) -> FrameMessage | None:
    """Receive the next message; None at the end of the stream.

    Raises:
        StreamError: the message is too long or invalid.
        OSError: the connection is broken.
    """
    header = _exactly(connection, _LENGTH.size)
    if header is None:
        return None
    (length,) = _LENGTH.unpack(header)
    if length > LARGEST:
        raise StreamError(f"a message has {length} bytes; the limit is {LARGEST}. Send smaller images.")
    content = _exactly(connection, length)
    if content is None:
        raise StreamError("the connection was closed within a message.")
    try:
        return _decoder.decode(content)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:  # ValueError: not UTF-8
        raise StreamError(f"a message cannot be read: {error}. docs/reference/live.md describes the format.") from error


def _exactly(connection: socket.socket, count: int) -> bytes | None:
    """Receive exactly `count` bytes; None if the connection ends earlier."""
    parts, missing = [], count
    while missing:
        part = connection.recv(min(missing, 1 << 20))
        if not part:
            return None
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)


def decoded(camera: str, image: ImageMessage) -> UInt8[np.ndarray, "height width 3"]:
    """Decode an image to RGB.

    Raises:
        StreamError: the image cannot be decoded, or is too large.
    """
    if image.encoding == "rgb8":
        if image.width < 1 or image.height < 1 or len(image.data) != 3 * image.width * image.height:
            raise StreamError(
                f"image of {camera}: {len(image.data)} bytes do not match {image.width} x {image.height} pixels in "
                "rgb8."
            )
        return np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
    from ..recording.images import decode_image  # noqa: PLC0415 - clients send, and never decode

    try:
        return decode_image(image.data, f"image of {camera}")
    except SequenceError as error:
        raise StreamError(f"{error} Send JPEG, PNG, or rgb8 with width and height.") from error


def encoded_masks(masks: Mapping[str, np.ndarray]) -> dict[str, bytes]:
    """Encode masks as PNG."""
    return {name: cv2.imencode(".png", np.uint8(255) * mask)[1].tobytes() for name, mask in masks.items()}


@dataclass(frozen=True)
class StreamFrame:
    """Frame of a stream: images with joint positions."""

    frame: Frame
    camera_poses: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Camera -> T_camera_world [4 x 4, m], for cameras whose pose differs from that in the scene."""
    arrived: float = field(default_factory=time.monotonic)
    """Time of arrival on the monotonic clock [s]."""


class Source(Protocol):
    """Source of frames, iterated on its own thread."""

    def __iter__(self) -> Iterator[StreamFrame]:
        """Iterate over frames as they arrive, until the stream ends or `close` is called.

        Raises:
            CartsError: the stream failed.
        """
        ...

    def close(self) -> None:
        """Close the source; can be called from any thread, more than once."""
        ...


def mounts_of(
    scene: Scene, frame: Frame, camera_poses: Mapping[str, Float[np.ndarray, "4 4"]]
) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Camera -> T_mount_world [m] of moving cameras; received poses override those of the frame."""
    sent = {
        camera.name: np.linalg.inv(camera.T_camera_world) @ camera_poses[camera.name]
        for camera in scene.cameras
        if camera.name in camera_poses
    }
    return {**frame.mounts, **sent}


class Assembler:
    """Assembles frames from messages; joints and camera poses persist until replaced.

    Args:
        sequence: sequence with the arms and cameras.
        cameras: cameras that need an image in each frame.
    """

    def __init__(self, sequence: Sequence, cameras: tuple[str, ...]) -> None:
        self._sequence, self._cameras = sequence, cameras
        self._joints = {arm: rows[0].copy() for arm, rows in sequence.measured.items()}
        self._known: set[str] = set()
        self._poses: dict[str, np.ndarray] = {}
        self._count = 0
        self._changing = threading.Lock()

    def moment(self, message: FrameMessage, arrived: float | None = None) -> StreamFrame | None:
        """Frame completed by a message; None for a message without images, or until joints of every arm have
        arrived.

        Args:
            message: the message.
            arrived: its time of arrival on the monotonic clock [s]; now by default.

        Raises:
            StreamError: the message has an unknown arm, joint or camera, lacks an image, or has an invalid image,
                time, joint position or camera pose.
        """
        if not math.isfinite(message.time):
            raise StreamError(f"a message has the time {message.time}. Give a finite time in seconds.")
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
            return StreamFrame(frame, dict(self._poses), time.monotonic() if arrived is None else arrived)

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
                        f"{name}: joint {joint!r} is {value}. Give values for the joints {', '.join(names)}, of at "
                        f"most {PLAUSIBLE['revolute']:.3g} rad or {PLAUSIBLE['prismatic']:.3g} m."
                    )
                self._joints[name][names.index(joint)] = value
            self._known.add(name)

    def _take_poses(self, message: FrameMessage) -> None:
        known = [camera.name for camera in self._sequence.scene.cameras]
        for name, rows in message.camera_poses.items():
            if name not in known:
                raise StreamError(f"camera_poses: there is no camera {name!r}; the cameras are {', '.join(known)}.")
            try:
                self._poses[name] = rigid_transform(rows, f"camera_poses of {name!r}")
            except SettingsError as error:
                raise StreamError(str(error)) from error

    def _image(self, name: str, message: FrameMessage) -> np.ndarray:
        if name not in message.images:
            raise StreamError(
                f"a frame has no image of camera {name!r}. Send one image per camera: {', '.join(self._cameras)}."
            )
        return self.undistorted(name, decoded(name, message.images[name]))

    def undistorted(self, name: str, image: np.ndarray) -> np.ndarray:
        """Undistort an image for the scene's camera.

        Raises:
            StreamError: the size of the image differs from that of the camera.
        """
        camera = self._sequence.recorded_camera(name)
        if image.shape[:2] != (camera.height, camera.width):
            height, width = image.shape[:2]
            raise StreamError(
                f"image of {name} is {width} x {height} px; the camera has {camera.width} x {camera.height}."
            )
        return camera.undistort(image)


class LatestFrame:
    """Buffer with the latest frame of a source; reads the source on a separate thread.

    Args:
        source: source that is read, and closed with the buffer.

    Attributes:
        arrived, dropped: numbers of frames that arrived and were dropped.
    """

    _RECENT = 20
    """Number of frames over which interval and decoding time are averaged."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._moment: StreamFrame | None = None
        self._ended, self._error = False, None
        self._changed = threading.Condition()
        self.arrived = self.dropped = 0
        self._times = deque[float](maxlen=self._RECENT)
        self._delays = deque[float](maxlen=self._RECENT)
        """Times from arrival to the end of decoding of recent frames [s]."""
        self._fresh_at = 0.0
        """Time at which the latest frame would usually be decoded [s, monotonic]."""
        self._thread = threading.Thread(target=self._read, name="carts-live-source", daemon=True)
        self._thread.start()

    def take(self, patience: float) -> StreamFrame | None:
        """Wait for the latest frame; None at the end of the stream.

        Args:
            patience: age, without the usual time for decoding, beyond which a frame is held back until the next one
                arrives, for at most `_NEXT` [s]. The frame that is then the latest is returned whatever its age.

        Raises:
            CartsError: the source failed.
        """
        waited = False
        with self._changed:
            while True:
                moment = self._moment
                if moment is not None and (waited or self._ended or time.monotonic() - self._fresh_at <= patience):
                    self._moment = None
                    return moment
                if self._ended:
                    if self._error is not None:
                        raise self._error
                    return None
                self._changed.wait(_NEXT)
                waited = moment is not None

    @property
    def interval(self) -> float:
        """Mean time between recent frames [s]; infinite before the second frame."""
        times = tuple(self._times)
        return (times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else math.inf

    def close(self) -> None:
        """Close the source and wait for its thread."""
        self._source.close()
        self._thread.join(5.0)

    def _read(self) -> None:
        error = None
        try:
            for moment in self._source:
                with self._changed:
                    self.arrived += 1
                    self._times.append(moment.arrived)
                    self._delays.append(time.monotonic() - moment.arrived)
                    self._fresh_at = moment.arrived + statistics.median_low(self._delays)
                    self.dropped += self._moment is not None
                    self._moment = moment
                    self._changed.notify()
        except Exception as found:  # Raised by `take`.
            error = found
        with self._changed:
            self._ended, self._error = True, error
            self._changed.notify()
