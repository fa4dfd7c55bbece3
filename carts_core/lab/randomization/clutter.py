"""Distractors of training images: solid objects, small items, occluders, shadows and blood.

Solid objects (rods, plates, cables, tools) are shaded like the arms, so that neither gloss nor shape alone identifies
an instrument. The label remains the occluded surface of an arm.
"""

import cv2
import numpy as np
from jaxtyping import Float

from .arms import Body, Intrinsics, PosedRobot
from .backgrounds import random_background, smooth_noise
from .shading import render_gbuffer, shade

Image = Float[np.ndarray, "h w 3"]

_SUPERSAMPLING = 2
_DEPTH = (0.05, 0.40)
"""Range of the distance from the camera [m]."""


def add_objects(rng: np.random.Generator, image: Image, intrinsics: Intrinsics) -> Image:
    """Draw one to four random objects and their shadows on a background."""
    height, width = image.shape[:2]
    things = [random_object(rng) for _ in range(rng.choice([1, 2, 3, 4], p=[0.4, 0.3, 0.2, 0.1]))]
    posed = [_placed(rng, thing, intrinsics, width, height) for thing in things]
    fx, fy, cx, cy = (value * _SUPERSAMPLING for value in intrinsics)
    view = render_gbuffer(things, posed, (fx, fy, cx, cy), width * _SUPERSAMPLING, height * _SUPERSAMPLING)
    color = shade(rng, view, things, image.mean((0, 1)))
    layers = view.image(np.column_stack([color, np.ones(len(color))]).astype(np.float32))
    layers = cv2.resize(layers, (width, height), interpolation=cv2.INTER_AREA)
    coverage = np.ascontiguousarray(layers[..., 3])
    for _ in range(rng.choice([0, 1, 2], p=[0.3, 0.5, 0.2])):
        image = cast_shadow(rng, image, coverage)
    return image * (1 - coverage[..., None]) + layers[..., :3]


def random_object(rng: np.random.Generator) -> Body:
    """Random rod, plate, rail, cable, tool or ring with a size of several centimetres, centred at the origin."""
    kinds = [_rod, _plate, _rails, _cable, _tool, _ring]
    make = kinds[int(rng.choice(len(kinds), p=[0.3, 0.2, 0.12, 0.16, 0.14, 0.08]))]
    parts = make(rng)
    counts = [len(vertices) for vertices, _ in parts]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    vertices = np.concatenate([vertices for vertices, _ in parts]).astype(np.float32)
    faces = np.concatenate([faces + start for (_, faces), start in zip(parts, starts, strict=True)]).astype(np.int32)
    face_part = np.repeat(np.arange(len(parts)), [len(faces) for _, faces in parts]).astype(np.int32)
    vertices -= vertices.mean(0)
    axis = np.array([0.0, 0.0, 1.0])
    end = axis * float(vertices[:, 2].min())
    shaft = 0 if rng.random() < 0.5 else -1
    return Body(vertices, _normals(vertices, faces), faces, face_part, shaft, axis, end)


Part = tuple[np.ndarray, np.ndarray]
"""Vertices [V, 3] and triangles [F, 3]."""


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _rod(rng: np.random.Generator) -> list[Part]:
    """Rod or tube, sometimes of two materials or with a collar."""
    radius, length = _log_uniform(rng, 0.0008, 0.012), _log_uniform(rng, 0.04, 0.5)
    cut = length * rng.uniform(0.1, 0.9) if rng.random() < 0.4 else length
    parts = [_straight(0, cut, radius, radius * rng.uniform(0.8, 1.0))]
    if cut < length:
        parts.append(_straight(cut, length, radius * rng.uniform(0.7, 1.4), radius * rng.uniform(0.5, 1.4)))
    if rng.random() < 0.3:
        at = rng.uniform(0, length)
        wide = radius * rng.uniform(1.2, 2.5)
        parts.append(_straight(at, at + radius * rng.uniform(0.5, 4), wide, wide))
    return parts


