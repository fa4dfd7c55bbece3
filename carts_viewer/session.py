"""The frames of a recording with their poses in the project, and the storage of the project."""

import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from carts_core.errors import CartsError, ProjectError, SequenceError
from carts_core.model.perturbation import perturb
from carts_core.model.scene import Scene, SceneState
from carts_core.project import (
    CorrectedIntrinsics,
    CorrectedTransform,
    DamagedProject,
    Edits,
    IgnoreRegion,
    JointCorrection,
    Key,
    Project,
    ProjectState,
    Provenance,
    ReviewState,
    default_path,
    rescued_copies,
)
from carts_core.project.state import calibrated_scene, corrected_state, source_of
from carts_core.recording import Frame, FrameReader, Sequence
from carts_core.settings import FreeParameters
from carts_viewer.editing import Editor, People, Person
from carts_viewer.jobs.choices import Observed
from carts_viewer.start.roots import Roots
from carts_viewer.state import NETWORK, Pose, Target, joint_range

_JOINTS_ALONE = FreeParameters()


class Session:
    """Frames of a sequence with their corrections from the project.

    A frame's pose is the measured pose until it is corrected; corrections do not depend on camera or domain.

    Attributes:
        scene: arms and cameras of the sequence.
        editor: edits the project and holds the unsaved draft.
        ranges: allowed range of each joint, by arm.
        roots: folders from which files may be imported, the sequence's own included.
    """

    def __init__(
        self, sequence: Sequence, people: People, person: Person | None = None, folders: Iterable[Path] = ()
    ) -> None:
        """`folders`: further folders from which files may be imported."""
        self._sequence = sequence
        self._own_offset = None if sequence.matching is None else sequence.matching.time_offset
        self.scene: Scene = sequence.scene
        self.editor = Editor(people, person or people.join())
        self.ranges = {
            arm.name: tuple(joint_range(arm, joint) for joint in range(len(arm.robot.joint_names)))
            for arm in self.scene.arms
        }
        self._reader = FrameReader(sequence)
        self._accepted: tuple[ProjectState, Frame, SceneState | None] | None = None
        """State of the project, frame, and its accepted state."""
        self.roots = Roots([sequence.path.parent, *folders])

    @property
    def time_offset(self) -> float | None:
        """Time in the kinematics table minus time of the image [s]; None if rows are not matched by time."""
        chosen = self.editor.view.get(Key.time_offset())
        return self._own_offset if chosen is None or self._own_offset is None else chosen.seconds

    @property
    def sequence(self) -> Sequence:
        """The recording, with joint positions matched to frames by `time_offset`.

        Raises:
            SequenceError: with this offset, a frame has no joint positions.
        """
        self._follow()
        return self._sequence

    def matched(self, frame: Frame) -> bool:
        """Whether the frame has the joint positions of the current time offset."""
        measured = self.sequence.measured
        return all(np.array_equal(values, measured[arm][frame.index]) for arm, values in frame.measured.items())

    def frame(self, index: int, domain: str, camera: str) -> Frame:
        """The frame with the images of all cameras, or only that of `camera` if another image is not usable.

        The following frames are prefetched.

        Raises:
            SequenceError: the image of that camera is not usable.
        """
        self._follow()
        try:
            return self._reader.frame(index, domain, *(own.name for own in self.scene.cameras))
        except SequenceError:
            return self._reader.frame(index, domain, camera)

    def close(self) -> None:
        """Stop prefetching frames, and save unfinished edits.

        Raises:
            ProjectError: the edits could not be saved.
        """
        self._reader.close()
        self.editor.save()

    def pose(self, frame: Frame, project: ProjectState | None = None) -> Pose:
        """The frame's pose in a state of the project, by default the current state with the draft."""
        project = self.editor.view if project is None else project
        state = corrected_state(self.scene, frame, project)
        return Pose(state, source_of(project, frame.index))

    def ignored(
        self, index: int, cameras: Iterable[str], target: Target = NETWORK
    ) -> dict[str, Bool[np.ndarray, "height width"]]:
        """Camera -> pixels of the frame that a fit ignores, for cameras with such pixels."""
        cameras = list(cameras)
        return target.ignored(self.ignore_regions(index, cameras), index, cameras)

    def ignore_regions(self, index: int, cameras: Iterable[str]) -> dict[str, IgnoreRegion]:
        """Camera -> ignore region of the frame, for cameras with such a region."""
        regions = {camera: self.editor.view.get(Key.ignore_region(index, camera)) for camera in cameras}
        return {camera: region for camera, region in regions.items() if region is not None}

    def target(self, observed: Observed, project: ProjectState | None = None) -> Target:
        """The chosen target of a run, with the masks of a state of the project, by default the current state."""
        return Target.of(observed, self.editor.view if project is None else project, self.sequence)

    def measured(self, frame: Frame) -> SceneState:
        """The frame's measured state, with the project's calibration."""
        return calibrated_scene(self.scene, self.editor.view).state(frame.measured, None, frame.mounts)

    def accepted(self, frame: Frame) -> SceneState | None:
        """The frame's state at its last acceptance.

        None if it was never accepted, or if the project is read-only and the frame is not accepted.
        """
        view = self.editor.view
        if self._accepted is None or self._accepted[:2] != (view, frame):
            past = view if view.review(frame.index).state is ReviewState.ACCEPTED else None
            past = past or self.editor.project.accepted(frame.index)
            self._accepted = view, frame, None if past is None else corrected_state(self.scene, frame, past)
        return self._accepted[2]

    def edits(
        self,
        frame: Frame,
        state: SceneState,
        provenance: Provenance,
        joint_std: Mapping[str, Float[np.ndarray, " dofs"]] | None = None,
        free: FreeParameters = _JOINTS_ALONE,
    ) -> dict[Key[Any], Any]:
        """Edits that set the frame's pose.

        Unchanged values keep their provenance; joints with their measured values get no correction.

        Args:
            frame: the frame.
            state: its new pose.
            provenance: provenance of the changed values.
            joint_std: arm -> standard deviations [rad, m], NaN if unknown.
            free: free parameters; other arms and groups of the calibration are not edited, since `state` may contain
                their earlier values.
        """
        saved = self.editor.project.state
        before, measured = self.pose(frame, saved).scene, self.scene.state(frame.measured, None, frame.mounts)
        edits: dict[Key[Any], Any] = {}
        for row, arm in enumerate(self.scene.arms):
            key, values = Key.joints(frame.index, arm.name), state.joint_positions[row]
            if any(free.frees(arm.name, joint) for joint in arm.robot.joint_names):
                if np.array_equal(values, before.joint_positions[row]):
                    edits[key] = saved.get(key)
                elif np.array_equal(values, measured.joint_positions[row]):
                    edits[key] = None
                else:
                    edits[key] = joint_correction(values, provenance, (joint_std or {}).get(arm.name))
            if free.base_frames and not np.array_equal(state.T_world_base[row], before.T_world_base[row]):
                edits[Key.base_frame(arm.name)] = _transform(state.T_world_base[row], provenance)
        for row, camera in enumerate(self.scene.cameras):
            transform, intrinsics = state.T_camera_world[row], state.intrinsics[row]
            if free.extrinsics and not np.array_equal(transform, before.T_camera_world[row]):
                edits[Key.extrinsics(camera.name)] = _transform(transform, provenance)
            if free.intrinsics and not np.array_equal(intrinsics, before.intrinsics[row]):
                edits[Key.intrinsics(camera.name)] = CorrectedIntrinsics(tuple(intrinsics.tolist()), provenance)
        return edits

    def saved(self, index: int) -> Edits:
        """Edits that restore the saved joints, verdict and review of a frame, and the calibration."""
        arms = [arm.name for arm in self.scene.arms]
        cameras = [camera.name for camera in self.scene.cameras]
        keys: list[Key[Any]] = [make(name) for make in (Key.extrinsics, Key.intrinsics) for name in cameras]
        keys += [Key.base_frame(arm) for arm in arms] + [Key.joints(index, arm) for arm in arms] + [Key.review(index)]
        saved = self.editor.project.state
        return {**{key: saved.get(key) for key in keys}, Key.verdict(index): saved.verdict(index)}

    def copied(self, frame: Frame, source: Frame) -> SceneState:
        """The frame's measured state with the correction of the source frame, clamped to the joint limits.

        Raises:
            CartsError: the source frame has no correction.
        """
        corrections = self.editor.view.joints(source.index)
        if not corrections:
            raise CartsError(f"Frame {source.frame_id} has no correction to copy. Correct it first.")
        values = {}
        for name, correction in corrections.items():
            here = np.asarray(frame.measured[name], np.float64)
            low, high = self.scene.arm(name).robot.joint_limits.T
            moved = here + np.array(correction.joint_positions) - source.measured[name]
            values[name] = np.clip(moved, np.minimum(low, here), np.maximum(high, here))
        return self.with_joints(self.measured(frame), values)

    def with_joint(self, state: SceneState, arm: str, joint: int, value: float) -> SceneState:
        """The state with one joint [rad or m] set, clamped to its limits."""
        limits = self.ranges[self.scene.arm(arm).name][joint]
        values = {name: joints.copy() for name, joints in self.joints(state).items()}
        values[arm][joint] = min(max(value, limits.lower), limits.upper)
        return self.with_joints(state, values)

    def with_joints(self, state: SceneState, values: dict[str, Float[np.ndarray, " dofs"]]) -> SceneState:
        """The state with the joint positions [rad, m] of the named arms replaced, not clamped."""
        return replace(
            state,
            joint_positions=tuple(
                np.asarray(values[arm.name], np.float32) if arm.name in values else old
                for arm, old in zip(self.scene.arms, state.joint_positions, strict=True)
            ),
        )

    def perturbed(self, state: SceneState, index: int, degrees: float, seed: int) -> SceneState:
        """The state with every measured joint offset by `degrees` [deg] or by as many millimetres, with random signs.

        For the same seed, the signs are those of `carts evaluate`.
        """
        joints = perturb(self.scene, self.joints(state), degrees, (seed, index), self.sequence.measured_joints)
        return self.with_joints(state, joints)

    def joints(self, state: SceneState) -> dict[str, Float[np.ndarray, " dofs"]]:
        """Joint positions [rad, m] by arm name."""
        return {
            arm.name: values.astype(np.float64)
            for arm, values in zip(self.scene.arms, state.joint_positions, strict=True)
        }

    def _follow(self) -> None:
        """Match joint positions to frames again if `time_offset` has changed."""
        matching, offset = self._sequence.matching, self.time_offset
        if matching is not None and offset is not None and offset != matching.time_offset:
            self._sequence = self._sequence.with_time_offset(offset)
            self._reader.close()
            self._reader = FrameReader(self._sequence)


