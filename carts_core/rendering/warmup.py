"""`python -m carts_core.rendering.warmup`: compile the kernels, and prepare the shipped robot's meshes.

Both are kept on disk, so that the first picture does not wait for them.
"""

import numpy as np

from ..camera import Camera
from ..resources import shipped_robot
from ..robot import Robot
from ..scene import Arm, Scene
from .renderer import Renderer


def main() -> None:
    """Render the shipped robot once, in a small picture."""
    robot = Robot.load(shipped_robot(), progress=print)
    camera = Camera("camera", 64, 48, (64.0, 64.0, 32.0, 24.0), np.eye(4))
    scene = Scene((Arm("arm", robot, np.eye(4)),), (camera,))
    Renderer(scene).surface(scene.state({"arm": np.zeros(len(robot.joint_names))}))


if __name__ == "__main__":
    main()
