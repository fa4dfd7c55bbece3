"""What is planned, and in which order."""

import pytest

from carts_core.errors import SettingsError
from carts_core.lab.benchmark import FULL, QUICK, Run, Source, plan
from carts_core.lab.synthesis import DOMAINS
from carts_core.recording import Sequence

METHODS = ("unet", "start", "l1", "paper", "ours")


def _source(name: str, frames: list[int], cameras: tuple[str, ...] = ("left",)) -> Source:
    def never(_: object) -> Sequence:
        raise AssertionError("a plan opens nothing")

    return Source(name, "", "left", frames, "", never, cameras, [0, 1])


BOTH = [_source("synthetic", [0, 2]), _source("real", [5], ("left", "right"))]


@pytest.mark.parametrize("scope", [QUICK, FULL])
def test_no_run_is_planned_twice_and_the_main_table_is_complete(scope) -> None:
    runs = plan(scope, BOTH)
    assert len(set(runs)) == len(runs)
    for source, frame in (("synthetic", 0), ("synthetic", 2), ("real", 5)):
        for domain in DOMAINS:
            for method in METHODS:
                assert Run(source, domain, frame, method) in runs


def test_frame_comes_after_frame_so_that_a_stopped_benchmark_has_some_of_everything() -> None:
    runs = plan(FULL, BOTH)
    alone = [run for run in runs if run.method not in ("sequence", "temporal")]
    assert runs[: len(alone)] == alone
    by_all = [run for run in alone if (run.source, run.frame) in (("synthetic", 0), ("synthetic", 2), ("real", 5))]
    assert runs[: len(by_all)] == by_all
    first = [run for run in by_all if (run.source, run.frame) != ("synthetic", 2)]
    assert runs[: len(first)] == first


@pytest.mark.parametrize("frames", [0, 25])
def test_more_frames_than_there_are_is_an_error_that_says_how_many_may_be_asked_for(frames: int) -> None:
    with pytest.raises(SettingsError, match=f"--frames is {frames}; .* Give 1 to {FULL.sequence_frames}"):
        FULL.with_frames(frames)
