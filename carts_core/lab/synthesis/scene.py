"""Synthetic scene: cameras, tissue (height field with folds, fat and vessels) and arms.

World frame [m]: origin at the centre of the tissue, x right, y away from the camera, z up.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates

from ...model.camera import Camera
from ...model.robot import Robot
from ...model.scene import Arm
from ...settings import EndoscopeConfig, SynthesisConfig


def smooth_noise(
    shape: Sequence[int], wavelength: float, rng: np.random.Generator, *, octaves: int = 1, gain: float = 0.5
) -> Float[np.ndarray, "..."]:
    """Periodic noise of zero mean and unit variance in any number of dimensions, filtered in the Fourier domain.

    Args:
        shape: size of the field, in samples per dimension.
        wavelength: typical distance between neighbouring crests of the first octave [samples].
        rng: random generator.
        octaves: number of bands, each with half the wavelength of the previous one.
        gain: amplitude of each band relative to the previous one.
    """
    spectrum = np.fft.rfftn(rng.standard_normal(shape).astype(np.float32))
    axes = [np.fft.fftfreq(n) for n in shape[:-1]] + [np.fft.rfftfreq(shape[-1])]
    frequency = np.sqrt(sum(axis**2 for axis in np.meshgrid(*axes, indexing="ij", sparse=True)))
    response = np.zeros_like(frequency)
    for octave in range(octaves):
        # The number of modes is proportional to f^dimensions, so each band has the same energy at any wavelength.
        center = 2.0**octave / wavelength
        band = np.exp(-0.5 * ((frequency - center) / (0.35 * center)) ** 2)
        energy = np.sqrt((band**2).sum())
        if energy > 0:
            response += gain**octave * band / energy
    response.flat[0] = 0.0
    field = np.fft.irfftn(spectrum * response, s=tuple(shape), axes=tuple(range(len(shape)))).astype(np.float32)
    deviation = float(field.std())
    return field / deviation if deviation > 0 else field


def smoothstep(value: np.ndarray, low: float, high: float) -> np.ndarray:
    """Smoothstep function: 0 below `low`, 1 above `high`, and a smooth transition in between."""
    x = np.clip((value - low) / (high - low), 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


ARM_NAMES = ("psm1", "psm2")
"""Names of the arms that enter from the left and from the right, as seen from the camera."""

JOINT_TYPES = ("revolute", "revolute", "prismatic", "revolute", "revolute", "revolute", "revolute")
"""Types of yaw, pitch, insertion, roll, wrist pitch, wrist yaw and jaw; instruments without jaws lack the last."""

_REMOTE_CENTRES_CAMERA = ((-0.092, 0.062, 0.006), (0.098, -0.010, 0.002))
"""Points at which the instruments pass through the body wall, in the frame of the left camera [m]."""

CENTRE = np.array([0.0, 0.0, 0.006])
"""World point at the centre of the scene, at which the cameras look [m]."""

WORK_POINTS = ((-0.011, -0.001, 0.014), (0.012, 0.002, 0.014))
"""World points at which the shafts point at zero joint positions, and about which the tips move [m]."""


def place_cameras(config: EndoscopeConfig) -> tuple[Camera, ...]:
    """Left camera and, in stereo, right camera."""
    forward = np.array([0.0, np.cos(config.elevation), -np.sin(config.elevation)])
    right = np.array([1.0, 0.0, 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    position = CENTRE - config.distance * forward
    focal = config.focal_length * config.width / 640.0
    names = ("left", "right") if config.stereo else ("left",)
    cameras = []
    for number, name in enumerate(names):
        T_camera_world = np.eye(4)
        T_camera_world[:3, :3] = rotation
        T_camera_world[:3, 3] = -rotation @ (position + number * config.baseline * right)
        intrinsics = (focal, focal, config.width / 2.0, config.height / 2.0)
        cameras.append(Camera(name, config.width, config.height, intrinsics, T_camera_world))
    return tuple(cameras)


def load_robot(config: SynthesisConfig) -> Robot:
    """Load the robot with finer meshes than the optimizer uses.

    Raises:
        RobotError: the URDF is unusable.
    """
    return Robot.load(config.robot, max_faces=config.render.robot_faces)


def is_instrument(robot: Robot) -> bool:
    """Whether the joints are the joints of a PSM: all seven, or all except the last."""
    return robot.joint_types in (JOINT_TYPES, JOINT_TYPES[:-1])


def place_arms(robot: Robot, tip_link: str, camera: Camera) -> tuple[Arm, ...]:
    """Arms with base frames such that, at zero joint positions, the instruments point at `WORK_POINTS`."""
    T_world_camera = np.linalg.inv(camera.T_camera_world)
    arms = []
    for name, centre, work in zip(ARM_NAMES, _REMOTE_CENTRES_CAMERA, WORK_POINTS, strict=True):
        centre_world = (T_world_camera @ np.append(centre, 1.0))[:3]
        T_world_base = np.eye(4)
        T_world_base[:3, :3] = rotation_between(_shaft_direction(robot, tip_link), np.asarray(work) - centre_world)
        T_world_base[:3, 3] = centre_world
        arms.append(Arm(name, robot, T_world_base))
    return tuple(arms)


def _shaft_direction(robot: Robot, tip_link: str) -> Float[np.ndarray, "3"]:
    """Direction of insertion in the base frame at zero joint positions."""
    joints = torch.zeros(2, len(robot.joint_names), dtype=torch.float64)
    joints[1, 2] = 0.1
    tips = robot.link_transform(joints, tip_link)[:, :3, 3].numpy()
    return tips[1] - tips[0]


def rotation_between(a: np.ndarray, b: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """Rotation from direction a to direction b that preserves their common up direction as far as possible."""
    return _frame(b) @ _frame(a).T


def _frame(direction: np.ndarray) -> np.ndarray:
    z = direction / np.linalg.norm(direction)
    helper = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=-1)


EXTENT = 0.26
"""Side length of the square of tissue, centred at the world origin [m]."""


@dataclass(frozen=True)
class _Kind:
    """Appearance of an organ; colours are linear RGB."""

    base: tuple[float, float, float]
    dark: tuple[float, float, float]
    patch: tuple[float, float, float]
    patch_share: float
    folds: float
    lobules: float
    vessels: int
    roughness: float


_KINDS = {
    "muscle": _Kind((0.47, 0.150, 0.120), (0.27, 0.055, 0.045), (0.52, 0.30, 0.135), 0.26, 0.0026, 0.0009, 7, 0.36),
    "bowel": _Kind((0.55, 0.28, 0.22), (0.40, 0.13, 0.105), (0.60, 0.38, 0.20), 0.30, 0.0048, 0.0010, 12, 0.33),
    "liver": _Kind((0.215, 0.055, 0.040), (0.110, 0.022, 0.020), (0.34, 0.15, 0.10), 0.12, 0.0012, 0.0004, 3, 0.30),
    "fat": _Kind((0.56, 0.36, 0.145), (0.46, 0.20, 0.085), (0.45, 0.15, 0.11), 0.26, 0.0022, 0.0016, 9, 0.38),
}
KINDS = tuple(_KINDS)
"""Kinds of tissue, for `grow_tissue`."""


@dataclass(frozen=True)
class Tissue:
    """Patch of tissue around the world origin, z up; rows and columns of fields are y and x, starting at -EXTENT /
    2."""

    heights: Float[np.ndarray, "n n"]
    """Height above z = 0 at the grid points [m]."""
    albedo: Float[np.ndarray, "m m 3"]
    """Diffuse reflectance, linear RGB in [0, 1]."""
    roughness: Float[np.ndarray, "m m"]
    """Roughness of the wet surface in [0, 1]."""

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Height [m] at points of the plane [m]; beyond the patch, the height of its border."""
        return sample(self.heights, x, y)

    def mesh(
        self,
    ) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], Float[np.ndarray, "v 2"]]:
        """Vertices [m], unit normals, faces and texture coordinates of the height field."""
        n = len(self.heights)
        unit = np.linspace(0.0, 1.0, n)
        v, u = np.meshgrid(unit, unit, indexing="ij")
        vertices = np.stack([(u - 0.5) * EXTENT, (v - 0.5) * EXTENT, self.heights], axis=-1)
        slope_y, slope_x = np.gradient(self.heights.astype(np.float64), EXTENT / (n - 1))
        normals = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        index = np.arange(n * n).reshape(n, n)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        faces = np.concatenate([np.stack(corner, axis=-1).reshape(-1, 3) for corner in ((a, b, c), (a, c, d))])
        return vertices.reshape(-1, 3), normals.reshape(-1, 3), faces, np.stack([u, v], axis=-1).reshape(-1, 2)


