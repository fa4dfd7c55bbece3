"""Jobs: one after the other, with progress and a log, and what becomes of them when the viewer ends."""

import json
import weakref
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import expect
from viewer_canvas import eventually
from viewer_desk import Desk
from viewer_tab import Tab

from carts_core.errors import CartsError
from carts_core.project import ReviewState, Source
from carts_core.project.identity import data_dir
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.companions import Decisions
from carts_viewer.jobs.job_list import (
    AdaptOptions,
    CalibrateOptions,
    ExportOptions,
    Job,
    JobList,
    JobState,
    OptimizeOptions,
    SolveOptions,
    read_options,
)
from carts_viewer.panels.jobs import job_line, jobs_question


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


def test_what_was_chosen_for_a_job_is_forgotten_with_the_job(desk: Desk) -> None:
    desk.do(intents.SetSetting("solver", "surface"), intents.OptimizeFrames("all"), intents.Calibrate(2))
    frame = weakref.ref(desk.state.frame)
    desk.do(intents.CancelJob(2), intents.CancelJob(1), intents.ShowFrame(1), intents.OptimizeFrames("all"))
    assert frame() is None


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


def job_list(folder: Path, *, kept: bool = True) -> JobList:
    """The list of a project of three frames, as a new viewer reads it."""
    return JobList(folder / "work.carts", kept=kept, frame_ids=["a", "b", "c"], decisions=Decisions())


EXPORT = {"format": "csv", "frames": "All"}


def test_after_the_viewer_was_killed_waiting_jobs_wait_and_the_one_that_ran_is_said_to_have_failed(
    tmp_path: Path,
) -> None:
    jobs = job_list(tmp_path)
    first, second = jobs.add("optimize", {"frames": [0, 1]}), jobs.add("export", EXPORT)
    jobs.change(first.number, "begun", state=JobState.RUNNING, done=1, total=2)
    again = job_list(tmp_path)
    assert [job.state for job in again.jobs] == [JobState.FAILED, JobState.WAITING]
    assert "start it again" in again.jobs[0].text and again.jobs[1] == second
    assert again.jobs[0].options == OptimizeOptions((0, 1)) and again.jobs[0].done == 1


@pytest.mark.parametrize(
    ("options", "read"),
    [
        (("optimize", {"frames": [2, -1, 7, 2, 10**12], "first": 10**12}), OptimizeOptions((2,), 1)),
        (("calibrate", {"frames": 10**12}), CalibrateOptions(500)),
        (("calibrate", {"frames": -3}), CalibrateOptions(1)),
        (("adapt", {"minutes": 10**9, "folder": 0}), AdaptOptions(240, 1)),
        (("solve", {"at": 99, "range": [5, -5]}), SolveOptions(False, 2, (0, 2))),
        (("export", {**EXPORT, "range": [9, 1]}), ExportOptions("csv", "All", range=(1, 2))),
    ],
)
def test_options_of_a_job_are_clamped_as_in_the_page(options: tuple[str, dict], read: object) -> None:
    assert read_options(*options, frames=3) == read


@pytest.mark.parametrize(
    "change", [{}, {"options": {"minutes": 200, "folder": 1}}, {"kind": "calibrate"}, {"token": ""}]
)
def test_only_jobs_that_this_user_has_queued_here_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict
) -> None:
    job_list(tmp_path).add("adapt", {"minutes": 15, "folder": 1})
    file = tmp_path / "work_jobs.json"
    row = json.loads(file.read_text())[0] | change | {"title": "Harmless"}
    row["options"] |= {"frames": 20} if row["kind"] == "calibrate" else {}
    file.write_text(json.dumps([row]))
    (job,) = job_list(tmp_path).jobs
    assert job.state is (JobState.ASKED if change else JobState.WAITING) and job.title != "Harmless"
    # On another computer, or for another user, every job is asked for.
    monkeypatch.setenv("CARTS_DATA", str(tmp_path / "other"))
    assert job_list(tmp_path).jobs[0].state is JobState.ASKED


def test_jobs_are_kept_and_asked_for_where_the_data_folder_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("CARTS_DATA", str(tmp_path / "file" / "data"))
    job = job_list(tmp_path).add("export", EXPORT)
    assert job.state is JobState.WAITING
    assert job_list(tmp_path).jobs == (replace(job, state=JobState.ASKED),)


