"""Jobs: one after the other, with progress and a log, and what becomes of them when the viewer ends."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from viewer_desk import Desk

from carts_core.errors import CartsError
from carts_core.project import ReviewState, Source
from carts_viewer import intents
from carts_viewer.jobs import Job, JobList, JobState
from carts_viewer.panels.jobs import job_line


def states(desk: Desk) -> list[tuple[str, str]]:
    return [(job.kind, str(job.state)) for job in desk.state.jobs]


def test_what_takes_long_waits_for_what_runs_and_the_page_stays_usable(desk: Desk) -> None:
    desk.do(intents.SetSetting("solver", "surface"), intents.OptimizeFrames("all"))
    desk.do(intents.Export("csv", "All"))
    assert states(desk) == [("optimize", "running"), ("export", "waiting")]
    desk.advance()
    # Meanwhile somebody works on.
    assert desk.do(intents.ShowFrame(2), intents.SetReview(ReviewState.REJECTED)).index == 2
    desk.finish()
    assert states(desk) == [("optimize", "done"), ("export", "done")]
    optimized, exported = desk.state.jobs
    assert (optimized.done, optimized.total) == (3, 3) and len(optimized.log) >= 5
    assert desk.state.export is not None and str(desk.state.export.path) in exported.text
    taken = [desk.saved.joints(index)["PSM1"].provenance.source for index in range(3) if desk.saved.joints(index)]
    assert f"{len(taken)} frames optimized" in optimized.text and set(taken) <= {Source.OPTIMIZER}
    # Each is a step of its own, with a verdict.
    assert all(desk.saved.verdict(index) is not None for index in range(3) if desk.saved.joints(index))


def test_a_job_that_waits_or_runs_can_be_cancelled_and_started_again(desk: Desk) -> None:
    desk.do(intents.SetSetting("solver", "surface"), intents.OptimizeFrames("all"), intents.Calibrate(2))
    desk.do(intents.CancelJob(2), intents.CancelJob(1))
    assert states(desk) == [("optimize", "cancelled"), ("calibrate", "cancelled")]
    assert desk.wait_time() is None and not desk.saved.steps
    desk.do(intents.RepeatJob(1))
    assert states(desk)[-1] == ("optimize", "running")
    with pytest.raises(CartsError, match="not ended"):
        desk.do(intents.RepeatJob(3))
    desk.do(intents.CancelJob(3), intents.ForgetJobs())
    assert desk.state.jobs == ()
    with pytest.raises(CartsError, match="no job 7"):
        desk.do(intents.CancelJob(7))


def test_a_calibration_is_a_job_and_one_step_of_undo_and_says_what_it_does_to_accepted_frames(desk: Desk) -> None:
    desk.do(intents.SetReview(ReviewState.ACCEPTED), intents.Calibrate(2))
    desk.finish()
    (job,) = desk.state.jobs
    assert job.state is JobState.DONE
    assert desk.saved.review(0).state is ReviewState.UNTOUCHED
    assert "accepted before: 1." in job.text and "solve again" in job.text
    steps = [step.name for step in desk.saved.steps]
    assert steps[1:] == ["Calibrate on 2 frames"]


def test_a_job_that_cannot_be_done_has_failed_and_the_next_one_is_begun(desk: Desk) -> None:
    with pytest.raises(CartsError, match="no keyframe yet"):
        desk.do(intents.Solve())
    assert states(desk) == [("solve", "failed")] and "no keyframe yet" in desk.state.jobs[0].text
    desk.do(intents.Export("csv", "All"))
    desk.finish()
    assert states(desk)[-1] == ("export", "done")


def test_after_the_viewer_was_killed_waiting_jobs_wait_and_the_one_that_ran_is_said_to_have_failed(
    tmp_path: Path,
) -> None:
    jobs = JobList(tmp_path / "work.carts", kept=True)
    first, second = jobs.add("optimize", "Optimize", {"frames": [0, 1]}), jobs.add("export", "Export", {})
    jobs.change(first.number, "begun", state=JobState.RUNNING, done=1, total=2)
    again = JobList(tmp_path / "work.carts", kept=True)
    assert [job.state for job in again.jobs] == [JobState.FAILED, JobState.WAITING]
    assert "start it again" in again.jobs[0].text and again.jobs[1] == second
    assert again.jobs[0].options == {"frames": [0, 1]} and again.jobs[0].done == 1
    (tmp_path / "work_jobs.json").write_text('{"not": "a list"}')
    assert JobList(tmp_path / "work.carts", kept=True).jobs == ()
    (tmp_path / "work_jobs.json").write_text(json.dumps([{"number": "x"}]))
    assert JobList(tmp_path / "work.carts", kept=True).jobs == ()


def test_only_jobs_that_have_ended_are_forgotten_however_many_wait(tmp_path: Path) -> None:
    jobs = JobList(tmp_path / "work.carts", kept=True)
    for number in range(1, 121):
        jobs.add("export", "Export", {})
        jobs.change(number, state=JobState.DONE if number % 2 else JobState.WAITING)
    kept = [job.number for job in jobs.jobs]
    assert kept[:3] == [2, 4, 6] and len([n for n in kept if n % 2 == 0]) == 60
    assert [job.number for job in jobs.jobs if job.over][-1] == 119 and len([n for n in kept if n % 2]) == 50


def test_a_line_says_how_far_a_job_is_and_how_long_it_will_take() -> None:
    job = Job(3, "optimize", "Solve <all>", state=JobState.RUNNING, done=10, total=40, began=100.0, text="Frame 10")
    line = job_line(job, now=120.0)
    assert "3. Solve &lt;all&gt;" in line and "10 of 40, about 60 s left" in line and 'value="25"' in line
    solve = job_line(replace(job, kind="solve"), now=120.0)
    assert "10 of 40" not in solve and "Frame 10" in solve and 'value="25"' in solve
