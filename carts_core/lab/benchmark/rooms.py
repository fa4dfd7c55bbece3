"""Rooms (synthetic or photographed backgrounds without instruments), and compositing of recorded instruments."""

import dataclasses
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from collections.abc import Sequence as Items
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_erosion, distance_transform_edt

from ...errors import SettingsError
from ...recording import Frame, MeanBackground, Sequence, background_of_recording
from ...recording.background import evenly_spaced
from ...recording.images import read_image

Half = Literal["tuning", "held-out"]
Picture = Float[np.ndarray, "h w 3"]

_SEEDS = 2
"""Number of synthetic rooms of each kind."""

_PHOTOGRAPHS = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True)
class Room:
    """Background that replaces the recorded background."""

    name: str
    half: Half
    """Whether the room may be used for tuning or is held out."""
    draw: Callable[[int, int], UInt8[np.ndarray, "h w 3"]]
    """Function that draws the image of the room at a width and height [px]."""

    @property
    def domain(self) -> str:
        """Name of the domain in runs."""
        return f"{self.half}: {self.name}"


def synthetic_rooms() -> list[Room]:
    """Synthetic rooms."""
    halves: list[tuple[Half, dict[str, Callable[..., Picture]]]] = [("tuning", _TUNING), ("held-out", _HELD_OUT)]
    return [
        Room(f"{kind} {seed}", half, partial(_made, kind, draw, seed))
        for half, kinds in halves
        for kind, draw in kinds.items()
        for seed in range(_SEEDS)
    ]


def photographs(folder: Path) -> list[Room]:
    """Rooms from the photographs in a folder; every other photograph, by name, is held out.

    Raises:
        SettingsError: the folder contains no photograph.
    """
    paths = sorted(path for path in folder.glob("*") if path.suffix.lower() in _PHOTOGRAPHS)
    if not paths:
        raise SettingsError(f"{folder} has no photographs. Give a folder with {', '.join(_PHOTOGRAPHS)} files.")
    halves: tuple[Half, Half] = ("tuning", "held-out")
    return [Room(path.stem, halves[index % 2], partial(_photograph, path)) for index, path in enumerate(paths)]


def _made(kind: str, draw: Callable[..., Picture], seed: int, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """Image of a synthetic room."""
    rng = np.random.default_rng([zlib.crc32(kind.encode()), seed])
    picture = draw(rng, width, height)
    picture *= 1.0 + 0.15 * _grain(rng, width, height, width / 3)[..., None]
    picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.6, 1.4))
    return np.rint(255 * picture.clip(0, 1)).astype(np.uint8)


def _photograph(path: Path, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """Read a photograph and crop its centre, resized to `width` x `height` px."""
    whole = read_image(path)
    rows, columns, _ = whole.shape
    scale = max(width / columns, height / rows)
    size = max(round(scale * columns), width), max(round(scale * rows), height)
    picture = cv2.resize(whole, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    top, left = (size[1] - height) // 2, (size[0] - width) // 2
    return np.ascontiguousarray(picture[top : top + height, left : left + width])


def _grain(rng: np.random.Generator, width: int, height: int, size: float) -> Float[np.ndarray, "h w"]:
    """Smooth noise in [-1, 1] with a wavelength of about `size` px."""
    cells = max(round(width / size), 2), max(round(height / size), 2)
    coarse = rng.uniform(-1, 1, cells[::-1]).astype(np.float32)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).clip(-1, 1)


def _color(rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]) -> np.ndarray:
    hsv = np.array([[[rng.uniform(0, 360), rng.uniform(*saturation), rng.uniform(*value)]]], np.float32)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0]


def _plain(color: np.ndarray, width: int, height: int) -> Picture:
    return np.tile(color.astype(np.float32), (height, width, 1))