def joint_correction(
    joint_positions: Float[np.ndarray, " dofs"],
    provenance: Provenance,
    joint_std: Float[np.ndarray, " dofs"] | None = None,
) -> JointCorrection:
    """A correction [rad, m] with its standard deviations, if any of them is known."""
    std = None if joint_std is None or not np.isfinite(joint_std).any() else tuple(joint_std.tolist())
    return JointCorrection(tuple(joint_positions.tolist()), provenance, std)


def _transform(matrix: Float[np.ndarray, "4 4"], provenance: Provenance) -> CorrectedTransform:
    return CorrectedTransform(tuple(tuple(row) for row in matrix.tolist()), provenance)


@dataclass(frozen=True)
class Storage:
    """An open project, and whether its edits are kept."""

    project: Project
    reason: str | None
    """Reason why edits are not kept; None if they are kept."""
    scratch: tempfile.TemporaryDirectory | None = None
    """The folder of a temporary project."""
    hint: str | None = None
    """Message about rescued copies of the project."""

    @property
    def kept(self) -> bool:
        """Whether edits are kept, in the file at `project.path`."""
        return self.reason is None and self.project.safe

    @property
    def notice(self) -> str | None:
        """Message for the user if edits are not kept, are kept in another file, or may be in a rescued copy; else
        None."""
        return self.project.storage_failure or self.reason or self.hint

    def close(self) -> None:
        """Close the project, so that other programs can write to it.

        Raises:
            ProjectError: saved edits are no longer on disk.
        """
        try:
            self.project.close()
        finally:
            if self.scratch is not None:
                self.scratch.cleanup()


