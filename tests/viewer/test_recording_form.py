"""The form of a new recording: what is asked has a control, and what is known stays in view."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_viewer.wizard.check import Guess, check_form, guess
from carts_viewer.wizard.draft import Draft, changed

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
    assert "not recognized" in found.problems["columns"]
    form = check_form(draft, found, {})
    assert "c thing (0.12)" in form and "log.csv" in form and "64 × 48" in form
    joints = [(f"column {joint}", f"{letter} thing") for joint, letter in zip(JOINT_NAMES, "abcdef", strict=True)]
    _, found = after(draft, *joints)
    assert found.recording is not None and not found.problems
    assert found.recording.arms[0].values is not None and found.recording.arms[0].values[0] == pytest.approx(JOINTS)
    _, found = after(draft, ("no-table", ""))
    assert found.recording is not None and not found.problems


def test_a_question_about_units_and_rates_is_answered_in_the_form(tmp_path: Path) -> None:
    decimetres = JOINTS * np.where(np.arange(6) == 2, 10, 1)
    draft = recording(tmp_path / "rec", list(JOINT_NAMES), decimetres)
    found = guess(draft)
    assert "insertion is not clear" in found.problems["columns"]
    assert 'value="dm"' in check_form(draft, found, {})
    for choice in (("length_unit", "dm"), ("unit insertion", "dm")):
        _, found = after(draft, choice)
        assert found.recording is not None and not found.problems
        assert found.recording.arms[0].values is not None
        assert found.recording.arms[0].values[0] == pytest.approx(JOINTS)
    _, found = after(draft, ("length_unit", "dm"), ("frame_rate", "10"))
    assert found.recording is not None and found.recording.frame_times == pytest.approx(np.arange(FRAMES) / 10)


def test_columns_that_were_chosen_or_named_are_not_called_guessed(tmp_path: Path) -> None:
    draft = recording(tmp_path / "named", list(JOINT_NAMES), JOINTS)
    form = check_form(draft, guess(draft), {})
    assert "yaw (by name)" in form and "(guessed)" not in form
    draft = recording(tmp_path / "numbered", [f"q{number}" for number in range(6)], JOINTS)
    assert "q0 (guessed)" in check_form(draft, guess(draft), {})
    chosen = after(draft, *((f"column {joint}", f"q{number}") for number, joint in enumerate(JOINT_NAMES)))
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
    assert "Choose one" in form and f'<option value="{folder / "Suturing_B002.txt"}">Suturing_B002</option>' in form
