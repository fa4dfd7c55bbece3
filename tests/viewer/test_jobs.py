"""Jobs: queue, progress and log, also after a restart of the viewer; adaptation of the network."""

import json
import shutil
import subprocess
import sys
import time
import weakref
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from viewer_desk import Desk
from viewer_tab import OpenViewer, place_of, view_of, widget
from waiting import eventually

from carts_core.errors import CartsError
from carts_core.networks.weights import read_weights, save_weights
from carts_core.project import CorrectedTransform, Key, Provenance, ReviewState, Source
from carts_core.project.identity import data_dir
from carts_core.resources import shipped_weights
from carts_core.settings import FreeParameters, SolverName, solver
from carts_core.settings.serialization import to_plain
from carts_core.wording import counted
from carts_viewer.actions import intents
from carts_viewer.jobs import work
from carts_viewer.jobs.choices import Choices, Observed, read_choices
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
from carts_viewer.jobs.networks import STARTED, Networks
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.jobs.solver import FrameTask
from carts_viewer.panels.jobs import job_line, jobs_question
from tools.raw_tab import RawTab


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
    assert f"{counted(len(taken), 'frame')} optimized" in optimized.text and set(taken) <= {Source.OPTIMIZER}
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
    desk.do(intents.CancelJob(3), intents.RemoveEndedJobs())
    assert desk.state.jobs == ()
    with pytest.raises(CartsError, match="Job 7 no longer exists"):
        desk.do(intents.CancelJob(7))


def test_what_was_chosen_for_a_job_is_forgotten_with_the_job(desk: Desk) -> None:
    desk.do(intents.SetSetting("solver", "surface"), intents.OptimizeFrames("all"), intents.Calibrate(2))
    frame = weakref.ref(desk.state.frame)
    desk.do(intents.CancelJob(2), intents.CancelJob(1), intents.ShowFrame(1), intents.OptimizeFrames("all"))
    assert frame() is None


