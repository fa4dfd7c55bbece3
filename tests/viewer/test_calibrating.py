"""A calibration over the recording is stopped at any moment: then the calibration from the points stays."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from clicked_points import clicked
from scipy.spatial.transform import Rotation
from viewer_canvas import eventually
from visitor import write_lab_files

from carts_core.model.camera import HALF_PIXEL
from carts_core.model.scene import Scene
from carts_core.optimization import CalibrationOptimizer, StopReason
from carts_core.optimization.hand_eye import PoseDeviation
from carts_core.recording import Sequence
from carts_viewer.start.site import Site
from carts_viewer.wizard import calibration, hand_eye
from carts_viewer.wizard.calibration import CalibrationJob
from carts_viewer.wizard.draft import Draft, DraftFile, Step
from carts_viewer.wizard.wizard import RecordingWizard

CALIBRATE, STOP = ("calibrate", ""), ("cancel", "")


class OneStep:
    """Stands for `CalibrationOptimizer`: one step, and the scene as it is for a result."""

    def __init__(self, scene: Scene, *_: object, **__: object) -> None:
        self._scene = scene

    def __iter__(self) -> Iterator[SimpleNamespace]:
        yield SimpleNamespace(stage=0, stages=1, index=0, loss=0.5, scene=self._scene)

    def result(self) -> SimpleNamespace:
        return SimpleNamespace(
            scene=self._scene,
            frame_losses_before=np.array([0.5]),
            frame_losses_after=np.array([0.25]),
            stop_reason=StopReason.CONVERGED,
            assessment=None,
            beyond=(),
            deviations={("PSM1", "left"): PoseDeviation(7.1, 8.2, 9.3)},
        )


@pytest.fixture
def jobs(monkeypatch: pytest.MonkeyPatch) -> list[CalibrationJob]:
    """The jobs that are begun."""
    begun: list[CalibrationJob] = []

    def begin(*arguments, **options) -> CalibrationJob:
        begun.append(CalibrationJob(*arguments, **options))
        return begun[-1]

    monkeypatch.setattr(hand_eye, "CalibrationJob", begin)
    monkeypatch.setattr(calibration, "CalibrationOptimizer", OneStep)
    return begun


@pytest.fixture
def site(tiny_sequence: Callable[..., Path], tmp_path: Path) -> Iterator[Site]:
    """At the last step of New recording, with the points clicked."""
    made = Sequence.open(tiny_sequence(frames=3, width=320, height=240))
    folder = tmp_path / "labs" / "day"
    shutil.copytree(made.path.parent / "regular" / "left", folder / "left_images")
    (camera,) = made.scene.cameras
    K = camera.K - np.array([[0, 0, HALF_PIXEL], [0, 0, HALF_PIXEL], [0, 0, 0]])
    write_lab_files(folder, range(1, 4), made.measured["PSM1"], [("left", (320, 240), K)])
    points = clicked(made.scene, made.measured, range(3), ("left",), noise=0.5)
    file = DraftFile()
    file.write(Draft(Step.HAND_EYE, str(folder), "day", points=tuple(points)))
    with Site([tmp_path / "labs"], port=0) as opened:
        opened.post(lambda: opened.show_recording(file.key))
        yield opened


def place_of(site: Site) -> RecordingWizard:
    site.wait()
    assert isinstance(site.shown, RecordingWizard) and 'role="alert"' not in site.document.content
    return site.shown


def ended(site: Site, text: str) -> Draft:
    """The draft once this is to be read."""
    eventually(lambda: site.document.content, lambda content: text in content)
    return place_of(site).draft


def test_a_calibration_that_is_not_stopped_is_taken(site: Site, jobs: list[CalibrationJob]) -> None:
    place = place_of(site)
    site.post(lambda: place.choose(*CALIBRATE))
    assert ended(site, "Calibrated").calibration is not None


def test_a_calibration_that_had_ended_before_it_was_stopped_is_not_taken_either(
    site: Site, jobs: list[CalibrationJob]
) -> None:
    place = place_of(site)

    def stop_when_it_has_ended() -> None:
        place.choose(*CALIBRATE)
        jobs[-1].join(60)
        place.choose(*STOP)

    site.post(stop_when_it_has_ended)
    assert ended(site, "Stopped; the calibration from your points is as it was.").calibration is None
    site.post(lambda: place.choose(*CALIBRATE))
    assert ended(site, "Calibrated").calibration is not None, "the next one is not stopped"


@pytest.mark.parametrize("moment", ["images are read", "a step", "the result"])
def test_a_calibration_is_stopped_at_any_moment(
    site: Site, jobs: list[CalibrationJob], monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    place = place_of(site)

    def pressed() -> None:
        site.post(lambda: place.choose(*STOP))
        assert site.shown is place
        eventually(lambda: jobs[-1].cancelled, bool)

    def spread(count: int, _: int) -> Iterator[int]:
        yield 0
        pressed()
        yield from range(1, count)

    class Stopped(OneStep):
        def __iter__(self) -> Iterator[SimpleNamespace]:
            assert moment != "images are read"
            yield from super().__iter__()
            if moment == "a step":
                pressed()
                yield from super().__iter__()

        def result(self) -> SimpleNamespace:
            assert moment == "the result"
            pressed()
            return super().result()

    if moment == "images are read":
        monkeypatch.setattr(calibration, "spread", spread)
    monkeypatch.setattr(calibration, "CalibrationOptimizer", Stopped)
    site.post(lambda: place.choose(*CALIBRATE))
    assert ended(site, "Stopped; the calibration from your points is as it was.").calibration is None


def test_stop_is_answered_at_once(site: Site, jobs: list[CalibrationJob], monkeypatch: pytest.MonkeyPatch) -> None:
    place = place_of(site)
    shown: list[str] = []

    class Slow(CalibrationOptimizer):
        def step(self):
            if self.history:
                site.post(lambda: place.choose(*STOP))
                site.wait()
                shown.append(site.document.content)
            return super().step()

    monkeypatch.setattr(calibration, "CalibrationOptimizer", Slow)
    site.post(lambda: place.choose(*CALIBRATE))
    assert ended(site, "Stopped; the calibration from your points is as it was.").calibration is None
    (content,) = shown
    assert "Stopping …" in content


def test_a_calibration_that_points_agree_with_is_kept_with_its_figures(site: Site, jobs: list[CalibrationJob]) -> None:
    place = place_of(site)
    assert "± 8.2 mm" not in site.document.content
    site.post(lambda: place.choose(*CALIBRATE))
    draft = ended(site, "Calibrated")
    assert draft.report is not None and draft.offered is None
    assert draft.report.before == pytest.approx(draft.report.after, abs=1e-6) and len(draft.report.before) == 12
    content = site.document.content
    for text in ("Loss 0.5000 → 0.2500", "± 8.2 mm", "± 9.3 mm", "± 7.1°", "<td>0.00°</td><td>0.0 mm</td>"):
        assert text in content
    assert Draft.from_json(draft.to_json()) == draft
    site.post(lambda: place.choose("undo", ""))
    assert "Loss" not in ended(site, "Of the calibration from points").to_json()
    assert place_of(site).draft.calibration is None and "± 8.2 mm" not in site.document.content


def test_a_calibration_that_moves_off_the_points_is_offered_and_not_kept(
    site: Site, jobs: list[CalibrationJob], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Moved(OneStep):
        """An optimizer that turns the base frame by two degrees."""

        def __init__(self, scene: Scene, *_: object, **__: object) -> None:
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec([0.0, 2.0, 0.0], degrees=True).as_matrix()
            super().__init__(
                replace(scene, arms=tuple(replace(a, T_world_base=turn @ a.T_world_base) for a in scene.arms))
            )

    monkeypatch.setattr(calibration, "CalibrationOptimizer", Moved)
    place = place_of(site)
    site.post(lambda: place.choose(*CALIBRATE))
    offer = ended(site, "Calibration not kept")
    assert offer.calibration is None and offer.offered is not None
    assert offer.report is not None and offer.report.objection
    assert "px allowed" in site.document.content and "<td>2.00°</td>" in site.document.content
    for choice, text, kept in (
        ("keep", "Kept by choice", True),
        ("undo", "Calibration not kept", False),
        ("discard", "Of the calibration from points", False),
        ("undo", "Calibration not kept", False),
    ):
        site.post(lambda choice=choice: place.choose(choice, ""))
        assert (ended(site, text).calibration is not None) is kept
        assert ("Keep anyway" in site.document.content) is (text == "Calibration not kept")
