"""How often verdicts and deviations were right, from measurements made by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from handmade import make_measurement, target_of

from carts_core.lab.benchmark import Measurement
from carts_core.lab.benchmark.conditions import NO_ARM, misled, with_other_instruments, wrong_inputs
from carts_core.recording import Sequence


def _judged(
    dice: float, verdict: str, probability: float, frame: int = 0, source: str = "synthetic", domain: str = "regular"
) -> Measurement:
    found = make_measurement((0.85, dice), frame=frame, source=source, domain=domain)
    return replace(found, verdict=verdict, probability=probability, within=(10, 7, 9))


FRAMES = [
    _judged(0.97, "good", 0.02),
    _judged(0.93, "doubtful", 0.3, 1),
    _judged(0.0, "failed", 0.99, 2, domain=NO_ARM),
    _judged(0.7, "good", 0.05, 3),
]


def test_the_area_under_the_roc_is_how_often_a_wrong_mask_is_held_for_less_likely() -> None:
    # Wrong at 0.99 and 0.05, right at 0.02 and 0.3: three of four pairs are in order.
    assert target_of("verdict against Dice", *FRAMES).reached == "0.750"
    assert target_of("verdict against Dice", *FRAMES[:3]).met is True
    assert target_of("verdict against Dice", FRAMES[0], FRAMES[3]).met is None, "nothing was wrong about any input"


def test_what_is_wrong_about_an_input_is_what_its_name_says(tiny_sequence) -> None:
    path: Path = tiny_sequence(frames=4, cameras=("left", "right"), width=160, height=128)
    sequence = Sequence.open(path)
    right = sequence.frame(1, "regular")
    assert right.masks is not None
    empty, joints, image, instrument = (misled(sequence, kind, 1, "left") for kind in wrong_inputs(4, 2, built_in=True))
    assert empty.masks is not None and not empty.masks["left"].any()
    np.testing.assert_array_equal(empty.images["left"], sequence.background("left", "regular"))
    np.testing.assert_array_equal(joints.measured["PSM1"], sequence.frame(3, "regular").measured["PSM1"])
    np.testing.assert_array_equal(joints.images["left"], right.images["left"])
    np.testing.assert_array_equal(image.images["left"], right.images["right"])
    assert image.masks is not None
    np.testing.assert_array_equal(image.masks["left"], right.masks["right"])
    np.testing.assert_array_equal(instrument.images["left"], right.images["left"])
    assert instrument.truth is None
    (arm,), (other,) = sequence.scene.arms, with_other_instruments(sequence.scene, 1).arms
    assert other.robot.name != arm.robot.name and other.robot.joint_names == arm.robot.joint_names