@pytest.fixture
def tasks(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> list[FrameTask]:
    """Tasks of all runs on single frames."""
    found, run = [], desk.factory.run
    monkeypatch.setattr(desk.factory, "run", lambda task: (found.append(task), run(task))[1])
    return found


CHOSEN = (
    intents.SetSetting("solver", "surface"),
    intents.SetSetting("iterations", 2),
    intents.SetObserved("masks", "recording"),
    intents.SetFreeJoint("PSM1", "roll", False),
    intents.ShowDomain("smoke"),
    intents.ShowCamera("right"),
)


def used(tasks: list[FrameTask]) -> set[tuple[Any, ...]]:
    """What the tasks of runs were made with."""
    return {(task.domain, task.settings, task.free, task.target.observed) for task in tasks}


@pytest.mark.parametrize("elsewhere", [False, True])
def test_jobs_use_what_was_chosen_when_they_were_queued_also_after_a_restart_and_elsewhere(
    desk: Desk, tasks: list[FrameTask], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, elsewhere: bool
) -> None:
    state = desk.do(*CHOSEN)
    chosen = state.domain, state.settings, state.free, state.observed
    export = intents.Export("masks", "All", shown_camera=True)
    desk.do(intents.Calibrate(1), intents.OptimizeFrames("all"), export)
    if elsewhere:
        monkeypatch.setenv("CARTS_DATA", str(tmp_path / "other"))
    desk = desk.reopened()
    assert desk.state.choices != state.choices
    assert [job for _, job in states(desk)] == ["failed", *["asked" if elsewhere else "waiting"] * 2]
    if elsewhere:
        # A job of this tab does not change what they use.
        desk.do(intents.Export("csv", "All"), intents.AnswerJobs(True))
    state = desk.finish()
    assert used(tasks) == {chosen} and all(job.state is JobState.DONE for job in state.jobs[1:])
    folders = [path for path in tmp_path.glob("sequence_exports/masks*/*") if path.is_dir()]
    assert folders and not any("left" in path.name for path in folders), folders


def test_a_job_that_is_started_again_uses_what_it_was_queued_with(desk: Desk, tasks: list[FrameTask]) -> None:
    state = desk.do(*CHOSEN, intents.OptimizeFrames("all"))
    while desk.state.jobs[0].done < 1:
        desk.advance()
    desk.do(intents.CancelJob(1), intents.SetSetting("iterations", 3), intents.SetObserved("network", "recording"))
    desk.do(intents.ShowDomain("regular"), intents.RepeatJob(1))
    desk.finish()
    assert {task.index for task in tasks} == {0, 1, 2}
    assert used(tasks) == {(state.domain, state.settings, state.free, state.observed)}


def test_a_job_of_an_earlier_version_uses_the_defaults_whatever_ran_before(desk: Desk, tasks: list[FrameTask]) -> None:
    row = {"number": 1, "kind": "optimize", "title": "", "options": {"frames": [0]}, "state": "waiting"}
    project = desk.session.editor.project.path
    project.with_name(f"{project.stem}_jobs.json").write_text(json.dumps([row]))
    desk = desk.reopened()
    state = desk.state
    desk.do(*CHOSEN, intents.Export("csv", "All"), intents.AnswerJobs(True))
    desk.finish()
    assert used(tasks) == {(state.domain, state.settings, state.free, state.observed)}


@pytest.mark.parametrize("name", ["domain", "camera"])
def test_a_job_fails_when_the_recording_does_not_have_its_images(desk: Desk, name: str) -> None:
    desk.do(intents.Calibrate(1), intents.Export("csv", "All"))
    project = desk.session.editor.project.path
    file = project.with_name(f"{project.stem}_jobs.json")
    rows = json.loads(file.read_text())
    rows[1]["choices"][name] = "elsewhere"
    file.write_text(json.dumps(rows))
    desk = desk.reopened()
    assert states(desk)[1] == ("export", "asked")
    desk.do(intents.AnswerJobs(True))
    with pytest.raises(CartsError, match=f"Unknown {name} 'elsewhere'. This sequence has: "):
        desk.finish()
    assert states(desk)[1] == ("export", "failed")


@pytest.mark.parametrize("edit", [intents.SetJoint("PSM1", 0, 0.1), intents.SetReview(ReviewState.ACCEPTED)])
def test_a_frame_that_is_edited_while_it_is_optimized_stays_as_edited(desk: Desk, edit: intents.Intent) -> None:
    desk.do(intents.SetSetting("solver", "surface"), intents.OptimizeFrames("all"))
    desk.advance()
    before = desk.do(edit, intents.Released()).project
    desk.finish()
    assert desk.saved.joints(0) == before.joints(0) and desk.saved.review(0) == before.review(0)
    assert any("001: discarded, edited during its run" in line for line in desk.state.jobs[0].log)


def test_a_calibration_is_a_job_and_one_step_of_undo_and_says_what_it_does_to_accepted_frames(desk: Desk) -> None:
    desk.do(intents.SetReview(ReviewState.ACCEPTED), intents.Calibrate(2))
    desk.finish()
    (job,) = desk.state.jobs
    assert job.state is JobState.DONE
    assert desk.saved.review(0).state is ReviewState.UNTOUCHED
    assert "Accepted frames that became unreviewed: 1." in job.text and "solve fitted frames again" in job.text
    steps = [step.name for step in desk.saved.steps]
    assert steps[1:] == ["Calibrate on 2 frames"]


def write_hand_eye(desk: Desk, T_world_base: np.ndarray, covariance: np.ndarray) -> None:
    """Write the result of a hand-eye calibration beside the sequence file."""
    arm = desk.session.scene.arms[0].name
    pose = {"T_world_base": T_world_base.tolist(), "covariance": covariance.tolist()}
    text = json.dumps({"free_cameras": [], "base_frames": {arm: pose}})
    desk.session.sequence.path.with_name("hand_eye.json").write_text(text)


def test_a_calibration_starts_with_what_the_clicked_points_left_open(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, covariance = desk.session.scene.arms[0], np.diag([1e-3] * 3 + [1e-4] * 3)
    write_hand_eye(desk, arm.T_world_base, covariance)
    tasks, calibration = [], desk.factory.calibration
    monkeypatch.setattr(desk.factory, "calibration", lambda task: (tasks.append(task), calibration(task))[1])
    desk.do(intents.Calibrate(2), intents.Calibrate(1))
    desk.finish()
    # The second one starts from other base frames than those of the points.
    assert [list(task.known_base_frames) for task in tasks] == [[arm.name], []]
    assert np.array_equal(tasks[0].known_base_frames[arm.name], covariance)
    assert all("hand-eye" not in job.text for job in desk.state.jobs)


def test_a_calibration_beyond_what_the_clicked_points_left_open_is_said(desk: Desk) -> None:
    T_world_base = desk.session.scene.arms[0].T_world_base.copy()
    T_world_base[:3, :3] = T_world_base[:3, :3] @ Rotation.from_rotvec(np.radians([0.0, 9.0, 0.0])).as_matrix()
    moved = CorrectedTransform(tuple(map(tuple, T_world_base.tolist())), Provenance(Source.HAND))
    desk.session.editor.apply("Move the base", {Key.base_frame("PSM1"): moved})
    # As if the points had left nothing open.
    write_hand_eye(desk, T_world_base, 1e-8 * np.eye(6))
    desk.do(intents.SetObserved("masks", "recording"), intents.Calibrate(2))
    desk.finish()
    (job,) = desk.state.jobs
    assert job.state is JobState.DONE, job.text
    assert "moves the base frame of PSM1 by" in job.text and "Undo it, or check the clicked points." in job.text


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
CHOICES = Choices(
    *("regular", "left", True, SolverName.SURFACE),
    *(solver("surface"), FreeParameters(locked_joints=("PSM1/roll",)), Observed("both", "painted"), "backward"),
)


def test_after_the_viewer_was_killed_waiting_jobs_wait_and_the_one_that_ran_is_said_to_have_failed(
    tmp_path: Path,
) -> None:
    jobs = job_list(tmp_path)
    first, second = jobs.add("optimize", {"frames": [0, 1]}), jobs.add("export", EXPORT)
    jobs.change(first.number, "begun", state=JobState.RUNNING, done=1, total=2)
    again = job_list(tmp_path)
    assert [job.state for job in again.jobs] == [JobState.FAILED, JobState.WAITING]
    assert "start the job again" in again.jobs[0].text and again.jobs[1] == second
    assert again.jobs[0].options == OptimizeOptions((0, 1)) and again.jobs[0].done == 1


def test_the_viewer_goes_on_when_the_list_of_jobs_cannot_be_written(open_viewer: OpenViewer) -> None:
    app = open_viewer(frames=2)
    file = app.project.path.with_name(f"{app.project.path.stem}_jobs.json")
    app.queue.put(intents.Export("csv", "All"))
    assert app.wait_until_shown().jobs[0].state is JobState.DONE
    file.unlink()
    (file / "blocked").mkdir(parents=True)
    # A job that cannot be written is not queued; those in the list continue and end.
    app.queue.put(intents.Export("csv", "All"))
    state = app.wait_until_shown()
    assert len(state.jobs) == 1 and file.name in str(state.error)
    app.queue.put(intents.RemoveEndedJobs())
    state = app.wait_until_shown()
    assert state.jobs == () and any(file.name in problem for problem in state.problems)
    shutil.rmtree(file)
    app.queue.put(intents.Export("csv", "All"))
    state = app.wait_until_shown()
    assert state.jobs[0].state is JobState.DONE and not state.problems


def test_a_job_whose_list_cannot_be_written_ends_as_any_other(desk: Desk) -> None:
    desk.do(intents.SetSetting("solver", "surface"), intents.OptimizeFrames("all"))
    project = desk.session.editor.project.path
    file = project.with_name(f"{project.stem}_jobs.json")
    file.unlink()
    (file / "blocked").mkdir(parents=True)
    state = desk.finish()
    assert states(desk) == [("optimize", "done")] and any(file.name in problem for problem in state.problems)


def test_the_worker_survives_an_error_of_the_panels(open_viewer: OpenViewer, monkeypatch: pytest.MonkeyPatch) -> None:
    app = open_viewer(frames=2)
    with RawTab(app.url) as raw:
        panel = type(view_of(app, raw).layout.panels[0])
        with monkeypatch.context() as broken:
            broken.setattr(panel, "show", lambda *_: 1 / 0)
            place_of(app, raw).put(intents.MoveFrame(1))
            assert "ZeroDivisionError" in str(app.wait_until_shown().error)
        place_of(app, raw).put(intents.DismissError())
        assert app.wait_until_shown().error is None


def test_options_of_a_job_are_clamped_as_in_the_page() -> None:
    for (kind, options), read in (
        (("optimize", {"frames": [2, -1, 7, 2, 10**12], "first": 10**12}), OptimizeOptions((2,), 1)),
        (("calibrate", {"frames": 10**12}), CalibrateOptions(500)),
        (("calibrate", {"frames": -3}), CalibrateOptions(1)),
        (("adapt", {"minutes": 10**9, "folder": 0}), AdaptOptions(240, 1)),
        (("solve", {"at": 99, "range": [5, -5]}), SolveOptions(False, 2, (0, 2))),
        (("export", {**EXPORT, "range": [9, 1]}), ExportOptions("csv", "All", range=(1, 2))),
    ):
        assert read_options(kind, options, frames=3) == read


def test_a_job_that_an_earlier_version_has_queued_here_waits(tmp_path: Path) -> None:
    job = job_list(tmp_path).add("export", EXPORT)
    file = tmp_path / "work_jobs.json"
    (row,) = json.loads(file.read_text())
    del row["choices"]
    file.write_text(json.dumps([row]))
    assert job.state is JobState.WAITING and job_list(tmp_path).jobs == (job,)


@pytest.mark.parametrize("name", list(SolverName))
def test_choices_are_read_as_they_were_written(tmp_path: Path, name: SolverName) -> None:
    choices = replace(CHOICES, solver=name, settings=solver(name))
    jobs = job_list(tmp_path)
    jobs.add("export", EXPORT, choices)
    (job,) = job_list(tmp_path).jobs
    assert job == jobs.jobs[0] and job.choices == choices


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"domain": 1}, r"Expected `str`, got `int` - at `\$.domain`"),
        ({"solver": "magic"}, "Invalid enum value 'magic'"),
        ({"settings": {"iterations": 10**12}}, "iterations is 1000000000000; allowed: 1 to 10000"),
        ({"settings": {"stages": [{"stage": ["Observe"]}]}}, r"has the stage \['Observe'\]"),
        ({"free": {"arms": [1]}}, "Expected `str`"),
        ({"observed": {"what": "stars"}}, "Invalid enum value 'stars'"),
        ({"direction": "sideways"}, "Invalid enum value 'sideways'"),
    ],
)
def test_wrong_choices_are_not_read(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_choices(to_plain(CHOICES) | change)


@pytest.mark.parametrize(
    "change",
    [
        *({}, {"options": {"minutes": 200, "folder": 1}}, {"kind": "calibrate"}, {"token": ""}),
        *({"choices": None}, {"choices": to_plain(replace(CHOICES, camera="right"))}),
    ],
)
def test_only_jobs_that_this_user_has_queued_here_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict
) -> None:
    job_list(tmp_path).add("adapt", {"minutes": 15, "folder": 1}, CHOICES)
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


