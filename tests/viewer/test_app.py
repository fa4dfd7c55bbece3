"""The running app over real sockets, without a browser."""

import csv
import gc
import math
import re
import threading
import weakref
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from viewer_tab import OpenViewer, decoded, place_of, run_without_end, view_of
from waiting import PATIENCE, eventually, get

from carts_core.optimization import Backgrounds
from carts_core.project import Project
from carts_core.recording import Sequence
from carts_core.recording.sequence import ByteCache
from carts_core.resources import sample_sequence
from carts_viewer import editing, tabs, worker
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.panels.browse import BrowsePanel
from carts_viewer.panels.project import SavedPanel
from carts_viewer.picture.layers import Layer, mask
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.picture.scene_view import FRAME, OVERLAY
from carts_viewer.serving import serve
from carts_viewer.session import open_storage
from carts_viewer.state import Phase
from tools.raw_tab import RawTab


def test_neither_page_nor_images_are_left_some_time_after_the_last_tab_has_left(
    open_viewer: OpenViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    images, get_image = [], ByteCache.get

    def get(cache: ByteCache, key: Hashable, make: Callable[[], np.ndarray]) -> np.ndarray:
        image = get_image(cache, key, make)
        images.append(weakref.ref(image))
        return image

    monkeypatch.setattr(worker, "MEMORY_KEPT", 0.5)
    monkeypatch.setattr(ByteCache, "get", get)
    app = open_viewer()
    gc.disable()
    try:
        with RawTab(app.url) as tab:
            page = weakref.ref(view_of(app, tab).page)
            background = weakref.ref(Backgrounds.of(app.sequence, ["left"], app.sequence.domains[0]))
            app.wait_until_shown()
            assert background() is not None and any(image() is not None for image in images)
        eventually(lambda: page() is None and background() is None and all(image() is None for image in images))
    finally:
        gc.enable()


def test_a_run_is_ended_and_its_pose_saved_once_its_tab_does_not_come_back(
    open_viewer: OpenViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tabs, "RECONNECT_TIME", 1e6)
    app = open_viewer()
    run_without_end(app)
    with RawTab(app.url, key="one") as raw:
        place = place_of(app, raw)
        place.put(intents.Run())
        eventually(lambda: len(place.controller.state.run.curves.loss) > 1)
    with RawTab(app.url, key="one"):
        # It came back in time, so its run goes on for as long as it stays.
        monkeypatch.setattr(tabs, "RECONNECT_TIME", 0.0)
        done = len(place.controller.state.run.curves.loss)
        eventually(lambda: len(place.controller.state.run.curves.loss) > done + 10)
        assert place.controller.state.run.phase is Phase.RUNNING
    eventually(lambda: place.controller.state.run.phase is Phase.IDLE)
    state = app.wait_until_shown()
    assert "tab was closed" in (state.run.reason or "") and state.undoable == 1 and not state.unsaved


def test_of_slider_values_the_last_is_shown_also_while_the_panel_is_written(open_viewer: OpenViewer) -> None:
    app = open_viewer(masks=False)
    app.queue.put(intents.ShowLayer(Layer.MASK))
    with RawTab(app.url) as tab:
        slider = app.view.layout.joints.slider("PSM1", 0)
        for value in np.linspace(-5.0, 5.0, 100):
            tab.set(app.page.element_id(slider), float(value))
        eventually(lambda: app.state.pose.scene.joint_positions[0][0] == pytest.approx(math.radians(5.0)))
        state = app.wait_until_shown()
        eventually(lambda: tab.overlays[-1][1] == app.view.scene.sent(OVERLAY))
        fresh = OverlayRenderer(app.sequence).arm_ids(state.pose.scene, "left")
        shown = cv2.cvtColor(decoded(tab.overlays[-1][1]), cv2.COLOR_BGRA2RGBA)
        assert np.array_equal(shown, mask(fresh, state.opacity))
        before = slider.value
        go_on: Any = slider._impl.sync_cb

        def write_meanwhile(*arguments: Any) -> None:
            slider.value = before
            go_on(*arguments)

        slider._impl.sync_cb = write_meanwhile
        tab.set(app.page.element_id(slider), before - 2.0)
        eventually(lambda: abs(math.degrees(app.state.pose.scene.joint_positions[0][0]) - before + 2.0) < 0.01)
        eventually(lambda: abs(slider.value - before + 2.0) < 0.01)


def test_the_old_frame_stays_until_the_next_one_is_decoded(
    open_viewer: OpenViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = open_viewer(frames=6)
    asked, decoded = threading.Event(), threading.Event()
    read = app.sequence.frame

    def slow(index: int, *arguments):
        if index == 5:
            asked.set()
            assert decoded.wait(PATIENCE)
        return read(index, *arguments)

    monkeypatch.setattr(app.sequence, "frame", slow)
    with RawTab(app.url):
        app.wait_until_shown()
        before = app.state
        sent = app.view.scene.sent(FRAME)
        app.queue.put(intents.ShowFrame(5))
        assert asked.wait(PATIENCE)
        assert app.state.frame is before.frame and app.view.scene.sent(FRAME) == sent
        decoded.set()
        state = app.wait_until_shown()
        assert state.index == state.frame.index == 5 and app.view.scene.sent(FRAME) != sent


def test_captions_have_times_remarks_and_the_offset_between_clocks(open_viewer: OpenViewer) -> None:
    def describe(text: str) -> str:
        frames = '[frames]\ntable = "frames.csv"\nframe_id = "{frame:03d}"\ntime_offset = -0.035\n'
        text = re.sub(r"K = \[\[[^,]*,", "K = [[20.0,", text)
        return text.replace('frame_id = "{frame:03d}"\n', "").replace("[[arms]]", frames + "[[arms]]", 1)

    def add_times(folder: Path) -> None:
        (folder / "frames.csv").write_text("frame,timestamp\n1,0.1\n2,0.15\n3,0.2\n")

    def as_ros(folder: Path) -> None:
        header, *rows = csv.reader((folder / "kinematics.csv").open())
        place = header.index("time")
        for row in rows:
            row[place] = f"{1467072000.25 + float(row[place]):.6f}"
        (folder / "kinematics.csv").write_text("\n".join(map(",".join, [header, *rows])) + "\n")

    def caption(app: ViewerApp) -> str:
        app.wait_until_shown()
        (panel,) = (panel for panel in app.view.display._panels if isinstance(panel, BrowsePanel))
        return panel._caption.content

    app = open_viewer(edit=describe, prepare=add_times)
    with RawTab(app.url) as tab:
        app.queue.put(intents.ShowFrame(1))
        assert "· 0.150 s ·" in caption(app)
        offset = app.view.page.find("Time offset [s]")
        assert offset.visible and offset.value == -0.035
        app.queue.put(intents.SetTimeOffset(-0.02))
        app.wait_until_shown()
        assert offset.value == -0.02
        shown = " ".join(str(widget.get("content", widget.get("label"))) for widget in tab.widgets.values())
        assert "1 remark about the files" in shown and "left: its calibration has focal lengths of 20 and" in shown
    app.close()
    app.project.path.unlink()
    other = open_viewer(prepare=as_ros)
    with RawTab(other.url):
        other.queue.put(intents.ShowFrame(1))
        since = "1467072000.350000 s since 1970, 2016-06-28 00:00:00 UTC"
        assert f'· <span title="{since}">0.100 s</span> ·' in caption(other)
        assert not other.view.page.find("Time offset [s]").visible


def test_weights_that_are_missing_are_an_error_in_the_page_for_a_run_and_once_for_a_layer(
    open_viewer: OpenViewer, tmp_path: Path
) -> None:
    app = open_viewer(networks={"weights": (tmp_path / "none.safetensors",)})
    app.queue.put(intents.Run())
    state = app.wait_until_shown()
    assert "none.safetensors" in (state.error or "") and state.busy is None
    app.queue.put(intents.ShowLayer(Layer.ATTENTION))
    state = app.wait_until_shown()
    assert "none.safetensors" in (state.error or "") and state.layer is Layer.MASK
    app.queue.put(intents.DismissError())
    assert app.wait_until_shown().error is None
    app.queue.put(intents.MoveFrame(1))
    assert app.wait_until_shown().index == 1


def test_the_page_carries_our_script_style_and_title(shared_viewer: ViewerApp) -> None:
    response = get(shared_viewer.url, "/")
    page = response.read().decode()
    assert "<title>tiny · CaRTS</title>" in page and "static/page.js" in page and "static/page.css" in page
    assert response.headers["X-Frame-Options"] == "DENY"
    for name, kind in (("page.js", "javascript"), ("page.css", "text/css"), ("icon.svg", "svg")):
        found = get(shared_viewer.url, f"/static/{name}")
        assert found.status == 200 and kind in found.headers["Content-Type"]


def test_serve_ends_with_code_2_and_a_message_when_the_sequence_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        serve(Path("nowhere.toml"))
    assert ended.value.code == 2
    assert "nowhere.toml is missing" in capsys.readouterr().err


def test_closing_ends_runs_and_reading_in_advance_and_saves_the_gesture_under_way(
    open_viewer: OpenViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = open_viewer(frames=6)
    assert app.project.path == app.sequence.path.with_suffix(".carts").resolve()
    app.queue.put(intents.SetJoint("PSM1", 0, 0.1))
    assert app.wait_until_shown().unsaved and not app.project.state.steps
    app.queue.put(intents.Released())
    assert not app.wait_until_shown().unsaved
    app.queue.put(intents.ShowFrame(1))
    # A gesture without an end is saved after a while.
    monkeypatch.setattr(editing, "MAX_DRAFT_SECONDS", 0.2)
    app.queue.put(intents.SetJoint("PSM1", 0, 0.3))
    eventually(lambda: len(app.project.state.steps) == 2 and not app.state.unsaved)
    monkeypatch.setattr(editing, "MAX_DRAFT_SECONDS", 1e6)
    app.queue.put(intents.SetJoint("PSM1", 0, 0.2))
    app.wait_until_shown()
    app.close()
    app.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "carts-frames"]
    with Project.open(app.sequence, app.project.path) as project:
        assert [project.state.joints(frame)["PSM1"].joint_positions[0] for frame in (0, 1)] == pytest.approx([0.1, 0.2])
    running = open_viewer(frames=6)
    running.queue.put(intents.Run())
    running.close()


def test_closing_waits_for_the_worker_and_says_so(open_viewer: OpenViewer, monkeypatch: pytest.MonkeyPatch) -> None:
    app, lines, goes_on = open_viewer(), list[str](), threading.Event()
    monkeypatch.setattr(worker, "_NOTICE", 0.05)
    monkeypatch.setattr(app._worker, "_say", lines.append)

    def block() -> None:
        goes_on.wait(60)

    app._worker.call(block)
    app.queue.put(intents.SetJoint("PSM1", 0, 0.1))
    closing = threading.Thread(target=app.close)
    closing.start()
    eventually(lambda: len(lines) > 2)
    assert set(lines) == {"Waiting for the current step to end"} and closing.is_alive()
    goes_on.set()
    closing.join()
    with Project.open(app.sequence, app.project.path) as project:
        assert project.state.joints(0)["PSM1"].joint_positions[0] == pytest.approx(0.1)


def test_after_an_unexpected_error_at_the_end_the_drafts_of_other_tabs_are_saved(
    open_viewer: OpenViewer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(editing, "MAX_DRAFT_SECONDS", 1e6)
    app = open_viewer()

    def broken() -> None:
        raise RuntimeError("generator already executing")

    with RawTab(app.url) as first, RawTab(app.url) as second:
        places = [place_of(app, tab) for tab in (first, second)]
        assert list(app.tabs) == places
        places[1].put(intents.SetJoint("PSM1", 0, 0.1))
        app.wait_until_shown()
        monkeypatch.setattr(places[0].controller, "close", broken)
        with pytest.raises(RuntimeError, match="already executing"):
            app.close()
    with Project.open(app.sequence, app.project.path) as project:
        assert project.state.joints(0)["PSM1"].joint_positions[0] == pytest.approx(0.1)
    assert "Unexpected error while unfinished work was saved" in caplog.text


def test_a_second_viewer_of_the_same_project_has_another_port_saves_nothing_and_says_so(
    open_viewer: OpenViewer,
) -> None:
    app = open_viewer()
    with ViewerApp.open(app.sequence.path, port=int(app.url.rsplit(":", 1)[1])) as second:
        assert second.url != app.url and get(second.url, "/").status == 200
        assert "open for writing elsewhere" in (second.notice or "") and app.notice is None
        second.queue.put(intents.SetJoint("PSM1", 0, 0.1))
        second.queue.put(intents.Released())
        assert second.wait_until_shown().unsaved
    assert not app.project.state.steps


def test_without_a_place_for_a_project_nothing_is_kept_and_the_page_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("CARTS_DATA", str(tmp_path / "file" / "data"))
    storage = open_storage(Sequence.open(sample_sequence()))
    assert "Temporary project" in (storage.notice or "") and storage.project.writable
    path = storage.project.path
    storage.close()
    assert not path.parent.exists()


def test_a_copy_that_was_rescued_is_said_when_its_project_is_opened(open_viewer: OpenViewer) -> None:
    def rescued(folder: Path) -> None:
        for name in ("sequence.rescued-20260101-120000", "sequence.rescued-20260102-120000-2"):
            (folder / f"{name}.carts").touch()
        # A copy of another project, a file of another name and a folder do not count.
        for name in ("other.rescued-20260101-120000", "sequence.rescued-mine"):
            (folder / f"{name}.carts").touch()
        (folder / "sequence.rescued-20260103-120000.carts").mkdir()

    app = open_viewer(frames=1, prepare=rescued)
    newest = app.project.path.with_name("sequence.rescued-20260102-120000-2.carts")
    assert f"{newest} (and 1 earlier) is a rescued copy" in (app.notice or "")
    assert f"--project '{newest}'" in (app.notice or "")
    with RawTab(app.url):
        app.wait_until_shown()
        (saved,) = (panel for panel in app.view.display._panels if isinstance(panel, SavedPanel))
        assert saved._notice.visible and newest.name in saved._notice.content