def test_jobs_of_another_user_run_when_they_are_accepted(desk: Desk) -> None:
    rows = [
        {"number": 1, "kind": "adapt", "title": "", "options": {"minutes": 10**9, "folder": 1}, "state": "done"},
        {"number": 2, "kind": "export", "title": "", "options": EXPORT, "state": "waiting"},
        {"number": 3, "kind": "adapt", "title": "", "options": {"minutes": 10**9, "folder": 1}, "state": "waiting"},
    ]
    project = desk.session.editor.project.path
    project.with_name(f"{project.stem}_jobs.json").write_text(json.dumps(rows))
    project.with_name(f"{project.stem}_adapted_1").mkdir()
    desk = desk.reopened()
    assert states(desk) == [("adapt", "done"), ("export", "asked"), ("adapt", "asked")]
    assert desk.wait_time() is None
    assert "Export all as" in jobs_question(desk.state) and "240 minutes" in jobs_question(desk.state)
    desk.do(intents.CancelJob(3), intents.AnswerJobs(True))
    desk.finish()
    assert states(desk)[1:] == [("export", "done"), ("adapt", "cancelled")] and not jobs_question(desk.state)
    # Their training is not continued: its checkpoint is theirs, too.
    desk.do(intents.RepeatJob(3), intents.CancelJob(4))
    assert desk.state.jobs[-1].options == AdaptOptions(240, 2)


def test_discarded_jobs_of_another_user_do_not_run(desk: Desk) -> None:
    project = desk.session.editor.project.path
    row = {"number": 1, "kind": "calibrate", "title": "", "options": {"frames": 2}, "state": "waiting"}
    project.with_name(f"{project.stem}_jobs.json").write_text(json.dumps([row]))
    desk = desk.reopened()
    desk.do(intents.AnswerJobs(False))
    assert states(desk) == [("calibrate", "cancelled")] and desk.wait_time() is None
    assert states(desk.reopened()) == [("calibrate", "cancelled")]


def test_a_damaged_list_is_kept_beside_the_new_one(tmp_path: Path) -> None:
    file = tmp_path / "work_jobs.json"
    for number, content in enumerate(('[{"number": "x"}]', '{"not": "a list"}'), 1):
        file.write_text(content)
        jobs = job_list(tmp_path)
        assert jobs.jobs == () and "work_jobs.json cannot be read: Expected `" in jobs.problem
        assert (tmp_path / f"work_jobs.json.damaged-{number}").read_text() == content
        jobs.add("export", EXPORT)
        assert len(job_list(tmp_path).jobs) == 1


def test_only_jobs_that_have_ended_are_forgotten_however_many_wait(tmp_path: Path) -> None:
    jobs = job_list(tmp_path)
    for number in range(1, 121):
        jobs.add("export", EXPORT)
        jobs.change(number, state=JobState.DONE if number % 2 else JobState.WAITING)
    kept = [job.number for job in jobs.jobs]
    assert kept[:3] == [2, 4, 6] and len([n for n in kept if n % 2 == 0]) == 60
    assert [job.number for job in jobs.jobs if job.over][-1] == 119 and len([n for n in kept if n % 2]) == 50
    # Nothing is remembered of jobs that are not in the list any more.
    assert len(list((data_dir() / "decisions").iterdir())) == len(kept)


def test_a_line_says_how_far_a_job_is_and_how_long_it_will_take() -> None:
    job = Job(
        3,
        "optimize",
        "Solve <all>",
        OptimizeOptions(()),
        state=JobState.RUNNING,
        done=10,
        total=40,
        began=100.0,
        text="Frame 10",
    )
    line = job_line(job, now=120.0)
    assert "3. Solve &lt;all&gt;" in line and "10 of 40, about 60 s left" in line and 'value="25"' in line
    solve = job_line(replace(job, kind="solve"), now=120.0)
    assert "10 of 40" not in solve and "Frame 10" in solve and 'value="25"' in solve


@pytest.mark.browser
def test_the_page_asks_for_jobs_of_another_user_and_runs_them(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    def plant(folder: Path) -> None:
        row = {"number": 1, "kind": "export", "title": "Harmless", "options": EXPORT, "state": "waiting"}
        (folder / "sequence_jobs.json").write_text(json.dumps([row]))

    app = open_viewer(plant, frames=2)
    tab = open_tab(app)
    expect(tab.page.get_by_text("wait for your decision")).to_be_visible()
    assert [job.state for job in app.state.jobs] == [JobState.ASKED]
    tab.page.get_by_text("Jobs", exact=True).first.click()
    expect(tab.page.get_by_text("so they do not run: Export all as")).to_be_visible()
    tab.button("Run jobs")
    eventually(lambda: app.state.jobs[0].state, lambda state: state is JobState.DONE, 60)
    expect(tab.page.get_by_text("wait for your decision")).to_have_count(0)
    expect(tab.page.get_by_role("button", name="Run jobs")).to_have_count(0)