# ---- The network adapted to the recording ---------------------------------------------------------------------------


SMALL = (
    "--steps 2 --batch-size 1 --workers 1 --threads 1 --validation-samples 2 --images.width 64 --images.height 48 "
    "--images.field-width 64 --fits 1"
).split()


OVER = 240.0
"""Time for a small run on a busy machine [s]."""


@pytest.fixture
def at_desk(tiny_sequence: Callable[..., Path]) -> Desk:
    """A desk with the shipped networks."""
    return Desk.open(tiny_sequence(frames=2), inference="torch")


def networks(project: Path, *, kept: bool = True, **options: Any) -> Networks:
    """The networks of a project, as a new viewer finds them."""
    factory = OptimizerFactory(inference="torch", report=lambda line: None, **options)
    return Networks(project, kept=kept, optimizers=factory, decisions=Decisions())


def ended(desk: Desk) -> Job:
    """The newest job, once it is over."""
    until = time.monotonic() + OVER
    while not desk.state.jobs[-1].over:
        assert time.monotonic() < until, desk.state.jobs[-1]
        time.sleep(desk.wait_time() or 0.0)
        desk.advance()
    return desk.state.jobs[-1]


@pytest.fixture
def planted(tmp_path: Path) -> Path:
    """A project with a network that another user has made and chosen."""
    folder = tmp_path / "work_adapted_1"
    folder.mkdir()
    (folder / "surface.safetensors").write_bytes(shipped_weights()[1].read_bytes())
    (tmp_path / "work_network.json").write_text('{"network": "Adapted 1"}')
    return tmp_path / "work.carts"


