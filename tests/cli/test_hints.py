"""What commands suggest after their results."""

from carts_core.cli.printing import base_frame_hint, kept_start_hint


def test_wrong_base_frames_are_named_with_the_ways_out_of_it() -> None:
    hint = base_frame_hint("right", [0.5, None, 0.3])
    assert hint is not None
    for part in ("right:", "40 %", "carts calibrate", "--base-frames"):
        assert part in hint


def test_frames_that_say_nothing_or_little_give_no_hint() -> None:
    assert base_frame_hint("left", []) is None
    assert base_frame_hint("left", [None, None]) is None
    assert base_frame_hint("left", [0.4, 0.01, 0.02, 0.0]) is None, "one frame is not the recording"


def test_kept_starts_are_counted() -> None:
    assert kept_start_hint("left", ["converged", "warm"]) is None
    hint = kept_start_hint("left", ["start kept", "converged", "start kept"])
    assert hint is not None and hint.startswith("left: the start was kept in 2 of 3 runs")
