"""Deferred shading of observed training images: G-buffer, microfacet highlights, lights, environment, lens.

The shading intentionally differs from the optimizer's Phong shading, so that the network does not overfit to one
shader.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from ...rendering import visibility
from ...settings import AppearanceRanges
from .arms import Body, Intrinsics, PosedRobot
from .backgrounds import smooth_noise


@dataclass(frozen=True)
class GBuffer:
    """Surface points of the n pixels that show an arm."""

    size: tuple[int, int]
    """Width and height of the image [px]."""
    rows: Int[np.ndarray, " n"]
    columns: Int[np.ndarray, " n"]
    arm: Int[np.ndarray, " n"]
    part: Int[np.ndarray, " n"]
    """Part of each pixel: index into `Robot.meshes`."""
    points: Float[np.ndarray, "n 3"]
    """Surface points in the camera frame [m]."""
    normals: Float[np.ndarray, "n 3"]
    """Unit normals in the camera frame, pointing towards the camera."""
    points_link: Float[np.ndarray, "n 3"]
    """Surface points in the frame of their link, for textures that are fixed to the link [m]."""

    def image(self, values: np.ndarray, empty: float = 0.0) -> np.ndarray:
        """Scatter per-pixel values [n, ...] into an image [height, width, ...]."""
        width, height = self.size
        image = np.full((height, width, *values.shape[1:]), empty, values.dtype)
        image[self.rows, self.columns] = values
        return image


def render_gbuffer(
    geometries: Sequence[Body], posed: Sequence[PosedRobot], intrinsics: Intrinsics, width: int, height: int
) -> GBuffer:
    """Rasterise the arms with the renderer's visibility kernel, the only code shared with the renderer."""
    vertices = np.concatenate([arm.vertices for arm in posed])
    normals = np.concatenate([arm.normals for arm in posed])
    link_points = np.concatenate([geometry.vertices for geometry in geometries])
    offsets = np.cumsum([0, *[len(geometry.vertices) for geometry in geometries[:-1]]])
    faces = np.concatenate([g.faces + offset for g, offset in zip(geometries, offsets, strict=True)]).astype(np.int32)
    face_part = np.concatenate([geometry.face_part for geometry in geometries])
    face_arm = np.repeat(np.arange(len(geometries)), [len(geometry.faces) for geometry in geometries])
    face_ids, depth = visibility(vertices, faces, intrinsics, width, height)
    rows, columns = np.nonzero(face_ids >= 0)
    face = face_ids[rows, columns]
    z = depth[rows, columns].astype(np.float32)
    fx, fy, cx, cy = intrinsics
    points = np.stack([(columns + 0.5 - cx) / fx * z, (rows + 0.5 - cy) / fy * z, z], axis=1).astype(np.float32)
    weights = _barycentric(points, vertices[faces[face]])
    corner = faces[face]
    normal = np.einsum("nk,nkc->nc", weights, normals[corner])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    away = _dot(normal, points) > 0
    normal[away] *= -1
    return GBuffer(
        (width, height), rows, columns, face_arm[face], face_part[face], points, normal.astype(np.float32),
        np.einsum("nk,nkc->nc", weights, link_points[corner]).astype(np.float32),
    )  # fmt: skip


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nc,nc->n", a, b)