def _plate(rng: np.random.Generator) -> list[Part]:
    """Disc or rectangular plate, sometimes with a rim."""
    thickness = _log_uniform(rng, 0.0008, 0.02)
    if rng.random() < 0.4:
        radius = _log_uniform(rng, 0.006, 0.12)
        parts = [_straight(0, thickness, radius, radius * rng.uniform(0.8, 1.0), sides=36)]
        if rng.random() < 0.4:
            parts.append(_bent(_circle(radius), thickness * rng.uniform(0.6, 1.5)))
        return parts
    return [_box(np.array([_log_uniform(rng, 0.01, 0.2), _log_uniform(rng, 0.006, 0.2), thickness]), np.zeros(3))]


def _rails(rng: np.random.Generator) -> list[Part]:
    """Parallel bars, round or square, as in a frame or a rack."""
    radius, length, gap = _log_uniform(rng, 0.001, 0.008), rng.uniform(0.1, 0.5), _log_uniform(rng, 0.008, 0.05)
    square, parts = rng.random() < 0.5, []
    for index in range(int(rng.integers(2, 6))):
        offset = np.array([index * gap, 0.0, 0.0])
        if square:
            parts.append(_box(np.array([2 * radius, 2 * radius, length]), offset))
        else:
            vertices, faces = _straight(0, length, radius, radius, sides=12)
            parts.append((vertices + offset - (0, 0, length / 2), faces))
    if rng.random() < 0.5:
        extent = np.array([gap * len(parts), 2.2 * radius, 2 * radius])
        parts.append(_box(extent, np.array([gap * (len(parts) - 1) / 2, 0.0, length * rng.uniform(-0.5, 0.5)])))
    return parts


def _cable(rng: np.random.Generator) -> list[Part]:
    """Winding cable, hose or wire."""
    steps = 40
    turns = np.cumsum(rng.normal(0, rng.uniform(0.02, 0.25), (steps, 3)), axis=0)
    heading = np.array([0.0, 0.0, 1.0]) + turns
    heading /= np.linalg.norm(heading, axis=1, keepdims=True)
    points = np.cumsum(heading, axis=0) * rng.uniform(0.1, 0.5) / steps
    return [_bent(points, _log_uniform(rng, 0.0005, 0.006))]


def _tool(rng: np.random.Generator) -> list[Part]:
    """Two crossing bars, as in scissors, pliers and tweezers, often with finger rings."""
    length, thickness = rng.uniform(0.06, 0.2), _log_uniform(rng, 0.0015, 0.005)
    opening, joint = rng.uniform(0.02, 0.35), rng.uniform(-0.4, 0.4) * length
    parts: list[Part] = []
    for side in (-1, 1):
        R = _turn_about_y(side * opening / 2)
        vertices, faces = _box(np.array([thickness * rng.uniform(1, 3), thickness, length]), np.array([0, 0, joint]))
        parts.append((vertices @ R.T, faces))
        if rng.random() < 0.6:
            radius = rng.uniform(0.008, 0.016)
            ring, faces = _bent(_circle(radius), thickness / 2)
            c, s = np.cos(np.pi / 2), np.sin(np.pi / 2)
            ring = ring @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T + (0, 0, joint - length / 2 - radius)
            parts.append((ring @ R.T, faces))
    return parts


def _ring(rng: np.random.Generator) -> list[Part]:
    radius = _log_uniform(rng, 0.004, 0.05)
    return [_bent(_circle(radius), radius * rng.uniform(0.05, 0.4))]


def _straight(low: float, high: float, near: float, far: float, sides: int = 20) -> Part:
    """Cylinder or cone along z with flat ends and separate vertices for sharp edges."""
    rings = [(low, 0.0), (low, near), (low, near), (high, far), (high, far), (high, 0.0)]
    angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    vertices = np.concatenate([np.column_stack([radius * circle, np.full(sides, z)]) for z, radius in rings])
    return vertices, np.concatenate([_band(index * sides, sides) for index in (0, 2, 4)])


