"""Hand-eye calibration from masks of an arm, without an initial pose.

Rotations are sampled over SO(3); for each, the translation follows from the centroids and sizes of the masks. The best
poses are refined with the chamfer distance between projected surface points and mask pixels, and compared by the IoU of
rendered silhouettes.
"""

from collections.abc import Sequence as Rows
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from ...errors import SettingsError
from ...model.camera import Camera
from ...model.robot import Robot
from ...model.scene import Scene
from ...rendering import Renderer
from .problem import NEAREST

WIDTH = 160
"""Width at which masks are compared [px]."""
_ROTATIONS = 4096
_KEPT = 16
"""Number of poses that are refined."""
_RENDERED = 6
"""Number of refined poses that are compared by IoU."""
_POINTS, _COARSE = 96, 40
"""Number of surface points and of mask pixels in each frame: in the refinement, and in the comparison of rotations."""
_STEPS, _RATE = 120, 0.04
"""Number of steps of the refinement, and its step size [rad], [1]."""
_MIN_PIXELS = 20
"""Minimum size of a mask [px at `WIDTH`]."""
MIN_IOU = 0.5
"""Minimum mean IoU of a usable result [1]."""


@dataclass(frozen=True)
class SilhouettePose:
    """Base frame of an arm estimated from masks."""

    T_camera_base: Float[np.ndarray, "4 4"]
    """Pose of the arm's base in the camera frame [m]."""
    iou: float
    """Mean IoU of the masks and the silhouettes of the arm [1]."""


def pose_from_masks(
    scene: Scene,
    arm: str,
    camera: str,
    joint_positions: Float[np.ndarray, "frames dofs"],
    masks: Rows[Bool[np.ndarray, "height width"]],
    *,
    seed: int = 0,
) -> SilhouettePose:
    """Estimate the base frame of an arm in a camera that does not move.

    Args:
        scene: scene with the arm and the camera; their poses are ignored.
        joint_positions: joint positions in the frames of the masks [rad, m].
        masks: mask of this arm in each frame; empty masks are skipped.
        seed: seed of the sampled rotations and points.

    Raises:
        SettingsError: all masks are empty, or no pose reaches a mean IoU of `MIN_IOU`.
    """
    view = scene.camera(camera)
    height = max(1, round(view.height * WIDTH / view.width))
    size = (WIDTH, height)
    small = [cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0 for mask in masks]
    used = [index for index, mask in enumerate(small) if mask.sum() >= _MIN_PIXELS]
    if not used:
        raise SettingsError(f"the masks of {camera} are empty. Give masks in which the arm {arm} is visible.")
    rng = np.random.default_rng(seed)
    robot = scene.arm(arm).robot
    joints, small = joint_positions[used], [small[index] for index in used]
    points = _surface_points(robot, joints, rng)
    problem = _Chamfer.of(points, small, view, rng)
    rotations = torch.tensor(Rotation.from_quat(rng.normal(size=(_ROTATIONS, 4))).as_matrix(), dtype=torch.float32)
    shifts = problem.translations(rotations)
    losses = torch.cat(
        [problem.losses(*part, _COARSE) for part in zip(rotations.split(256), shifts.split(256), strict=True)]
    )
    best = losses.argsort()[:_KEPT]
    rotations, shifts, losses = problem.refined(rotations[best], shifts[best])
    renderer = Renderer(scene, cameras=[camera], width=WIDTH, height=height)
    found: list[SilhouettePose] = []
    for index in losses.argsort()[:_RENDERED].tolist():
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotations[index].double().numpy(), shifts[index].double().numpy()
        found.append(SilhouettePose(T, _iou(renderer, placed(scene, arm, camera, T), arm, joints, small)))
    result = max(found, key=lambda pose: pose.iou)
    if result.iou < MIN_IOU:
        raise SettingsError(
            f"no pose of {arm} fits the masks: the best one has a mean IoU of {result.iou:.2f}; at least {MIN_IOU} is "
            "required. Check the units and signs of the joints, the intrinsics and the masks, which must contain the "
            "whole visible arm and nothing else. Or click points: --points."
        )
    return result


def placed(scene: Scene, arm: str, camera: str, T_camera_base: Float[np.ndarray, "4 4"]) -> Scene:
    """The scene with an arm at a pose in the frame of a camera [m]."""
    T_world_base = np.linalg.inv(scene.camera(camera).T_camera_world) @ T_camera_base
    arms = (replace(own, T_world_base=T_world_base) if own.name == arm else own for own in scene.arms)
    return replace(scene, arms=tuple(arms))


def _surface_points(
    robot: Robot, joints: Float[np.ndarray, "frames dofs"], rng: np.random.Generator
) -> Float[Tensor, "frames points 3"]:
    """Random points on the surface in the base frame [m], with a density proportional to the area."""
    corners = [mesh.vertices[mesh.faces] for mesh in robot.meshes]
    areas = [np.linalg.norm(np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]), axis=1) for c in corners]
    links = np.concatenate([np.full(len(mesh.faces), mesh.link) for mesh in robot.meshes])
    weights = np.concatenate(areas)
    faces = rng.choice(len(weights), _POINTS, p=weights / weights.sum())
    shares = rng.dirichlet(np.ones(3), _POINTS)
    points = np.einsum("pc,pcd->pd", shares, np.concatenate(corners)[faces])
    Ts = robot.forward_kinematics(joints)[:, links[faces]]
    return torch.tensor(np.einsum("fpij,pj->fpi", Ts[..., :3, :3], points) + Ts[..., :3, 3], dtype=torch.float32)