def sample(field: Float[np.ndarray, "n n"], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Interpolate a field of the tissue bilinearly at points of the plane [m]."""
    scale = len(field) - 1
    rows, columns = (np.asarray(y) / EXTENT + 0.5) * scale, (np.asarray(x) / EXTENT + 0.5) * scale
    return map_coordinates(field, np.stack([rows, columns]), order=1, mode="nearest")


def grow_tissue(kind: str, resolution: int, texels: int, rng: np.random.Generator) -> Tissue:
    """Generate tissue of one of `KINDS`, with `resolution` grid points and `texels` of colour along each side."""
    look, paint = _KINDS[kind], _Canvas(texels, rng)

    patches = paint.grown(0.060, 0.003, octaves=4, gain=0.42)
    patch = smoothstep(patches, *np.quantile(patches, [1.0 - look.patch_share - 0.12, 1.0 - look.patch_share + 0.10]))
    crests = np.exp(-((paint.grown(0.040, 0.005) / 0.5) ** 2))  # vessels are along the zero crossings
    folds = crests * smoothstep(paint.noise(0.080), -0.6, 1.0)
    lobules = np.minimum(np.abs(paint.grown(0.011, 0.002)), 1.2)
    vessels = paint.vessels(look.vessels)
    glossy = smoothstep(paint.noise(0.030), -0.8, 1.2)

    relief = 0.0042 * paint.noise(0.090, octaves=2, gain=0.3) + look.folds * folds
    relief += look.lobules * patch * lobules + 0.0003 * vessels
    relief += 0.00005 * paint.noise(0.0032, octaves=2) * (0.35 + 0.65 * glossy)

    hollows = smoothstep(cv2.GaussianBlur(relief, (0, 0), 0.004 * paint.scale) - relief, -0.0002, 0.0016)
    blush = 0.5 + 0.5 * np.tanh(0.8 * paint.noise(0.030, octaves=4))
    color = _mix(np.array(look.base) * _jitter(rng), np.array(look.dark), np.clip(0.65 * blush + 0.35 * hollows, 0, 1))
    color = _mix(color, np.array(look.patch) * _jitter(rng), 0.85 * patch * (1.0 - 0.5 * hollows))
    capillaries = np.exp(-((paint.grown(0.008, 0.004) / 0.07) ** 2)) * smoothstep(paint.noise(0.020), 0.0, 1.2)
    color = _mix(color, np.array([0.42, 0.035, 0.035]), 0.45 * capillaries)
    color = _mix(color, np.array([0.23, 0.030, 0.036]), 0.6 * vessels)
    color *= 1.0 + 0.05 * paint.noise(0.0012, octaves=2)[..., None]

    roughness = look.roughness + 0.05 * paint.noise(0.012, octaves=2) + 0.10 * patch
    # The tissue rises around the centre, so that it fills every image.
    unit = np.linspace(-EXTENT / 2, EXTENT / 2, resolution)
    radius = np.hypot(*np.meshgrid(unit, unit))
    cavity = (6.0 * np.maximum(radius - 0.050, 0.0) ** 2).astype(np.float32)
    return Tissue(
        heights=cavity + cv2.resize(relief, (resolution, resolution), interpolation=cv2.INTER_AREA),
        albedo=np.clip(color, 0.01, 0.9).astype(np.float32),
        roughness=np.clip(roughness, 0.18, 0.7).astype(np.float32),
    )


class _Canvas:
    """Random patterns on the patch of tissue, with lengths in metres."""

    def __init__(self, texels: int, rng: np.random.Generator) -> None:
        self._texels, self._rng = texels, rng
        self.scale = texels / EXTENT
        """Texels per metre."""
        self._warp = self.noise(0.035, octaves=2), self.noise(0.035, octaves=2)

    def noise(self, wavelength: float, octaves: int = 1, gain: float = 0.5) -> np.ndarray:
        return smooth_noise((self._texels,) * 2, wavelength * self.scale, self._rng, octaves=octaves, gain=gain)

    def grown(self, wavelength: float, amount: float, octaves: int = 1, gain: float = 0.5) -> np.ndarray:
        """Domain-warped noise, which has organic shapes."""
        rows, columns = np.indices((self._texels,) * 2, dtype=np.float32)
        shift = np.float32(amount * self.scale)
        columns, rows = columns + shift * self._warp[0], rows + shift * self._warp[1]
        field = self.noise(wavelength, octaves, gain)
        return cv2.remap(field, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)

    def vessels(self, count: int) -> np.ndarray:
        """Branching, tapering lines with value 1 at their centre and 0 outside."""
        rng = self._rng
        canvas = np.zeros((self._texels,) * 2, np.float32)
        stack = [
            (rng.uniform(0.1, 0.9, 2) * self._texels, rng.uniform(0, 2 * np.pi), rng.uniform(0.7, 1.5) * 1e-3)
            for _ in range(count)
        ]
        step = 0.0012 * self.scale
        while stack:
            point, heading, width = stack.pop()
            bend = 0.0
            for _ in range(rng.integers(25, 90)):
                bend = 0.85 * bend + rng.normal(0.0, 0.06)
                heading += bend
                target = point + step * np.array([np.cos(heading), np.sin(heading)])
                thickness = max(1, round(width * self.scale))
                cv2.line(canvas, _pixel(point), _pixel(target), 1.0, thickness, cv2.LINE_AA, shift=4)
                point, width = target, width * 0.99
                if width > 0.0003 and rng.random() < 0.05:
                    stack.append((point, heading + rng.choice([-1, 1]) * rng.uniform(0.4, 1.0), width * 0.65))
        return cv2.GaussianBlur(canvas, (0, 0), 0.00040625 * self.scale)


def _jitter(rng: np.random.Generator) -> np.ndarray:
    return np.exp(rng.normal(0.0, 0.05, 3))


def _mix(color: np.ndarray, other: np.ndarray, share: np.ndarray) -> np.ndarray:
    return color + (other - color) * share[..., None]


def _pixel(point: np.ndarray) -> tuple[int, int]:
    return int(point[0] * 16), int(point[1] * 16)
