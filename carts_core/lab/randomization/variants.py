"""Scenes for training: the robots with randomised colours, proportions and optimizer's light."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...model.camera import Camera
from ...model.robot import Robot
from ...model.scene import Arm, Light, Scene
from ...rendering import Renderer
from .geometry import RobotGeometry

THICKNESS = (0.88, 1.15)
"""Factor on the thickness of links, so that the network is not tied to one instrument's exact shape."""

PERFECT_MODEL = 0.5
"""Share of scenes whose rendered arms have exactly the proportions of the observed ones."""


@dataclass(frozen=True)
class Variant:
    """One or two arms, ready to be posed, shaded and rendered."""

    geometries: tuple[RobotGeometry, ...]
    """The arms that the camera observes."""
    rendered: tuple[RobotGeometry, ...]
    """The arms as the optimizer knows them: the same, or of slightly other proportions, as models are."""
    renderer: Renderer
    """The optimizer's renderer of `rendered`, for hybrid images."""


def random_variant(rng: np.random.Generator, robots: Sequence[Robot], arms: int, width: int, height: int) -> Variant:
    """A scene of `arms` arms, each a robot of `robots` with random colours and thickness."""
    chosen = [robots[int(rng.integers(len(robots)))] for _ in range(arms)]
    observed = [_vary(rng, robot) for robot in chosen]
    rendered = observed if rng.random() < PERFECT_MODEL else [_vary(rng, robot) for robot in chosen]
    scene = Scene(
        tuple(Arm(f"arm{index}", robot, np.eye(4)) for index, robot in enumerate(rendered)),
        (Camera("training", width, height, (float(width), float(width), width / 2, height / 2), np.eye(4)),),
        _random_light(rng),
    )
    geometries = tuple(RobotGeometry(robot) for robot in observed)
    known = geometries if rendered is observed else tuple(RobotGeometry(robot) for robot in rendered)
    return Variant(geometries, known, Renderer(scene, width=width, height=height))


def _vary(rng: np.random.Generator, robot: Robot) -> Robot:
    varied = copy.copy(robot)
    thickness = rng.uniform(*THICKNESS)
    own_colors = rng.random() < 0.4
    shade = rng.uniform(0.02, 0.6)
    meshes = []
    for mesh in robot.meshes:
        extents = np.ptp(mesh.vertices, axis=0)
        scale = np.full(3, thickness * rng.uniform(0.94, 1.06))
        scale[np.argmax(extents)] = 1.0
        # Normals of a surface that is stretched by S are those of the surface pressed by S.
        normals = mesh.normals / scale
        normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
        color = mesh.color if own_colors else np.clip(shade * np.clip(rng.normal(1, 0.12, 3), 0.6, 1.5), 0, 1)
        if not own_colors and rng.random() < 0.7:
            color = np.clip(rng.uniform(0.15, 0.8) * np.clip(rng.normal(1, 0.08, 3), 0.6, 1.4), 0, 1)
        vertices = (mesh.vertices * scale).astype(np.float32)
        meshes.append(replace(mesh, vertices=vertices, normals=normals.astype(np.float32), color=color))
    varied.meshes = tuple(meshes)
    return varied


def _random_light(rng: np.random.Generator) -> Light:
    return Light(
        position=(float(rng.normal(0, 0.01)), float(rng.normal(0, 0.01)), float(rng.uniform(-0.04, 0.0))),
        ambient=float(rng.uniform(0.15, 0.4)),
        diffuse=float(rng.uniform(0.5, 0.85)),
        specular=float(rng.uniform(0.1, 0.6)),
        shininess=float(rng.uniform(8, 50)),
    )
