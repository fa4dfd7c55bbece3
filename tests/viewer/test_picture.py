"""Pictures over the frame, when they are sent, the timeline's curves and thumbnails, and the table of keys."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from viewer_desk import Desk
from viewer_tab import decoded
from waiting import get

from carts_core.errors import CartsError
from carts_core.project import Figures, Key, Review, ReviewState
from carts_viewer.actions import intents
from carts_viewer.actions.shortcuts import checked_keys, key_table, shortcuts, with_keys
from carts_viewer.app import ViewerApp
from carts_viewer.panels.timeline import THUMBNAIL_HEIGHT, Traces, frame_code
from carts_viewer.panels.tools import ToolPalette
from carts_viewer.picture import layers
from carts_viewer.picture.display import FIRST_WAIT, LONGEST_WAIT, PageDisplay, RateLimit
from carts_viewer.picture.strokes import Tool
from tools.raw_tab import RawTab


@pytest.fixture
def arm_ids() -> np.ndarray:
    """Two arms, the second over a corner of the first."""
    ids = np.full((48, 64), -1)
    ids[10:30, 10:40] = 0
    ids[20:40, 30:60] = 1
    return ids


def test_the_mask_covers_exactly_the_arms_in_their_colours(arm_ids: np.ndarray) -> None:
    picture = layers.mask(arm_ids, 0.5)
    assert np.array_equal(picture[..., 3] > 0, arm_ids >= 0)
    assert tuple(picture[12, 12]) == (*layers.ARM_COLORS[0], 128)
    assert tuple(picture[25, 35]) == (*layers.ARM_COLORS[1], 128)
    for layer in (layers.mask, layers.contour):
        assert not layer(np.full((8, 8), -1), 1.0)[..., 3].any()


def test_the_contour_runs_along_the_arms_and_leaves_their_inside_open(arm_ids: np.ndarray) -> None:
    picture = layers.contour(arm_ids, 1.0)
    assert picture[10, 20, 3] == 255 and picture[20, 10, 3] == 255
    assert picture[15, 20, 3] == 0 and picture[2, 2, 3] == 0
    assert tuple(picture[39, 45, :3]) == layers.ARM_COLORS[1]


def test_the_comparison_uses_the_papers_colours() -> None:
    predicted = np.array([[True, True, False, False]])
    truth = np.array([[True, False, True, False]])
    picture = layers.against_truth(predicted, truth, 0.6)
    names = ("true positive", "false positive", "false negative", "true negative")
    assert [tuple(pixel[:3]) for pixel in picture[0]] == [layers.TRUTH_COLORS[name] for name in names]
    assert set(picture[..., 3].ravel()) == {153}


def test_the_shaded_arm_shows_the_rendering_where_the_arm_is(arm_ids: np.ndarray) -> None:
    image = np.full((3, 48, 64), 2.0, np.float32)
    image[:, 12, 12] = (0.0, 0.5, 1.0)
    picture = layers.shaded(image, arm_ids, 1.0)
    assert tuple(picture[12, 12]) == (0, 128, 255, 255)
    assert tuple(picture[25, 35]) == (255, 255, 255, 255)
    assert tuple(picture[2, 2]) == (0, 0, 0, 0)


def test_a_map_of_a_lower_resolution_fills_the_picture_from_dark_to_bright() -> None:
    values = np.tile(np.linspace(0, 1, 16, dtype=np.float32), (12, 1))
    picture = layers.heat(values, 0.0, 1.0, (48, 64), 0.5)
    assert picture.shape == (48, 64, 4)
    brightness = picture[24, :, :3].astype(int).sum(-1)
    assert brightness[2] < brightness[32] < brightness[61]
    assert set(picture[..., 3].ravel()) == {128}
    assert layers.heat(np.full((4, 4), np.nan, np.float32), 0.0, 1.0, (8, 8), 1.0).shape == (8, 8, 4)


def test_the_next_picture_may_go_once_the_last_one_is_drawn_or_after_a_while() -> None:
    now = [100.0]
    limit = RateLimit(lambda: now[0])
    assert limit.ready_in() == 0.0
    limit.sent()
    assert limit.ready_in() == pytest.approx(FIRST_WAIT)
    now[0] += FIRST_WAIT
    assert limit.ready_in() == 0.0
    number = limit.sent()
    now[0] += 0.02
    limit.drawn(number)
    assert limit.ready_in() == 0.0


@pytest.mark.parametrize("loading", [0.4, 3.0])
def test_a_tab_that_draws_slowly_gets_as_many_pictures_as_it_can_draw(loading: float) -> None:
    now = [100.0]
    limit = RateLimit(lambda: now[0])
    drawn = []
    while len(drawn) < 4:
        number, wait = limit.sent(), limit.ready_in()
        if wait > loading:  # An image that is replaced while it is loaded is never drawn.
            now[0] += loading
            limit.drawn(number)
            drawn.append(now[0])
        else:
            now[0] += wait
        assert limit.ready_in() == 0.0
    assert drawn[0] < 100.0 + 5.0 * loading
    assert np.diff(drawn) == pytest.approx(loading), "no picture is lost once the time that one needs is known"


def test_the_wait_has_bounds_and_a_fast_picture_ends_it() -> None:
    now = [100.0]
    limit = RateLimit(lambda: now[0])
    waits = []
    for _ in range(9):
        limit.sent()
        waits.append(limit.ready_in())
        now[0] += waits[-1]
    assert waits == pytest.approx([FIRST_WAIT * 2**count for count in range(6)] + 3 * [LONGEST_WAIT])
    number = limit.sent()
    limit.drawn(number - 1)
    assert limit.ready_in() == LONGEST_WAIT, "the last picture is on its way, and the one before it needed as long"
    now[0] += 0.02
    limit.drawn(number)
    assert limit.ready_in() == 0.0
    limit.sent()
    assert limit.ready_in() == pytest.approx(FIRST_WAIT)


class Sent:
    """Page and scene of a tab that record in order what is sent to them."""

    def __init__(self) -> None:
        self.client = SimpleNamespace(client_id=1)
        self.log: list[Any] = []

    def call(self, *message: Any) -> None:
        self.log.append(message)

    @contextmanager
    def atomic(self) -> Iterator[None]:
        self.log.append("begin")
        yield
        self.log.append("end")

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *arguments: self.log.append(name)


def test_the_frame_of_strokes_changes_with_the_picture_and_not_with_the_widgets(desk: Desk) -> None:
    sent: Any = Sent()
    display = PageDisplay(sent, desk.session, desk.renderer, sent, [ToolPalette(sent, desk.session)])
    display.show_picture(desk.state)
    assert ("setPicture", 0, "left", 96, 72) in sent.log
    desk.do(intents.SetTool(Tool.BRUSH), intents.ShowFrame(1))
    assert display.ready_in() > 0.0
    sent.log.clear()
    display.show_panels(desk.state)
    ((name, brush),) = sent.log
    assert name == "setBrush" and not {"frame", "camera"} & set(brush)
    display.show_picture(desk.state)
    assert sent.log[1:4] == ["begin", ("setPicture", 1, "left", 96, 72), "show_frame"]
    sent.log.clear()
    display.show_picture(desk.do(intents.SetOpacity(0.7)))
    assert "show_overlay" in sent.log and "setPicture" not in [each[0] for each in sent.log]


def test_an_image_that_is_the_same_as_before_is_not_reported_as_sent(tiny_sequence: Callable[..., Path]) -> None:
    """A tab waits for the images that were sent; viser does not send the same file again."""
    with ViewerApp.open(tiny_sequence(cameras=("left", "right")), port=0) as app, RawTab(app.url):
        app.wait_until_shown()
        view, camera = app.view.scene, app.scene.camera("left")
        overlay = layers.transparent(camera.height, camera.width)
        assert view.show_overlay(overlay + 1, camera)
        assert view.show_overlay(overlay, camera) and not view.show_overlay(overlay, camera)
        frame = app.state.frame.images["left"]
        assert view.show_frame(255 - frame, camera)
        assert view.show_frame(frame, camera) and not view.show_frame(frame, camera)
        assert view.show_frame(frame, app.scene.camera("right"))


# ---- The timeline ---------------------------------------------------------------------------------------------------


def test_a_curve_is_the_lowest_and_highest_value_of_each_column_and_follows_what_is_corrected(desk: Desk) -> None:
    traces, project = Traces(desk.session), desk.session.editor.project
    for asked in (("Nothing", 0, 3, 9), ("Loss", 2, 2, 9), ("Loss", 0, 3, 0), ("", -5, -3, 1)):
        assert traces.between(*asked) is None
    assert traces.names[:2] == ["Loss", "Dice"] and traces.names[3].endswith("[°]")
    yaw = traces.names[3]
    measured = np.degrees(desk.session.sequence.measured["PSM1"][:, 0])
    found = traces.between(yaw, 0, 3, 100)
    assert found is not None and found["edges"] == [0, 1, 2, 3]
    assert found["curves"][0] == [pytest.approx(measured, rel=1e-4)] * 2 and found["curves"][1] == [[None] * 3] * 2
    desk.do(intents.ShowFrame(1), intents.SetJoint("PSM1", 0, 0.1), intents.Released())
    traces.follow(project.state, [1])
    whole = traces.between(yaw, 0, 3, 1)
    assert whole is not None and whole["edges"] == [0, 3]
    assert whole["curves"][0] == [[pytest.approx(measured.min(), rel=1e-4)], [pytest.approx(measured.max(), rel=1e-4)]]
    assert whole["curves"][1] == [[pytest.approx(np.degrees(0.1), rel=1e-4)]] * 2
    project.record_figures({2: Figures(loss=0.25)}, project.state)
    traces.follow(project.state, [2])
    loss = traces.between("Loss", 0, 3, 100)
    assert loss is not None and loss["curves"] == [[[None, None, 0.25]] * 2]


def test_a_frame_of_which_the_fit_is_not_known_has_no_height_and_one_that_fits_well_has_some(desk: Desk) -> None:
    editor = desk.session.editor
    editor.apply("Accept", {Key.review(1): Review(ReviewState.ACCEPTED), Key.review(2): Review(ReviewState.ACCEPTED)})

    def high() -> list[int]:
        return [frame_code(editor.project.state, frame, desk.session.scene) >> 8 for frame in (0, 1, 2)]

    assert high() == [0, 0, 0]
    editor.project.record_figures({1: Figures(dice=1.0), 2: Figures(dice=0.5)}, editor.project.state)
    assert high() == [0, 1, 255]


def test_thumbnails_are_served_of_frames_that_there_are(shared_viewer: ViewerApp) -> None:
    answer = get(shared_viewer.url, "/thumbnail/0/0/2.jpg")
    assert answer.status == 200 and decoded(answer.read()).shape == (THUMBNAIL_HEIGHT, THUMBNAIL_HEIGHT * 96 // 72, 3)
    outlined = get(shared_viewer.url, "/thumbnail/0/0/2-7.jpg")
    plain = decoded(get(shared_viewer.url, "/thumbnail/0/0/2.jpg").read())
    assert outlined.status == 200
    changed = np.abs(decoded(outlined.read()).astype(int) - plain).max(axis=2) > 40
    assert 0.02 < changed.mean() < 0.5, "the arm is overlaid, and the rest is the image"
    for path in (
        "0/0/3.jpg",
        "1/0/0.jpg",
        "0/1/0.jpg",
        "0/0/-1.jpg",
        "../0/0/0.jpg",
        "0/0/0.png",
        "0/0/99999999999.jpg",
    ):
        assert get(shared_viewer.url, f"/thumbnail/{path}").status == 404, path


# ---- Keys -----------------------------------------------------------------------------------------------------------


PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "keys.md"


def test_no_two_shortcuts_share_a_key_and_none_flies_the_camera() -> None:
    keys = [shortcut.key for shortcut in shortcuts().values()]
    assert len(set(keys)) == len(keys) >= 60
    assert not set(keys) & set("WASDQE")
    assert checked_keys({name: shortcut.key for name, shortcut in shortcuts().items()}) == {}


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"MoveFrame 1": "G"}, "G is the key of 'Next frame'. Press another key."),
        ({"MoveFrame 1": "W"}, "W moves the camera of the 3D view. Press another key."),
        ({"MoveFrame 1": "Ctrl+T"}, "Ctrl+T belongs to the browser. Press another key."),
        ({"MoveFrame 1": ""}, "No key is not a key. Press another key."),
        ({"MoveFrame 1": "x" * 1000}, f"{'x' * 24} is not a key. Press another key."),
        ({"Format the disk": "F1"}, "'Format the disk' is not an action with a key."),
    ],
)
def test_a_key_that_has_another_function_is_refused(changed: dict[str, str], reason: str) -> None:
    with pytest.raises(CartsError, match=re.escape(reason)):
        checked_keys(changed)


def test_the_page_of_keys_lists_them_as_they_are() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert with_keys(text) == text and key_table() in text
