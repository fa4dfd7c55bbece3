"""Working in the page in headless Chromium: runs, solving, jobs, exports, imports and reviews."""

import io
import json
import re
import threading
import zipfile
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import expect
from viewer_tab import OpenTab, Tab, box_of, decoded, run_without_end
from waiting import eventually, wait_in

from carts_core.optimization import SequenceOptimizer
from carts_core.project import Project, ReviewState
from carts_viewer.actions import intents
from carts_viewer.actions.sequence import PropagatingHandler
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.job_list import JobState
from carts_viewer.jobs.solver_process import SolverInProcess
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.state import Phase

pytestmark = pytest.mark.browser

_FIT = "(carts.timeline().code(0) >> 3) & 3"


def distance_below(tab: Tab) -> float:
    """Distance between the verdict and the widgets below it [px]."""
    return (
        box_of(tab.page.get_by_role("button", name="Play", exact=True))["y"]
        - box_of(tab.page.locator(".carts-verdict"))["y"]
    )


def check_lost_connection(tab: Tab) -> None:
    """Nothing is saved by a server that does not answer."""
    tab.open("Review")
    expect(tab.page.get_by_text("1 moved by hand")).to_be_visible()
    expect(tab.page.locator(".carts-saved span")).to_be_visible()
    tab.app.page.close()
    expect(tab.page.locator("body.carts-offline .carts-saved")).to_be_visible()
    style = "getComputedStyle(document.querySelector('.carts-saved'), '::after').content"
    assert "Not connected" in tab.page.evaluate(style)
    expect(tab.page.locator(".carts-saved span")).to_be_hidden()


def test_a_frame_is_checked_and_optimized_and_the_page_shows_what_is_out_of_date(open_tab: OpenTab) -> None:
    tab = open_tab(width=160, height=120)
    app, verdict = tab.app, tab.page.locator(".carts-verdict")
    expect(verdict).to_contain_text("not checked")
    # Key 5 shows what the optimizer would see, and is no run.
    tab.press("5")
    eventually(lambda: app.state.maps)
    expect(verdict).not_to_contain_text("determined")
    place = distance_below(tab)
    check = tab.page.get_by_role("button", name="Check the fit", exact=True)
    check.click()
    eventually(lambda: app.state.verdict, timeout=90)
    # The button says why it cannot be pressed.
    expect(tab.page.get_by_role("button", name="Fit checked", exact=True)).to_be_disabled()
    shown = eventually(lambda: tab.page.evaluate(_FIT), lambda fit: fit > 0)
    # While a run moves the frame, the verdict is an old one; a reset brings it back.
    tab.put(intents.Step())
    eventually(lambda: app.state.run.phase, lambda phase: phase is Phase.PAUSED, timeout=90)
    eventually(lambda: tab.page.evaluate(_FIT), lambda fit: fit == 0)
    expect(check).to_be_enabled()
    tab.put(intents.Reset())
    eventually(lambda: tab.page.evaluate(_FIT), lambda fit: fit == shown)
    tab.button("Perturb all joints")
    eventually(lambda: app.state.undoable, lambda count: count == 1)
    expect(verdict).to_contain_text("not checked")
    app.wait_until_shown()
    start = tab.view.scene.sent("/overlay")
    tab.button("Run")
    eventually(lambda: app.state.run, lambda run: run.phase is Phase.IDLE and run.reason is not None, timeout=90)
    said = eventually(lambda: app.state.verdict)
    assert said is not None
    curves = app.state.run.curves
    assert min(curves.loss[1:]) < curves.loss[0] and curves.comparable
    assert distance_below(tab) == place
    best = f"result {curves.loss[curves.best]:.3g}, iteration {curves.best}"
    for text in (app.state.run.reason or "", best):
        expect(tab.page.get_by_text(text).first).to_be_visible()
    expect(verdict).to_contain_text(f"Mask {said.verdict}")
    expect(verdict).to_contain_text(re.compile("joints? not determined|all joints determined"))
    app.wait_until_shown()
    assert tab.view.scene.sent("/overlay") != start
    charts = "Object.values(window.__viserTestpoints.uplots).map(entry => Array.from(entry.chart.data[1]))"
    assert any(np.allclose(chart, curves.loss) for chart in tab.page.evaluate(charts))
    tab.page.locator(".uplot").first.hover()
    expect(tab.page.locator(".u-legend .u-label").filter(has_text="Loss").first).to_be_visible()
    expect(tab.page.locator(".carts-curve.carts-outdated")).to_have_count(0)
    tab.press("o")
    expect(tab.page.locator(".carts-curve.carts-outdated").first).to_be_visible()
    expect(verdict).to_contain_text("not checked")
    check_lost_connection(tab)