def _bent(points: np.ndarray, radius: float, sides: int = 10) -> Part:
    """Tube along points [n, 3]; closed if the last point equals the first."""
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True) + 1e-12
    helper = np.eye(3)[np.abs(along).mean(0).argmin()]
    u = np.cross(along, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True) + 1e-12
    v = np.cross(along, u)
    angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    around = np.cos(angles)[None, :, None] * u[:, None] + np.sin(angles)[None, :, None] * v[:, None]
    vertices = (points[:, None] + radius * around).reshape(-1, 3)
    return vertices, np.concatenate([_band(index * sides, sides) for index in range(len(points) - 1)])


def _band(start: int, sides: int) -> np.ndarray:
    """Triangles between two consecutive rings of vertices."""
    here = start + np.arange(sides)
    beside = start + (np.arange(sides) + 1) % sides
    corners = np.stack([here, beside, here + sides, beside, beside + sides, here + sides], 1)
    return corners.reshape(-1, 3)


def _circle(radius: float) -> np.ndarray:
    angles = np.linspace(0, 2 * np.pi, 33)
    return radius * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])


def _box(extents: np.ndarray, centre: np.ndarray) -> Part:
    """Box with separate vertices for each face."""
    vertices, faces = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            corners = np.zeros((4, 3))
            corners[:, axis] = sign
            corners[:, (axis + 1) % 3] = (-1, 1, 1, -1)
            corners[:, (axis + 2) % 3] = (-1, -1, 1, 1)
            faces.append(np.array([[0, 1, 2], [0, 2, 3]]) + 4 * len(vertices))
            vertices.append(corners * extents / 2 + centre)
    return np.concatenate(vertices), np.concatenate(faces)


def _normals(vertices: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "V 3"]:
    """Vertex normals: area-weighted means over adjacent triangles. Their sign is arbitrary, since `render_gbuffer`
    turns them towards the camera.
    """
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    cross, normals = np.cross(b - a, c - a), np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], cross)
    return (normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-20)).astype(np.float32)


def _placed(rng: np.random.Generator, thing: Body, intrinsics: Intrinsics, width: int, height: int) -> PosedRobot:
    """Object at a random pose in or near the image."""
    fx, fy, cx, cy = intrinsics
    depth = _log_uniform(rng, *_DEPTH)
    u, v = rng.uniform(-0.1, 1.1, 2) * (width, height)
    centre = np.array([(u - cx) / fx * depth, (v - cy) / fy * depth, depth])
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0].astype(np.float32)
    vertices = thing.vertices @ R.T + centre
    return PosedRobot(vertices.astype(np.float32), thing.normals @ R.T)


def _turn_about_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def occlude(rng: np.random.Generator, image: Image, coverage: Float[np.ndarray, "h w"]) -> Image:
    """Cover the arms with one to three ragged or smooth occluders without red texture; images without arms are
    unchanged."""
    rows, columns = np.nonzero(coverage > 0.5)
    if not len(rows):
        return image
    height, width = coverage.shape
    for _ in range(rng.integers(1, 4)):
        at = rng.integers(len(rows))
        shape = _shape(rng, (float(columns[at]), float(rows[at])), width, height)[..., None]
        image = image + shape * (_texture(rng, width, height) - image)
    return image


def _texture(rng: np.random.Generator, width: int, height: int) -> Image:
    """Random texture without red, since training data exclude blood on instruments, which is part of the evaluation."""
    texture = random_background(rng, width, height).astype(np.float32) * rng.uniform(0.6, 1.2)
    # Where red is the strongest channel, it is swapped with the second strongest channel, which causes no visible
    # edges.
    red, strongest = texture[..., 0].copy(), 1 + texture[..., 1:].argmax(2)[..., None]
    other = np.take_along_axis(texture, strongest, 2)[..., 0]
    texture[..., 0] = np.minimum(red, other)
    np.put_along_axis(texture, strongest, np.maximum(red, other)[..., None], 2)
    return texture


