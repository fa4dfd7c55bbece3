"""Shading of observed training images: microfacet highlights, several lights and an environment to reflect.

This path is on purpose not the optimizer's Phong: the network must learn what an instrument is, not our shader.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from .gbuffer import GBuffer
from .geometry import Body

_ENVIRONMENT = (24, 48)
_GAMMA = 1 / 2.2


@dataclass(frozen=True)
class _Surface:
    """Material per pixel; n pixels."""

    albedo: Float[np.ndarray, "n 3"]
    roughness: Float[np.ndarray, " n"]
    metalness: Float[np.ndarray, " n"]


def shade(
    rng: np.random.Generator, gbuffer: GBuffer, geometries: Sequence[Body], ambience: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Display colours in [0, 1] of the pixels of `gbuffer`, with random materials, lights and environment.

    Args:
        ambience: mean colour of the background [3], which the arms reflect.
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


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nc,nc->n", a, b)


def _light(gbuffer, view, n_v, roughness, base, body, position, radiance) -> np.ndarray:
    """Cook-Torrance with the GGX distribution, Schlick's Fresnel and Smith's shadowing in Karis' short form."""
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
    """Position [m] and radiance of some lights: one or two at the lens, others anywhere on the camera's side."""
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
    """A map over directions: a floor in the background's colour and some bright windows, whose mirror images on a
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
    # OpenCV's remap limits an image to 32,767 rows, so the list of pixels is folded into a square.
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
    """Smooth noise over the surface, zero mean, about unit deviation."""
    noise = np.zeros(len(points), np.float32)
    for _ in range(4):
        wave = rng.normal(size=3)
        wave *= 2 * np.pi / (np.linalg.norm(wave) * np.exp(rng.uniform(np.log(0.0015), np.log(0.02))))
        noise += np.sin(points @ wave.astype(np.float32) + np.float32(rng.uniform(0, 2 * np.pi)))
    return noise / np.sqrt(2)
