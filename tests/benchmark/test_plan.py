"""What is planned, and in which order."""

import pytest

from carts_core.benchmark import FULL, QUICK, Run, plan
from carts_core.errors import SettingsError
from carts_core.synthesis import DOMAINS

METHODS = ("unet", "start", "l1", "paper", "ours")


@pytest.mark.parametrize("scope", [QUICK, FULL])
def test_no_run_is_planned_twice_and_the_main_table_is_complete(scope) -> None:
    runs = plan(scope, {"synthetic": [0, 2], "real": [5]}, METHODS)
    assert len(set(runs)) == len(runs)
    for source, frame in (("synthetic", 0), ("synthetic", 2), ("real", 5)):
        for domain in DOMAINS:
            for method in METHODS:
                assert Run(source, domain, frame, method) in runs


def test_frame_comes_after_frame_so_that_a_stopped_benchmark_has_some_of_everything() -> None:
    runs = plan(FULL, {"synthetic": [0, 2], "real": [5]}, METHODS)
    first = [run for run in runs if (run.source, run.frame) != ("synthetic", 2)]
    assert runs[: len(first)] == first


def test_the_full_scope_has_every_error_in_every_domain() -> None:
    runs = plan(FULL, {"synthetic": [0]}, METHODS)
    for degrees in range(7):
        for domain in DOMAINS:
            assert Run("synthetic", domain, 0, "ours", float(degrees)) in runs


@pytest.mark.parametrize("frames", [0, 25])
def test_more_frames_than_there_are_is_an_error_that_says_how_many_may_be_asked_for(frames: int) -> None:
    with pytest.raises(SettingsError, match=f"--frames is {frames}; .* Give 1 to 24"):
        FULL.with_frames(frames)
