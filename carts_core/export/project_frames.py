"""Frames as a project has them: corrected joint positions, verdicts, reviews, and masks with what was painted."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from ..model.scene import SceneState
from ..project import Key, MaskCorrection, ProjectState, Source
from ..project.calibrated import corrected_state, source_of
from ..recording import Sequence as Recording
from .frames import ExportFrame

RenderMask = Callable[[SceneState, str], Bool[np.ndarray, "height width"]]
"""Pose of the scene and name of a camera -> where arms are rendered, at the camera's size."""
_SOURCES = {
    Source.MEASURED: "measured",
    Source.HAND: "edited",
    Source.OPTIMIZER: "optimized",
    Source.PROPAGATED: "propagated",
}
"""As in the tables of `carts optimize`, so that `--keyframes` finds frames that were edited by hand."""


class _CorrectedMasks(Mapping[str, Bool[np.ndarray, "height width"]]):
    """Camera -> the corrected mask of a frame, for cameras with a correction; rendered on access."""

    def __init__(self, render: RenderMask, pose: SceneState, corrections: Mapping[str, MaskCorrection]) -> None:
        self._render, self._pose, self._corrections = render, pose, corrections

    def __getitem__(self, camera: str) -> Bool[np.ndarray, "height width"]:
        return self._corrections[camera].applied_to(self._render(self._pose, camera))

    def __iter__(self) -> Iterator[str]:
        return iter(self._corrections)

    def __len__(self) -> int:
        return len(self._corrections)


def project_frame(
    recording: Recording, project: ProjectState, index: int, cameras: Sequence[str], render: RenderMask
) -> ExportFrame:
    """A frame as a project has it.

    Args:
        recording: with the project's time offset; corrected or as measured.
        project: its corrections.
        index: 0-based position of the frame.
        cameras: whose painted masks and parts are included.
        render: called for cameras whose mask was corrected.
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