@dataclass(frozen=True, eq=False)
class _Chamfer:
    """Chamfer distance between projected surface points and masks."""

    points: Float[Tensor, "frames points 3"]
    """Surface points in the base frame [m]."""
    pixels: Float[Tensor, "frames pixels 2"]
    """Mask pixels, in normalized image coordinates."""
    outside: Float[Tensor, "frames height width"]
    """Distance from the mask, in normalized image coordinates."""
    scale: Float[Tensor, "4"]
    """Intrinsics at `WIDTH` [px]."""

    @staticmethod
    def of(points: Tensor, masks: Rows[np.ndarray], view: Camera, rng: np.random.Generator) -> "_Chamfer":
        scale = np.array(view.intrinsics) * WIDTH / view.width
        pixels = []
        for mask in masks:
            places = np.argwhere(mask)[:, ::-1] + 0.5
            pixels.append((places[rng.integers(len(places), size=_POINTS)] - scale[2:]) / scale[:2])
        outside = [cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3) / scale[0] for mask in masks]
        arrays = np.stack(pixels), np.stack(outside), scale
        return _Chamfer(points, *(torch.tensor(array, dtype=torch.float32) for array in arrays))

    def translations(self, rotations: Float[Tensor, "poses 3 3"]) -> Float[Tensor, "poses 3"]:
        """Translations [m] at which the centroids and sizes of the projected points are those of the masks."""
        turned = torch.einsum("rij,fpj->rfpi", rotations, self.points)
        middle, centre = turned.mean(2), self.pixels.mean(1)
        size = (turned[..., :2] - middle[..., None, :2]).square().mean((2, 3)).sqrt()
        spread = (self.pixels - centre[:, None]).square().mean((1, 2)).sqrt()
        # x + t_x = u (z + t_z), y + t_y = v (z + t_z), and z + t_z = size / spread, weighted by the spread.
        depth = torch.stack([torch.zeros_like(spread), torch.zeros_like(spread), spread], 1)
        one, none = torch.ones_like(spread), torch.zeros_like(spread)
        A = torch.cat([torch.stack([one, none, -centre[:, 0]], 1), torch.stack([none, one, -centre[:, 1]], 1), depth])
        b = torch.cat(
            [
                centre[:, 0] * middle[..., 2] - middle[..., 0],
                centre[:, 1] * middle[..., 2] - middle[..., 1],
                size - spread * middle[..., 2],
            ],
            1,
        )
        return torch.linalg.lstsq(A.expand(len(b), -1, -1), b[..., None]).solution[..., 0]

    def losses(self, rotations: Tensor, shifts: Tensor, count: int = _POINTS) -> Float[Tensor, " poses"]:
        """Mean distance of points from the mask and of mask pixels from the points, in normalized coordinates."""
        p = torch.einsum("rij,fpj->rfpi", rotations, self.points[:, :count]) + shifts[:, None, None]
        projected = p[..., :2] / p[..., 2:].clamp(min=NEAREST)
        height, width = self.outside.shape[1:]
        places = projected * self.scale[:2] + self.scale[2:]
        grid = 2.0 * places / torch.tensor([width, height]) - 1.0
        inside = (grid.abs() <= 1.0).all(-1)
        # One call samples the maps of all frames; poses are the rows of the grid.
        sampled = torch.nn.functional.grid_sample(
            self.outside[:, None], grid.transpose(0, 1), padding_mode="border", align_corners=False
        )[:, 0].transpose(0, 1)
        beyond = (sampled * inside).sum((1, 2)) / inside.sum((1, 2)).clamp(min=1)
        near = torch.cdist(self.pixels[:, :count].expand(len(p), -1, -1, -1), projected).amin(-1)
        return beyond + near.mean((1, 2))

    def refined(self, rotations: Tensor, shifts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rotations, translations and losses after gradient descent."""
        turns = torch.zeros(len(rotations), 3, requires_grad=True)
        moves = torch.zeros(len(rotations), 3, requires_grad=True)
        pivot = torch.einsum("rij,j->ri", rotations, self.points.mean((0, 1)))
        far = (pivot + shifts)[:, 2:].abs().clamp(min=NEAREST)

        def poses() -> tuple[Tensor, Tensor]:
            turn = torch.linalg.matrix_exp(_skew(turns))
            # Rotations are about the middle of the arm, and translations in units of its depth.
            return turn @ rotations, shifts + far * moves + pivot - (turn @ pivot[..., None])[..., 0]

        optimizer = torch.optim.Adam([turns, moves], lr=_RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _STEPS)
        for _ in range(_STEPS):
            optimizer.zero_grad()
            self.losses(*poses()).sum().backward()
            optimizer.step()
            schedule.step()
        with torch.no_grad():
            return (*poses(), self.losses(*poses()))


def _skew(vectors: Float[Tensor, "poses 3"]) -> Float[Tensor, "poses 3 3"]:
    x, y, z = vectors.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))


def _iou(renderer: Renderer, scene: Scene, arm: str, joints: np.ndarray, masks: Rows[np.ndarray]) -> float:
    """Mean IoU of masks and silhouettes."""
    scores = []
    for row, mask in zip(joints, masks, strict=True):
        others = {own.name: np.zeros(len(own.robot.joint_names)) for own in scene.arms}
        silhouette = renderer.segment(scene.with_cameras([renderer.scene.cameras[0].name]).state({**others, arm: row}))
        seen = silhouette[0] >= 0
        scores.append((seen & mask).sum() / max((seen | mask).sum(), 1))
    return float(np.mean(scores))