def _bar(
    picture: Picture,
    middle: tuple[float, float],
    angle: float,
    length: float,
    width: float,
    color: np.ndarray,
    profile: np.ndarray,
) -> None:
    """Draw a straight bar and its shadow; `profile` is the brightness across the bar."""
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])

    def shape(low: float, high: float, moved: float) -> np.ndarray:
        corners = [(-1, low), (1, low), (1, high), (-1, high)]
        points = [np.array(middle) + (s * along * length + t * across * width) / 2 + moved for s, t in corners]
        return np.rint(8 * np.array(points)).astype(np.int32)

    shadow = np.ones(picture.shape[:2], np.float32)
    cv2.fillPoly(shadow, [shape(-1, 1, 0.4 * width)], 0.6, cv2.LINE_AA, 3)
    picture *= cv2.GaussianBlur(shadow, (0, 0), 0.2 * width + 1)[..., None]
    edges = np.linspace(-1, 1, len(profile) + 1)
    for low, high, light in zip(edges[:-1], edges[1:], profile, strict=True):
        cv2.fillPoly(picture, [shape(low, high + 0.02, 0)], (color * light).clip(0, 1).tolist(), cv2.LINE_AA, 3)


def _disc(picture: Picture, middle: tuple[float, float], radius: int, grey: float) -> None:
    cv2.circle(picture, (round(middle[0]), round(middle[1])), radius, [grey] * 3, -1, cv2.LINE_AA)


def _round(light: float, gloss: float, steps: int = 15) -> np.ndarray:
    """Brightness profile across a cylinder."""
    across = np.linspace(-0.98, 0.98, steps)
    normal = np.stack([across, np.sqrt(1 - across**2)])
    toward = normal.T @ np.array([np.sin(light), np.cos(light)])
    return 0.25 + 0.75 * toward.clip(0) + gloss * toward.clip(0) ** 40


def _somewhere(rng: np.random.Generator, width: int, height: int) -> tuple[float, float]:
    return rng.uniform(0.1, 0.9) * width, rng.uniform(0.1, 0.9) * height


def _bench(rng: np.random.Generator, width: int, height: int) -> Picture:
    """Table with boxes, tools and screws."""
    wood = np.array([0.55, 0.4, 0.27]) * rng.uniform(0.7, 1.4)
    picture = _plain(wood, width, height)
    rings = np.sin(np.linspace(0, 60, height)[:, None] + 4 * _grain(rng, width, height, width / 2))
    picture *= (1 + 0.08 * rings + 0.06 * _grain(rng, width, height, 6))[..., None]
    for _ in range(14):
        middle, angle = _somewhere(rng, width, height), rng.uniform(0, np.pi)
        color = _color(rng, (0.0, 0.9), (0.15, 0.9))
        if rng.random() < 0.5:
            _bar(picture, middle, angle, rng.uniform(40, 160), rng.uniform(30, 120), color, rng.uniform(0.8, 1.1, 1))
        else:
            profile = _round(rng.uniform(-1, 1), rng.uniform(0, 0.8))
            _bar(picture, middle, angle, rng.uniform(80, 300), rng.uniform(6, 40), color, profile)
    for _ in range(40):
        grey, place = rng.uniform(0.2, 0.9), _somewhere(rng, width, height)
        _disc(picture, place, int(rng.integers(2, 8)), grey)
    return picture


def _rods(rng: np.random.Generator, width: int, height: int) -> Picture:
    """Straight dark and bright cylinders, about as thick as an instrument shaft."""
    picture = _plain(_color(rng, (0.05, 0.5), (0.5, 0.9)), width, height)
    picture *= (1 + 0.1 * _grain(rng, width, height, 20))[..., None]
    for _ in range(7):
        color = np.full(3, rng.choice([rng.uniform(0.05, 0.2), rng.uniform(0.4, 0.8)])) * rng.uniform(0.9, 1.1, 3)
        profile = _round(rng.uniform(-1, 1), rng.uniform(0, 0.6))
        length = rng.uniform(0.3, 1.4) * width
        place, angle = _somewhere(rng, width, height), rng.uniform(0, np.pi)
        _bar(picture, place, angle, length, rng.uniform(12, 60), color, profile)
    return picture


