"""Use any URDF with meshes as an arm: write a URDF, render it, and fit its joints to an image with plain PyTorch.

python examples/06_a_urdf_of_your_own.py [--steps 80] [--picture own_arm.png]

No network is involved: the renderer is differentiable, so Adam moves the joints until the silhouettes agree.
"""

import tempfile
from pathlib import Path

import cv2
import numpy as np
import torch
import trimesh
import tyro
from kornia.filters import gaussian_blur2d

from carts_core.export import image_and_mask, outlined
from carts_core.model.camera import Camera
from carts_core.model.robot import Robot
from carts_core.model.scene import Arm, Scene
from carts_core.rendering import Renderer

LENGTHS = {"upper": 0.05, "lower": 0.04, "hand": 0.02}  # lengths of the rods, each along its own z [m]


def write_urdf(folder: Path) -> Path:
    """Write the URDF and meshes of a planar arm: three rods that rotate about y."""
    parts, parent, offset = ['<robot name="three_rods"><link name="base"/>'], "base", 0.0
    for name, length in LENGTHS.items():
        rod = trimesh.creation.cylinder(radius=0.006, segment=[[0, 0, 0], [0, 0, length]])
        rod.export(folder / f"{name}.stl")
        parts.append(f'<link name="{name}"><visual><geometry><mesh filename="{name}.stl"/></geometry></visual></link>')
        parts.append(
            f'<joint name="{name}_joint" type="revolute"><parent link="{parent}"/><child link="{name}"/>'
            f'<origin xyz="0 0 {offset}"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/>'
            "</joint>"
        )
        parent, offset = name, length
    path = folder / "three_rods.urdf"
    path.write_text("\n".join([*parts, "</robot>"]), encoding="utf-8")
    return path


def blurred(silhouette: torch.Tensor) -> torch.Tensor:
    """Blur a silhouette [height, width] widely, for gradients over larger distances."""
    return gaussian_blur2d(silhouette[None, None], (25, 25), (6.0, 6.0))


def main(steps: int = 80, picture: Path = Path("own_arm.png")) -> None:
    """Fit the joints to a rendered image of the arm."""
    with tempfile.TemporaryDirectory() as folder:
        robot = Robot.load(write_urdf(Path(folder)))
    # The camera looks along the world's y from 20 cm away, so the arm moves parallel to the image plane.
    T_camera_world = np.array([[1, 0, 0, 0], [0, 0, -1, 0.05], [0, 1, 0, 0.2], [0, 0, 0, 1]], float)
    camera = Camera("camera", 320, 240, (400.0, 400.0, 160.0, 120.0), T_camera_world)
    scene = Scene((Arm("rods", robot, np.eye(4)),), (camera,))
    renderer = Renderer(scene)
    true, start = scene.state({"rods": [0.3, 0.6, -0.4]}), scene.state({"rods": [0.0, 0.2, 0.1]})
    image, mask = image_and_mask(renderer, true)
    target, before = blurred(torch.from_numpy(mask).float()), image_and_mask(renderer, start)[1]

    joints = start.joint_positions[0].requires_grad_()
    optimizer = torch.optim.Adam([joints], lr=0.05)
    for step in range(steps):
        optimizer.zero_grad()
        loss = torch.nn.functional.mse_loss(blurred(renderer(start).silhouette[0]), target)
        loss.backward()
        optimizer.step()
        if step % 20 == 0:
            print(f"step {step:3}  loss {loss.item():.5f}")
    error = (joints.detach() - true.joint_positions[0]).abs().max()
    print(f"largest joint error: {torch.rad2deg(error):.2f} deg")
    after = image_and_mask(renderer, start)[1]
    cv2.imwrite(str(picture), np.hstack([outlined(image, before), outlined(image, after)])[..., ::-1])
    print(f"wrote {picture}: the outline before and after")


if __name__ == "__main__":
    tyro.cli(main)
