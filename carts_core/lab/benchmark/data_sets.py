"""Benchmark on SurgPose and SurgSync: delay, hand-eye calibration, corrected joints and keypoint errors per recording.

SurgPose publishes dots painted on the instruments as keypoints. Their positions on the links are not published; they
are estimated together with the hand-eye calibration, from frames that are not scored. SurgSync publishes hand-eye
calibrations, which are used, and no keypoints.
"""

from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Several
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from ...errors import CartsError, SequenceError
from ...evaluation import Setup
from ...files import write_text
from ...model.camera import HALF_PIXEL, Camera, opencv_matrix
from ...model.scene import Arm, Scene
from ...networks import FeatureExtractor
from ...optimization import FreeParameters, SurfacePredictor, SurfaceSolver
from ...recording import (
    Sequence,
    TimeOffsetEstimate,
    calibrated_sequence_file,
    estimate_time_offsets,
    evenly_spaced,
    offsets_to_write,
)
from ...recording.annotations import read_annotations
from ...recording.importing.delays import with_delays
from ...recording.importing.importer import import_recording
from ...recording.sources.datasets import SURGPOSE, SURGSYNC
from ...settings.interchange import ImportOptions

SOURCES = {source.name: source for source in (SURGPOSE, SURGSYNC)}
_FIRST_DOT = {"PSM1": 1, "PSM3": 8}
"""Arm -> number of its first dot in SurgPose."""
_LINKS = {0: "roll_link", 1: "wrist_pitch_link", 2: "wrist_yaw_link", 5: "wrist_pitch_link", 6: "roll_link"}
"""Dot, counted from the first of the arm -> its link. Dots 3 and 4 are on the jaws, whose angle is not recorded."""
_CALIBRATION_FRAMES, _DOT_FRAMES = 30, 10
"""Number of frames for the hand-eye calibration, and for the positions of the dots."""
_MIN_DOTS = 12
"""Minimum number of keypoints in the first camera for a hand-eye calibration."""
_MIN_DOT_POINTS = 3
"""Minimum number of keypoints of a dot whose position is estimated."""
_NOMINAL = {0: (0.0, 0.0, -0.009), 6: (0.0, 0.0, -0.009)}
"""Dot -> approximate position in its link's frame [m]; other dots are near the origins of their links."""
_DOT_M, _DOT_PX = 0.003, 5.0
"""Standard deviations of approximate positions [m], and of keypoints predicted from measured joints [px]."""
_KEYPOINT_PX = 2.0
"""Standard deviation of published keypoints [px]."""
_JOINT_STD = {"revolute": 0.02, "prismatic": 0.001}
"""Standard deviations of measured joints [rad, m]."""
_NEAREST = 1e-3
"""Minimum depth in projections [m]."""


@dataclass(frozen=True)
class Keypoint:
    """Published position of a dot in an undistorted image."""

    frame: int
    camera: str
    dot: int
    """Number of the dot, counted from the first of the arm."""
    pixel: tuple[float, float]


@dataclass(frozen=True)
class KeypointError:
    """Mean distances between published and predicted keypoints."""

    px: float
    """In the images [px]."""
    mm: float | None
    """In space, for dots triangulated from both cameras [mm]; None without such dots."""
    keypoints: int
    """Number of keypoints in the images."""


@dataclass(frozen=True)
class ArmResult:
    """Results for an arm of a recording; fields are None if unknown."""

    recording: str
    arm: str
    delay: float | None
    """Estimated `time_offset` [s]."""
    delay_std: float | None
    delay_problem: str | None
    """Reason why the delay is unknown."""
    hand_eye: str
    """Origin of the base frame: `keypoints`, `published` or `none`."""
    hand_eye_px: float | None
    """RMS residual of the keypoints of the calibration [px]."""
    frames: int
    """Number of corrected frames."""
    rotation_deg: float | None
    """Median absolute correction of the measured revolute joints [deg]."""
    insertion_mm: float | None
    """Median absolute correction of the insertion [mm]."""
    measured: KeypointError | None
    """Error at the measured joint positions."""
    corrected: KeypointError | None
    """Error at the corrected joint positions."""


