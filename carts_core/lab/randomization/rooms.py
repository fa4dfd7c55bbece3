"""Procedural rooms behind the arms: walls and benches, racks, perforated boards, foil, drapes, plain bright colours."""

import colorsys

import cv2
import numpy as np
from jaxtyping import Float

from .noise import grain, smooth_noise

Image = Float[np.ndarray, "h w 3"]


def room(rng: np.random.Generator, width: int, height: int) -> Image:
    """Surfaces with straight borders, one in front of the other, with bars, holes and cables on them."""
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
    """One colour, grey or saturated, with a slope of light and a little texture."""
    image = np.full((height, width, 3), _color(rng), np.float32)
    slope = 1 + rng.uniform(0, 0.25) * smooth_noise(rng, width, height, 2, 1)
    texture = 1 + rng.uniform(0, 0.05) * grain(rng, width, height)
    return np.ascontiguousarray(image * np.clip(slope, 0.5, 1.5)[..., None] * texture, np.float32)


def foil(rng: np.random.Generator, width: int, height: int) -> Image:
    """Crumpled metal foil or wet plastic: facets that are bright or dark as they happen to face the light."""
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
    """Cloth that hangs or lies in folds."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    angle, period = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(14), np.log(90)))
    warp = rng.uniform(0.2, 1.0) * period * smooth_noise(rng, width, height, rng.uniform(2, 6), 2)
    phase = (x * np.cos(angle) + y * np.sin(angle) + warp) * 2 * np.pi / period
    folds = np.sin(phase) + rng.uniform(0, 0.5) * np.sin(2 * phase + rng.uniform(0, 2 * np.pi))
    image = plain(rng, width, height) * np.clip(1 + rng.uniform(0.1, 0.45) * folds, 0.15, 1.8)[..., None]
    return image * (1 + rng.uniform(0, 0.08) * grain(rng, width, height))


def _color(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """A display colour that is not dark: saturated, pale or grey."""
    kind = rng.random()
    saturation = rng.uniform(0.5, 1.0) if kind < 0.4 else rng.uniform(0.1, 0.5) if kind < 0.7 else rng.uniform(0, 0.08)
    return np.array(colorsys.hsv_to_rgb(rng.random(), saturation, rng.uniform(0.4, 1.0)), np.float32)


def _panel(rng: np.random.Generator, image: Image) -> Image:
    """A wall, shelf or table top: a quadrangle with a shade, an edge and sometimes a shadow below it."""
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
    """A regular grid of dark or light dots, as of a perforated board or a grating."""
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
    """Parallel straight bars, round or flat, shiny, dark or coloured, that may cross the whole image."""
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
    """A palm and some fingers in a glove of any colour, or bare."""
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
    """Colours over the width of a round thing, `t` from -1 to 1, lit from somewhere, dull or shiny."""
    normal = np.sqrt(np.clip(1 - t * t, 0, 1))
    light = rng.uniform(-0.7, 0.7)
    facing = np.clip(light * t + np.sqrt(1 - light**2) * normal, 0, 1)
    shine = rng.uniform(0, 1.0) * facing ** np.exp(rng.uniform(np.log(4), np.log(80)))
    return (color * (0.3 + 0.8 * facing)[..., None] + shine[..., None]).astype(np.float32)


def _distance(points: np.ndarray, width: int, height: int) -> Float[np.ndarray, "h w"]:
    """Distance of each pixel from a line through points [n, 2] [px]; up to the image's size where it is not in it."""
    away = np.ones((height, width), np.uint8)
    cv2.polylines(away, [np.rint(np.vstack([points, points[-1:]])).astype(np.int32)], False, 0, 1)
    if away.all():
        return np.full((height, width), float(width), np.float32)
    return cv2.distanceTransform(away, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