def _barycentric(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Barycentric coordinates [n, 3] of points [n, 3] in triangles [n, 3, 3]."""
    a = triangles[:, 0]
    u, v, w = triangles[:, 1] - a, triangles[:, 2] - a, points - a
    uu, vv, uv = _dot(u, u), _dot(v, v), _dot(u, v)
    wu, wv = _dot(w, u), _dot(w, v)
    scale = 1.0 / np.maximum(uu * vv - uv * uv, 1e-24)
    s, t = (vv * wu - uv * wv) * scale, (uu * wv - uv * wu) * scale
    # This avoids extrapolated normals because of rounding for sliver triangles.
    s, t = np.clip(s, 0, 1), np.clip(t, 0, 1)
    return np.stack([np.clip(1 - s - t, 0, 1), s, t], axis=1).astype(np.float32)


Image = Float[np.ndarray, "h w 3"]


def photograph(rng: np.random.Generator, image: Image, ranges: AppearanceRanges) -> Image:
    """Apply random vignette, blur, exposure, colour, noise and JPEG artefacts within `ranges`; the result is in [0,
    1]."""
    height, width = image.shape[:2]
    image = image * _vignette(rng, width, height, ranges)
    sigma = rng.uniform(*ranges.blur)
    if sigma > 0.2:
        image = cv2.GaussianBlur(image, (0, 0), sigma)
    if rng.random() < 0.25:  # sharpening by the camera, which causes bright seams along dark shafts
        image = image + rng.uniform(0.2, 1.0) * (image - cv2.GaussianBlur(image, (0, 0), rng.uniform(0.7, 1.5)))
    image = tone(rng, image, ranges)
    sigma = rng.uniform(*ranges.noise)
    luminance = rng.standard_normal((height, width, 1), np.float32)
    color = cv2.resize(rng.standard_normal((height // 2, width // 2, 3), np.float32), (width, height))
    image = np.clip(image + sigma * (luminance + 0.7 * color) * (0.5 + image), 0, 1)
    if rng.random() < 0.7:
        options = [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(*ranges.jpeg_quality))]
        decoded = cv2.imdecode(
            cv2.imencode(".jpg", (image[..., ::-1] * 255).astype(np.uint8), options)[1], cv2.IMREAD_COLOR
        )
        assert decoded is not None
        image = decoded[..., ::-1].astype(np.float32) / 255
    if rng.random() < 0.08:  # the black border of a round endoscope image
        y, x = np.mgrid[:height, :width].astype(np.float32)
        radius = np.hypot(x - width * rng.uniform(0.4, 0.6), y - height * rng.uniform(0.4, 0.6))
        edge = rng.uniform(0.55, 0.75) * width
        image = image * np.clip((edge - radius) / rng.uniform(1, 6), 0, 1)[..., None]
    return image.astype(np.float32)


def tone(rng: np.random.Generator, image: Image, ranges: AppearanceRanges) -> Image:
    """Apply only random exposure, white balance, contrast and tone curve."""
    factor = rng.uniform(*ranges.brightness) * rng.uniform(*ranges.white_balance, size=3)
    # The brightness floor applies to the whole image, before white balance.
    factor *= max(1.0, ranges.brightness[0] / factor.mean())
    image = np.clip(image * factor.astype(np.float32), 0, 1.2)
    mean = image.mean()
    image = mean + (image - mean) * rng.uniform(*ranges.contrast)
    return np.clip(image, 0, 1) ** np.float32(rng.uniform(*ranges.gamma))


def _vignette(rng: np.random.Generator, width: int, height: int, ranges: AppearanceRanges) -> np.ndarray:
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = x / width - 0.5, y / height - 0.5
    light = 1 - rng.uniform(*ranges.vignette) * np.clip((x * x + y * y) * 2, 0, 1)
    if rng.random() < 0.6:
        light = light * np.exp(
            rng.uniform(0, ranges.unevenness) * smooth_noise(rng, width, height, rng.uniform(2, 5), 1)
        )
        # The mean brightness is unchanged, since training data exclude low light.
        light = light / light.mean()
    return np.clip(light, 0.35, 1.6)[..., None]


_ENVIRONMENT = (24, 48)
_GAMMA = 1 / 2.2


@dataclass(frozen=True)
class _Surface:
    """Material of n pixels."""

    albedo: Float[np.ndarray, "n 3"]
    roughness: Float[np.ndarray, " n"]
    metalness: Float[np.ndarray, " n"]


def shade(
    rng: np.random.Generator, gbuffer: GBuffer, geometries: Sequence[Body], ambience: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Shade the pixels of `gbuffer` with random materials, lights and environment; returns display colours in [0, 1].

    The arms reflect `ambience`, the mean colour of the background.
    """
    if len(gbuffer.rows) == 0:
        return np.zeros((0, 3), np.float32)
    surface = _random_surface(rng, gbuffer, geometries)
    distance = np.linalg.norm(gbuffer.points, axis=1, keepdims=True)
    view = -gbuffer.points / distance
    n_v = np.clip(_dot(gbuffer.normals, view), 0.02, 1)
    base = 0.04 + surface.metalness[:, None] * (surface.albedo - 0.04)
    body = surface.albedo * (1 - surface.metalness)[:, None]
    color = np.zeros_like(surface.albedo)
    middle = float(np.median(distance))
    for position, radiance in _random_lights(rng, middle):
        color += _light(gbuffer, view, n_v, surface.roughness, base, body, position, radiance)
    color += _reflections(rng, gbuffer, view, n_v, surface.roughness, base, body, ambience)
    color *= np.exp(rng.normal(0, 0.25))
    return np.clip(color, 0, 1) ** _GAMMA


def _light(gbuffer, view, n_v, roughness, base, body, position, radiance) -> np.ndarray:
    """Cook-Torrance shading with the GGX distribution, Schlick's Fresnel term and Smith's shadowing in Karis'
    approximation."""
    to_light = position - gbuffer.points
    distance = np.linalg.norm(to_light, axis=1, keepdims=True)
    light = to_light / distance
    n_l = np.clip(_dot(gbuffer.normals, light), 0, 1)
    half = light + view
    half /= np.linalg.norm(half, axis=1, keepdims=True) + 1e-9
    n_h = np.clip(_dot(gbuffer.normals, half), 0, 1)
    v_h = np.clip(_dot(view, half), 0, 1)
    alpha2 = roughness**4
    density = alpha2 / (np.pi * (n_h * n_h * (alpha2 - 1) + 1) ** 2)
    k = (roughness + 1) ** 2 / 8
    shadowing = 1 / ((n_l * (1 - k) + k) * (n_v * (1 - k) + k) * 4)
    fresnel = base + (1 - base) * ((1 - v_h) ** 5)[:, None]
    specular = fresnel * (density * shadowing)[:, None]
    falloff = radiance * (np.linalg.norm(position - gbuffer.points.mean(0)) / distance) ** 2
    return ((body / np.pi + np.minimum(specular, 8.0)) * falloff * n_l[:, None]).astype(np.float32)


def _random_lights(rng: np.random.Generator, distance: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Positions [m] and radiances of one or two lights at the lens, and of further lights on the camera's side."""
    lights = []
    at_lens = rng.integers(1, 3)
    for index in range(at_lens + rng.integers(0, 3)):
        if index < at_lens:
            position = np.array([*rng.normal(0, 0.012, 2), rng.uniform(-0.03, 0.005)])
        else:
            direction = rng.normal(size=3)
            direction[2] = -abs(direction[2])
            position = np.array([0, 0, distance]) + direction / np.linalg.norm(direction) * distance * rng.uniform(1, 4)
        tint = np.clip(rng.normal(1, 0.08, 3), 0.6, 1.4)
        lights.append((position.astype(np.float32), (rng.uniform(0.4, 2.0) * tint).astype(np.float32)))
    return lights


def _reflections(rng, gbuffer, view, n_v, roughness, base, body, ambience) -> np.ndarray:
    sharp = _random_environment(rng, ambience)
    soft = cv2.blur(sharp, (9, 5), borderType=cv2.BORDER_REFLECT)
    diffuse = cv2.blur(sharp, (25, 13), borderType=cv2.BORDER_REFLECT)
    mirrored = 2 * _dot(gbuffer.normals, view)[:, None] * gbuffer.normals - view
    gloss = np.clip(1 - roughness, 0, 1)[:, None]
    reflected = gloss * _look_up(sharp, mirrored) + (1 - gloss) * _look_up(soft, mirrored)
    fresnel = base + (np.maximum(gloss, base) - base) * ((1 - n_v) ** 5)[:, None]
    return fresnel * reflected + body * _look_up(diffuse, gbuffer.normals)


def _random_environment(rng: np.random.Generator, ambience: np.ndarray) -> np.ndarray:
    """Random environment map: a floor with the colour of the background, and bright windows, whose reflections in a
    cylinder are the long highlights of a shaft."""
    rows, columns = _ENVIRONMENT
    level = rng.uniform(0.1, 0.7)
    small = (
        level * ambience * np.clip(rng.normal(1, 0.35, (4, 6, 1)), 0.1, 2.5) * np.clip(rng.normal(1, 0.06, 3), 0.7, 1.3)
    )
    environment = cv2.resize(small.astype(np.float32), (columns, rows), interpolation=cv2.INTER_LINEAR)
    for _ in range(rng.integers(0, 5)):
        centre = (int(rng.integers(columns)), int(rng.integers(rows)))
        axes = (int(rng.integers(1, 9)), int(rng.integers(1, 5)))
        value = float(rng.uniform(0.4, 3.0))
        cv2.ellipse(environment, centre, axes, float(rng.uniform(0, 180)), 0, 360, (value, value, value), -1)
    return cv2.GaussianBlur(environment, (3, 3), 0)


def _look_up(environment: np.ndarray, direction: np.ndarray) -> np.ndarray:
    rows, columns = environment.shape[:2]
    u = (np.arctan2(direction[:, 0], direction[:, 2]) / (2 * np.pi) + 0.5) * (columns - 1)
    v = (np.arcsin(np.clip(direction[:, 1], -1, 1)) / np.pi + 0.5) * (rows - 1)
    # OpenCV's remap supports at most 32,767 rows, so the list of pixels is reshaped to a square.
    side = int(np.ceil(np.sqrt(len(u))))
    grid = np.zeros((2, side * side), np.float32)
    grid[0, : len(u)], grid[1, : len(v)] = u, v
    grid = grid.reshape(2, side, side)
    found = cv2.remap(environment, grid[0], grid[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(-1, 3)[: len(u)]


def _random_surface(rng: np.random.Generator, gbuffer: GBuffer, geometries: Sequence[Body]) -> _Surface:
    n = len(gbuffer.rows)
    albedo, roughness, metalness = np.empty((n, 3), np.float32), np.empty(n, np.float32), np.empty(n, np.float32)

    def paint(pixels: np.ndarray, material: tuple[np.ndarray, float, float]) -> None:
        albedo[pixels], roughness[pixels], metalness[pixels] = material

    for arm, geometry in enumerate(geometries):
        on_arm = gbuffer.arm == arm
        steel = _random_metal(rng)
        for part in np.unique(gbuffer.part[on_arm]):
            pixels = on_arm & (gbuffer.part == part)
            points = gbuffer.points_link[pixels]
            if part == geometry.shaft:
                paint(pixels, _random_shaft(rng))
                if rng.random() < 0.6:
                    height = (points - geometry.shaft_end) @ geometry.shaft_axis
                    ring = np.zeros(n, bool)
                    ring[pixels] = height < rng.uniform(0.001, 0.012)
                    paint(ring, _random_metal(rng))
            else:
                paint(pixels, steel if rng.random() < 0.6 else _random_metal(rng))
            if rng.random() < 0.25:
                centre = points[rng.integers(len(points))]
                mark = np.zeros(n, bool)
                mark[pixels] = ((points - centre) ** 2).sum(1) < rng.uniform(0.0008, 0.003) ** 2
                paint(mark, (rng.uniform(0.02, 0.9, 3), rng.uniform(0.2, 0.8), 0.0))
    grime = _grime(rng, gbuffer.points_link)
    return _Surface(
        np.clip(albedo * np.exp(rng.uniform(0, 0.35) * grime)[:, None], 0, 1),
        np.clip(roughness * np.exp(rng.uniform(0, 0.25) * grime), 0.08, 1),
        metalness,
    )


def _random_shaft(rng: np.random.Generator) -> tuple[np.ndarray, float, float]:
    if rng.random() < 0.85:
        grey = np.exp(rng.uniform(np.log(0.003), np.log(0.07)))
        return grey * np.clip(rng.normal(1, 0.1, 3), 0.5, 1.6), rng.uniform(0.2, 0.75), 0.0
    return _random_metal(rng)


def _random_metal(rng: np.random.Generator) -> tuple[np.ndarray, float, float]:
    if rng.random() < 0.85:
        grey = rng.uniform(0.12, 0.75)
        return grey * np.clip(rng.normal(1, 0.06, 3), 0.6, 1.4), rng.uniform(0.08, 0.65), rng.uniform(0.5, 1.0)
    return rng.uniform(0.01, 0.7, 3), rng.uniform(0.2, 0.9), rng.uniform(0, 0.5)


def _grime(rng: np.random.Generator, points: np.ndarray) -> np.ndarray:
    """Smooth noise on the surface with zero mean and approximately unit standard deviation."""
    noise = np.zeros(len(points), np.float32)
    for _ in range(4):
        wave = rng.normal(size=3)
        wave *= 2 * np.pi / (np.linalg.norm(wave) * np.exp(rng.uniform(np.log(0.0015), np.log(0.02))))
        noise += np.sin(points @ wave.astype(np.float32) + np.float32(rng.uniform(0, 2 * np.pi)))
    return noise / np.sqrt(2)