def recordings(folder: Path, data_set: str) -> list[Path]:
    """Recordings of a data set: the folder itself, or the folders below it.

    Raises:
        CartsError: the folder contains no recording.
    """
    detect = SOURCES[data_set].detect
    found = [folder] if detect(folder) else sorted(path for path in folder.glob("**/") if detect(path))
    if not found:
        raise CartsError(f"{folder} has no recording of {data_set}: {SOURCES[data_set].looked_for}.")
    return found


def bench_recording(
    path: Path,
    data_set: str,
    folder: Path,
    networks: FeatureExtractor | SurfacePredictor,
    frames: int,
    frame_rate: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> list[ArmResult]:
    """Evaluate a recording; its sequence files with the estimated delay and base frames are written into a folder.

    Args:
        path: folder of the recording, which is not changed.
        data_set: `surgpose` or `surgsync`.
        networks: networks or predictor of the optimizer.
        frames: number of frames that are corrected and scored.
        frame_rate: rate of images without times [1/s]; without it, the delay of such recordings is unknown.
        progress: called with a description of each step.

    Raises:
        CartsError: the recording is damaged or cannot be used.
    """
    progress("importing")
    options = ImportOptions(source=data_set, frame_rate=frame_rate)
    file, _ = import_recording(path, folder / "imported", options, overwrite=True, estimate_delays=False)
    sequence = Sequence.open(file)
    progress("delay")
    delays: dict[str, TimeOffsetEstimate] = {}
    no_delay = ""
    try:
        estimates = estimate_time_offsets(sequence)
        delays = {each.arm: each for each in estimates}
        if offsets := offsets_to_write(estimates, sequence):
            # Frames without rows at the new offset are left out by the import.
            file, _ = import_recording(path, folder / "imported", with_delays(options, offsets), overwrite=True)
            sequence = Sequence.open(file)
    except SequenceError as error:
        no_delay = str(error)
    keypoints, scored = _keypoints(path, sequence), evenly_spaced(len(sequence), min(frames, len(sequence)))
    progress("hand-eye")
    others = {arm: [point for point in points if point.frame not in scored] for arm, points in keypoints.items()}
    found = {arm: hand_eye(sequence, sequence.scene.arm(arm), points) for arm, points in others.items()}
    bases = {arm: result for arm, result in found.items() if result is not None}
    given = data_set == SURGSYNC.name
    if bases:
        arms = [
            replace(arm, T_world_base=bases[arm.name][0] if arm.name in bases else arm.T_world_base)
            for arm in sequence.scene.arms
        ]
        sequence = _rewritten(sequence, replace(sequence.scene, arms=tuple(arms)), folder / "calibrated")
    cameras = tuple(camera.name for camera in sequence.scene.cameras)
    setup = Setup(sequence, sequence.domains[0], cameras, networks, SurfaceSolver(), FreeParameters())
    usable = given or len(bases) == len(sequence.scene.arms)
    joints = _corrected(setup, scored if usable else [], progress)
    # The positions of the dots are estimated for both kinds of joint positions, from frames that are not
    # scored.
    dot_frames = sorted({point.frame for points in others.values() for point in points})
    dot_frames = [dot_frames[index] for index in evenly_spaced(len(dot_frames), min(_DOT_FRAMES, len(dot_frames)))]
    dot_joints = _corrected(setup, dot_frames if usable else [], progress)
    results = []
    for arm in sequence.scene.arms:
        delay = delays.get(arm.name) or delays.get("")
        points, (rotation, insertion) = keypoints.get(arm.name, []), _correction(sequence, arm, *joints)
        errors = [
            _error(sequence, arm, _dots(sequence, arm, points, other), points, each)
            for each, other in zip(joints, dot_joints, strict=True)
        ]
        results.append(
            ArmResult(
                recording=path.name,
                arm=arm.name,
                delay=None if delay is None or delay.problem else round(delay.seconds, 4),
                delay_std=None if delay is None or delay.problem else round(delay.deviation, 4),
                delay_problem=no_delay if delay is None else delay.problem,
                hand_eye="keypoints" if arm.name in bases else "published" if given else "none",
                hand_eye_px=bases[arm.name][1] if arm.name in bases else None,
                frames=len(joints[0]),
                rotation_deg=rotation,
                insertion_mm=insertion,
                measured=errors[0],
                corrected=errors[1],
            )
        )
    return results


def _rewritten(sequence: Sequence, scene: Scene, folder: Path) -> Sequence:
    """The sequence with another calibration, written into a folder."""
    text = calibrated_sequence_file(sequence.path, folder, sequence.scene, scene, "bench")
    write_text(folder / "sequence.toml", text)
    return Sequence.open(folder / "sequence.toml")


def _keypoints(path: Path, sequence: Sequence) -> dict[str, list[Keypoint]]:
    """Arm -> keypoints on links whose joints are recorded."""
    found: dict[str, list[Keypoint]] = {}
    for camera in sequence.scene.cameras:
        file = path / f"keypoints_{camera.name}.yaml"
        if not file.is_file():
            continue
        for annotation in read_annotations(file, sequence, camera.name, format="surgpose").frames:
            for arm, first in _FIRST_DOT.items():
                if arm not in sequence.measured:
                    continue
                for dot in _LINKS:
                    if (pixel := annotation.keypoints.get(str(first + dot))) is not None:
                        found.setdefault(arm, []).append(Keypoint(annotation.frame, camera.name, dot, pixel))
    return found


class _Projection:
    """Projection of the dots of an arm, for its keypoints in frames with joint positions."""

    def __init__(self, sequence: Sequence, arm: Arm, points: Several[Keypoint], joints: Float[np.ndarray, "n dofs"]):
        cameras = {camera.name: camera for camera in sequence.scene.cameras}
        self._robot, self._links = arm.robot, [arm.robot.link_names.index(_LINKS[point.dot]) for point in points]
        self.move(joints)
        self.Ts_camera_world = np.stack([cameras[point.camera].T_camera_world for point in points])
        self.intrinsics = np.array([cameras[point.camera].intrinsics for point in points])
        self.pixels = np.array([point.pixel for point in points])

    def move(self, joints: Float[np.ndarray, "n dofs"]) -> None:
        """Set the joint positions at each keypoint [rad, m]."""
        self.Ts_base_link = self._robot.forward_kinematics(joints)[np.arange(len(joints)), self._links]

    def distances(
        self, T_world_base: Float[np.ndarray, "4 4"], positions: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 2"]:
        """Differences of predicted and published keypoints [px], for positions in the frames of the links [m]."""
        local = np.concatenate([positions, np.ones((len(positions), 1))], 1)[..., None]
        seen = (self.Ts_camera_world @ T_world_base @ self.Ts_base_link @ local)[:, :3, 0]
        depth = np.maximum(seen[:, 2:], _NEAREST)
        return self.intrinsics[:, :2] * seen[:, :2] / depth + self.intrinsics[:, 2:] - self.pixels


def _robust(distances: Float[np.ndarray, "n 2"], deviation: float) -> Float[np.ndarray, " m"]:
    """Residuals whose squares grow linearly for outliers (soft L1)."""
    scaled = np.linalg.norm(distances, axis=1, keepdims=True) / deviation
    return (distances / deviation * np.sqrt(2.0 / (1.0 + np.sqrt(1.0 + scaled**2)))).ravel()


def hand_eye(
    sequence: Sequence, arm: Arm, keypoints: Several[Keypoint]
) -> tuple[Float[np.ndarray, "4 4"], float] | None:
    """Base frame `T_world_base` of an arm, and RMS residual at the measured joints [px]; None for too few keypoints.

    The errors of the measured joints in each frame and the positions of the dots on their links are also estimated,
    from zero and from approximate values. Otherwise, errors of joints become errors of the base frame.
    """
    frames = sorted({point.frame for point in keypoints})
    chosen = [frames[index] for index in evenly_spaced(len(frames), min(_CALIBRATION_FRAMES, len(frames)))]
    points = [point for point in keypoints if point.frame in chosen]
    first = sequence.scene.cameras[0]
    own = np.array([point.camera == first.name for point in points])
    if own.sum() < _MIN_DOTS:
        return None
    measured = np.asarray(sequence.measured[arm.name])[chosen]
    of_frame = np.array([chosen.index(point.frame) for point in points])
    projection = _Projection(sequence, arm, points, measured[of_frame])
    dots = sorted({point.dot for point in points})
    rows, nominal = np.array([dots.index(point.dot) for point in points]), _nominal(dots)
    joint_std = np.array([_JOINT_STD[type_] for type_ in arm.robot.joint_types])
    errors_from = 6 + 3 * len(dots)

    def distances(x: np.ndarray, errors: np.ndarray) -> np.ndarray:
        projection.move((measured + joint_std * errors)[of_frame])
        return projection.distances(_pose(x[:6]), (nominal + _DOT_M * x[6:errors_from].reshape(-1, 3))[rows])

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.concatenate([_robust(distances(x, x[errors_from:].reshape(measured.shape)), _KEYPOINT_PX), x[6:]])

    p_base = (projection.Ts_base_link @ np.c_[nominal[rows], np.ones(len(rows))][..., None])[:, :3, 0]
    K = opencv_matrix(first.intrinsics)
    _, turn, shift = cv2.solvePnP(p_base[own], projection.pixels[own] - HALF_PIXEL, K, None, flags=cv2.SOLVEPNP_SQPNP)
    T = np.linalg.inv(first.T_camera_world) @ _pose(np.concatenate([turn.ravel(), shift.ravel()]))
    start = np.zeros(errors_from + measured.size)
    start[:6] = *Rotation.from_matrix(T[:3, :3]).as_rotvec(), *T[:3, 3]
    # A keypoint depends on the errors of its own frame only.
    own_errors = np.repeat(np.eye(len(chosen))[of_frame], measured.shape[1], axis=1)
    of_points = np.concatenate([np.ones((len(points), errors_from)), own_errors], 1)
    sparsity = csr_array(np.concatenate([np.repeat(of_points, 2, axis=0), np.eye(len(start))[6:]]))
    fit = least_squares(residuals, start, x_scale="jac", jac_sparsity=sparsity)
    remaining = distances(fit.x, np.zeros_like(measured))
    return _pose(fit.x[:6]), float(np.sqrt(np.square(remaining).sum(1).mean()))


def _nominal(dots: Several[int]) -> Float[np.ndarray, "dots 3"]:
    return np.array([_NOMINAL.get(dot, (0.0, 0.0, 0.0)) for dot in dots])


def _dots(
    sequence: Sequence, arm: Arm, keypoints: Several[Keypoint], joints: "Joints"
) -> dict[int, Float[np.ndarray, "3"]]:
    """Dot -> position in its link's frame [m], estimated from the frames with joint positions."""
    found = {}
    for dot in _LINKS:
        points = [point for point in keypoints if point.dot == dot and point.frame in joints]
        if len(points) < _MIN_DOT_POINTS:
            continue
        positions = np.stack([joints[point.frame][arm.name] for point in points])
        projection, nominal = _Projection(sequence, arm, points, positions), _nominal([dot])[0]

        def residuals(x: np.ndarray, projection: _Projection = projection, nominal: np.ndarray = nominal) -> np.ndarray:
            distances = projection.distances(arm.T_world_base, np.tile(x, (len(projection.pixels), 1)))
            return np.concatenate([_robust(distances, _DOT_PX), (x - nominal) / _DOT_M])

        found[dot] = least_squares(residuals, nominal, x_scale=_DOT_M).x
    return found


def _pose(values: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Transform from a rotation vector and a translation [rad, m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(values[:3]).as_matrix(), values[3:]
    return T


Joints = dict[int, Mapping[str, np.ndarray]]
"""Frame -> arm -> joint positions [rad, m]."""


def _corrected(setup: Setup, frames: Several[int], progress: Callable[[str], None]) -> tuple[Joints, Joints]:
    """Measured and corrected joint positions of frames, jointly over all cameras."""
    measured, corrected = {}, {}
    for number, index in enumerate(frames, start=1):
        progress(f"frame {number} of {len(frames)}")
        frame = setup.frame(index)
        best = setup.solved(frame).best
        assert best is not None
        measured[index], corrected[index] = frame.measured, best.joint_positions()
    return measured, corrected


def _correction(sequence: Sequence, arm: Arm, measured: Joints, corrected: Joints) -> tuple[float | None, float | None]:
    """Median absolute correction of the measured revolute joints [deg] and of the insertion [mm]."""
    if not corrected:
        return None, None
    change = np.abs([corrected[frame][arm.name] - measured[frame][arm.name] for frame in corrected])
    recorded = [name in sequence.measured_joints[arm.name] for name in arm.robot.joint_names]
    kinds = np.array(arm.robot.joint_types)
    rotation, insertion = (change[:, (kinds == kind) & recorded] for kind in ("revolute", "prismatic"))
    return float(np.degrees(np.median(rotation))), float(1e3 * np.median(insertion))


def _error(
    sequence: Sequence,
    arm: Arm,
    dots: Mapping[int, Float[np.ndarray, "3"]],
    keypoints: Several[Keypoint],
    joints: Joints,
) -> KeypointError | None:
    """Error of the predicted keypoints in the frames with joint positions; None without keypoints."""
    points = [point for point in keypoints if point.frame in joints and point.dot in dots]
    if not points:
        return None
    projection = _Projection(sequence, arm, points, np.stack([joints[point.frame][arm.name] for point in points]))
    positions = np.stack([dots[point.dot] for point in points])
    pixels = np.linalg.norm(projection.distances(arm.T_world_base, positions), axis=1)
    local = np.c_[positions, np.ones(len(points))][..., None]
    p_world = (arm.T_world_base @ projection.Ts_base_link @ local)[:, :3, 0]
    cameras = {camera.name: camera for camera in sequence.scene.cameras}
    seen: dict[tuple[int, int], list[int]] = {}
    for row, point in enumerate(points):
        seen.setdefault((point.frame, point.dot), []).append(row)
    millimetres = [
        1e3
        * np.linalg.norm(
            _triangulated([(cameras[points[row].camera], points[row].pixel) for row in rows]) - p_world[rows[0]]
        )
        for rows in seen.values()
        if len(rows) > 1
    ]
    return KeypointError(float(pixels.mean()), float(np.mean(millimetres)) if millimetres else None, len(points))


def _triangulated(seen: Several[tuple[Camera, tuple[float, float]]]) -> Float[np.ndarray, "3"]:
    """Position of a point in the world [m], from its pixels in undistorted images of two cameras."""
    projections = [camera.K @ camera.T_camera_world[:3] for camera, _ in seen[:2]]
    pixels = [np.array(pixel, np.float64)[:, None] for _, pixel in seen[:2]]
    found = cv2.triangulatePoints(*projections, *pixels)
    return (found[:3] / found[3]).ravel()


_HEADINGS = (
    "recording",
    "arm",
    "delay [s]",
    "hand-eye",
    "residual [px]",
    "frames",
    "rotation [deg]",
    "insertion [mm]",
    "measured [px]",
    "measured [mm]",
    "corrected [px]",
    "corrected [mm]",
)


def table(results: Several[ArmResult]) -> Iterator[str]:
    """Lines of a Markdown table with one row per arm of a recording; unknown values are empty."""

    def shown(value: float | None, digits: int = 2) -> str:
        return "" if value is None else f"{value:.{digits}f}"

    yield "| " + " | ".join(_HEADINGS) + " |"
    yield "|" + "---|" * len(_HEADINGS)
    for result in results:
        delay = shown(result.delay, 3) + (f" ± {result.delay_std:.3f}" if result.delay_std is not None else "")
        errors = [
            shown(None if error is None else value)
            for error in (result.measured, result.corrected)
            for value in ((None, None) if error is None else (error.px, error.mm))
        ]
        cells = [result.recording, result.arm, delay, result.hand_eye, shown(result.hand_eye_px), str(result.frames)]
        yield "| " + " | ".join([*cells, shown(result.rotation_deg), shown(result.insertion_mm), *errors]) + " |"
