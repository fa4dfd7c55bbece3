"""How certain the estimates of a sequence say they are."""

from dataclasses import replace

import numpy as np
from short_sequence import ALONE, ARM, FRAMES, Truths, optimizer

from carts_core.optimization.measurement import Origin
from carts_core.optimization.verdict import Verdict


def test_frames_in_quick_succession_inform_others_less(truths: Truths) -> None:
    """Errors of images are alike for a while, and the longer that is, the less many frames know."""
    stds = []
    for memory in (0.01, 1.0):
        sequence = optimizer(truths, model=replace(ALONE, correlation_seconds=memory, shared_seconds=memory))
        last = [step for step in sequence if step.index == FRAMES - 1][-1]
        end = sequence.estimates
        stds.append(end[3].joint_std[ARM])
        # The last frame knew all others when it was visited, and for itself it counts whole.
        np.testing.assert_allclose(last.joint_std[ARM], end[FRAMES - 1].joint_std[ARM], rtol=1e-3)
    assert (stds[1] > 1.2 * stds[0]).any() and (stds[1] > 0.99 * stds[0]).all()


def test_deviations_count_on_no_more_than_images_that_differ(truths: Truths) -> None:
    """A network that errs alike in all frames is not averaged out; what is estimated does not depend on that."""
    ends = []
    for shared in (0.5, 5.0):
        sequence = optimizer(truths, model=replace(ALONE, correlation_seconds=0.5, shared_seconds=shared))
        list(sequence)
        ends.append(sequence.estimates)
    for index in range(FRAMES):
        narrow, wide = (end[index] for end in ends)
        assert np.array_equal(narrow.joint_positions[ARM], wide.joint_positions[ARM])
        assert (wide.joint_std[ARM] > 0.999 * narrow.joint_std[ARM]).all()
    assert (ends[1][3].joint_std[ARM] > 1.1 * ends[0][3].joint_std[ARM]).any()


def test_a_doubtful_frame_is_less_certain_unless_its_values_come_from_elsewhere(truths: Truths) -> None:
    sequence = optimizer(truths)
    list(sequence)
    scene = truths.sequence.scene
    for start in Origin:
        estimate = replace(sequence.estimates[2], start=start)
        assert estimate.assessment is not None
        doubtful = replace(estimate.assessment, verdict=Verdict.DOUBTFUL, probability=0.4)
        judged = estimate.judged(doubtful, scene)
        assert judged.assessment is doubtful
        elsewhere = start in (Origin.KEYFRAME, Origin.CARRIED)
        known, before = judged.joint_std[ARM], estimate.joint_std[ARM]
        assert np.array_equal(known, before) if elsewhere else (known > 1.1 * before).any(), start
        np.testing.assert_array_equal(known, judged.uncertainty.joint_std(ARM, scene.arms[0].robot.joint_names))