def _saturated(rng: np.random.Generator, width: int, height: int) -> Picture:
    """Uniform areas of saturated colours."""
    picture = _plain(_color(rng, (0.7, 1), (0.5, 1)), width, height)
    for _ in range(5):
        corners = np.array([_somewhere(rng, width, height) for _ in range(4)])
        hull = cv2.convexHull(np.rint((corners - corners.mean(0)) * 1.6 + corners.mean(0)).astype(np.int32))
        cv2.fillPoly(picture, [hull], _color(rng, (0.6, 1), (0.3, 1)).tolist(), cv2.LINE_AA)
    return picture


def _patterns(rng: np.random.Generator, width: int, height: int) -> Picture:
    """Weaves, stripes and checks in perspective."""
    rows, columns = np.indices((height, width)).astype(np.float32)
    depth = 1 + rng.uniform(0.3, 1.2) * rows / height
    a, pitch = rng.uniform(0, np.pi), rng.uniform(14, 60)
    u = (columns - width / 2) / depth * np.cos(a) + rows / depth * np.sin(a)
    v = -(columns - width / 2) / depth * np.sin(a) + rows / depth * np.cos(a)
    first, second = _color(rng, (0, 0.8), (0.5, 1)), _color(rng, (0, 0.8), (0.05, 0.5))
    sign = np.sin(2 * np.pi * u / pitch)
    if rng.random() < 0.5:
        sign *= np.sin(2 * np.pi * v / pitch)
    share = 1 / (1 + np.exp(-8 * sign))[..., None]
    return (share * first + (1 - share) * second).astype(np.float32)


def _plates(rng: np.random.Generator, width: int, height: int) -> Picture:
    """Metal sheets with screws and holes."""
    picture = _plain(np.full(3, rng.uniform(0.1, 0.4)), width, height)
    for _ in range(6):
        middle, angle = _somewhere(rng, width, height), rng.uniform(-0.4, 0.4)
        size = rng.uniform(100, 360, 2)
        metal = np.array([0.7, 0.72, 0.75]) * rng.uniform(0.5, 1.25)
        glare = 1 + 0.4 * np.sin(np.linspace(0, rng.uniform(2, 9), 40) + rng.uniform(0, 6))
        _bar(picture, middle, angle, size[0], size[1], metal, glare * rng.uniform(0.95, 1.05, 40))
        for x, y in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
            place = middle[0] + 0.42 * x * size[0], middle[1] + 0.42 * y * size[1]
            _disc(picture, place, int(rng.integers(4, 12)), rng.uniform(0, 0.4))
    return picture


def _rails(rng: np.random.Generator, width: int, height: int) -> Picture:
    """Profile rails: long straight bands with slots."""
    picture = _plain(_color(rng, (0, 0.6), (0.3, 0.9)), width, height)
    for _ in range(6):
        side = rng.uniform(25, 80)
        slots = np.repeat([1.0, 0.8, 0.3, 0.1, 0.35, 0.85, 1.05, 0.8, 0.3, 0.1, 0.35, 0.9], 2)
        angle = rng.choice([0, np.pi / 2]) + rng.normal(0, 0.25)
        metal = np.array([0.75, 0.77, 0.8]) * rng.uniform(0.5, 1.2)
        _bar(picture, _somewhere(rng, width, height), angle, 2 * width, side, metal, slots)
    return picture


