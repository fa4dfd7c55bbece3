"""What many frames together are said to be worth."""

from dataclasses import replace

import numpy as np
import pytest
from evidence import CONVINCING

from carts_core.cli.printing import calibration_hint, sequence_hint, verdict_line
from carts_core.optimization import Assessment, StopReason, Verdict
from carts_core.optimization.verdict import (
    DomainCheck,
    assess,
    assess_calibration,
    assess_sequence,
    median_evidence,
    without_knowledge,
    worse_in,
)

RIGHT = replace(CONVINCING, changed=None, overlap_with_change=None)
WRONG = replace(RIGHT, loss=0.2, residual=0.8, agreement=0.4, unconditioned=0.1, predicted=0.1)


def verdicts(right: int, wrong: int) -> list[Assessment]:
    return [assess(RIGHT)] * right + [assess(WRONG)] * wrong


@pytest.mark.parametrize(
    ("right", "wrong", "wanted"),
    [(20, 0, Verdict.GOOD), (19, 1, Verdict.GOOD), (15, 5, Verdict.DOUBTFUL), (10, 10, Verdict.FAILED)],
)
def test_a_sequence_is_as_good_as_most_of_its_frames(right: int, wrong: int, wanted: Verdict) -> None:
    found = assess_sequence(verdicts(right, wrong))
    assert found.verdict is wanted and found.counts == {"good": right, "doubtful": 0, "failed": wrong}
    assert (sequence_hint("left", found) is None) == (wanted is Verdict.GOOD)


def test_the_verdict_on_a_sequence_names_the_reason_of_most_frames_and_what_to_try() -> None:
    unseen = assess(replace(RIGHT, start_area=0.0))
    found = assess_sequence([unseen] * 3 + verdicts(2, 1))
    assert unseen.reason in found.reason and found.remedy == unseen.remedy
    hint = sequence_hint("left", found)
    assert hint is not None and "keep the measured values" in hint


def test_an_arm_that_has_left_the_image_makes_a_fit_fail_however_well_the_others_fit() -> None:
    found = assess(replace(RIGHT, still_in_view=0.1))
    assert found.verdict is Verdict.FAILED and "left the image" in found.reason and found.remedy


def test_a_calibration_is_judged_by_the_median_of_its_frames() -> None:
    good, failed = assess_calibration([RIGHT] * 5), assess_calibration([WRONG] * 5)
    assert good.verdict is Verdict.GOOD and good.reason == "The images support the calibration."
    assert failed.verdict is Verdict.FAILED and "calibration" in failed.reason and "--observe masks" in failed.remedy
    assert "kept as it was" in (calibration_hint(failed, StopReason.FAILED) or "")
    assert median_evidence([RIGHT, WRONG]).agreement == pytest.approx(0.675)


def test_a_doubtful_calibration_fails_where_the_network_does_not_know_the_robot() -> None:
    doubtful = Assessment(Verdict.DOUBTFUL, "The edges do not agree.", "Look at it.", 0.3, RIGHT)
    stranger, friend, unseen = (DomainCheck(recognized=value, elsewhere=0.0) for value in (0.9, 0.97, None))
    found = without_knowledge(doubtful, [stranger, unseen, stranger])
    assert found.verdict is Verdict.FAILED and "The edges do not agree, and the network recognizes" in found.reason
    assert "overlap of 0.90" in found.reason and "--observe masks" in found.remedy
    hardly = without_knowledge(doubtful, [replace(stranger, recognized=0.9499)])
    assert "an overlap of 0.949 only (0.95 or more is usual)" in hardly.reason
    assert without_knowledge(doubtful, [friend, friend, stranger]) == doubtful
    assert without_knowledge(doubtful, [unseen]) == doubtful and without_knowledge(doubtful, []) == doubtful
    good = assess_calibration([RIGHT] * 5)
    assert without_knowledge(good, [stranger]) == good


def test_what_is_worse_beyond_chance_is_named() -> None:
    before = [replace(RIGHT, agreement=0.95 + 0.001 * i) for i in range(6)]
    assert worse_in(before, before) == []
    lower = [replace(found, agreement=found.agreement - 0.01) for found in before]
    assert worse_in(before, lower) == ["agreement"] and worse_in(lower, before) == []
    uneven = [replace(f, residual=f.residual + (0.3 if i == 0 else -0.05)) for i, f in enumerate(before)]
    assert worse_in(before, uneven) == []


@pytest.mark.parametrize(("drop", "wanted"), [(1e-5, []), (0.005, []), (0.1, ["agreement"])])
def test_one_frame_is_worse_by_more_than_frames_usually_differ(drop: float, wanted: list[str]) -> None:
    assert worse_in([RIGHT], [replace(RIGHT, agreement=RIGHT.agreement - drop)]) == wanted


def test_five_measures_together_are_called_worse_by_chance_once_in_twenty() -> None:
    random, names = np.random.default_rng(0), ("agreement", "unconditioned", "overlap_with_change", "residual", "loss")
    known, wrong = replace(CONVINCING), 0
    for _ in range(400):
        changes = 0.02 * random.standard_normal((20, len(names)))
        after = [
            replace(known, **{name: getattr(known, name) + step for name, step in zip(names, row, strict=True)})
            for row in changes
        ]
        wrong += bool(worse_in([known] * len(after), after))
    assert wrong / 400 < 0.07


@pytest.mark.parametrize(
    ("agreement", "wanted"), [(0.97, Verdict.GOOD), (0.85, Verdict.DOUBTFUL), (0.6, Verdict.FAILED)]
)
def test_where_masks_are_fitted_the_overlap_with_them_decides(agreement: float, wanted: Verdict) -> None:
    assert assess(replace(RIGHT, masked=True, agreement=agreement)).verdict is wanted


def test_verdicts_on_masks_are_counted_with_the_joints_that_are_not_determined() -> None:
    assert verdict_line("left", [None], [None]) is None
    joints = [["PSM1.roll", "PSM1.jaw"], None, ["PSM1.roll", "PSM1.jaw"], [], None]
    said = verdict_line("left", ["good", "failed", "good", "good", None], joints)
    assert said == (
        "left: mask good, 2 joints not determined in 2 of 4 runs; mask good, all joints determined in 1 of 4 runs; "
        "mask failed in 1 of 4 runs."
    )
