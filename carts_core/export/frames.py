"""Frames of an export, from a recording, a table or a project: joint positions, verdicts, reviews and corrected
masks."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, UInt8
from numpy import ndarray

from ..errors import SequenceError
from ..model.scene import SceneState
from ..project import Key, MaskCorrection, ProjectState, Source
from ..project.state import corrected_state, source_of
from ..recording import Sequence
from .kinematics import KinematicsRow


@dataclass(frozen=True)
class ExportFrame(KinematicsRow):
    """A frame to export: joint positions, their source, and corrected masks."""

    index: int = field(kw_only=True)
    """0-based position in the sequence."""
    review: str | None = field(default=None, kw_only=True)
    """Review state, such as accepted; None without a project."""
    dice: float | None = field(default=None, kw_only=True)
    """Dice with the recorded masks, lowest over the cameras [1]; None if unknown."""
    masks: Mapping[str, Bool[ndarray, "height width"]] = field(default_factory=dict, kw_only=True)
    """Camera -> corrected mask at the camera's size; other cameras get the rendered mask."""
    part_labels: Mapping[str, UInt8[ndarray, "height width"]] = field(default_factory=dict, kw_only=True)
    """Camera -> painted part class number (`carts_core.model.parts.PartClass`) per pixel, 0 for none. Painted classes
    override the rendered ones, and painted pixels belong to the mask.
    """


def measured_frames(sequence: Sequence, indices: Iterable[int]) -> list[ExportFrame]:
    """Frames with measured joint positions."""
    return [
        ExportFrame(
            sequence.frame_ids[index],
            "measured",
            {arm: positions[index] for arm, positions in sequence.measured.items()},
            index=index,
        )
        for index in indices
    ]


def corrected_frames(sequence: Sequence, indices: Iterable[int], rows: Iterable[KinematicsRow]) -> list[ExportFrame]:
    """Frames of `indices` that have a table row, with its joint positions.

    Raises:
        SequenceError: a row refers to a frame that is not in the sequence, or two rows to the same frame.
    """
    known = set(sequence.frame_ids)
    by_id: dict[str, KinematicsRow] = {}
    for row in rows:
        if row.frame_id not in known:
            raise SequenceError(
                f"the kinematics are of frame {row.frame_id!r}, which {sequence.path} does not have. "
                "Give the table that was made from this sequence."
            )
        if row.frame_id in by_id:
            raise SequenceError(f"the kinematics have frame {row.frame_id!r} twice. Remove one of the rows.")
        by_id[row.frame_id] = row
    chosen = ((index, by_id[sequence.frame_ids[index]]) for index in indices if sequence.frame_ids[index] in by_id)
    return [
        ExportFrame(row.frame_id, row.source, row.joint_positions, row.joint_std, row.verdict, index=index)
        for index, row in chosen
    ]


RenderMask = Callable[[SceneState, str], Bool[np.ndarray, "height width"]]
"""Function that renders the mask of a camera, given by name, at its full size for a scene state."""
_SOURCES = {
    Source.MEASURED: "measured",
    Source.HAND: "edited",
    Source.OPTIMIZER: "optimized",
    Source.PROPAGATED: "propagated",
}
"""Source names as in the tables of `carts optimize`, so that `--keyframes` finds manually edited frames."""


class _CorrectedMasks(Mapping[str, Bool[np.ndarray, "height width"]]):
    """Mapping camera -> corrected mask of a frame, rendered on access."""

    def __init__(self, render: RenderMask, pose: SceneState, corrections: Mapping[str, MaskCorrection]) -> None:
        self._render, self._pose, self._corrections = render, pose, corrections

    def __getitem__(self, camera: str) -> Bool[np.ndarray, "height width"]:
        return self._corrections[camera].applied_to(self._render(self._pose, camera))

    def __iter__(self) -> Iterator[str]:
        return iter(self._corrections)

    def __len__(self) -> int:
        return len(self._corrections)


def project_frame(
    recording: Sequence, project: ProjectState, index: int, cameras: Iterable[str], render: RenderMask
) -> ExportFrame:
    """Frame with the corrections of a project, and with painted masks and parts for the given cameras.

    Args:
        recording: recording with the project's time offset; other corrections may be applied.
        render: renders masks; called for cameras whose mask was corrected.
    """
    frame = recording.frame(index, cameras=[])
    pose = corrected_state(recording.scene, frame, project)
    known = {name: value.standard_deviations for name, value in project.joints(index).items()}
    painted = {camera: project.get(Key.mask_correction(index, camera)) for camera in cameras}
    labels = {camera: project.get(Key.part_labels(index, camera)) for camera in cameras}
    verdict, figures = project.verdict(index), project.figures(index)
    return ExportFrame(
        frame.frame_id,
        _SOURCES[source_of(project, index)],
        {
            arm.name: values.numpy().astype(np.float64)
            for arm, values in zip(recording.scene.arms, pose.joint_positions, strict=True)
        },
        {arm: np.array(std, float) for arm, std in known.items() if std is not None} or None,
        None if verdict is None else verdict.verdict,
        index=index,
        review=project.review(index).state.value,
        dice=None if figures is None else figures.dice,
        part_labels={name: value.labels() for name, value in labels.items() if value is not None},
        masks=_CorrectedMasks(render, pose, {name: p for name, p in painted.items() if p is not None}),
    )
