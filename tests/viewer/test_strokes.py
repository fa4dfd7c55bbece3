"""Strokes as browsers send them, and what they do to painted layers."""

import json
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from carts_core.errors import SettingsError
from carts_core.model.camera import Camera
from carts_core.project import IgnoreRegion, MaskCorrection
from carts_viewer.picture.layers import ADDED_COLOR, IGNORED_COLOR, REMOVED_COLOR, nothing, paint_over
from carts_viewer.picture.strokes import LONGEST_STROKE, Painted, Stroke, Target, corrected, ignored, read_stroke

CAMERA = Camera("left", 64, 48, (60.0, 60.0, 32.0, 24.0), np.eye(4))
GOOD: dict[str, Any] = {
    "number": 1,
    "frame": 2,
    "camera": "left",
    "target": "Mask",
    "erase": False,
    "polygon": False,
    "diameter": 7,
    "points": [[10.0, 12.0], [40.5, 30.5]],
}


def _read(**changes: Any) -> Stroke:
    painted = msgspec.json.decode(json.dumps({"type": "Painted", **GOOD, **changes}), type=Painted)
    return read_stroke(painted, 3, {"left": CAMERA})


def test_a_line_covers_what_lies_within_its_radius() -> None:
    covered = _read().covers(CAMERA)
    y, x = np.mgrid[:48, :64] + 0.5
    a, b = np.array(GOOD["points"])
    along = np.clip(((x - a[0]) * (b - a)[0] + (y - a[1]) * (b - a)[1]) / ((b - a) @ (b - a)), 0, 1)
    distance = np.hypot(x - a[0] - along * (b - a)[0], y - a[1] - along * (b - a)[1])
    # OpenCV makes lines of odd thickness up to 1.2 px too wide at either side.
    assert covered[distance < 3.4].all() and not covered[distance > 4.8].any()


def test_a_single_point_is_a_dot() -> None:
    covered = _read(points=[[20.5, 20.5]], diameter=9).covers(CAMERA)
    y, x = np.mgrid[:48, :64] + 0.5
    distance = np.hypot(x - 20.5, y - 20.5)
    assert covered[distance < 4].all() and not covered[distance > 5.5].any()


def test_a_polygon_is_filled_and_knows_no_brush() -> None:
    covered = _read(polygon=True, points=[[10, 10], [50, 10], [50, 40], [10, 40]], diameter=200).covers(CAMERA)
    assert covered[11:39, 11:49].all() and covered.sum() <= 41 * 31


def test_points_far_outside_and_brushes_too_thick_are_clamped() -> None:
    stroke = _read(points=[[-1e9, 20], [1e300, 20]], diameter=1e9)
    assert stroke.points.tolist() == [[-64, 20], [128, 20]] and stroke.diameter == 300
    assert stroke.covers(CAMERA).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"points": [[float("nan"), 1.0]]},
        {"points": [[1.0, float("inf")]]},
        {"points": []},
        {"points": [[1, 2]] * (LONGEST_STROKE + 1)},
        {"points": [[1, 2, 3]]},
        {"points": [[1, 2], [3]]},
        {"points": [None]},
        {"points": {"0": [1, 2]}},
        {"points": [[1, 2], [3, 4]], "polygon": True},
        {"points": [[10**400, 1]]},
        {"diameter": -3},
        {"diameter": float("nan")},
        {"diameter": "5"},
        {"frame": 3},
        {"frame": -1},
        {"frame": 1.5},
        {"frame": True},
        {"number": None},
        {"camera": "../left"},
        {"camera": ["left"]},
        {"target": "Review"},
    ],
)
def test_what_no_page_would_send_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises((SettingsError, msgspec.DecodeError)):
        _read(**changes)


def test_a_later_stroke_wins_and_what_is_rendered_needs_no_adding() -> None:
    rendered, stroke = np.zeros((4, 6), bool), np.zeros((4, 6), bool)
    rendered[:, :3], stroke[1] = True, True
    added = corrected(None, stroke, rendered, erase=False)
    assert added is not None and not added.removed().any()
    assert np.array_equal(added.added(), stroke & ~rendered)
    # Erasing the same takes the addition back and the rendered part out.
    removed = corrected(added, stroke, rendered, erase=True)
    assert removed is not None and not removed.added().any()
    assert np.array_equal(removed.removed(), stroke & rendered)
    assert np.array_equal(removed.applied_to(rendered), rendered & ~stroke)
    # And painting it again leaves the rendered mask with the addition.
    again = corrected(removed, stroke, rendered, erase=False)
    assert again is not None and np.array_equal(again.applied_to(rendered), rendered | stroke)


def test_a_layer_of_which_nothing_is_left_is_none() -> None:
    stroke, rendered = np.ones((4, 6), bool), np.zeros((4, 6), bool)
    assert corrected(corrected(None, stroke, rendered, erase=False), stroke, rendered, erase=True) is None
    assert ignored(ignored(None, stroke, erase=False), stroke, erase=True) is None
    assert ignored(None, stroke, erase=True) is None


def test_painted_pixels_are_seen_in_their_colours() -> None:
    added, removed, region = np.zeros((3, 40, 60), bool)
    added[:20, :20], removed[:20, 20:40], region[25:38, 10:50] = True, True, True
    picture = nothing(40, 60)
    paint_over(picture, MaskCorrection.of(added, removed), IgnoreRegion.of(region), 0.5)
    assert (picture[added] == (*ADDED_COLOR, 128)).all() and (picture[removed] == (*REMOVED_COLOR, 128)).all()
    hatched = picture[region][:, 3] > 0
    assert 0.3 < hatched.mean() < 0.9 and (picture[region][hatched][:, :3] == IGNORED_COLOR).all()
    rest = ~(added | removed | region)
    assert not picture[rest].any()


def test_a_line_is_that_of_opencv() -> None:
    wanted = np.zeros((48, 64), np.uint8)
    cv2.line(wanted, (10, 12), (40, 30), 1, 7)
    covered = _read(points=[[10.5, 12.5], [40.5, 30.5]]).covers(CAMERA)
    assert np.array_equal(covered, wanted.astype(bool))


def test_the_target_and_the_eraser_are_read() -> None:
    stroke = _read(target="Ignore region", erase=True)
    assert stroke.target is Target.IGNORE and stroke.erase and (stroke.number, stroke.frame) == (1, 2)