@pytest.mark.parametrize("kept", [True, False])
def test_weights_of_another_user_are_asked_for_once_a_file(
    planted: Path, kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = networks(planted, kept=kept)
    assert (first.used, first.asked) == (STARTED, "Adapted 1")
    first.answer(True)
    assert (first.used, first.asked) == ("Adapted 1", "")
    with pytest.raises(CartsError, match="No network needs"):
        first.answer(True)
    again = networks(planted, kept=kept)
    assert (again.used, again.asked) == ("Adapted 1", "")
    monkeypatch.setenv("CARTS_DATA", str(tmp_path / "other user"))
    other = networks(planted, kept=kept)
    assert (other.used, other.asked) == (STARTED, "Adapted 1")
    other.answer(False)
    refused = networks(planted, kept=kept)
    assert (refused.used, refused.asked) == (STARTED, "")
    refused.use("Adapted 1")
    assert (refused.used, refused.asked) == (STARTED, "Adapted 1")


def test_weights_that_were_replaced_are_asked_for_again(planted: Path) -> None:
    first = networks(planted)
    first.answer(True)
    planted.with_name("work_adapted_1").joinpath("surface.safetensors").write_bytes(b"others")
    again = networks(planted)
    assert (again.used, again.asked) == (STARTED, "Adapted 1")


def test_a_damaged_choice_is_kept_and_the_first_network_runs(planted: Path) -> None:
    file = planted.with_name("work_network.json")
    for number, content in enumerate(("", "[]", '{"network": 1}', '{"network": null}', "{}", "[" * 100), 1):
        file.write_text(content)
        found = networks(planted)
        assert (found.used, found.asked) == (STARTED, "")
        assert "network selection work_network.json" in found.problem
        assert file.with_name(f"work_network.json.damaged-{number}").read_text() == content and not file.exists()


TRAINING = """#!{python} -S
import json, pathlib, shutil, sys, time
folder = pathlib.Path(sys.argv[4])
checkpoint = folder / "checkpoint.safetensors"
print("step 0", flush=True)
if checkpoint.exists():
    shutil.copy(pathlib.Path(__file__).with_name("adapted.safetensors"), folder / "surface.safetensors")
    (folder / "report").mkdir()
    (folder / "report" / "fits.json").write_text(json.dumps({{"worse": [], "gain": "Dice 0.9, remaining error 1"}}))
else:
    folder.mkdir(exist_ok=True)
    checkpoint.touch()
    time.sleep(1000)
"""
"""Stands for `carts train`: leaves a checkpoint at first, and a network when it is run again."""


@pytest.mark.parametrize("real", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_training_that_is_cancelled_goes_on_in_its_folder_and_its_network_is_used_and_remembered(
    at_desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, real: bool
) -> None:
    if not real:
        stand_in, weights = tmp_path / "training", read_weights(shipped_weights()[1])
        next(weights.network.parameters()).data.mul_(1.001)
        save_weights(weights.network, tmp_path / "adapted.safetensors", {}, weights.working_size)
        stand_in.write_text(TRAINING.format(python=sys.executable))
        stand_in.chmod(0o700)
        monkeypatch.setattr(sys, "executable", str(stand_in))
    # At so large a rate the initial weights stay the best, however many steps were taken before.
    small = *SMALL, "--learning-rate", "1"
    monkeypatch.setattr(work, "TRAINING_OPTIONS", ("--steps", "100000", "--checkpoint-every", "1", *small[2:]))
    trainings: list[subprocess.Popen] = []
    popen = subprocess.Popen

    def watched(*arguments: Any, **options: Any) -> subprocess.Popen:
        trainings.append(popen(*arguments, **options))
        return trainings[-1]

    monkeypatch.setattr(subprocess, "Popen", watched)
    project = at_desk.session.editor.project.path
    folder = project.with_name("sequence_adapted_1")
    at_desk.do(intents.Adapt(1))
    # The page stays usable meanwhile.
    assert at_desk.do(intents.ShowFrame(1)).index == 1

    def checkpoint() -> bool:
        found = (folder / "checkpoint.safetensors").is_file()
        at_desk.advance()
        return found

    eventually(checkpoint, timeout=OVER)
    at_desk.do(intents.CancelJob(1))
    assert at_desk.state.jobs[0].state is JobState.CANCELLED and at_desk.wait_time() is None
    assert trainings[0].wait(OVER) != 0
    assert any("step 0" in line for line in at_desk.state.jobs[0].log)
    monkeypatch.setattr(work, "TRAINING_OPTIONS", small)
    at_desk.do(intents.RepeatJob(1))
    job = ended(at_desk)
    assert job.state is JobState.DONE and job.options == AdaptOptions(1, 1)
    assert "Dice" in job.text and "remaining error" in job.text
    at_desk.do(intents.RepeatJob(2), intents.CancelJob(3))
    assert at_desk.state.jobs[-1].options == AdaptOptions(1, 2)
    # The network is offered, and used when it is chosen.
    assert at_desk.state.networks == (STARTED, "Adapted 1") and at_desk.state.network == STARTED
    before = at_desk.factory.prepare().result()
    assert at_desk.do(intents.UseNetwork("Adapted 1")).network == "Adapted 1"
    assert at_desk.factory.prepare().result() != before and networks(project).used == "Adapted 1"
    # Weights of the command line count more, and weights that are damaged are not used.
    assert networks(project, weights=(shipped_weights()[1],)).used == STARTED
    (folder / "surface.safetensors").write_bytes(b"nothing")
    assert networks(project).used == STARTED
    at_desk.do(intents.UseNetwork("Adapted 1"))
    with pytest.raises(CartsError, match=r"surface\.safetensors"):
        at_desk.do(intents.AnswerNetwork(True))
    assert at_desk.do(intents.UseNetwork(STARTED)).network == STARTED
    assert at_desk.factory.prepare().result() == before
    with pytest.raises(CartsError, match=r"Unknown network '\.\./\.\./else'"):
        at_desk.do(intents.UseNetwork("../../else"))


def test_an_adapted_network_is_offered_and_used_by_a_button(open_viewer: OpenViewer) -> None:
    def plant(folder: Path) -> None:
        (folder / "sequence_adapted_1").mkdir()
        shutil.copy(shipped_weights()[1], folder / "sequence_adapted_1" / "surface.safetensors")

    app = open_viewer(plant, frames=2, networks={"weights": ()})
    with RawTab(app.url) as tab:
        offered = widget(app, tab, "Use newest network")
        assert offered.visible
        tab.set(app.page.element_id(offered), True)
        eventually(lambda: app.state.asked_network or app.state.network != STARTED)
        app.queue.put(intents.AnswerNetwork(True))
        assert app.wait_until_shown().network == "Adapted 1" and not offered.visible


@pytest.mark.slow
def test_a_program_that_ends_while_it_trains_does_not_hang(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    program = (
        "import pathlib, sys; from carts_viewer.jobs.work import adapt\n"
        "training = adapt(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), 1.0); next(training)"
    )
    subprocess.run([sys.executable, "-c", program, tiny_sequence(frames=2), tmp_path / "run"], check=True, timeout=OVER)


def test_training_that_fails_says_why(at_desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work, "TRAINING_OPTIONS", ("--steps", "0"))
    at_desk.do(intents.Adapt(1))
    with pytest.raises(CartsError, match="steps is 0; allowed: 1 or more"):
        ended(at_desk)
    assert at_desk.state.jobs[0].state is JobState.FAILED and at_desk.state.networks == (STARTED,)


def test_a_run_says_what_the_network_does_not_know_once_and_what_helps(
    at_desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_desk.do(intents.SetSetting("solver", "surface"), intents.SetSetting("iterations", 1))
    state = at_desk.do(intents.Step())
    assert all("Fit masks (Fit to), or adapt the network" in line for line in state.unfamiliar)
    monkeypatch.setattr(sys.modules["carts_core.optimization.verdict"], "RECOGNIZED", 1.01)
    at_desk.factory = OptimizerFactory(inference="torch", report=lambda line: None)
    at_desk = at_desk.reopened()
    at_desk.do(intents.SetSetting("solver", "surface"), intents.SetSetting("iterations", 1))
    state = at_desk.do(intents.Reset(), intents.Step())
    assert "this robot or distance" in state.unfamiliar[0]
    assert at_desk.do(intents.Reset(), intents.SetObserved("masks", "recording"), intents.Step()).unfamiliar == ()