def test_exports_are_downloaded_and_written_beside_the_project(open_tab: OpenTab) -> None:
    tab = open_tab()
    app = tab.app
    tab.button("Perturb all joints")
    eventually(lambda: app.state.undoable, lambda count: count == 1)
    tab.open("Export")
    with tab.page.expect_download() as started:
        tab.button("Export mask")
    mask = decoded(Path(started.value.path()).read_bytes())
    shown = OverlayRenderer(app.sequence).arm_ids(app.state.pose.scene, "left") >= 0
    assert started.value.suggested_filename == "tiny_001_left.png" and np.array_equal(mask > 0, shown)
    tab.button("Export")
    path = eventually(lambda: app.state.export and app.state.export.path)
    expect(tab.page.get_by_role("status").filter(has_text=str(path))).to_be_visible()
    with tab.page.expect_download() as started:
        tab.button("Download")
    assert started.value.suggested_filename == "masks.zip"
    with zipfile.ZipFile(io.BytesIO(Path(started.value.path()).read_bytes())) as archive:
        assert np.array_equal(decoded(archive.read("masks/binary/left_001.png")), mask)
        views = json.loads(archive.read("masks/export.json"))["views"]
    assert [view["source"] for view in views] == ["edited", "measured", "measured"]
    tab.press("g")
    tab.choose("Format", "COCO")
    tab.choose("Frames", "Accepted")
    expect(tab.page.get_by_text("1 of 3 frames")).to_be_visible()
    tab.button("Export")
    path = eventually(lambda: app.state.export and app.state.export.path, lambda path: path and path.name == "coco")
    assert path is not None
    content = json.loads((path / "annotations" / "instances_default.json").read_text())
    assert path.parent == app.project.path.with_name("sequence_exports") and len(content["images"]) == 1


def test_frames_are_solved_while_the_page_stays_live_and_a_suspected_calibration_is_corrected(
    open_tab: OpenTab, monkeypatch: pytest.MonkeyPatch
) -> None:
    tab = open_tab(frames=4, width=160, height=120, solver=SolverInProcess())
    app = tab.app
    stop, solve = (tab.page.get_by_role("button", name=name, exact=True) for name in ("Stop and keep", "Solve all"))
    go_on, make = threading.Event(), PropagatingHandler._make

    def slowly(*arguments):
        assert go_on.wait(60)
        return make(*arguments)

    monkeypatch.setattr(PropagatingHandler, "_make", slowly)
    tab.open("Review")
    tab.press("k")
    expect(tab.page.get_by_text("001 to 004")).to_be_visible()
    tab.put(intents.MoveFrame(1))
    expect(tab.page.get_by_text("3 frames would be fitted, 1 kept")).to_be_visible()
    tab.button("Solve between")
    expect(tab.page.get_by_text("Preparing", exact=True)).to_be_visible()
    expect(solve).to_be_disabled()
    expect(stop).to_be_visible()
    tab.press("n")
    go_on.set()
    wait_in(tab.page, "carts.timeline().solving?.[1] === 4")
    eventually(lambda: app.state.index, lambda index: index == 2)
    expect(tab.page.get_by_text("3 frames solved")).to_be_visible(timeout=60_000)
    expect(stop).to_be_hidden()
    sources = "[...Array(4).keys()].map((frame) => (carts.timeline().code(frame) >> 5) & 3)"
    eventually(lambda: tab.page.evaluate(sources), lambda codes: codes[1:] == [3] * 3)
    assert not app.state.project.joints(0) and all(app.state.project.joints(frame) for frame in range(1, 4))
    expect(tab.page.get_by_text("The calibration may be wrong")).to_have_count(0)
    monkeypatch.setattr(SequenceOptimizer, "base_frame_gain", lambda self: 0.4)
    tab.button("Solve all")
    expect(tab.page.get_by_text("The calibration may be wrong")).to_be_visible(timeout=120_000)
    tab.button("Calibrate on 4 frames")
    said = tab.page.get_by_role("status").get_by_text("run or solve fitted frames again")
    expect(said.locator("visible=true")).to_have_count(1, timeout=120_000)
    expect(said.locator("visible=true")).to_contain_text("Moved: T_world_base of PSM1 by ")
    expect(tab.page.get_by_text("The calibration may be wrong")).to_have_count(0)


