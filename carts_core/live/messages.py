"""Messages of a live stream over a socket: msgpack, each after its length as four bytes, most significant first.

docs/reference/live.md describes them.
"""

import socket
import struct
from collections.abc import Mapping
from typing import Literal

import cv2
import msgspec
import numpy as np
from jaxtyping import UInt8

from ..errors import CartsError, SequenceError

LARGEST = 64 * 2**20
"""Of a message [bytes]."""
_LENGTH = struct.Struct(">I")


class StreamError(CartsError):
    """A message of a live stream is not usable."""


class ImageMessage(msgspec.Struct, forbid_unknown_fields=True):
    """An image as the camera recorded it."""

    data: bytes
    encoding: Literal["jpeg", "png", "rgb8"] = "jpeg"
    """`rgb8` is three bytes a pixel, row after row."""
    width: int = 0
    """Of `rgb8` [px]."""
    height: int = 0


class FrameMessage(msgspec.Struct, tag="frame", forbid_unknown_fields=True):
    """What a sender says: images, joints, or both."""

    time: float
    """When it was taken, on the sender's clock [s]."""
    joints: dict[str, dict[str, float]] = {}
    """Arm -> joint -> position [rad, m]; what is left out stays as it was."""
    images: dict[str, ImageMessage] = {}
    """Camera -> image; a message without images only changes joints."""
    camera_poses: dict[str, list[list[float]]] = {}
    """Camera -> T_camera_world [4 x 4, m], of a camera that moves; it stays until the next one."""
    id: str = ""
    """Comes back with the result."""


class ResultMessage(msgspec.Struct, tag="result"):
    """What came of a frame."""

    id: str
    time: float
    """As the sender gave it [s]."""
    age: float
    """Between the frame's arrival and this message [s]."""
    verdict: str
    """`good`, `doubtful` or `lost`."""
    effort: str
    loss: float
    joints: dict[str, dict[str, tuple[float, float | None]]]
    """Arm -> joint -> corrected position and its standard deviation [rad, m]."""
    base_frames: dict[str, dict[str, list[list[float]]]]
    """Arm -> camera -> T_camera_base [4 x 4, m]."""
    masks: dict[str, bytes] = {}
    """Camera -> PNG, 255 where an arm is; base64 in JSON lines."""


class ErrorMessage(msgspec.Struct, tag="error"):
    """Why the connection is closed."""

    message: str


_decoder = msgspec.msgpack.Decoder(FrameMessage)


def packed(message: msgspec.Struct) -> bytes:
    """A message as it goes over a socket."""
    content = msgspec.msgpack.encode(message)
    return _LENGTH.pack(len(content)) + content


def receive(connection: socket.socket) -> FrameMessage | None:
    """The next message of a sender; None at the end.

    Raises:
        StreamError: it is too long, or no message.
        OSError: the connection is broken.
    """
    header = _exactly(connection, _LENGTH.size)
    if header is None:
        return None
    (length,) = _LENGTH.unpack(header)
    if length > LARGEST:
        raise StreamError(f"a message of {length} bytes was announced; {LARGEST} are allowed. Send smaller images.")
    content = _exactly(connection, length)
    if content is None:
        raise StreamError("the connection ended within a message.")
    try:
        return _decoder.decode(content)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:  # a ValueError: no UTF-8
        raise StreamError(f"a message cannot be read: {error}. docs/reference/live.md describes them.") from error


def _exactly(connection: socket.socket, count: int) -> bytes | None:
    """So many bytes; None where the sender ends before all are there."""
    parts, missing = [], count
    while missing:
        part = connection.recv(min(missing, 1 << 20))
        if not part:
            return None
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)


def decoded(camera: str, image: ImageMessage) -> UInt8[np.ndarray, "height width 3"]:
    """An image as RGB.

    Raises:
        StreamError: it is none, or too large.
    """
    if image.encoding == "rgb8":
        if image.width < 1 or image.height < 1 or len(image.data) != 3 * image.width * image.height:
            raise StreamError(
                f"image of {camera}: {len(image.data)} bytes are not {image.width} x {image.height} pixels of rgb8."
            )
        return np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
    from ..recording.images import decode_image  # noqa: PLC0415 - clients send, and never decode

    try:
        return decode_image(image.data, f"image of {camera}")
    except SequenceError as error:
        raise StreamError(f"{error} Send JPEG, PNG, or rgb8 with width and height.") from error


def encoded_masks(masks: Mapping[str, np.ndarray]) -> dict[str, bytes]:
    """Masks as PNG."""
    return {name: cv2.imencode(".png", np.uint8(255) * mask)[1].tobytes() for name, mask in masks.items()}
