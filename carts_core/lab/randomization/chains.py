"""Random serial robots for training images, with three to seven joints, links of cylinders, boxes and spheres, and a
gripper."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ...files import output_path, write_text
from ...model.robot import Robot

_REACH = (0.25, 1.3)
"""Range of the sum of all link lengths [m]."""
_SLIM = (0.10, 0.45)
"""Range of a link's radius, relative to its length [1]."""
_LIMIT = 2.6
"""Joint limits of revolute joints [rad]."""


def random_chain(rng: np.random.Generator) -> Robot:
    """Random serial robot with a gripper or a plain tool."""
    with TemporaryDirectory(prefix="carts-chain-") as folder:
        path = output_path(Path(folder), "chain.urdf")
        write_text(path, _urdf(rng))
        return Robot.load(path.path)


def _urdf(rng: np.random.Generator) -> str:
    joints = int(rng.integers(3, 8))
    lengths = rng.uniform(0.5, 1.5, joints + 1) * np.linspace(1.2, 0.7, joints + 1)
    lengths *= np.exp(rng.uniform(*np.log(_REACH))) / lengths.sum()
    radius = lengths.mean() * rng.uniform(*_SLIM)
    radii = np.maximum(radius * np.linspace(1.0, rng.uniform(0.4, 1.0), joints + 1), 0.012)
    elements = [f'<link name="link_0">{_visuals(rng, lengths[0], 1.3 * radii[0])}</link>']
    bent = rng.random() < 0.3
    for index in range(joints):
        axis = ("0 0 1", "0 1 0", "1 0 0")[0 if index % 2 == 0 else int(rng.integers(1, 3))]
        # Links of some arms are offset sideways at the joints, as in lightweight robots.
        aside = radii[index] * rng.uniform(-1.5, 1.5) if bent else 0.0
        shape = _visuals(rng, lengths[index + 1], radii[index + 1])
        if index == joints - 1:
            shape += _tool(rng, lengths[-1], radii[-1])
        elements.append(
            f'<joint name="joint_{index}" type="revolute"><parent link="link_{index}"/><child link="link_{index + 1}"/>'
            f'<origin xyz="{aside:.4f} 0 {lengths[index]:.4f}"/><axis xyz="{axis}"/>'
            f'<limit lower="-{_LIMIT}" upper="{_LIMIT}" effort="1" velocity="1"/></joint>'
            f'<link name="link_{index + 1}">{shape}</link>'
        )
    return f'<robot name="chain">{"".join(elements)}</robot>'


def _visuals(rng: np.random.Generator, length: float, radius: float) -> str:
    """URDF visuals of a link along z: a joint housing, and a tube, box or pair of rails."""
    housing = radius * rng.uniform(1.0, 1.5)
    shapes = [f'<sphere radius="{housing:.4f}"/>', f'<cylinder radius="{housing:.4f}" length="{2 * housing:.4f}"/>']
    visuals = [_visual(shapes[int(rng.integers(2))], "0 0 0", "1.5708 0 0" if rng.random() < 0.5 else "0 0 0")]
    kind = rng.choice(["tube", "box", "rails"], p=[0.6, 0.25, 0.15])
    middle = f"0 0 {length / 2:.4f}"
    if kind == "tube":
        visuals.append(_visual(f'<cylinder radius="{0.85 * radius:.4f}" length="{length:.4f}"/>', middle))
    elif kind == "box":
        width, depth = radius * rng.uniform(1.0, 2.2, 2)
        visuals.append(_visual(f'<box size="{width:.4f} {depth:.4f} {length:.4f}"/>', middle))
    else:
        for side in (-1, 1):
            box = f'<box size="{0.4 * radius:.4f} {1.4 * radius:.4f} {length:.4f}"/>'
            visuals.append(_visual(box, f"{side * 0.8 * radius:.4f} 0 {length / 2:.4f}"))
    return "".join(visuals)


def _tool(rng: np.random.Generator, length: float, radius: float) -> str:
    if rng.random() < 0.3:
        long = radius * rng.uniform(1.5, 4)
        return _visual(f'<cylinder radius="{radius / 2:.4f}" length="{long:.4f}"/>', f"0 0 {length + long / 2:.4f}")
    gap, finger = radius * rng.uniform(0.3, 1.0), radius * rng.uniform(1.5, 4.0)
    box = f'<box size="{2.4 * radius:.4f} {radius:.4f} {0.6 * radius:.4f}"/>'
    visuals = [_visual(box, f"0 0 {length:.4f}")]
    for side in (-1, 1):
        box = f'<box size="{0.4 * radius:.4f} {0.7 * radius:.4f} {finger:.4f}"/>'
        visuals.append(_visual(box, f"{side * (gap + 0.2 * radius):.4f} 0 {length + finger / 2:.4f}"))
    return "".join(visuals)


def _visual(shape: str, xyz: str, rpy: str = "0 0 0") -> str:
    return f'<visual><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{shape}</geometry></visual>'