def test_a_range_is_what_is_solved_exported_and_queued(open_tab: OpenTab) -> None:
    tab = open_tab(window=(1280, 800), frames=12, cameras=("left", "right"), width=160, height=120)
    tab.put(intents.SetReview(ReviewState.ACCEPTED), intents.SetRange((4, 7)))
    expect(tab.page.locator(".carts-range")).to_have_text("005 – 008")
    tab.open("Review")
    between, whole = (
        tab.page.get_by_role("button", name=name, exact=True) for name in ("Solve between", "Solve range")
    )
    expect(tab.page.get_by_text("is limited to the range, but this frame lies outside of it")).to_be_visible()
    expect(between).to_be_disabled()
    expect(whole).to_be_enabled()
    tab.put(intents.Solve())
    expect(tab.page.get_by_text("the shown frame lies outside of it").last).to_be_visible()
    tab.put(intents.DismissError(), intents.ShowFrame(5))
    expect(tab.page.get_by_text("there is none in the range")).to_be_visible()
    tab.put(intents.SetReview(ReviewState.ACCEPTED))
    expect(tab.page.get_by_text("Solve between, 005 to 008: 3 frames would be fitted, 1 kept")).to_be_visible()
    # The bright button is what the range was most likely chosen for.
    assert (tab.find("Solve range").color, tab.find("Solve between").color) == ("teal", "gray")
    tab.open("Export")
    expect(tab.page.get_by_text("1 accepted frame outside of the range is not exported")).to_be_visible()
    tab.page.get_by_label("Only the range").uncheck()
    expect(tab.page.get_by_text("outside of the range")).to_be_hidden()
    tab.open("Jobs")
    frames = tab.page.locator(tab.element(tab.find("Which frames")))
    expect(frames).to_have_value("Range in the timeline")
    tab.put(intents.SetRange(None))
    expect(frames).to_have_value("Unreviewed")
    assert tab.find("Solve between").color == "teal"
    # What was chosen by hand stays.
    tab.choose("Which frames", "All")
    tab.put(intents.SetRange((4, 7)))
    expect(tab.page.locator(".carts-range")).to_have_text("005 – 008")
    expect(frames).to_have_value("All")
    # The longest status that solving leaves is not cut off.
    codes = "[0, 6 + 8 + 96 + 5 * 65536]"
    tab.page.evaluate(f"carts.setTimeline({{ whole: false, codes: {codes}, solving: null, traced: false }})")
    tab.put(intents.ShowFrame(0))
    status = tab.page.locator(".carts-strip output")
    expect(status).to_have_text("001 of 12 · solved together · mask good")
    expect(status).to_have_attribute("title", "001 of 12 · solved together · mask good, 4 joints not determined")
    assert not status.evaluate("one => one.scrollWidth > one.clientWidth")