def _ceramic(rng: np.random.Generator, width: int, height: int) -> Picture:
    """Tiled wall with white cups, plates and tubes."""
    picture = _plain(np.array([0.85, 0.86, 0.84]) * rng.uniform(0.7, 1.1), width, height)
    pitch = int(rng.integers(50, 110))
    picture[::pitch] = picture[1::pitch] = picture[:, ::pitch] = picture[:, 1::pitch] = rng.uniform(0.3, 0.6)
    for _ in range(9):
        x, y = _somewhere(rng, width, height)
        radius = rng.uniform(20, 90)
        rows, columns = np.indices((height, width))
        inside = np.hypot(columns - x, (rows - y) / rng.uniform(0.6, 1)) / radius
        bowl = 0.75 + 0.25 * np.cos(3 * inside) - 0.35 * (np.abs(inside - 0.92) < 0.06)
        gloss = np.exp(-((columns - x + radius / 3) ** 2 + (rows - y + radius / 3) ** 2) / (2 * (radius / 8) ** 2))
        color = (0.92, 0.92, 0.9) if rng.random() < 0.7 else _color(rng, (0.3, 0.8), (0.4, 0.9))
        dish = np.asarray(color) * bowl[..., None] + gloss[..., None]
        cover = ((1.02 - inside) * radius / 2).clip(0, 1)[..., None]
        picture = (cover * dish + (1 - cover) * picture).astype(np.float32)
    place, angle = _somewhere(rng, width, height), rng.uniform(0, np.pi)
    _bar(picture, place, angle, width, rng.uniform(15, 45), np.full(3, 0.9), _round(0.5, 0.7))
    return picture


def _cables(rng: np.random.Generator, width: int, height: int) -> Picture:
    """Thick and thin cables over a board with small parts."""
    picture = _plain(_color(rng, (0.2, 0.9), (0.2, 0.6)), width, height)
    for _ in range(60):
        x, y = _somewhere(rng, width, height)
        a, b = rng.uniform(4, 30, 2)
        shade = _color(rng, (0, 0.5), (0.05, 0.9)).tolist()
        cv2.rectangle(picture, (int(x), int(y)), (int(x + a), int(y + b)), shade, -1)
    for _ in range(14):
        knots = np.array([(rng.uniform(-0.1, 1.1) * width, rng.uniform(-0.1, 1.1) * height) for _ in range(4)])
        t = np.linspace(0, 1, 80)[:, None]
        s = 1 - t
        curve = s**3 * knots[0] + 3 * t * s**2 * knots[1] + 3 * t**2 * s * knots[2] + t**3 * knots[3]
        color, thick = _color(rng, (0, 1), (0.05, 0.8)), float(rng.uniform(4, 26))
        for share, light in ((1.0, 0.5), (0.7, 0.9), (0.25, 1.4)):
            line, shade = [np.rint(curve).astype(np.int32)], (color * light).clip(0, 1).tolist()
            cv2.polylines(picture, line, False, shade, max(round(share * thick), 1), cv2.LINE_AA)
    return picture


_TUNING = {"bench": _bench, "rods": _rods, "saturated": _saturated, "patterns": _patterns}
_HELD_OUT = {"plates": _plates, "rails": _rails, "ceramic": _ceramic, "cables": _cables}


_PARALLAX = 24
"""Shift of the room between consecutive cameras [px]."""

_RIM = 2
"""Width of the mask's boundary strip, whose colours are replaced by colours farther inside, to remove the old
background [px]."""

_SEAM = 0.8
"""Standard deviation of the blur of the mask's edge [px]."""

_MATCH = (0.85, 1.15)
"""Range of the gain that matches the instrument's brightness to the room [1]."""

_GAIN, _NOISE = 0.03, 1.5
"""Maximum relative change of brightness between frames [1], and sensor noise [grey levels]."""


