"""New recording without a browser: its form, delays, and calibrations that are stopped, kept or offered."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from clicked_points import clicked
from scipy.spatial.transform import Rotation
from swaying import write_log, write_swaying
from visitor import write_lab_files
from waiting import PATIENCE, eventually

from carts_core import optimization
from carts_core.errors import SettingsError
from carts_core.imaging.working_image import Window
from carts_core.model.camera import HALF_PIXEL
from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_core.model.robot import Robot
from carts_core.model.scene import Scene
from carts_core.networks import FeatureExtractor
from carts_core.optimization import ImagePredictor, StopReason
from carts_core.optimization.hand_eye import ImagePoint, PoseDeviation, read_prior
from carts_core.recording import Sequence
from carts_core.recording.importing.delays import open_recording
from carts_core.rendering import Renderer
from carts_core.settings.interchange import ImportOptions
from carts_viewer.jobs.solver_process import SolverInProcess
from carts_viewer.start.roots import Roots
from carts_viewer.start.site import Site
from carts_viewer.wizard import hand_eye
from carts_viewer.wizard.calibration import CalibrationJob, target_folder
from carts_viewer.wizard.check import Guess, check_form, guess
from carts_viewer.wizard.draft import ClickedPoint, Draft, DraftFile, Step, changed, picked
from carts_viewer.wizard.hand_eye import FramePicture
from carts_viewer.wizard.points import ClickPrompt
from carts_viewer.wizard.wizard import RecordingWizard

FRAMES = 6


JOINTS = np.array([0.1, 0.05, 0.12, 0.5, 0.1, -0.2])


def recording(folder: Path, header: list[str], values: np.ndarray) -> Draft:
    (folder / "left").mkdir(parents=True)
    for number in range(FRAMES):
        cv2.imwrite(str(folder / f"left/{number:03d}.png"), np.zeros((48, 64, 3), np.uint8))
    np.savetxt(folder / "log.csv", np.tile(values, (FRAMES, 1)), delimiter=",", header=",".join(header), comments="")
    return Draft(source=str(folder), name="rec")


def after(draft: Draft, *choices: tuple[str, str]) -> tuple[Draft, Guess]:
    for name, value in choices:
        made = changed(draft, name, value, {})
        assert made is not None
        draft = made
    return draft, guess(draft)


def test_a_table_of_unknown_columns_is_shown_with_values_and_the_cameras_stay(tmp_path: Path) -> None:
    draft = recording(tmp_path / "rec", [f"{letter} thing" for letter in "abcdef"], JOINTS)
    found = guess(draft)
    assert found.recording is not None and [camera.name for camera in found.recording.cameras] == ["left"]
    assert "neither six recognizable joints" in found.problems["columns", ""]
    form = check_form(draft, found, {})
    assert (
        ">c thing</th>" in form
        and ">0.12</td>" in form
        and "log.csv" in form
        and "64 × 48" in form
        and " --" not in form
    )
    joints = [(f"meaning {letter} thing", joint) for joint, letter in zip(JOINT_NAMES, "abcdef", strict=True)]
    _, found = after(draft, *joints)
    assert found.recording is not None and not found.problems
    assert found.recording.arms[0].values is not None and found.recording.arms[0].values[0] == pytest.approx(JOINTS)
    _, found = after(draft, ("no-table", ""))
    assert found.recording is not None and not found.problems


def test_a_question_about_units_and_rates_is_answered_in_the_form(tmp_path: Path) -> None:
    decimetres = JOINTS * np.where(np.arange(6) == 2, 10, 1)
    draft = recording(tmp_path / "rec", list(JOINT_NAMES), decimetres)
    found = guess(draft)
    assert "insertion is ambiguous" in found.problems["columns", ""]
    assert 'value="dm"' in check_form(draft, found, {})
    for choice in (("length_unit", "dm"), ("unit insertion", "dm")):
        _, found = after(draft, choice)
        assert found.recording is not None and not found.problems
        assert found.recording.arms[0].values is not None
        assert found.recording.arms[0].values[0] == pytest.approx(JOINTS)
    _, found = after(draft, ("length_unit", "dm"), ("frame_rate", "10"))
    assert found.recording is not None and found.recording.frame_times == pytest.approx(np.arange(FRAMES) / 10)


def test_what_belongs_to_a_table_or_a_camera_goes_with_it(tmp_path: Path) -> None:
    draft = recording(tmp_path / "rec", ["q1", "q2", "q3", "q4", "q5", "q6"], JOINTS)
    made, found = after(draft, ("angle_unit", "deg"), ("frame_rate", "30"), ("no-table", ""))
    assert found.recording is not None and made.options == replace(draft.options, kinematics=Path("none"))
    extra = draft.with_options(
        images={"left": str(tmp_path / "rec/left"), "extra": str(tmp_path / "rec/left")},
        calibration={"extra": tmp_path / "extra.yaml"},
        calibration_size={"extra": "64x48"},
    )
    made = changed(extra, "remove-camera", "extra", {})
    assert made is not None and [*made.options.images] == ["left"]
    assert not made.options.calibration and not made.options.calibration_size


def test_columns_that_were_chosen_or_named_are_not_called_guessed(tmp_path: Path) -> None:
    draft = recording(tmp_path / "named", list(JOINT_NAMES), JOINTS)
    form = check_form(draft, guess(draft), {})
    assert "yaw (by name)" in form and "(guessed)" not in form
    draft = recording(tmp_path / "numbered", [f"q{number}" for number in range(6)], JOINTS)
    assert "yaw (guessed)" in check_form(draft, guess(draft), {})
    chosen = after(draft, *((f"meaning q{number}", joint) for number, joint in enumerate(JOINT_NAMES)))
    assert "(guessed)" not in check_form(*chosen, {})


def test_a_pose_table_that_raises_a_question_is_not_called_missing(tmp_path: Path) -> None:
    poses = np.array([0.1, 0.2, 30.0, 0.0, 0.0, 0.0, 1.0])
    draft = recording(tmp_path / "rec", [*"xyz", "qx", "qy", "qz", "qw"], poses)
    found = guess(draft)
    form = check_form(draft, found, {})
    assert found.problems and "log.csv" in form and "64 × 48" in form
    assert "no table" not in form


def test_the_trials_of_a_folder_of_jigsaws_are_offered(tmp_path: Path) -> None:
    folder = tmp_path / "JIGSAWS/Suturing/kinematics/AllGestures"
    folder.mkdir(parents=True)
    for number in (1, 2):
        (folder / f"Suturing_B00{number}.txt").write_text("1 2 3\n")
    draft = Draft(source=str(tmp_path / "JIGSAWS"), name="JIGSAWS")
    found = guess(draft)
    form = check_form(draft, found, {})
    assert "Choose a trial" in form and f'<option value="{folder / "Suturing_B002.txt"}">Suturing_B002</option>' in form


def test_a_delay_between_video_and_log_is_proposed_taken_and_undone(tmp_path: Path, shipped_psm: Robot) -> None:
    folder = write_swaying(tmp_path / "labs" / "run", shipped_psm, 3, 7.0).parent
    write_log(folder / "log.csv", shipped_psm, 3, 7.0, late=0.12)
    (folder / "sequence.toml").unlink()
    file = DraftFile()
    file.write(Draft(source=str(folder), name="run"))
    with Site([tmp_path / "labs"], port=0) as site:
        site.post(lambda: site.show_recording(file.key))
        place = place_of(site)

        def chosen(name: str, value: str = "") -> float | None:
            site.post(lambda: place.choose(name, value))
            site.wait()
            return place.draft.options.time_offset

        def shows(text: str) -> None:
            eventually(lambda: text in site.document.content)

        site.wait()
        shows("Estimating the delay")
        assert "Columns of log.csv" in site.document.content
        chosen("clock", "s")  # another choice, which starts it again
        shows("Proposed: time_offset")
        assert place.draft.options.time_offset is None
        assert chosen("accept-delay") == pytest.approx(0.12, abs=0.01)
        chosen("estimate-delay")
        chosen("cancel-delay")
        assert "Estimating" not in site.document.content and "Estimate from the motion" in site.document.content
        chosen("estimate-delay")
        shows("agrees with the motion")
        assert chosen("undo") is None


@pytest.mark.parametrize("offset", [-1.3, 1.3])
def test_points_stay_in_their_images_when_a_time_offset_drops_frames(
    tmp_path: Path, shipped_psm: Robot, offset: float
) -> None:
    folder = write_swaying(tmp_path / "labs" / "run", shipped_psm, 3, 1.5).parent
    (folder / "sequence.toml").unlink()
    draft = Draft(Step.HAND_EYE, str(folder), "run", ImportOptions(time_offset=0.0))
    last = len(ids_of(draft)) - 1
    points = [ImagePoint(frame, "left", "PSM1", "tip", (9.0, 9.0)) for frame in (0, 20, last)]
    file = DraftFile()
    file.write(replace(draft, points=drafted(points)))
    with Site([tmp_path / "labs"], port=0) as site:
        site.post(lambda: site.show_recording(file.key))
        place = place_of(site)
        before = [point.frame_id for point in place.draft.points]
        for name, value in (("back", ""), ("time_offset", str(offset)), ("continue", "")):
            site.post(lambda name=name, value=value: place.choose(name, value))
        site.wait()
        assert "1 point was removed, since the frame" in site.document.content
        kept = place.draft.points
    ids = ids_of(place.draft)
    assert [point.frame_id for point in kept] == (before[1:] if offset < 0 else before[:-1])
    assert len(ids) < last and [ids[point.frame] for point in kept] == [point.frame_id for point in kept]


def ids_of(draft: Draft) -> tuple[str, ...]:
    found = guess(draft).recording
    assert found is not None
    return found.frame_ids


def test_points_are_removed_with_the_images_or_the_calibration_of_their_camera_only() -> None:
    left, right = (ClickedPoint(0, camera, "PSM1", "tip", (9.0, 9.0), "1") for camera in ("left", "right"))
    found = {"left": Path("/run/left"), "right": Path("/run/right")}
    draft = Draft(source="/run", points=(left, right))
    assert picked(draft, "calibration left", Path("/run/left.yaml"), found).points == (right,)
    assert picked(draft, "images right", Path("/run/other"), found).points == (left,)
    assert picked(draft, "images", Path("/run/third"), found).points == (left, right)
    assert after(draft, ("calibration_size right", "64x48"))[0].points == (left,)


def test_an_arm_without_points_keeps_its_placeholder_pose_and_its_note(tmp_path: Path) -> None:
    folder = tmp_path / "labs" / "rec"
    header = [f"{arm}Joint{number}" for arm in ("PSM1", "PSM2") for number in range(1, 7)]
    draft = replace(recording(folder, header, np.tile(JOINTS, 2)), step=Step.HAND_EYE, focal_length=True)
    rows = np.tile(JOINTS, (FRAMES, 2)) * np.random.default_rng(0).uniform(0.4, 1.6, (FRAMES, 12))
    np.savetxt(folder / "log.csv", rows, delimiter=",", header=",".join(header), comments="")
    found = guess(draft).recording
    assert found is not None
    sequence, opened = open_recording(found)
    with opened:
        (camera,) = sequence.scene.cameras
        fx, fy, cx, cy = camera.intrinsics
        true = replace(sequence.scene, cameras=(replace(camera, intrinsics=(1.2 * fx, 1.2 * fy, cx, cy)),))
        points = clicked(true, sequence.measured, range(4), (camera.name,), noise=0.01)
    file = DraftFile()
    file.write(replace(draft, points=drafted(point for point in points if point.arm == "PSM1")))
    with Site([tmp_path / "labs"], port=0) as site:
        site.post(lambda: site.show_recording(file.key))
        place = place_of(site)
        assert "PSM2: placeholder pose." in site.document.content
        site.post(lambda: place.choose("save", ""))
        app = eventually(lambda: site.app, lambda now: now is not None)
        assert app is not None
        text, prior = app.sequence.path.read_text(), read_prior(app.sequence.path, app.sequence.scene)
    assert prior is not None and list(prior.base_covariances) == ["PSM1"]
    assert text.count("Base frame: 16 points clicked in carts view.") == 1
    assert text.count("Base frame: a placeholder in front of the camera.") == 1
    assert "PSM2: no base frame" in text and "PSM1: no base frame" not in text and "no calibration" not in text


# ---- Calibrations; this part stands for any step of the optimizer ---------------------------------------------------


CALIBRATE, STOP = ("calibrate", ""), ("cancel", "")


class OneStep:
    """Replacement of `CalibrationOptimizer`: one step, with the unchanged scene as result."""

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
            unknowns=(),
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
    monkeypatch.setattr(optimization, "CalibrationOptimizer", OneStep)
    return begun


def drafted(points: Iterable[ImagePoint]) -> tuple[ClickedPoint, ...]:
    """Points as in a draft of an earlier version, with the indices of their frames only."""
    return tuple(ClickedPoint(**asdict(point)) for point in points)


def open_calibration(folder: Path, made: Sequence, seen: Scene) -> tuple[Path, str]:
    """Write a recording whose points were clicked as in a scene, and its draft; returns root and key of the draft."""
    (folder / "labs" / "day" / "left").mkdir(parents=True)
    for number in range(len(made)):
        image = np.full((240, 320, 3), 200 * np.eye(3)[2 - number], np.uint8)
        cv2.imwrite(str(folder / f"labs/day/left/{number}.png"), image)
    (camera,) = made.scene.cameras
    K = camera.K - np.array([[0, 0, HALF_PIXEL], [0, 0, HALF_PIXEL], [0, 0, 0]])
    write_lab_files(folder / "labs" / "day", range(len(made)), made.measured["PSM1"], [("left", (320, 240), K)])
    points = clicked(seen, made.measured, range(len(made)), ("left",), noise=0.5)
    file = DraftFile()
    file.write(Draft(Step.HAND_EYE, str(folder / "labs" / "day"), "day", points=drafted(points)))
    return folder / "labs", file.key


@pytest.fixture
def made(tiny_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(tiny_sequence(frames=3, width=320, height=240))


@pytest.fixture
def site(made: Sequence, tmp_path: Path) -> Iterator[Site]:
    """At the last step of New recording, with the points clicked."""
    root, key = open_calibration(tmp_path / "new", made, made.scene)
    with Site([root], port=0, solver=SolverInProcess()) as opened:
        opened.post(lambda: opened.show_recording(key))
        yield opened


def place_of(site: Site) -> RecordingWizard:
    site.wait()
    assert isinstance(site.shown, RecordingWizard) and 'role="alert"' not in site.document.content
    return site.shown


def keys(place: RecordingWizard) -> list[str]:
    """The points in the page's messages."""
    return [ClickPrompt.of(point).key for point in place.draft.points]