def _shape(rng: np.random.Generator, centre: tuple[float, float], width: int, height: int) -> Float[np.ndarray, "h w"]:
    """Occluded share of each pixel: an ellipse with a wavy, ragged or smooth edge."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    angle, radius = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(0.012), np.log(0.1))) * width
    u = ((x - centre[0]) * np.cos(angle) + (y - centre[1]) * np.sin(angle)) / (radius * np.exp(rng.uniform(0, 1)))
    v = ((y - centre[1]) * np.cos(angle) - (x - centre[0]) * np.sin(angle)) / radius
    waves = smooth_noise(rng, width, height, rng.uniform(4, 40), int(rng.integers(1, 4)))
    inside = 1 - np.hypot(u, v) + rng.uniform(0, 0.5) * waves
    return cv2.GaussianBlur((inside > 0).astype(np.float32), (0, 0), rng.uniform(0.4, 1.5))


def add_clutter(rng: np.random.Generator, image: Image) -> Image:
    """Draw shadow-like streaks, blobs, threads, crumbs and small objects on a background."""
    for _ in range(rng.choice([0, 1, 2, 3], p=[0.3, 0.35, 0.2, 0.15])):
        image = _streak(rng, image)
    for _ in range(rng.choice([0, 1, 2, 4], p=[0.5, 0.25, 0.15, 0.1])):
        image = _object(rng, image)
    for _ in range(rng.choice([0, 1, 2], p=[0.7, 0.2, 0.1])):
        image = _thread(rng, image)
    if rng.random() < 0.6:
        image = _crumbs(rng, image)
    return image


def cast_shadow(rng: np.random.Generator, image: Image, coverage: Float[np.ndarray, "h w"]) -> Image:
    """Darken the background by a soft shadow of the arms: the displaced, rotated and blurred silhouette.

    The arms are composited later, so the shadow is visible only beside the arms.
    """
    width = coverage.shape[1]
    reach = np.exp(rng.uniform(np.log(0.01), np.log(0.35))) * width
    moved = _displaced(rng, coverage, reach, turn=6, scale=(0.9, 1.15))
    soft = cv2.GaussianBlur(moved, (0, 0), np.clip(reach * rng.uniform(0.03, 0.2), 0.6, 8))
    # Close to an arm, a shadow may be nearly black.
    return _darken(rng, image, soft, 0.9 if reach < 0.08 * width else 0.6)


def contact_shadow(
    rng: np.random.Generator, image: Image, coverage: Float[np.ndarray, "h w"], darkness: float
) -> Image:
    """Draw a sharp shadow beside the arms, with a brightness similar to the arms (`darkness` [1]), so that only its
    shape differs."""
    reach = np.exp(rng.uniform(np.log(0.006), np.log(0.06))) * coverage.shape[1]
    moved = _displaced(rng, coverage, reach, turn=2, scale=(1.0, 1.0))
    shape = cv2.GaussianBlur(moved, (0, 0), rng.uniform(0.4, 1.5))[..., None]
    brightness = darkness * np.exp(rng.normal(0, 0.4))
    tinted = image * np.clip(brightness / max(float(image.mean()), 1e-3), 0.03, 0.8)
    grey = brightness * np.clip(rng.normal(1, 0.05, 3), 0.8, 1.2)
    dark = tinted + rng.uniform(0, 0.9) * (grey - tinted)
    return (image + shape * (np.minimum(dark, image) - image)).astype(np.float32)


def _displaced(
    rng: np.random.Generator, coverage: np.ndarray, reach: float, turn: float, scale: tuple[float, float]
) -> np.ndarray:
    """Silhouette shifted by `reach` [px] in a random direction, rotated by a random angle (standard deviation `turn`
    [deg]), and scaled."""
    height, width = coverage.shape
    heading = rng.uniform(0, 2 * np.pi)
    centre = rng.uniform(0, width), rng.uniform(0, height)
    motion = cv2.getRotationMatrix2D(centre, rng.normal(0, turn), rng.uniform(*scale))
    motion[:, 2] += reach * np.cos(heading), reach * np.sin(heading)
    return cv2.warpAffine(coverage, motion, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _darken(rng: np.random.Generator, image: np.ndarray, shape: np.ndarray, strongest: float = 0.6) -> np.ndarray:
    strength = rng.uniform(0.12, strongest) * np.clip(rng.normal(1, 0.06, 3), 0.8, 1.2)
    return image * np.clip(1 - shape[..., None] * strength.astype(np.float32), 0.05, 1)


def _streak(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """Draw a tapered dark band with soft edges and visible texture: a shadow, not an instrument."""
    height, width = image.shape[:2]
    start, heading = rng.uniform(-0.1, 1.1, 2) * (width, height), rng.uniform(0, 2 * np.pi)
    length = rng.uniform(0.2, 1.3) * width
    along = np.array([np.cos(heading), np.sin(heading)])
    across = np.array([-along[1], along[0]])
    near, far = np.exp(rng.uniform(np.log(1.5), np.log(16), 2))
    bend = across * rng.normal(0, 0.04) * length
    middle, end = start + along * length / 2 + bend, start + along * length
    half = (near + far) / 2
    outline = [start + across * near, middle + across * half, end + across * far,
               end - across * far, middle - across * half, start - across * near]  # fmt: skip
    shape = np.zeros((height, width), np.float32)
    cv2.fillPoly(shape, [(np.array(outline) * 8).astype(np.int32)], 1.0, cv2.LINE_AA, 3)
    if rng.random() < 0.4:
        centre = tuple(int(v * 8) for v in end)
        cv2.circle(shape, centre, int(far * rng.uniform(1, 1.6) * 8), 1.0, -1, cv2.LINE_AA, 3)
    return _darken(rng, image, cv2.GaussianBlur(shape, (0, 0), rng.uniform(0.6, 5)))


def _object(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """Draw a small opaque object with shading, such as a swab, clip or fold."""
    height, width = image.shape[:2]
    shape = np.zeros((height, width), np.float32)
    centre = rng.uniform(0, 1, 2) * (width, height)
    size = np.exp(rng.uniform(np.log(2), np.log(0.18 * width)))
    if rng.random() < 0.5:
        axes = (max(int(size * 4), 8), max(int(size * 8 * rng.uniform(0.3, 1)), 8))
        cv2.ellipse(
            shape, tuple((centre * 8).astype(int).tolist()), axes, rng.uniform(0, 180), 0, 360, 1.0, -1, cv2.LINE_AA, 3
        )
    else:
        angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 8)))
        radius = size * rng.uniform(0.4, 1, len(angles))
        corners = centre + np.stack([np.cos(angles) * radius, np.sin(angles) * radius], 1)
        cv2.fillPoly(shape, [(corners * 8).astype(np.int32)], 1.0, cv2.LINE_AA, 3)
    shape = cv2.GaussianBlur(shape, (0, 0), np.exp(rng.uniform(np.log(0.4), np.log(4))))[..., None]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    slope = ((x - centre[0]) * rng.normal(0, 1) + (y - centre[1]) * rng.normal(0, 1)) / (size + 4)
    color = rng.uniform(0.2, 1.0, 3).astype(np.float32) * (1 + 0.12 * np.clip(slope, -2, 2))[..., None]
    return image + shape * rng.uniform(0.5, 1) * (color - image)


def _thread(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.2, 30))
    steps = np.stack([np.cos(heading), np.sin(heading)], 1) * rng.uniform(0.01, 0.04) * width
    points = rng.uniform(0, 1, 2) * (width, height) + np.cumsum(steps, axis=0)
    shape = np.zeros((height, width), np.float32)
    cv2.polylines(shape, [(points * 8).astype(np.int32)], False, 1.0, int(rng.integers(1, 3)), cv2.LINE_AA, 3)
    return image + shape[..., None] * rng.uniform(0.3, 0.9) * (rng.uniform(0.05, 0.95, 3).astype(np.float32) - image)


def _crumbs(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    shape = np.zeros((height, width), np.float32)
    for _ in range(rng.integers(1, 12)):
        centre = tuple((rng.uniform(0, 1, 2) * (width, height) * 8).astype(int).tolist())
        axes = tuple((np.exp(rng.uniform(np.log(0.4), np.log(3), 2)) * 8).astype(int).tolist())
        cv2.ellipse(shape, centre, axes, rng.uniform(0, 180), 0, 360, float(rng.uniform(0.3, 1)), -1, cv2.LINE_AA, 3)
    return image + shape[..., None] * (rng.uniform(0.05, 0.5, 3).astype(np.float32) - image)


_BLOOD = np.array([0.42, 0.035, 0.03], np.float32)
"""Colour of thick blood in display values [1]."""


def bleed(rng: np.random.Generator, image: Image, coverage: Float[np.ndarray, "h w"]) -> Image:
    """Add blood to an image: pools on the background, films and drops on background and arms.

    Args:
        image: display colours in [0, 1].
        coverage: share of each pixel that shows an arm.
    """
    height, width = coverage.shape
    pools = _blood_patches(rng, width, height, rng.uniform(0.0, 0.8), np.exp(rng.uniform(np.log(2), np.log(12))))
    depth = pools * np.exp(rng.uniform(np.log(0.5), np.log(6)))
    stained = _blood_patches(rng, width, height, rng.uniform(0.0, 0.7), np.exp(rng.uniform(np.log(4), np.log(30))))
    films = stained * np.exp(rng.uniform(np.log(0.1), np.log(4)))
    # Pools cover arms that dip into them; most arms are above the pools.
    dips = rng.uniform(0.3, 1.0) if rng.random() < 0.2 else 0.0
    depth = depth * (1 - coverage * (1 - dips)) + films * coverage
    for _ in range(rng.choice([0, 3, 12], p=[0.4, 0.4, 0.2])):
        depth = _blood_drop(rng, depth)
    color = _BLOOD * np.float32(rng.uniform(0.3, 1.3)) * np.clip(rng.normal(1, 0.15, 3), 0.6, 1.4).astype(np.float32)
    grey = image.mean(2, keepdims=True)
    shade = np.clip(grey / max(float(grey.mean()), 0.05), 0.3, 2.0) ** np.float32(rng.uniform(0.2, 0.9))
    absorbed = np.exp(-depth[..., None] * np.array([0.35, 2.2, 2.4], np.float32))
    result = image * absorbed + color * shade * (1 - absorbed[..., 1:2])
    return np.clip(result + _glints(rng, depth), 0, 1).astype(np.float32)


def _blood_patches(rng: np.random.Generator, width: int, height: int, share: float, cells: float) -> np.ndarray:
    """Patches with smooth edges that cover approximately the given share of the image, in [0, 1]."""
    noise = smooth_noise(rng, width, height, cells, int(rng.integers(1, 4)))
    level = np.quantile(noise, 1 - share) if share > 0 else noise.max()
    return np.clip((noise - level) * np.float32(rng.uniform(1.5, 12)), 0, 1)


def _blood_drop(rng: np.random.Generator, depth: np.ndarray) -> np.ndarray:
    """Add a drop or a trickle of blood."""
    height, width = depth.shape
    layer = np.zeros_like(depth)
    start = rng.uniform(0, 1, 2) * (width, height)
    radius = np.exp(rng.uniform(np.log(0.7), np.log(7)))
    end = start + rng.normal(0, rng.choice([1.0, 20.0]), 2)
    points = (np.array([start, end]) * 8).astype(np.int32)
    cv2.line(layer, points[0].tolist(), points[1].tolist(), 1.0, max(int(2 * radius), 1), cv2.LINE_AA, 3)
    return depth + cv2.GaussianBlur(layer, (0, 0), 0.6) * np.float32(rng.uniform(1, 6))


def _glints(rng: np.random.Generator, depth: np.ndarray) -> np.ndarray:
    """White reflections of the lamp on the wet surface [h, w, 1]."""
    height, width = depth.shape
    waves = smooth_noise(rng, width, height, np.exp(rng.uniform(np.log(8), np.log(50))), 2)
    bright = np.clip(waves - rng.uniform(1.4, 3.0), 0, 1) * rng.uniform(0.5, 3.0)
    return (np.clip(bright, 0, 1) * np.clip(depth, 0, 1))[..., None].astype(np.float32) * np.float32(0.9)
