"""Fits of robot arms to an image, or to a frame of a recording, in one call."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, UInt8
from numpy.typing import ArrayLike

from ..model.camera import Camera
from ..model.scene import Scene
from ..networks import FeatureExtractor
from ..optimization import Backgrounds, FrameOptimizer, MaskPredictor, SurfacePredictor, check_domain
from ..optimization.predictor import predictor_of
from ..recording import Frame
from ..recording import Sequence as Recording
from ..rendering import Renderer
from ..settings import FreeParameters, SolverSettings, SurfaceSolver
from .inputs import (
    CAMERA,
    ImageInput,
    JointInput,
    MaskInput,
    RobotInput,
    arms_of,
    binary_mask,
    camera_of,
    check_size,
    rgb_image,
)
from .result import NOT_IN_VIEW, Fit

_UNKNOWN_ROBOT = "Give a mask of the arms (mask=...), or weights trained for this robot (networks=...)."


def fit(
    image: ImageInput,
    *,
    K: ArrayLike | Camera,
    T_camera_base: ArrayLike | Mapping[str, ArrayLike],
    urdf: RobotInput | Mapping[str, RobotInput],
    joints: JointInput | Mapping[str, JointInput],
    pixel_center: float | None = None,
    distortion: Sequence[float] = (),
    background: ImageInput | None = None,
    mask: MaskInput | None = None,
    ignore: MaskInput | None = None,
    base_link: str | Mapping[str, str | None] | None = None,
    settings: SolverSettings | None = None,
    free: FreeParameters | None = None,
    networks: FeatureExtractor | SurfacePredictor | None = None,
) -> Fit:
    """Correct the joint positions of robot arms so that their rendering matches an image.

    **Pixels.** `K` is in OpenCV's convention, as from `cv2.calibrateCamera`, ROS and Kalibr: the centre of the first
    pixel is at (0, 0). If it is at (0.5, 0.5), as in COLMAP, most renderers and `Camera.K`, give `pixel_center=0.5`;
    otherwise all results are wrong by half a pixel. A `Camera` as `K` needs no convention.

    **Several arms.** Give `T_camera_base` and `joints`, and `urdf` for different robots, as mappings from arm name.

    Args:
        image: RGB image [height, width, 3] of type uint8, or a path. OpenCV reads BGR: pass `image[..., ::-1]`.
        K: intrinsic matrix [3, 3], or fx, fy, cx, cy [px], or a `Camera`, whose size, intrinsics and distortion
            are used.
        T_camera_base: transform from an arm's base to the camera [4, 4] [m] (OpenCV's axes: x right, y down,
            z forward).
        urdf: path of the arm's URDF, `builtin:NAME` (see `carts robots`), or a `Robot`.
        joints: measured joint positions [rad, m], in the order of the URDF or by joint name. Mimic joints are left
            out.
        pixel_center: coordinate of the centre of the first pixel in the convention of `K`: 0 (OpenCV, default) or 0.5.
        distortion: OpenCV's coefficients k1 k2 p1 p2 [k3 ...] of the image.
        background: image of the same view without arms, to discount false detections.
        mask: mask of all arms, which is fitted instead of the network's prediction; for robots that the network does
            not know.
        ignore: mask of pixels that show an occluder.
        base_link: link to which `T_camera_base` refers; by default the root of the URDF.
        settings: the solver, `SurfaceSolver()` by default.
        free: free parameters, all joints by default.
        networks: the networks, or a predictor of surface maps; the shipped networks by default, loaded once.

    Returns:
        Result with `mask`, `joints`, `std`, `verdict` and `plot()`. If the fit has failed, it holds the measured joint
        positions, unless they fit worse.

    Raises:
        SettingsError: an argument has a wrong type, shape or value.
        SequenceError: an image or mask file is missing, damaged or too large.
        RobotError: the URDF is invalid, or joint positions do not match it.

    Warns:
        UserWarning: `K` is unusual or probably in the other convention, joint positions exceed the limits, no arm is in
            view, or the network does not know the robot. The texts are also in `Fit.remarks`.
    """
    picture = rgb_image(image, "image")
    camera, remarks = camera_of(K, picture, pixel_center, distortion)
    arms = arms_of(T_camera_base, urdf, joints, base_link)
    empty = None if background is None else _straight(rgb_image(background, "background"), "background", camera)
    target = None if mask is None else _straight(binary_mask(mask, "mask"), "mask", camera)
    occluder = None if ignore is None else _straight(binary_mask(ignore, "mask to ignore"), "mask to ignore", camera)
    scene = Scene(arms.arms, (replace(camera, distortion=()),))
    frame = Frame(
        index=0,
        frame_id="image",
        domain="image",
        images={CAMERA: camera.undistort(picture)},
        measured=arms.joints,
        truth=None,
        masks=None if target is None else {CAMERA: target},
        timestamp=None,
    )
    problem = _Problem(scene, frame, camera, picture, settings or SurfaceSolver(), _predictor(target, networks))
    backgrounds = Backgrounds({} if empty is None else {CAMERA: empty})
    remarks = [*remarks, *arms.remarks, *problem.remarks(backgrounds)]
    for remark in remarks:
        warnings.warn(remark, UserWarning, stacklevel=2)
    found = problem.solved(backgrounds, occluder, free)
    return replace(found, single=arms.single, by_name=arms.by_name, remarks=tuple(remarks))


def fit_frame(
    sequence: Recording,
    index: int = 0,
    *,
    camera: str | None = None,
    domain: str | None = None,
    mask: MaskInput | None = None,
    ignore: MaskInput | None = None,
    settings: SolverSettings | None = None,
    free: FreeParameters | None = None,
    networks: FeatureExtractor | SurfacePredictor | None = None,
) -> Fit:
    """Correct the joint positions of a recording's arms in one frame, seen by one camera.

    The background is estimated from the recording, or is the image given in the sequence file. Consecutive frames are
    corrected more accurately together, by `carts_core.optimization.SequenceOptimizer`.

    Args:
        sequence: the recording, opened by `carts_core.open`.
        index: 0-based position of the frame.
        camera: name of the camera, the first by default.
        domain: domain of the image, the first by default.
        mask, ignore, settings, free, networks: as in `fit`; masks refer to the undistorted image.

    Returns:
        Result with the undistorted image; joint positions are dictionaries of arrays, by arm.

    Raises:
        SequenceError: there is no such frame, camera or domain, or an image is missing or damaged.
        SettingsError: an argument has a wrong type, shape or value.

    Warns:
        UserWarning: no arm is in view, or, in the first fit of a camera and domain, the network does not know the
            robot.
    """
    name = sequence.scene.cameras[0].name if camera is None else camera
    frame = sequence.frame(index, domain, [name])
    scene = sequence.scene.with_cameras([name])
    recorded, picture = scene.cameras[0], frame.images[name]
    target = None if mask is None else _straight(binary_mask(mask, "mask"), "mask", recorded)
    occluder = None if ignore is None else _straight(binary_mask(ignore, "mask to ignore"), "mask to ignore", recorded)
    frame = replace(frame, masks=None if target is None else {name: target})
    problem = _Problem(scene, frame, recorded, picture, settings or SurfaceSolver(), _predictor(target, networks))
    required = not isinstance(problem.settings, SurfaceSolver)
    backgrounds = Backgrounds.of(sequence, [name], frame.domain, required=required)
    checked = _CHECKED.setdefault(sequence, set())
    remarks = problem.remarks(backgrounds, known=(name, frame.domain) in checked)
    checked.add((name, frame.domain))
    for remark in remarks:
        warnings.warn(remark, UserWarning, stacklevel=2)
    return replace(problem.solved(backgrounds, occluder, free), remarks=tuple(remarks))


_CHECKED: WeakKeyDictionary[Recording, set[tuple[str, str]]] = WeakKeyDictionary()
"""Recording -> cameras and domains in which the network's domain was checked."""