def test_jobs_of_another_user_are_asked_for_and_jobs_and_choices_survive_the_server(open_tab: OpenTab) -> None:
    def plant(folder: Path) -> None:
        row = {"number": 1, "kind": "export", "title": "Harmless", "state": "waiting"}
        row["options"] = {"format": "csv", "frames": "All"}
        (folder / "sequence_jobs.json").write_text(json.dumps([row]))

    tab = open_tab(prepare=plant, frames=6, width=160, height=120)
    app = tab.app
    expect(tab.page.get_by_text("need your confirmation")).to_be_visible()
    assert [job.state for job in app.state.jobs] == [JobState.ASKED]
    tab.open("Jobs")
    expect(tab.page.get_by_text("did not queue them on this computer: Export all as")).to_be_visible()
    tab.button("Run jobs")
    eventually(lambda: app.state.jobs[0].state, lambda state: state is JobState.DONE, 60)
    expect(tab.page.get_by_text("need your confirmation")).to_have_count(0)
    expect(tab.page.get_by_role("button", name="Run jobs")).to_have_count(0)
    run_without_end(app)
    tab.button("Optimize individually")
    running = tab.page.locator(".carts-jobs li.running")
    expect(running).to_contain_text("Optimize 6 frames individually")
    tab.press("n")
    eventually(lambda: app.state.index, lambda index: index == 1)
    tab.button("Cancel")
    expect(tab.page.locator(".carts-jobs li.cancelled")).to_be_visible()
    tab.choose("Slider range", "± 20")
    tab.choose("Layer", "Contour")
    eventually(lambda: (app.state.reach, app.state.layer), lambda now: now == ("± 20", "Contour"))
    wait_in(tab.page, "JSON.parse(localStorage.getItem('carts-settings')).layer == 'Contour'")
    tab.put(intents.ShowFrame(4))
    wait_in(tab.page, "carts.shown().frame == 4")
    # Another server at the same address finds frame, choices and tab as they were.
    port = int(app.url.rsplit(":", 1)[1])
    app.close()
    expect(tab.page.locator("body.carts-offline")).to_be_attached()
    with ViewerApp.open(app.sequence.path, port=port) as again:
        eventually(lambda: again.state.index, lambda index: index == 4, timeout=60)
        expect(tab.page.locator("[role=tab][aria-selected=true]").filter(has_text="Jobs")).to_be_visible()
        expect(tab.page.locator(".carts-jobs li.cancelled")).to_be_visible()
        eventually(lambda: (again.state.reach, again.state.layer), lambda now: now == ("± 20", "Contour"))
        view = tab.place_in(again).view
        assert view is not None
        slider = view.layout.joints.slider("PSM1", 0)
        assert slider.max - slider.min > 30


def test_a_review_is_saved_as_the_page_says_under_the_name_that_was_typed(open_tab: OpenTab) -> None:
    tab = open_tab()
    app = tab.app
    tab.open("Review")
    fields = tab.page.locator(".mantine-TextInput-input:visible")
    fields.last.fill("Ann")
    fields.last.press("Enter")
    eventually(lambda: tab.state.name, lambda name: name == "Ann")
    fields.first.click()
    fields.first.press_sequentially("smoke on the left", delay=20)
    expect(tab.page.get_by_text("Not saved yet")).to_be_visible()
    fields.first.press("Tab")
    saved = tab.page.locator(".carts-saved")
    expect(saved).to_have_text("Saved")
    expect(saved).to_have_attribute("title", re.compile(r"sequence\.carts$"))
    tab.button("Needs work")
    tab.button("Next unreviewed")
    eventually(lambda: app.state.index, lambda index: index == 1)
    tab.button("Accept + next")
    expect(tab.page.get_by_text("1 accepted")).to_be_visible()
    app.close()
    with Project.open(app.sequence) as again:
        project = again.state
    assert (project.review(0).state, project.review(0).note) == ("needs work", "smoke on the left")
    assert project.review(1).state == "accepted" and len(project.steps) == 3