def open_storage(sequence: Sequence, path: Path | None = None) -> Storage:
    """Open a sequence's project for the viewer, or create it.

    A project that cannot be written opens read-only. If no project can be created, a temporary project is used.

    Args:
        sequence: the recording.
        path: the project file; None for the default path.

    Raises:
        ProjectError: the file belongs to another sequence, has a newer version or is not a project, or `path` cannot be
            created.
    """
    try:
        project = Project.open(sequence, path)
    except DamagedProject:
        # The error names the file with the rescued content.
        raise
    except ProjectError as error:
        if (path or default_path(Path(sequence.path))).is_file():
            project = Project.open(sequence, path, read_only=True)
            return Storage(project, f"Read-only: {error}")
        if path is not None:
            raise
        scratch = tempfile.TemporaryDirectory(prefix="carts-")
        project = Project.open(sequence, Path(scratch.name) / "scratch.carts")
        return Storage(project, f"Temporary project, deleted when the viewer is closed: {error}", scratch)
    reason = None if project.writable else f"Read-only: {project.read_only_reason}"
    return Storage(project, reason, hint=_rescued_hint(project.path))


def _rescued_hint(path: Path) -> str | None:
    copies = rescued_copies(path)
    if not copies:
        return None
    newest, others = copies[0], f" (and {len(copies) - 1} earlier)" if len(copies) > 1 else ""
    return (
        f"{newest}{others} is a rescued copy of the lost or damaged {path.name}. It may contain corrections "
        f"that are not in {path.name}: open it with --project '{newest}', or delete it."
    )