def open(sequence: Path | str, *, progress: Callable[[str], None] | None = None) -> Recording:
    """Open a recording by its sequence file; `carts import` writes one for recordings in other formats.

    Args:
        sequence: the sequence file (TOML, `docs/reference/sequence_format.md`).
        progress: called with a line of progress.

    Raises:
        SequenceError: the file, or a file that it refers to, is missing or invalid.
        RobotError: a robot or one of its meshes is missing or invalid.
    """
    return Recording.open(sequence, progress=progress)


@cache
def _shipped_networks() -> FeatureExtractor:
    return FeatureExtractor.load()


def _predictor(
    mask: Bool[np.ndarray, "height width"] | None, networks: FeatureExtractor | SurfacePredictor | None
) -> FeatureExtractor | SurfacePredictor:
    if mask is not None:
        return MaskPredictor(None if networks is None else predictor_of(networks))
    return _shipped_networks() if networks is None else networks


def _straight(array: np.ndarray, what: str, camera: Camera) -> np.ndarray:
    """Undistorted background or mask of the camera's size."""
    check_size(array, what, camera)
    return camera.undistort(array)


@dataclass(frozen=True)
class _Problem:
    """A frame of one camera, before it is solved."""

    scene: Scene
    frame: Frame
    camera: Camera
    """Camera of `picture`."""
    picture: UInt8[np.ndarray, "height width 3"]
    settings: SolverSettings
    predictor: FeatureExtractor | SurfacePredictor

    def remarks(self, backgrounds: Backgrounds, *, known: bool = False) -> list[str]:
        """Remarks on the pose of the arms and, unless `known`, on the network's domain."""
        if not self._in_view(self.scene):
            return [f"no arm is in view at the measured joints.{self._inverse_hint()} {NOT_IN_VIEW}"]
        if known or self.frame.masks is not None or not isinstance(self.settings, SurfaceSolver):
            return []
        checked = check_domain(self.scene, self.frame, self.predictor, self.settings)
        return checked.warnings("image", _UNKNOWN_ROBOT, background=backgrounds.covers(self.scene))

    def solved(
        self, backgrounds: Backgrounds, ignore: Bool[np.ndarray, "height width"] | None, free: FreeParameters | None
    ) -> Fit:
        """Run the optimizer to completion."""
        (camera,) = self.scene.cameras
        optimizer = FrameOptimizer(
            self.scene,
            self.frame,
            backgrounds,
            self.predictor,
            ignore=None if ignore is None else {camera.name: ignore},
            settings=self.settings,
            free=free,
            live=False,
        )
        for _ in optimizer:
            pass
        assert optimizer.best is not None and optimizer.stop_reason is not None
        start = self.scene.state(self.frame.measured, mounts=self.frame.mounts)
        ended = optimizer.best, optimizer.stop_reason, optimizer.assessment
        return Fit(self.picture, self.scene, self.camera, start, self.frame.measured, *ended)

    def _in_view(self, scene: Scene) -> bool:
        state = scene.state(self.frame.measured, mounts=self.frame.mounts)
        return bool((Renderer(scene).segment(state) >= 0).any())

    def _inverse_hint(self) -> str:
        """Sentence for the case that T_base_camera was given instead of T_camera_base."""
        if self.frame.mounts:
            return ""
        T_camera_world = self.scene.cameras[0].T_camera_world
        arms = [
            replace(arm, T_world_base=np.linalg.inv(T_camera_world) @ np.linalg.inv(T_camera_world @ arm.T_world_base))
            for arm in self.scene.arms
        ]
        if not self._in_view(replace(self.scene, arms=tuple(arms))):
            return ""
        return " With the inverse transforms an arm is in view, so T_base_camera may have been given."
