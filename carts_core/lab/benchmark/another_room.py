"""Real frames with their instrument cut out and put into other rooms."""

import dataclasses
import zlib
from collections.abc import Iterable
from collections.abc import Sequence as Items
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_erosion, distance_transform_edt

from ...recording import Frame, MeanBackground, Sequence, background_of_recording
from ...recording.background import spread
from .rooms import Room

_PARALLAX = 24
"""How far the room of one camera is moved against that of the camera before [px]."""

_RIM = 2
"""Width of the rim whose colours come from further inside, since the old background shines through it [px]."""

_SEAM = 0.8
"""Deviation of the blur of the cut [px]."""

_MATCH = (0.85, 1.15)
"""How far the instrument's brightness follows the room's [1]."""

_GAIN, _NOISE = 0.03, 1.5
"""Largest change of the light from frame to frame [1], and the sensor's noise [grey levels]."""


class AnotherRoom:
    """A real sequence in which each domain is a room.

    The room stands still through the recording; light and noise vary from frame to frame. The mean background is
    estimated as that of any recording: as the median over its frames of what the arms, as measured, do not cover.

    Args:
        sequence: with masks of the cameras.
        rooms: each is a domain of that name.
        seed: of light and noise.
    """

    def __init__(self, sequence: Sequence, rooms: Items[Room], seed: int) -> None:
        self.scene, self.timestamps = sequence.scene, sequence.timestamps
        self.measured_joints = sequence.measured_joints
        self.rooms = {room.domain: room for room in rooms}
        self._sequence, self._seed = sequence, seed
        self._cameras = [camera.name for camera in sequence.scene.cameras]
        self._picture = lru_cache(maxsize=8)(self._make_picture)
        self._background = lru_cache(maxsize=8)(self._make_background)

    def __len__(self) -> int:
        return len(self._sequence)

    def frame(self, index: int, domain: str | None = None, cameras: Iterable[str] | None = None) -> Frame:
        """A frame in a room; the first one by default."""
        room = domain or next(iter(self.rooms))
        frame = self._sequence.frame(index, cameras=cameras or self._cameras)
        assert frame.masks is not None
        images = {
            camera: self._photographed(
                pasted(image, frame.masks[camera], self.empty(room, camera)), room, camera, index
            )
            for camera, image in frame.images.items()
        }
        return dataclasses.replace(frame, domain=room, images=images)

    def frame_without_arm(self, index: int, room: str, cameras: Iterable[str] | None = None) -> Frame:
        """The same with nothing in the room; the masks are empty."""
        frame = self._sequence.frame(index, cameras=cameras or self._cameras)
        assert frame.masks is not None
        images = {camera: self._photographed(self.empty(room, camera), room, camera, index) for camera in frame.images}
        masks = {camera: np.zeros_like(mask) for camera, mask in frame.masks.items()}
        return dataclasses.replace(frame, domain=room, images=images, masks=masks)

    def empty(self, room: str, camera: str) -> UInt8[np.ndarray, "h w 3"]:
        """The room as a camera sees it, without light's and noise's changes."""
        return self._picture(room, camera)

    def background(self, camera: str, domain: str | None = None) -> UInt8[np.ndarray, "h w 3"]:
        """The mean background, estimated from the recording in the room."""
        return self.mean_background(camera, domain).image.copy()

    def mean_background(self, camera: str, domain: str | None = None) -> MeanBackground:
        """The same with where it is known."""
        return self._background(domain or next(iter(self.rooms)), camera)

    def _make_picture(self, room: str, camera: str) -> UInt8[np.ndarray, "h w 3"]:
        known = self.scene.with_cameras([camera]).cameras[0]
        left = _PARALLAX * self._cameras.index(camera)
        wide = self.rooms[room].draw(known.width + _PARALLAX * (len(self._cameras) - 1), known.height)
        return np.ascontiguousarray(wide[:, left : left + known.width])

    def _make_background(self, room: str, camera: str) -> MeanBackground:
        indices = spread(len(self))
        states = [self.scene.state(self._sequence.frame(index, cameras=()).measured) for index in indices]
        return background_of_recording(
            self.scene, camera, states, lambda place: self.frame(indices[place], room, [camera]).images[camera]
        )

    def _photographed(
        self, picture: UInt8[np.ndarray, "h w 3"], room: str, camera: str, index: int
    ) -> UInt8[np.ndarray, "h w 3"]:
        """The picture under the light and with the noise of one moment."""
        rng = np.random.default_rng([self._seed, zlib.crc32(f"{self.rooms[room].name}/{camera}".encode()), index])
        light = picture * rng.uniform(1 - _GAIN, 1 + _GAIN)
        return np.rint(light + rng.normal(0, _NOISE, picture.shape)).clip(0, 255).astype(np.uint8)


def pasted(
    image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], room: UInt8[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    """The masked part of an image before a room, about as bright as the room, with a soft seam."""
    if not mask.any():
        return room.astype(np.float32)
    inside = np.asarray(binary_erosion(mask, iterations=_RIM), bool)
    # The colour of each pixel near the rim is that of the nearest one well inside.
    nearest = distance_transform_edt(~(inside if inside.any() else mask), return_distances=False, return_indices=True)
    arm = image[tuple(np.asarray(nearest))].astype(np.float32)
    gain = np.clip(np.sqrt(max(float(np.median(room)), 1.0) / max(float(np.median(image)), 1.0)), *_MATCH)
    cover = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), _SEAM)[..., None]
    return cover * arm * gain + (1.0 - cover) * room
