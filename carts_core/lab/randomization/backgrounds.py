"""Backgrounds of training images in display colours: tissue, rooms, cloth, boards, patterns and photographs."""

import colorsys
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from ...errors import SettingsError
from ...files.reading import IMAGE, check_regular, read_bytes, size_problem


def smooth_noise(rng: np.random.Generator, width: int, height: int, cells: float, octaves: int = 3) -> np.ndarray:
    """Multi-octave noise [height, width] with zero mean and approximately unit standard deviation.

    `cells` is the number of cells across the width in the coarsest octave.
    """
    noise = np.zeros((height, width), np.float32)
    amplitude = 1.0
    for _ in range(octaves):
        columns = max(int(cells), 2)
        rows = max(int(cells * height / width), 2)
        grid = rng.standard_normal((rows, columns), np.float32)
        noise += amplitude * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        cells *= 2.1
        amplitude *= 0.55
    return (noise - noise.mean()) / (noise.std() + 1e-6)


def grain(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Noise with a wavelength of several pixels and approximately unit standard deviation [height, width, 1]."""
    texture = rng.standard_normal((height, width), np.float32)
    texture = cv2.GaussianBlur(texture, (0, 0), rng.uniform(0.5, 2.0))
    return (texture / (texture.std() + 1e-6))[..., None]


Image = Float[np.ndarray, "h w 3"]

_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff")
_LARGEST = 640
"""Longer side of photographs after downscaling [px]."""
_DARKEST = 0.25
"""Minimum mean brightness of photographs [1]: training data exclude low light."""


_CACHED = 200
"""Number of decoded photographs that are kept."""


class Photographs:
    """Generator of random crops of the image files in a folder and its subfolders, which are read on demand.

    Raises:
        SettingsError: the folder has no image file, or a file is no image.
    """

    def __init__(self, folder: Path) -> None:
        paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES)
        if not paths:
            raise SettingsError(
                f"{folder} has no photographs. Give a folder with at least one image file ({', '.join(_SUFFIXES)})."
            )
        for path in paths:
            _check(path)
        self._paths, self._read = paths, lru_cache(_CACHED)(_read)

    def __len__(self) -> int:
        return len(self._paths)

    def __call__(self, rng: np.random.Generator, width: int, height: int) -> Image:
        """Random crop of a photograph, rotated, mirrored, enlarged and with modified colours; RGB in [0, 1].

        Raises:
            SettingsError: the photograph cannot be decoded.
        """
        image = self._read(self._paths[int(rng.integers(len(self._paths)))])
        rows, columns = image.shape[:2]
        if rng.random() < 0.5:
            image = image[:, ::-1]
        # The crop is not larger than the photograph, so that the border of the photograph is rarely visible.
        largest = min(columns / width, rows / height)
        step = largest * np.exp(rng.uniform(np.log(0.3), 0.0))
        turn = rng.normal(0, 12) + 90 * int(rng.integers(4)) * (rng.random() < 0.3)
        centre = np.array([columns, rows]) * 0.5 + rng.uniform(-0.5, 0.5, 2) * (
            columns - step * width,
            rows - step * height,
        )
        motion = cv2.getRotationMatrix2D((width / 2, height / 2), turn, 1 / step)
        motion[:, 2] = np.array([width, height]) / 2 - motion[:, :2] @ centre
        if step > 1:
            image = cv2.GaussianBlur(image, (0, 0), 0.4 * step)
        part = cv2.warpAffine(image, motion, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        image = part.astype(np.float32) / 255
        # Change exposure, saturation and white balance; sometimes swap channels.
        if rng.random() < 0.15:
            image = image[..., rng.permutation(3)]
        grey = image.mean(2, keepdims=True)
        image = grey + (image - grey) * np.float32(rng.uniform(0.3, 1.6))
        image = image * np.clip(rng.normal(1, 0.1, 3), 0.7, 1.3).astype(np.float32) * np.float32(rng.uniform(0.8, 1.3))
        image = np.clip(image, 0, 1)
        return np.clip(image + max(_DARKEST - float(image.mean()), 0.0), 0, 1)


def _check(path: Path) -> None:
    """Check that a file begins as an image does; `SettingsError` otherwise."""
    try:
        check_regular(path, IMAGE)
        known = cv2.haveImageReader(str(path))
    except OSError:
        known = False
    if not known:
        raise _unreadable(path)


def _unreadable(path: Path) -> SettingsError:
    return SettingsError(f"photograph {path} cannot be read. Replace or remove it.")


def _read(path: Path) -> np.ndarray:
    try:
        content = read_bytes(path, IMAGE)
        image = None if size_problem(content) else cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    except (OSError, cv2.error):
        image = None
    if image is None:
        raise _unreadable(path)
    scale = _LARGEST / max(image.shape[:2])
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image[..., ::-1])


def room(rng: np.random.Generator, width: int, height: int) -> Image:
    """Overlapping surfaces with straight borders, covered with bars, holes and cables."""
    image = plain(rng, width, height)
    for _ in range(int(rng.integers(1, 7))):
        image = _panel(rng, image)
    if rng.random() < 0.35:
        image = _holes(rng, image)
    for _ in range(rng.choice([0, 1, 2, 3], p=[0.35, 0.3, 0.2, 0.15])):
        image = _bars(rng, image)
    for _ in range(rng.choice([0, 1, 3], p=[0.6, 0.25, 0.15])):
        image = _cable(rng, image)
    if rng.random() < 0.2:
        image = _hand(rng, image)
    return image


def plain(rng: np.random.Generator, width: int, height: int) -> Image:
    """Uniform grey or saturated colour with a brightness gradient and slight texture."""
    image = np.full((height, width, 3), _color(rng), np.float32)
    slope = 1 + rng.uniform(0, 0.25) * smooth_noise(rng, width, height, 2, 1)
    texture = 1 + rng.uniform(0, 0.05) * grain(rng, width, height)
    return np.ascontiguousarray(image * np.clip(slope, 0.5, 1.5)[..., None] * texture, np.float32)


def foil(rng: np.random.Generator, width: int, height: int) -> Image:
    """Crumpled metal foil or wet plastic: facets with random orientation to the light."""
    facets = np.zeros((height, width), np.float32)
    for _ in range(int(rng.integers(2, 5))):
        folded = np.abs(smooth_noise(rng, width, height, np.exp(rng.uniform(np.log(3), np.log(24))), 1))
        facets += folded * np.float32(rng.uniform(0.3, 1))
    slope_x, slope_y = cv2.Sobel(facets, cv2.CV_32F, 1, 0), cv2.Sobel(facets, cv2.CV_32F, 0, 1)
    heading = rng.uniform(0, 2 * np.pi)
    facing = slope_x * np.cos(heading) + slope_y * np.sin(heading)
    facing /= facing.std() + 1e-6
    color = _color(rng) if rng.random() < 0.4 else np.float32(rng.uniform(0.4, 0.8)) * np.ones(3, np.float32)
    shine = np.clip(facing - rng.uniform(0.5, 1.5), 0, 2)[..., None] * rng.uniform(0.2, 0.8)
    return color * np.clip(1 + rng.uniform(0.15, 0.45) * facing, 0.1, 2)[..., None] + shine


def drape(rng: np.random.Generator, width: int, height: int) -> Image:
    """Folded cloth."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    angle, period = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(14), np.log(90)))
    warp = rng.uniform(0.2, 1.0) * period * smooth_noise(rng, width, height, rng.uniform(2, 6), 2)
    phase = (x * np.cos(angle) + y * np.sin(angle) + warp) * 2 * np.pi / period
    folds = np.sin(phase) + rng.uniform(0, 0.5) * np.sin(2 * phase + rng.uniform(0, 2 * np.pi))
    image = plain(rng, width, height) * np.clip(1 + rng.uniform(0.1, 0.45) * folds, 0.15, 1.8)[..., None]
    return image * (1 + rng.uniform(0, 0.08) * grain(rng, width, height))


def _color(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Random saturated, pale or grey display colour that is not dark."""
    kind = rng.random()
    saturation = rng.uniform(0.5, 1.0) if kind < 0.4 else rng.uniform(0.1, 0.5) if kind < 0.7 else rng.uniform(0, 0.08)
    return np.array(colorsys.hsv_to_rgb(rng.random(), saturation, rng.uniform(0.4, 1.0)), np.float32)


def _panel(rng: np.random.Generator, image: Image) -> Image:
    """Draw a wall, shelf or table top: a shaded quadrangle with an edge and sometimes a shadow below it."""
    height, width = image.shape[:2]
    centre = rng.uniform(0, 1, 2) * (width, height)
    size = np.exp(rng.uniform(np.log(0.1), np.log(1.2), 2)) * width / 2
    turn = rng.normal(0, 0.3) + rng.integers(2) * np.pi / 2
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size * (1 + rng.normal(0, 0.12, (4, 2)))
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    outline = np.rint((corners @ R.T + centre) * 8).astype(np.int32)
    shape = np.zeros((height, width), np.float32)
    cv2.fillPoly(shape, [outline], 1.0, cv2.LINE_AA, 3)
    if rng.random() < 0.4:
        shifted = np.roll(shape, tuple(rng.integers(-5, 6, 2)), axis=(0, 1))
        shadow = cv2.GaussianBlur(shifted, (0, 0), rng.uniform(1, 5))[..., None]
        image = image * (1 - rng.uniform(0.1, 0.6) * shadow)
    surface = plain(rng, width, height)
    if rng.random() < 0.3:  # brushed metal
        streaks = cv2.resize(rng.standard_normal((height, 8), np.float32), (width, height))
        surface = (
            surface * (1 + rng.uniform(0.03, 0.15) * (streaks if rng.random() < 0.5 else streaks[::-1]))[..., None]
        )
    if rng.random() < 0.3:
        cv2.polylines(surface, [outline], True, _color(rng).tolist(), int(rng.integers(1, 5)), cv2.LINE_AA, 3)
    return image + shape[..., None] * (surface - image)


def _holes(rng: np.random.Generator, image: Image) -> Image:
    """Draw a regular grid of dark or light dots, as on a perforated board or a grating."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    angle, period = rng.normal(0, 0.4), np.exp(rng.uniform(np.log(7), np.log(40)))
    u = (x * np.cos(angle) + y * np.sin(angle)) / period + rng.random()
    v = ((y * np.cos(angle) - x * np.sin(angle)) / period + rng.random()) * rng.uniform(0.5, 1.5)
    distance = np.hypot(u - np.rint(u), v - np.rint(v)) * period
    dots = np.clip(period * rng.uniform(0.12, 0.4) - distance, 0, 1)
    region = smooth_noise(rng, width, height, 2, 1) > rng.uniform(-3, 0.5)
    return image + (dots * region * rng.uniform(0.4, 1))[..., None] * (rng.uniform(0.05, 0.9) - image)


def _bars(rng: np.random.Generator, image: Image) -> Image:
    """Draw parallel straight bars, round or flat, shiny, dark or coloured, that may cross the whole image."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    angle, radius = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(2), np.log(22)))
    gap = radius * rng.uniform(2.5, 8)
    along = (x - width / 2) * np.cos(angle) + (y - height / 2) * np.sin(angle)
    across = (y - height / 2) * np.cos(angle) - (x - width / 2) * np.sin(angle) + rng.uniform(-0.5, 0.5) * height
    across = across * (1 + along / width * rng.uniform(-0.4, 0.4))
    index = np.clip(np.rint(across / gap), 0, int(rng.integers(0, 5)))
    t = (across - index * gap) / radius
    ends = np.sort(rng.uniform(-1.2, 1.2, 2)) * width
    shape = np.clip((1 - np.abs(t)) * radius + 0.5, 0, 1) * ((along > ends[0]) & (along < ends[1]))
    color = _color(rng) if rng.random() < 0.4 else np.float32(rng.uniform(0.03, 0.7)) * np.ones(3, np.float32)
    return image + shape[..., None] * (_round(rng, t, color) - image)


def _cable(rng: np.random.Generator, image: Image) -> Image:
    height, width = image.shape[:2]
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, rng.uniform(0.03, 0.25), 40))
    steps = np.stack([np.cos(heading), np.sin(heading)], 1) * rng.uniform(0.015, 0.05) * width
    distance = _distance(rng.uniform(-0.1, 1.1, 2) * (width, height) + np.cumsum(steps, axis=0), width, height)
    radius = np.exp(rng.uniform(np.log(1.2), np.log(9)))
    color = _color(rng) if rng.random() < 0.5 else np.float32(rng.uniform(0.03, 0.3)) * np.ones(3, np.float32)
    shape = np.clip(radius - distance + 0.5, 0, 1)[..., None]
    return image + shape * (_round(rng, distance / radius, color) - image)


def _hand(rng: np.random.Generator, image: Image) -> Image:
    """Draw a palm and fingers, bare or in a glove of any colour."""
    height, width = image.shape[:2]
    palm = rng.uniform(0, 1, 2) * (width, height)
    size, heading = rng.uniform(0.08, 0.22) * width, rng.uniform(0, 2 * np.pi)
    heights = np.sqrt(np.clip(1 - (_distance(palm[None], width, height) / size) ** 2, 0, 1))
    for finger in range(int(rng.integers(2, 6))):
        bearing = heading + (finger - 2) * rng.uniform(0.2, 0.45)
        reach = np.linspace(0, 1, 6)[:, None] * size * rng.uniform(1.6, 2.6)
        bend = np.linspace(0, rng.normal(0, 0.8), 6)
        points = palm + reach * np.stack([np.cos(bearing + bend), np.sin(bearing + bend)], 1)
        radius = size * rng.uniform(0.2, 0.3)
        tube = np.sqrt(np.clip(1 - (_distance(points, width, height) / radius) ** 2, 0, 1))
        heights = np.maximum(heights, tube)
    skin = np.array([0.85, 0.62, 0.5], np.float32) * np.float32(rng.uniform(0.5, 1.1))
    color = skin if rng.random() < 0.4 else _color(rng)
    shade = color * (0.55 + 0.5 * heights)[..., None] * (1 + 0.03 * grain(rng, width, height))
    return image + np.clip(heights * 4, 0, 1)[..., None] * (shade - image)


def _round(rng: np.random.Generator, t: np.ndarray, color: np.ndarray) -> Image:
    """Colours across a matt or shiny cylinder, at `t` from -1 to 1, under a random light."""
    normal = np.sqrt(np.clip(1 - t * t, 0, 1))
    light = rng.uniform(-0.7, 0.7)
    facing = np.clip(light * t + np.sqrt(1 - light**2) * normal, 0, 1)
    shine = rng.uniform(0, 1.0) * facing ** np.exp(rng.uniform(np.log(4), np.log(80)))
    return (color * (0.3 + 0.8 * facing)[..., None] + shine[..., None]).astype(np.float32)


def _distance(points: np.ndarray, width: int, height: int) -> Float[np.ndarray, "h w"]:
    """Distance of each pixel from the polyline through points [n, 2] [px]; the image width if the line is outside the
    image."""
    away = np.ones((height, width), np.uint8)
    cv2.polylines(away, [np.rint(np.vstack([points, points[-1:]])).astype(np.int32)], False, 0, 1)
    if away.all():
        return np.full((height, width), float(width), np.float32)
    return cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


_TISSUE = np.array(
    [
        [0.75, 0.35, 0.30], [0.85, 0.55, 0.45], [0.60, 0.22, 0.20], [0.88, 0.70, 0.55],
        [0.80, 0.66, 0.36], [0.92, 0.80, 0.66], [0.66, 0.42, 0.36], [0.80, 0.45, 0.48],
    ],
    np.float32,
)  # fmt: skip
_BOARD = np.array(
    [
        [0.58, 0.55, 0.36], [0.72, 0.68, 0.55], [0.62, 0.52, 0.40], [0.55, 0.58, 0.52],
        [0.80, 0.78, 0.74], [0.45, 0.52, 0.60], [0.42, 0.58, 0.44], [0.66, 0.60, 0.46],
    ],
    np.float32,
)  # fmt: skip


def random_background(rng: np.random.Generator, width: int, height: int, tissue: float = 0.0) -> Image:
    """Random background without shadows, clutter or camera effects, RGB in [0, 1].

    The mean brightness is at least about 0.25, since training data exclude low light.

    Args:
        tissue: share of backgrounds that are tissue; the others have the usual distribution, which includes tissue [1].
    """
    always = tissue > 0.0 and rng.random() < tissue
    name = "tissue" if always else rng.choice(list(_SHARES), p=list(_SHARES.values()))
    image = MAKERS[name](rng, width, height).astype(np.float32)
    image = np.clip(image, 0, 1)
    mean = image.mean()
    if mean < 0.25:
        image = np.clip(image + (0.25 - mean), 0, 1)
    # The light is uneven: a broad spot and a gradient, with a minimum of about two thirds.
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = x / width - rng.uniform(0.1, 0.9), y / height - rng.uniform(0.1, 0.9)
    spot = np.exp(-(x * x + y * y) / (2 * rng.uniform(0.3, 0.9) ** 2))
    slope = x * rng.normal(0, 0.2) + y * rng.normal(0, 0.2)
    light = 1 - rng.uniform(0, 0.4) * (1 - spot) + slope
    return image * np.clip(light, 0.6, 1.25)[..., None].astype(np.float32)


def _free(rng: np.random.Generator, width: int, height: int) -> Image:
    """Cloud-like noise in random colours."""
    image = _blend(rng, rng.uniform(0.1, 0.95, (3, 3)).astype(np.float32), width, height)
    return image * (1 + rng.uniform(0, 0.12) * grain(rng, width, height))


def _blend(rng: np.random.Generator, colors: np.ndarray, width: int, height: int) -> Image:
    cells, octaves = np.exp(rng.uniform(np.log(2), np.log(12))), int(rng.integers(1, 5))
    image = np.broadcast_to(colors[0], (height, width, 3)).astype(np.float32)
    for color in colors[1:]:
        sharpness = rng.uniform(0.8, 3.0)
        field = sharpness * (smooth_noise(rng, width, height, cells, octaves) + rng.normal(0, 0.5))
        share = 1 / (1 + np.exp(-field))
        image = image + share[..., None] * (color - image)
    return image


def _tissue(rng: np.random.Generator, width: int, height: int) -> Image:
    colors = _TISSUE[rng.choice(len(_TISSUE), 3, replace=False)] * np.clip(rng.normal(1, 0.12, (3, 3)), 0.6, 1.4)
    image = _blend(rng, colors.astype(np.float32), width, height)
    relief = smooth_noise(rng, width, height, rng.uniform(4, 20), 3)
    image = image * (1 + rng.uniform(0, 0.15) * relief[..., None])
    image = image * (1 + rng.uniform(0, 0.06) * grain(rng, width, height))
    for _ in range(rng.integers(0, 8)):
        image = _vessel(rng, image)
    for _ in range(rng.choice([0, 1, 2, 4], p=[0.35, 0.25, 0.25, 0.15])):
        image = _glare(rng, image)
    if rng.random() < 0.65:
        image = _wet_relief(rng, image)
    elif rng.random() < 0.5:  # wet spots reflect the light
        wet = smooth_noise(rng, width, height, rng.uniform(15, 45), 2) + 0.5 * relief
        spots = np.clip((wet - rng.uniform(2.0, 3.0)) * 2, 0, 1)[..., None]
        image = image + spots * (rng.uniform(0.7, 1.0) - image)
    return image


def _wet_relief(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """Add folds illuminated by a lamp at the lens, with small and large white highlights of a wet surface."""
    height, width = image.shape[:2]
    relief = smooth_noise(rng, width, height, np.exp(rng.uniform(np.log(3), np.log(14))), int(rng.integers(1, 4)))
    if rng.random() < 0.4:  # creases
        relief = -np.abs(relief)
    if rng.random() < 0.5:
        folds = _folds(rng, width, height)
        relief = np.float32(rng.uniform(0.1, 0.5)) * relief + folds * np.float32(rng.uniform(1, 3))
        image = image * (1 - rng.uniform(0, 0.5) * np.exp(-8 * folds))[..., None]  # areas between folds are dark
    steepness = rng.uniform(4, 14)
    slope_x, slope_y = (
        cv2.Sobel(relief, cv2.CV_32F, 1, 0) * steepness / 8,
        cv2.Sobel(relief, cv2.CV_32F, 0, 1) * steepness / 8,
    )
    y, x = np.mgrid[:height, :width].astype(np.float32)
    focal = rng.uniform(0.8, 1.6) * width
    tilt_x, tilt_y = (x - rng.uniform(0.2, 0.8) * width) / focal, (y - rng.uniform(0.2, 0.8) * height) / focal
    # Since the lamp is at the lens, highlights are at normals parallel to the view ray.
    facing = (1 + slope_x * tilt_x + slope_y * tilt_y) / np.sqrt(
        (1 + slope_x**2 + slope_y**2) * (1 + tilt_x**2 + tilt_y**2)
    )
    facing = np.clip(facing, 0, 1)
    shininess = np.exp(rng.uniform(np.log(15), np.log(300)))
    highlight = rng.uniform(0, 1.3) * facing**shininess
    if rng.random() < 0.5:  # specular highlights
        highlight = highlight * np.clip(1 + smooth_noise(rng, width, height, width / rng.uniform(3, 10), 1), 0, 3)
    shade = 1 + rng.uniform(0.2, 0.8) * (facing - facing.mean())
    return image * shade[..., None] + highlight[..., None]


def _folds(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Height map of folds, gut and vessels: overlapping winding tubes [height, width], in [0, 1]."""
    heights = np.zeros((height, width), np.float32)
    for _ in range(rng.integers(2, 14)):
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, rng.uniform(0.05, 0.4), 30))
        steps = np.stack([np.cos(heading), np.sin(heading)], 1) * rng.uniform(0.01, 0.05) * width
        points = rng.uniform(-0.1, 1.1, 2) * (width, height) + np.cumsum(steps, axis=0)
        away = np.ones((height, width), np.uint8)
        cv2.polylines(away, [np.rint(points).astype(np.int32)], False, 0, 1)
        distance = cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        radius = np.float32(np.exp(rng.uniform(np.log(2.5), np.log(26))))
        tube = np.sqrt(np.clip(1 - (distance / radius) ** 2, 0, 1))
        heights = np.maximum(heights, tube * np.float32(min(radius / 12, 1.0)))
    return cv2.GaussianBlur(heights, (0, 0), rng.uniform(0.6, 2.0))