def ended(site: Site, text: str, timeout: float = PATIENCE) -> Draft:
    """The draft once this is to be read."""
    eventually(lambda: site.document.content, lambda content: text in content, timeout)
    return place_of(site).draft


def test_a_calibration_that_had_ended_before_it_was_stopped_is_not_taken_either(
    site: Site, jobs: list[CalibrationJob]
) -> None:
    place = place_of(site)

    def stop_when_it_has_ended() -> None:
        place.choose(*CALIBRATE)
        jobs[-1].join(PATIENCE)
        place.choose(*STOP)

    site.post(stop_when_it_has_ended)
    assert ended(site, "Stopped; the calibration from your points is unchanged.").calibration is None
    site.post(lambda: place.choose(*CALIBRATE))
    assert ended(site, "Calibrated").calibration is not None, "the next one is not stopped"


@pytest.mark.parametrize("moment", ["the start", "a step", "the result"])
def test_a_calibration_is_stopped_at_any_moment(
    site: Site, jobs: list[CalibrationJob], monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    place = place_of(site)

    def pressed() -> None:
        site.post(lambda: place.choose(*STOP))
        # The page answers at once.
        eventually(lambda: "Stopping …" in site.document.content)
        eventually(lambda: jobs and jobs[-1].cancelled)

    class Stopped(OneStep):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            if moment == "the start":
                pressed()

        def __iter__(self) -> Iterator[SimpleNamespace]:
            yield from super().__iter__()
            if moment == "a step":
                pressed()
                yield from super().__iter__()

        def result(self) -> SimpleNamespace:
            assert moment == "the result"
            pressed()
            return super().result()

    monkeypatch.setattr(optimization, "CalibrationOptimizer", Stopped)
    site.post(lambda: place.choose(*CALIBRATE))
    assert ended(site, "Stopped; the calibration from your points is unchanged.").calibration is None


def test_two_clicks_on_the_same_prompt_place_one_point(site: Site) -> None:
    place = place_of(site)
    for key in keys(place)[:2]:
        site.post(lambda key=key: place.choose("remove-point", key))
    place_of(site)
    assert place.prompt is not None and place.prompt.key in site.document.content
    for at in ("0.5 0.5", "0.6 0.5", "nan 2"):
        site.post(lambda key=place.prompt.key, at=at: place.choose(f"click {key}", at))
    points = place_of(site).draft.points
    assert len(points) == 11 and points[-1].pixel == (160.0, 120.0)


def test_two_clicks_on_remove_take_away_one_point(site: Site) -> None:
    place = place_of(site)
    first, *others = place.draft.points
    key = keys(place)[0]
    # The second one is of a document of before; an unknown point is ignored.
    for name, value in (
        ("remove-point", key),
        ("remove-point", key),
        ("remove-point", "1"),
        (f"move-point {key}", "0 0"),
    ):
        site.post(lambda name=name, value=value: place.choose(name, value))
    assert place_of(site).draft.points == tuple(others)
    site.post(lambda: place.choose("undo", ""))
    assert place_of(site).draft.points == (first, *others)


def test_displacements_of_a_point_add_up(site: Site) -> None:
    place = place_of(site)
    (u, v), others = place.draft.points[0].pixel, place.draft.points[1:]
    for by in ("0.01 0", "0.01 -0.02", "2 0", "0.1"):
        site.post(lambda by=by: place.choose(f"shift-point {keys(place)[0]}", by))
    points = place_of(site).draft.points
    assert points[0].pixel == pytest.approx((u + 0.02 * 320, v - 0.02 * 240)) and points[1:] == others


def test_points_of_another_calibration_are_removed_with_a_message(site: Site) -> None:
    place = place_of(site)
    for name, value in (("back", ""), ("calibration_size left", "320x240")):
        site.post(lambda name=name, value=value: place.choose(name, value))
    site.wait()
    assert "12 clicked points of the previous images or calibration removed." in site.document.content
    assert not place.draft.points
    site.post(lambda: place.choose("undo", ""))
    assert len(place_of(site).draft.points) == 12


def test_a_stop_does_not_wait_for_all_steps_to_be_shown(
    site: Site, jobs: list[CalibrationJob], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Steps(OneStep):
        def __iter__(self) -> Iterator[SimpleNamespace]:
            for _ in range(200):
                yield from super().__iter__()

    shown: list[int] = []

    def show(_: FramePicture, index: int, *__: object) -> None:
        shown.append(index)
        time.sleep(0.2)

    place = place_of(site)
    monkeypatch.setattr(optimization, "CalibrationOptimizer", Steps)
    monkeypatch.setattr(FramePicture, "show", show)
    site.post(lambda: place.choose(*CALIBRATE))
    eventually(lambda: bool(jobs))
    jobs[-1].join(PATIENCE)
    count = len(shown)
    site.post(lambda: place.choose(*STOP))
    site.wait()
    assert len(shown) <= count + 2


def test_a_recording_in_a_read_only_folder_is_saved_in_the_next_allowed_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Root may write to every folder, so the answer of the operating system is replaced."""
    source, other = tmp_path / "labs" / "day", tmp_path / "results"
    for folder in (source, other):
        folder.mkdir(parents=True)
    roots, read_only = Roots([source.parent, other]), {source.parent}
    monkeypatch.setattr(os, "access", lambda folder, _: folder not in read_only)
    assert target_folder(roots, source, "day") == other / "day_sequence"
    (other / "day_sequence").mkdir()
    assert target_folder(roots, source, "day") == other / "day_sequence_2"
    read_only.add(other)
    with pytest.raises(SettingsError, match=r"are read-only\. Make one of them writable"):
        target_folder(roots, source, "day")


def test_few_points_are_called_ambiguous_until_a_calibration_is_kept(site: Site, jobs: list[CalibrationJob]) -> None:
    place, text = place_of(site), "another pose, beyond the standard deviations, can fit these points equally well."
    assert text not in site.document.content
    for _ in range(4):
        wrist = next(key for key in keys(place) if key.partition("PSM1/")[2].startswith("wrist"))
        site.post(lambda wrist=wrist: place.choose("remove-point", wrist))
        site.wait()
    assert f"PSM1 in left: {text} Click the tip and the wrist joints" in site.document.content
    site.post(lambda: place.choose(*CALIBRATE))
    ended(site, "Calibrated")
    assert text not in site.document.content


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
    assert "Loss" not in ended(site, "Calibration from points").to_json()
    assert place_of(site).draft.calibration is None and "± 8.2 mm" not in site.document.content


def test_a_calibration_that_moves_within_the_errors_of_points_and_joints_says_what_it_follows(
    site: Site, jobs: list[CalibrationJob], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Moved(OneStep):
        """An optimizer that shifts the base frame by 0.3 mm."""

        def __init__(self, scene: Scene, *_: object, **__: object) -> None:
            shift = np.eye(4)
            shift[0, 3] = 3e-4
            arms = tuple(replace(arm, T_world_base=shift @ arm.T_world_base) for arm in scene.arms)
            super().__init__(replace(scene, arms=arms))

    monkeypatch.setattr(optimization, "CalibrationOptimizer", Moved)
    place = place_of(site)
    site.post(lambda: place.choose(*CALIBRATE))
    report = ended(site, "The calibration fits the images of many frames").report
    assert report is not None and not report.objection and report.rms_limit is not None
    assert f"explain up to {report.rms_limit:.1f} px RMS" in site.document.content
    before, after = (np.sqrt(np.mean(np.square(np.array(each, float)))) for each in (report.before, report.after))
    assert before + 0.1 < after < report.rms_limit


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

    monkeypatch.setattr(optimization, "CalibrationOptimizer", Moved)
    place = place_of(site)
    site.post(lambda: place.choose(*CALIBRATE))
    offer = ended(site, "Calibration not kept")
    assert offer.calibration is None and offer.offered is not None
    assert offer.report is not None and offer.report.objection
    assert "px allowed" in site.document.content and "<td>2.00°</td>" in site.document.content
    for choice, text, kept in (
        ("keep", "Kept by the user", True),
        ("undo", "Calibration not kept", False),
        ("discard", "Calibration from points", False),
        ("undo", "Calibration not kept", False),
    ):
        site.post(lambda choice=choice: place.choose(choice, ""))
        assert (ended(site, text).calibration is not None) is kept
        assert ("Keep anyway" in site.document.content) is (text == "Calibration not kept")


_CALIBRATE = """
import json, sys, time
from pathlib import Path

import carts_core.cli.command_line
from carts_viewer.start.roots import Roots
from carts_viewer.start.site import Site

RUNS = 'aria-label="Calibration"'
with Site([Path(sys.argv[1])], port=0) as site:
    site.post(lambda: site.show_recording(sys.argv[2]))
    site.wait()
    page = site.shown
    for choice in ("back", "continue", "calibrate"):
        site.post(lambda choice=choice: page.choose(choice, ""))
    site.wait()
    assert RUNS in site.document.content
    while RUNS in site.document.content:
        time.sleep(0.1)
    print(json.dumps([page.draft.to_json(), site.document.content, "torch" in sys.modules]))
"""


def test_a_calibration_of_the_solver_process_equals_one_in_this_process_and_needs_no_torch(
    made: Sequence, tmp_path: Path
) -> None:
    root, key = open_calibration(tmp_path / "new", made, made.scene)
    images = root / "day" / "left"
    shutil.rmtree(images)
    shutil.copytree(made.path.parent / "regular" / "left", images)
    here = DraftFile()
    here.write(DraftFile(key).read())
    command = [sys.executable, "-c", _CALIBRATE, str(root), key]
    said = subprocess.check_output(command, text=True, timeout=300)
    there, content, torch_imported = json.loads(said.splitlines()[-1])
    with Site([root], port=0, solver=SolverInProcess()) as site:
        site.post(lambda: site.show_recording(here.key))
        place = place_of(site)
        site.post(lambda: place.choose(*CALIBRATE))
        eventually(lambda: "Loss" in site.document.content, timeout=300)
        assert there == place.draft.to_json() and place.draft.calibration is not None
    assert "Calibrated" in content and not torch_imported


class Truths(ImagePredictor):
    """Predicts the true surface map of one of three frames: the red, the green or the blue one."""

    device = torch.device("cpu")
    stride, sha256 = 16, "0" * 64

    def __init__(self, made: Sequence) -> None:
        renderer = Renderer(made.scene, width=640, height=480)
        frames = map(made.frame, range(len(made)))
        maps = [renderer.surface(made.scene.state(frame.measured)).maps for frame in frames]
        self.maps = [torch.nn.functional.avg_pool2d(each, 2) for each in maps]

    def predict(self, images: torch.Tensor, given: torch.Tensor, window: Window) -> torch.Tensor:
        """The truth in a window."""
        return window.of(self.maps[int(images[0].mean((1, 2)).argmax())])[: len(images)]


@pytest.mark.parametrize("agreeing", [True, False])
def test_a_calibration_by_true_maps_is_kept_where_clicked_points_agree(
    made: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, agreeing: bool
) -> None:
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0 if agreeing else 6.0, 0.0], degrees=True).as_matrix()
    (arm,) = made.scene.arms
    seen = replace(made.scene, arms=(replace(arm, T_world_base=turn @ arm.T_world_base),))
    root, key = open_calibration(tmp_path / "new", made, seen)
    monkeypatch.setattr(FeatureExtractor, "load", lambda *_, **__: Truths(made))
    with Site([root], port=0, solver=SolverInProcess()) as site:
        site.post(lambda: site.show_recording(key))
        place = place_of(site)
        site.post(lambda: place.choose(*CALIBRATE))
        draft = ended(site, "Calibrated" if agreeing else "Calibration not kept", 240)
    assert draft.report is not None and (draft.calibration is not None) is agreeing
    assert bool(draft.report.objection) is not agreeing
    rows = site.document.content.count('class="wrong"')
    assert rows == len(draft.report.disagreeing)
