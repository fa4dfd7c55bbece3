"""Pictures of comparisons: outlines of several poses, two poses side by side, and painted masks before and after."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from carts_core.export.dataset import labelled
from carts_core.model.scene import SceneState
from carts_core.project import MaskCorrection
from carts_viewer.picture.layers import ADDED_COLOR, REMOVED_COLOR, ArmIds, Rgba, mask, transparent
from carts_viewer.session import Session
from carts_viewer.state import ComparedPose, CompareMode, ViewState


@dataclass(frozen=True)
class LineStyle:
    """Colour and dashes of an outline."""

    color: tuple[int, int, int]
    dash: int = 0
    """Length of a dash, in multiples of the line's width; 0 for a solid line."""
    gap: int = 0
    """Length of a gap, in multiples of the line's width."""


LINES = {
    ComparedPose.MEASURED: LineStyle((250, 204, 21), 1, 3),
    ComparedPose.ACCEPTED: LineStyle((240, 130, 250), 5, 3),
    ComparedPose.CURRENT: LineStyle((34, 211, 238)),
}
"""Styles of the outlined poses, from the lowest to the uppermost; they also differ without their colours."""
_SOLID = 8
"""Length of the pieces of a solid line, in multiples of its width."""
_STRIPES = 6
"""Distance of the stripes on removed pixels [px]."""


def compared_pose(which: ComparedPose, state: ViewState, session: Session) -> SceneState | None:
    """A pose of the shown frame; None if there is none."""
    if which is ComparedPose.MEASURED:
        return session.measured(state.frame)
    if which is ComparedPose.BEFORE_RUN:
        return state.run.start
    if which is ComparedPose.CURRENT:
        return state.pose.scene
    return None if state.streaming else session.accepted(state.frame)


def compared_poses(state: ViewState, session: Session) -> dict[ComparedPose, SceneState | None]:
    """The poses of the current comparison."""
    compare = state.compare
    outlined = compare.mode is CompareMode.OUTLINES and not compare.peek
    used = tuple(LINES) if outlined else (compare.left, compare.right)
    return {which: compared_pose(which, state, session) for which in used}


def composed(own: Rgba, other: Rgba, share: float) -> Rgba:
    """The other picture on the left, the own one on the right, and a line between them."""
    column = round(share * own.shape[1])
    both = np.concatenate([other[:, :column], own[:, column:]], axis=1)
    if 0 < column < own.shape[1]:
        both[:, max(column - 1, 0) : column + 1] = 255
    return both


def outlines(masks: Mapping[ComparedPose, ArmIds], size: tuple[int, int]) -> Rgba:
    """Outlines of the arms in several poses, in the styles of `LINES` on a dark edge; `size` is height and width."""
    picture = transparent(*size)
    width = max(2, round(max(size) / 320))
    for which, arm_ids in masks.items():
        style, pieces = LINES[which], []
        for arm in range(int(arm_ids.max(initial=-1)) + 1):
            visible = (arm_ids == arm).astype(np.uint8)
            for contour in cv2.findContours(visible, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
                pieces += _pieces(contour[:, 0], style, width, size)
        for color, extra in (((0, 0, 0), 2), (style.color, 0)):
            cv2.polylines(picture, pieces, False, (*color, 255), width + extra, cv2.LINE_8)
    return picture


def _pieces(contour: np.ndarray, style: LineStyle, width: int, size: tuple[int, int]) -> list[np.ndarray]:
    """The dashes of a closed contour [points 2], without its parts along the image's border."""
    dash, period = (style.dash or _SOLID) * width, ((style.dash or _SOLID) + style.gap) * width
    border = ((contour == 0) | (contour == np.array(size[::-1]) - 1)).any(axis=1)
    first = int(border.argmax())
    contour, border = np.roll(contour, -first, axis=0), np.roll(border, -first)
    # The first point is on the border, if any is, so that every second part is within the image.
    parts = np.split(contour, np.flatnonzero(np.diff(border)) + 1)[1::2]
    inner = parts if border.any() else [np.append(contour, contour[:1], axis=0)]
    return [line[start : start + dash + 1] for line in inner for start in range(0, len(line), period)]


def painted(rendered: ArmIds, correction: MaskCorrection | None, camera: str, opacity: float) -> tuple[Rgba, Rgba]:
    """The mask before and after painting; afterwards, added pixels are solid and removed pixels striped."""
    before = mask(rendered, opacity)
    if correction is None:
        return before, before
    corrected = correction.applied_to(rendered >= 0)
    ids = labelled(corrected, rendered, camera) if (rendered >= 0).any() else np.where(corrected, 0, -1)
    after = mask(ids, opacity)
    rows, columns = np.ogrid[: rendered.shape[0], : rendered.shape[1]]
    after[correction.added()] = (*ADDED_COLOR, 255)
    after[correction.removed() & ((rows + columns) % _STRIPES < _STRIPES // 2)] = (*REMOVED_COLOR, 255)
    return before, after


def legend(state: ViewState, poses: Mapping[ComparedPose, SceneState | None]) -> list[dict[str, object]]:
    """Entries of the legend over the image: name, colour, and dashes or stripes."""
    if state.camera in state.frame.missing:
        return [{"name": "This camera has no image of this frame.", "color": "transparent"}]
    if state.compare.mode is CompareMode.OUTLINES:
        return [
            {
                "name": pose_name(which, state) if poses[which] is not None else f"{which}: none",
                "color": f"rgb{LINES[which].color}",
                "dash": [LINES[which].dash, LINES[which].gap],
            }
            for which in ComparedPose
            if which in poses and which in LINES
        ]
    correction = state.mask_correction
    if state.compare.mode is not CompareMode.PAINTED:
        return []
    if correction is None:
        return [{"name": "The mask is as rendered", "color": "transparent"}]
    added, removed = int(correction.added().sum()), int(correction.removed().sum())
    return [
        {"name": f"{added} px added", "color": f"rgb{ADDED_COLOR}"},
        {"name": f"{removed} px removed", "color": f"rgb{REMOVED_COLOR}", "striped": True},
    ]


def pose_name(which: ComparedPose, state: ViewState) -> str:
    """Label of a pose over the image."""
    of_run = which is ComparedPose.CURRENT and state.maps is not None and state.maps.of_run
    return "This run" if of_run else str(which)


def side_names(state: ViewState, poses: Mapping[ComparedPose, SceneState | None]) -> tuple[str, str] | None:
    """Labels of the two sides of a swipe; None without a swipe."""
    compare = state.compare
    if compare.mode is CompareMode.PAINTED:
        return "Before painting", "After painting"
    if compare.mode is not CompareMode.SWIPE:
        return None
    left, right = (
        pose_name(which, state) if poses[which] is not None else f"{which}: none"
        for which in (compare.left, compare.right)
    )
    return left, right
