"""`python -m carts_core.rendering.warmup`: compile the kernels, and prepare the shipped robot's meshes.

Both are cached on disk, which speeds up the first rendering.
"""

import numpy as np

from ..model.camera import Camera
from ..model.robot import Robot
from ..model.scene import Arm, Scene
from ..optimization.image_factors import nearest_edges
from ..optimization.regions import RegionFactor, RegionImages
from ..optimization.variables import Variables
from ..resources import shipped_robot
from ..settings import FreeParameters, SurfaceSolver
from ..settings.stages import AlignRegions
from .renderer import Renderer


def main() -> None:
    """Render the shipped robot once, in a small picture, with derivatives."""
    robot = Robot.load(shipped_robot(), progress=print)
    # The camera is slightly behind the base, with its axis along the instrument.
    T_camera_world = np.eye(4)
    T_camera_world[2, 3] = 0.05
    camera = Camera("camera", 64, 48, (64.0, 64.0, 32.0, 24.0), T_camera_world)
    scene = Scene((Arm("arm", robot, np.eye(4)),), (camera,))
    step = 1e-3
    around = scene.state({"arm": np.array([[0.0], [-step], [step]]) * np.ones(len(robot.joint_names))})
    renderer = Renderer(scene)
    rendering = renderer.surface(around, 2 * step)
    assert rendering.jacobian, "an invisible scene would not compile the kernels"
    renderer.outline(around.map(lambda values: values[0]), renderer.tangents(around, 2 * step))
    image, pixel, samples = (np.zeros(shape, np.float32) for shape in ((1, 2, 2, 6), (2, 1), 3))
    nearest_edges(image, np.zeros(1, np.int64), pixel, pixel, samples, samples)
    settings, state = SurfaceSolver(), around.map(lambda values: values[0])
    images = RegionImages(scene, {"camera": np.zeros((48, 64, 3), np.uint8)}, {}, settings)
    variables = Variables(scene, state, FreeParameters(), settings.length_scale)
    colours = images.learnt(state)
    assert colours is not None
    factor = RegionFactor(images, variables, colours, AlignRegions())
    factor.render(0.0 * variables.lower)
    factor.linearize(0.0 * variables.lower)


if __name__ == "__main__":
    main()