class AlteredSequence(ABC):
    """Base class of sequences whose images are altered in memory and that define their own domains."""

    def __init__(self, sequence: Sequence) -> None:
        self.scene, self.timestamps = sequence.scene, sequence.timestamps
        self.measured_joints = sequence.measured_joints
        self._sequence = sequence

    def __len__(self) -> int:
        return len(self._sequence)

    @abstractmethod
    def frame(self, index: int, domain: str | None = None, cameras: Iterable[str] | None = None) -> Frame:
        """Frame with its images in a domain, by default the first domain."""

    @abstractmethod
    def mean_background(self, camera: str, domain: str | None = None) -> MeanBackground:
        """Mean background, and the pixels in which it is known."""

    def background(self, camera: str, domain: str | None = None) -> UInt8[np.ndarray, "h w 3"]:
        """Mean background in a domain."""
        return self.mean_background(camera, domain).image.copy()


class AnotherRoom(AlteredSequence):
    """Sequence with masks, composited over rooms; its domains are those of the rooms (`Room.domain`).

    The room is static; light and noise vary between frames and depend on the seed. The mean background is estimated as
    for recordings: the median over frames, excluding pixels covered by the arms at their measured positions.
    """

    def __init__(self, sequence: Sequence, rooms: Items[Room], seed: int) -> None:
        super().__init__(sequence)
        self.rooms, self._seed = {room.domain: room for room in rooms}, seed
        self._cameras = [camera.name for camera in sequence.scene.cameras]
        self._picture, self._background = lru_cache(8)(self._make_picture), lru_cache(8)(self._make_background)

    def frame(self, index: int, domain: str | None = None, cameras: Iterable[str] | None = None) -> Frame:
        """Frame composited over a room, by default the first room."""
        room = domain or next(iter(self.rooms))
        frame = self._sequence.frame(index, cameras=cameras or self._cameras)
        assert frame.masks is not None
        images = {}
        for camera, image in frame.images.items():
            picture = pasted(image, frame.masks[camera], self._picture(room, camera))
            # Brightness and noise are reproducible per room, camera and frame.
            rng = np.random.default_rng([self._seed, zlib.crc32(f"{self.rooms[room].name}/{camera}".encode()), index])
            light = picture * rng.uniform(1 - _GAIN, 1 + _GAIN)
            noisy = np.rint(light + rng.normal(0, _NOISE, picture.shape))
            images[camera] = noisy.clip(0, 255).astype(np.uint8)
        return dataclasses.replace(frame, domain=room, images=images)

    def mean_background(self, camera: str, domain: str | None = None) -> MeanBackground:
        """Mean background of the recording in a room, and the pixels in which it is known."""
        return self._background(domain or next(iter(self.rooms)), camera)

    def _make_picture(self, room: str, camera: str) -> UInt8[np.ndarray, "h w 3"]:
        known = self.scene.with_cameras([camera]).cameras[0]
        left = _PARALLAX * self._cameras.index(camera)
        wide = self.rooms[room].draw(known.width + _PARALLAX * (len(self._cameras) - 1), known.height)
        return np.ascontiguousarray(wide[:, left : left + known.width])

    def _make_background(self, room: str, camera: str) -> MeanBackground:
        indices = evenly_spaced(len(self))
        states = [self.scene.state(self._sequence.frame(index, cameras=()).measured) for index in indices]
        return background_of_recording(
            self.scene, camera, states, lambda place: self.frame(indices[place], room, [camera]).images[camera]
        )


def pasted(
    image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], room: UInt8[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w 3"]:
    """Composite the masked part of an image over a room, with matched brightness and a soft edge."""
    if not mask.any():
        return room.astype(np.float32)
    inside = np.asarray(binary_erosion(mask, iterations=_RIM), bool)
    # Pixels near the boundary take the colour of the nearest pixel farther inside.
    nearest = distance_transform_edt(~(inside if inside.any() else mask), return_distances=False, return_indices=True)
    arm = image[tuple(np.asarray(nearest))].astype(np.float32)
    gain = np.clip(np.sqrt(max(float(np.median(room)), 1.0) / max(float(np.median(image)), 1.0)), *_MATCH)
    cover = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), _SEAM)[..., None]
    return cover * arm * gain + (1.0 - cover) * room
