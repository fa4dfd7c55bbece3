"""Prompts for landmarks to click, and the calibration computed after each click."""

from collections.abc import Sequence as Rows
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from carts_core.errors import CartsError
from carts_core.model.keypoints import SHAFT_EDGE, TIP, LandmarkKind, landmarks
from carts_core.model.scene import Scene
from carts_core.optimization.hand_eye import (
    HandEyeResult,
    HandEyeSettings,
    ImagePoint,
    mounts_of_points,
    moved_cameras,
    result_json,
    solve_hand_eye,
)
from carts_core.optimization.hand_eye.files import STATIONARY_TOLERANCE
from carts_core.recording import Sequence, evenly_spaced

_FRAMES = 4
"""Number of frames to click in the first camera."""
_FURTHER_FRAMES = 2
"""Number of frames to click in each other camera."""
_COMPARED_FRAMES = 50
"""Number of frames among which the most frequent camera pose is sought."""


@dataclass(frozen=True)
class ClickPrompt:
    """A landmark to click, in a frame of a camera."""

    camera: str
    frame: int
    arm: str
    landmark: str

    @staticmethod
    def of(point: ImagePoint) -> "ClickPrompt":
        """The prompt of a point."""
        return ClickPrompt(point.camera, point.frame, point.arm, point.landmark)

    @property
    def key(self) -> str:
        """Unique name of the prompt; names of cameras and arms do not contain slashes."""
        return f"{self.camera}/{self.frame}/{self.arm}/{self.landmark}"


class Clicking:
    """The planned points, the next point to click, and the calibration computed from clicked points.

    Attributes:
        sequence: the recording, with placeholder base frames.
        frames: frames with the same camera poses, for prompts.
        plan: all prompts, in order.
        result: calibration from the points; None if there are too few points.
        content: the result as `carts hand-eye` writes it; empty without a result.
        problem: cause of a missing result.
    """

    def __init__(self, sequence: Sequence, *, focal_length: bool = False) -> None:
        self.sequence = sequence
        self.frames = _stationary(sequence)
        self.plan = _plan(sequence, self.frames)
        self.result: HandEyeResult | None = None
        self.content: dict[str, Any] = {}
        self.problem = ""
        self._settings = HandEyeSettings(focal_length=focal_length, free_cameras=unknown_cameras(sequence.scene))

    @property
    def scene(self) -> Scene:
        """The scene with the calibration so far."""
        return self.sequence.scene if self.result is None else self.result.scene

    def free_focal_length(self, free: bool) -> None:
        """Set whether `solve` also estimates focal lengths."""
        self._settings = replace(self._settings, focal_length=free)

    def next_prompt(self, points: Rows[ImagePoint], skipped: frozenset[ClickPrompt]) -> ClickPrompt | None:
        """The first prompt that is neither clicked nor skipped; None if there is none."""
        done = {ClickPrompt.of(point) for point in points} | skipped
        return next((prompt for prompt in self.plan if prompt not in done), None)

    def move_frame(self, camera: str, frame: int, other: int) -> None:
        """Move the prompts of a frame to another frame."""
        self.plan = tuple(
            replace(prompt, frame=other) if (prompt.camera, prompt.frame) == (camera, frame) else prompt
            for prompt in self.plan
        )

    def solve(self, points: Rows[ImagePoint]) -> None:
        """Compute the calibration from the points, which must be in frames with the same camera poses."""
        self.result, self.content, self.problem = None, {}, ""
        try:
            mounts = mounts_of_points(self.sequence, points)
            scene = moved_cameras(self.sequence.scene, mounts)
            result = solve_hand_eye(scene, self.sequence.measured, points, self._settings)
            # Written poses of arms in cameras are those at the time of the points.
            self.content = result_json(self.sequence, points, result, self._settings.free_cameras)
            self.result = replace(result, scene=moved_cameras(result.scene, mounts, back=True))
        except CartsError as error:
            self.problem = str(error)

    def names(self, arm: str) -> tuple[str, ...]:
        """Names of all landmarks of an arm."""
        return tuple(landmarks(self.sequence.scene.arm(arm)))

    def hint(self, arm: str, landmark: str) -> str:
        """Description of a landmark."""
        return landmarks(self.sequence.scene.arm(arm))[landmark].hint


def unknown_cameras(scene: Scene) -> tuple[str, ...]:
    """Cameras with unknown pose; in the recording they have the pose of the first camera."""
    first = scene.cameras[0]
    return tuple(
        camera.name for camera in scene.cameras[1:] if np.array_equal(camera.T_camera_world, first.T_camera_world)
    )


def _stationary(sequence: Sequence) -> frozenset[int]:
    """Frames of the first camera's images with the most frequent pose of the moving cameras."""
    present = sequence.frames_of(sequence.scene.cameras[0].name)
    mounts = np.array([[*sequence.mounts(frame).values()] for frame in present]).reshape(len(present), -1)
    # With half the tolerance of each, two frames differ by at most the tolerance.
    alike = [
        np.abs(mounts - mounts[row]).max(axis=1, initial=0.0) <= STATIONARY_TOLERANCE / 2
        for row in evenly_spaced(len(present), _COMPARED_FRAMES)
    ]
    return frozenset(present[row] for row in np.flatnonzero(max(alike, key=np.sum)))


def _plan(sequence: Sequence, usable: frozenset[int]) -> tuple[ClickPrompt, ...]:
    """Prompts in frames with arm positions far from each other."""
    scene = sequence.scene
    arms = [arm for arm in scene.arms if len(sequence.measured[arm.name])]
    tips = np.concatenate(
        [arm.robot.forward_kinematics(sequence.measured[arm.name])[:, -1, :3, 3] for arm in arms], axis=-1
    )
    unknown = unknown_cameras(scene)
    prompts = []
    for number, camera in enumerate(scene.cameras):
        if number and camera.name not in unknown:
            # The first camera suffices for a calibrated pair.
            continue
        if not (present := [frame for frame in sequence.frames_of(camera.name) if frame in usable]):
            continue
        frames = [present[row] for row in spread_out(tips[present], _FRAMES)]
        chosen = frames if number == 0 else [frames[row] for row in (0, -1)][:_FURTHER_FRAMES]
        for frame in dict.fromkeys(chosen):
            prompts += [
                ClickPrompt(camera.name, frame, arm.name, name) for arm in arms for name in _prompted(scene, arm.name)
            ]
    return tuple(prompts)


def _prompted(scene: Scene, arm: str) -> list[str]:
    """The prompted landmarks: tip, end of the shaft, and edge of the shaft."""
    known = landmarks(scene.arm(arm))
    joints = [name for name, mark in known.items() if mark.kind is LandmarkKind.POINT and name != TIP]
    return [name for name in (TIP, *joints[-1:], SHAFT_EDGE) if name in known]


def spread_out(positions: Rows[np.ndarray] | np.ndarray, count: int) -> list[int]:
    """Sorted rows of positions far from each other, by farthest-point sampling from the most central position."""
    points = np.asarray(positions, float)
    chosen = [int(np.linalg.norm(points - np.median(points, axis=0), axis=1).argmin())]
    while len(chosen) < min(count, len(points)):
        distances = np.min([np.linalg.norm(points - points[row], axis=1) for row in chosen], axis=0)
        chosen.append(int(distances.argmax()))
    return sorted(chosen)