def _glare(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """Add the reflection of the lamp on a wet bulge: a bright patch, smooth or with rough edges, up to white."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    centre = rng.uniform(0, 1, 2) * (width, height)
    angle, radius = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(4), np.log(35)))
    u = ((x - centre[0]) * np.cos(angle) + (y - centre[1]) * np.sin(angle)) / radius
    v = ((y - centre[1]) * np.cos(angle) - (x - centre[0]) * np.sin(angle)) / (radius * rng.uniform(0.4, 1))
    bulge = np.exp(-((u * u + v * v) ** rng.uniform(0.7, 2.0)))
    rough = smooth_noise(rng, width, height, width / np.exp(rng.uniform(np.log(2), np.log(12))), 2)
    shine = np.clip(rng.uniform(0.6, 2.5) * bulge * (1 + rng.uniform(0, 1.2) * rough), 0, 1.2)
    return image + shine[..., None] * np.clip(rng.normal(0.9, 0.1, 3), 0.7, 1).astype(np.float32)


def _vessel(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    steps = 24
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.25, steps))
    stride = rng.uniform(0.02, 0.06) * width
    start = rng.uniform(0, 1, 2) * (width, height)
    points = start + np.cumsum(np.stack([np.cos(heading), np.sin(heading)], 1) * stride, axis=0)
    layer = np.zeros((height, width), np.float32)
    cv2.polylines(layer, [(points * 8).astype(np.int32)], False, 1.0, int(rng.integers(1, 5)), cv2.LINE_AA, 3)
    layer = cv2.GaussianBlur(layer, (0, 0), rng.uniform(0.6, 2.0))[..., None] * rng.uniform(0.2, 0.7)
    color = image.mean((0, 1)) * rng.uniform(0.5, 1.0) * np.array([1.0, 0.75, 0.75], np.float32)
    return image + layer * (color - image)


def _board(rng: np.random.Generator, width: int, height: int) -> Image:
    color = _BOARD[rng.integers(len(_BOARD))] * np.clip(rng.normal(1, 0.12, 3), 0.6, 1.4)
    stain = smooth_noise(rng, width, height, rng.uniform(2, 8), 4)[..., None]
    image = color * (1 + rng.uniform(0, 0.08) * stain)
    image = image * (1 + rng.uniform(0, 0.06) * grain(rng, width, height))
    return image.astype(np.float32)


def _pattern(rng: np.random.Generator, width: int, height: int) -> Image:
    """Weave, stripes or checks of two colours."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    angle, period = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(4), np.log(60)))
    u = (x * np.cos(angle) + y * np.sin(angle)) * 2 * np.pi / period
    v = (y * np.cos(angle) - x * np.sin(angle)) * 2 * np.pi / period
    wave = np.sin(u) * (np.sin(v) if rng.random() < 0.6 else 1)
    share = 1 / (1 + np.exp(-wave * rng.uniform(1, 8)))[..., None]
    first = rng.uniform(0.25, 0.9, 3)
    second = np.clip(first + rng.normal(0, 0.2, 3), 0.15, 0.95)
    return (first + share * (second - first)).astype(np.float32) * (1 + 0.05 * grain(rng, width, height))


MAKERS = {
    "tissue": _tissue,
    "board": _board,
    "free": _free,
    "pattern": _pattern,
    "room": room,
    "plain": plain,
    "drape": drape,
    "foil": foil,
}
"""Generators of backgrounds by name; arguments are the random generator, width and height [px]."""

_SHARES = dict(zip(MAKERS, (0.42, 0.14, 0.06, 0.06, 0.18, 0.05, 0.05, 0.04), strict=True))
"""Probability of each kind of background; the sum is 1."""
