"""The tool Prompt: clicks and boxes become paint, further clicks are about the same thing, and undo takes them back."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from test_paint_page import Hand
from viewer_canvas import eventually
from viewer_desk import Desk
from viewer_tab import Tab

from carts_core.evaluation.evaluate import dice
from carts_core.project import Key, Project
from carts_core.recording import Sequence
from carts_core.segmentation import Prompt
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.picture.strokes import Stroke, Target, Tool

RADIUS = 9.0


class Discs:
    """A plug-in: discs around the points, without those around the points beside it; or the box."""

    def __init__(self) -> None:
        self.asked: list[Prompt] = []

    def segment(self, image: np.ndarray, prompt: Prompt) -> np.ndarray:
        self.asked.append(prompt)
        rows, columns = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
        mask = np.zeros(image.shape[:2], bool)
        if prompt.box is not None:
            left, top, right, low = prompt.box
            mask |= (columns > left) & (columns < right) & (rows > top) & (rows < low)
        for u, v in prompt.inside:
            mask |= np.hypot(columns - u, rows - v) < RADIUS
        for u, v in prompt.outside:
            mask &= np.hypot(columns - u, rows - v) >= RADIUS
        return mask


@pytest.fixture
def discs() -> Discs:
    return Discs()


@pytest.fixture
def prompted(tiny_sequence: Callable[..., Path], untrained_weights: Path, discs: Discs) -> Desk:
    """A desk whose segmenter is a plug-in."""
    sequence = Sequence.open(tiny_sequence(frames=2))
    factory = OptimizerFactory(weights=(untrained_weights,), segmenter=discs, report=lambda line: None)
    return Desk(sequence, Project.open(sequence), factory)


def _point(number: int, *points: tuple[float, float], erase: bool = False) -> intents.Paint:
    stroke = Stroke(number, 0, "left", Target.IGNORE, erase, False, 1, np.array(points), prompt=True)
    return intents.Paint(7, stroke)


def _region(desk: Desk) -> np.ndarray:
    region = desk.saved.get(Key.ignore_region(0, "left"))
    return np.zeros(desk.state.frame.images["left"].shape[:2], bool) if region is None else region.region()


def test_clicks_are_about_one_thing_until_it_is_finished_and_each_is_a_step(prompted: Desk, discs: Discs) -> None:
    prompted.do(_point(1, (20.0, 20.0)))
    first = _region(prompted)
    prompted.do(_point(2, (34.0, 20.0)))
    prompted.do(_point(3, (20.0, 12.0), erase=True))
    assert discs.asked[-1] == Prompt(inside=((20.0, 20.0), (34.0, 20.0)), outside=((20.0, 12.0),))
    assert not _region(prompted)[12, 20] and _region(prompted)[24, 20] and _region(prompted)[20, 34]
    assert [step.name for step in prompted.saved.steps] == ["Segment by a prompt, frame 001"] * 3
    # The next one begins anew and adds to what is there.
    before = _region(prompted)
    prompted.do(intents.NextObject(), _point(4, (50.0, 40.0)))
    assert discs.asked[-1] == Prompt(inside=((50.0, 40.0),))
    assert (_region(prompted) & before).sum() == before.sum() < _region(prompted).sum()
    for _ in range(3):
        prompted.do(intents.Undo())
    np.testing.assert_array_equal(_region(prompted), first)


def test_after_undo_or_other_paint_a_click_is_about_something_new(prompted: Desk, discs: Discs) -> None:
    prompted.do(_point(1, (20.0, 20.0)), intents.Undo(), _point(2, (40.0, 30.0)))
    assert discs.asked[-1] == Prompt(inside=((40.0, 30.0),))
    assert not _region(prompted)[20, 20] and _region(prompted)[30, 40]


def test_shift_on_something_new_takes_it_away_and_a_box_adds(prompted: Desk, discs: Discs) -> None:
    prompted.do(_point(1, (50.0, 40.0), (10.0, 10.0)))
    assert discs.asked[-1] == Prompt(box=(10.0, 10.0, 50.0, 40.0))
    assert _region(prompted).sum() == 40 * 30
    prompted.do(intents.NextObject(), _point(2, (30.0, 25.0), erase=True))
    assert not _region(prompted)[25, 30] and _region(prompted)[12, 12]


def test_in_a_box_the_mask_becomes_what_is_segmented_whatever_is_rendered(prompted: Desk, discs: Discs) -> None:
    rendered = prompted.renderer.mask(prompted.state.pose.scene, "left")
    height, width = rendered.shape
    corners = np.array([[0.0, 0.0], [float(width), float(height)]])
    wanted = np.zeros_like(rendered)
    wanted[5:15, 5:15] = True
    discs.segment = lambda image, prompt: wanted  # type: ignore[method-assign]
    prompted.do(intents.Paint(7, Stroke(1, 0, "left", Target.MASK, False, False, 1, corners, prompt=True)))
    mask = prompted.renderer.mask(prompted.state.pose.scene, "left", prompted.state.mask_correction)
    assert rendered.any()
    np.testing.assert_array_equal(mask, wanted)


def test_a_mask_and_its_class_come_from_one_prompt(prompted: Desk) -> None:
    stroke = Stroke(1, 0, "left", Target.MASK, False, False, 1, np.array([[20.0, 20.0]]), 3, prompt=True)
    prompted.do(intents.Paint(7, stroke))
    labels = prompted.saved.get(Key.part_labels(0, "left"))
    assert (
        labels is not None
        and (labels.labels() == 3).sum()
        == Discs().segment(prompted.state.frame.images["left"], Prompt(inside=((20.0, 20.0),))).sum()
    )
    assert prompted.renderer.mask(prompted.state.pose.scene, "left", prompted.state.mask_correction)[20, 20]
    prompted.do(intents.Undo())
    assert prompted.saved.get(Key.part_labels(0, "left")) is None and prompted.state.mask_correction is None


@pytest.mark.browser
def test_a_click_in_the_page_segments_the_arm_under_it_by_the_shipped_network(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=1, width=640, height=480)
    tab = open_tab(app)
    tab.page.get_by_text("Paint", exact=True).click()
    tab.button("Ignore region")
    masks = app.sequence.frame(0, "regular", ["left"]).masks
    assert masks is not None
    truth = masks["left"]
    rows, columns = np.nonzero(truth)
    middle = int(np.median(np.arange(len(rows))))
    hand = _HandOf(tab)
    tab.page.keyboard.press("Shift+T")
    hand.holds(tool=Tool.PROMPT.lower(), target="Ignore region")
    tab.page.mouse.click(*tab.place(columns[middle] + 0.5, rows[middle] + 0.5))
    hand.steps(1)
    region = app.project.state.get(Key.ignore_region(0, "left"))
    assert region is not None and dice(region.region(), truth) > 0.8
    tab.page.keyboard.press("Control+z")
    eventually(lambda: app.project.state.get(Key.ignore_region(0, "left")), lambda layer: layer is None)
    # A box gives what of it is inside.
    tab.page.mouse.move(*tab.place(40.0, 40.0))
    tab.page.mouse.down()
    tab.page.mouse.move(*tab.place(320.0, 240.0))
    tab.page.mouse.move(*tab.place(600.0, 440.0))
    tab.page.mouse.up()
    layer = eventually(lambda: app.project.state.get(Key.ignore_region(0, "left")), lambda layer: layer is not None)
    inside = np.zeros_like(truth)
    inside[40:440, 40:600] = True
    assert layer is not None and dice(layer.region(), truth & inside) > 0.8


class _HandOf(Hand):
    """A hand that knows where the picture is by the page's own script."""

    def locate(self) -> None:
        """Nothing: no discs mark the picture."""
