"""The running app over real sockets, without a browser."""

import gc
import math
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from places import place_of, view_of, widget
from viewer_canvas import decoded
from viewer_run import run_without_end
from waiting import get, wait_for
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from carts_core.errors import ProjectError, SequenceError, SettingsError
from carts_core.optimization import Backgrounds
from carts_core.project import Project, ProjectState
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


def _picture(png: bytes) -> np.ndarray:
    return cv2.cvtColor(decoded(png), cv2.COLOR_BGRA2RGBA)


def test_neither_page_nor_images_are_left_some_time_after_the_last_tab_has_left(
    open_viewer: Callable[..., ViewerApp], monkeypatch: pytest.MonkeyPatch
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
        wait_for(lambda: page() is None and background() is None and all(image() is None for image in images))
    finally:
        gc.enable()


def test_memory_is_returned_during_work_that_no_page_shows(
    open_viewer: Callable[..., ViewerApp], monkeypatch: pytest.MonkeyPatch
) -> None:
    returned: list[Phase] = []
    app = open_viewer()
    run_without_end(app)
    app.queue.put(intents.Run())
    wait_for(lambda: app.state.run.phase is Phase.RUNNING)
    monkeypatch.setattr(worker, "return_memory", lambda: returned.append(app.state.run.phase))
    monkeypatch.setattr(worker, "MEMORY_KEPT", 0.3)
    wait_for(lambda: returned.count(Phase.RUNNING) > 1)


def test_memory_is_returned_during_work_beside_a_page(
    open_viewer: Callable[..., ViewerApp], monkeypatch: pytest.MonkeyPatch
) -> None:
    returned: list[Phase] = []
    app = open_viewer()
    run_without_end(app)
    with RawTab(app.url, key="one") as raw:
        place = place_of(app, raw)
        place.put(intents.Run())
        wait_for(lambda: place.controller.state.run.phase is Phase.RUNNING)
        monkeypatch.setattr(worker, "return_memory", lambda: returned.append(place.controller.state.run.phase))
        monkeypatch.setattr(worker, "MEMORY_KEPT_AT_WORK", 0.3)
        wait_for(lambda: returned.count(Phase.RUNNING) > 1)


def test_a_run_is_ended_and_its_pose_saved_once_its_tab_does_not_come_back(
    open_viewer: Callable[..., ViewerApp], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tabs, "AWAY", 2.0)
    app = open_viewer()
    run_without_end(app)
    with RawTab(app.url, key="one") as raw:
        place = place_of(app, raw)
        place.put(intents.Run())
        wait_for(lambda: len(place.controller.state.run.curves.loss) > 1)
    with RawTab(app.url, key="one"):
        # It came back in time, so its run goes on for as long as it stays.
        end = time.monotonic() + tabs.AWAY
        wait_for(lambda: time.monotonic() > end)
        assert place.controller.state.run.phase is Phase.RUNNING
    wait_for(lambda: place.controller.state.run.phase is Phase.IDLE)
    state = app.wait_until_shown()
    assert "tab was closed" in (state.run.reason or "") and state.undoable == 1 and not state.unsaved


def test_after_a_burst_of_slider_values_the_overlay_is_that_of_the_last(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer(masks=False)
    app.queue.put(intents.ShowLayer(Layer.MASK))
    with RawTab(app.url) as tab:
        slider = app.view.layout.joints.slider("PSM1", 0)
        for value in np.linspace(-5.0, 5.0, 100):
            tab.set(app.page.element_id(slider), float(value))
        wait_for(lambda: app.state.pose.scene.joint_positions[0][0] == pytest.approx(math.radians(5.0)))
        state = app.wait_until_shown()
        wait_for(lambda: tab.overlays[-1][1] == app.view.scene.sent(OVERLAY))
        fresh = OverlayRenderer(app.sequence).arm_ids(state.pose.scene, "left")
        assert np.array_equal(_picture(tab.overlays[-1][1]), mask(fresh, state.opacity))
        assert 1 <= len(tab.overlays) < 100


def test_a_value_is_not_lost_to_a_panel_that_is_brought_up_to_date_at_that_moment(
    open_viewer: Callable[..., ViewerApp],
) -> None:
    app = open_viewer()
    with RawTab(app.url) as tab:
        slider = app.view.layout.joints.slider("PSM1", 0)
        before = slider.value
        go_on: Any = slider._impl.sync_cb

        def write_meanwhile(*arguments: Any) -> None:
            slider.value = before
            go_on(*arguments)

        slider._impl.sync_cb = write_meanwhile
        tab.set(app.page.element_id(slider), before + 2.0)
        wait_for(lambda: abs(math.degrees(app.state.pose.scene.joint_positions[0][0]) - before - 2.0) < 0.01)
        wait_for(lambda: abs(slider.value - before - 2.0) < 0.01)


@pytest.mark.parametrize("value", [float("nan"), 1e12, -1e12])
def test_a_raw_client_cannot_move_a_joint_out_of_its_limits(
    open_viewer: Callable[..., ViewerApp], value: float
) -> None:
    app = open_viewer()
    with RawTab(app.url) as tab:
        slider = app.view.layout.joints.slider("PSM1", 0)
        tab.set(app.page.element_id(slider), value)
        wait_for(lambda: math.isfinite(slider.value) and abs(slider.value) < 1e6)
        state = app.wait_until_shown()
    limits = app.scene.arms[0].robot.joint_limits[0]
    assert limits[0] - 1e-5 <= state.pose.scene.joint_positions[0][0] <= limits[1] + 1e-5
    assert state.error is None


def test_a_choice_that_does_not_exist_is_put_right(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer(cameras=("left", "right"))
    with RawTab(app.url) as rogue:
        dropdown = app.view.page.find("Camera")
        rogue.set(app.page.element_id(dropdown), "no such camera")
        wait_for(lambda: dropdown.value == "left")
        wait_for(lambda: rogue.values.get(app.page.element_id(dropdown)) == "left")
    assert app.state.camera == "left" and app.state.error is None


def test_every_tab_has_its_own_frame(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer()
    with RawTab(app.url) as first, RawTab(app.url) as second:
        first.set(app.page.element_id(widget(app, first, "Frame")), 3)
        wait_for(lambda: place_of(app, first).controller.state.index == 2)
        second.set(app.page.element_id(widget(app, second, "Frame")), 2)
        wait_for(lambda: place_of(app, second).controller.state.index == 1)
        app.wait_until_shown()
        assert [place_of(app, tab).controller.state.index for tab in (first, second)] == [2, 1]


def test_a_tab_that_reloads_is_where_it_was(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer()
    with RawTab(app.url, key="mine") as tab, RawTab(app.url):
        tab.set(app.page.element_id(widget(app, tab, "Frame")), 3)
        wait_for(lambda: app.state.index == 2)
    with RawTab(app.url), RawTab(app.url, key="mine") as again:
        assert place_of(app, again).controller.state.index == 2 == widget(app, again, "Frame").value - 1


def test_a_missing_image_is_an_error_in_the_page_and_the_server_stays_up(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer(frames=12)
    image = app.sequence.path.parent / "regular" / "left" / "012.png"  # Too far away to be read in advance.
    image.rename(image.with_suffix(".gone"))
    app.queue.put(intents.ShowFrame(11))
    state = app.wait_until_shown()
    assert state.error is not None and "012.png" in state.error and state.index == 0
    image.with_suffix(".gone").rename(image)
    app.queue.put(intents.ShowFrame(11))
    state = app.wait_until_shown()
    assert state.index == 11 and state.error is None
    assert get(app.url, "/").status == 200


def test_the_old_frame_stays_until_the_next_one_is_decoded(
    open_viewer: Callable[..., ViewerApp], monkeypatch: pytest.MonkeyPatch
) -> None:
    app = open_viewer(frames=6)
    asked, decoded = threading.Event(), threading.Event()
    read = app.sequence.frame

    def slow(index: int, *arguments):
        if index == 5:
            asked.set()
            assert decoded.wait(30)
        return read(index, *arguments)

    monkeypatch.setattr(app.sequence, "frame", slow)
    with RawTab(app.url):
        app.wait_until_shown()
        before = app.state
        sent = app.view.scene.sent(FRAME)
        app.queue.put(intents.ShowFrame(5))
        assert asked.wait(30)
        assert app.state.frame is before.frame and app.view.scene.sent(FRAME) == sent
        decoded.set()
        state = app.wait_until_shown()
        assert state.index == state.frame.index == 5 and app.view.scene.sent(FRAME) != sent


def test_the_offset_between_the_clocks_is_shown_and_hidden_where_there_are_none(
    open_viewer: Callable[..., ViewerApp],
) -> None:
    def describe(text: str) -> str:
        frames = '[frames]\ntable = "frames.csv"\nframe_id = "{frame:03d}"\ntime_offset = -0.035\n'
        return text.replace('frame_id = "{frame:03d}"\n', "").replace("[[arms]]", frames + "[[arms]]", 1)

    def add_times(folder: Path) -> None:
        (folder / "frames.csv").write_text("frame,timestamp\n1,0.1\n2,0.15\n3,0.2\n")

    app = open_viewer(edit=describe, prepare=add_times)
    app.queue.put(intents.ShowFrame(1))
    app.wait_until_shown()
    with RawTab(app.url):
        app.wait_until_shown()
        captions = [panel._caption.content for panel in app.view.display._panels if isinstance(panel, BrowsePanel)]
        assert ["at 0.150 s" in caption for caption in captions] == [True]
        offset = app.view.page.find("Time offset [s]")
        assert offset.visible and offset.value == -0.035
        app.queue.put(intents.SetTimeOffset(-0.02))
        app.wait_until_shown()
        assert offset.value == -0.02
    other = open_viewer()
    with RawTab(other.url):
        assert not other.view.page.find("Time offset [s]").visible


def test_closing_ends_the_reading_of_frames_in_advance(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer(frames=6)
    app.queue.put(intents.ShowFrame(1))
    app.wait_until_shown()
    app.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "carts-frames"]


def test_weights_that_are_missing_are_an_error_in_the_page(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    with ViewerApp.open(tiny_sequence(), port=0, weights=(tmp_path / "none.safetensors",)) as app:
        app.queue.put(intents.Run())
        state = app.wait_until_shown(60)
        assert "none.safetensors" in (state.error or "") and state.busy is None
        app.queue.put(intents.MoveFrame(1))
        assert app.wait_until_shown().index == 1


def test_a_layer_that_cannot_be_computed_is_an_error_once_and_not_for_ever(
    tiny_sequence: Callable[..., Path], tmp_path: Path
) -> None:
    with ViewerApp.open(tiny_sequence(), port=0, weights=(tmp_path / "none.safetensors",)) as app:
        app.queue.put(intents.ShowLayer(Layer.ATTENTION))
        state = app.wait_until_shown(60)
        assert "none.safetensors" in (state.error or "") and state.layer is Layer.MASK
        app.queue.put(intents.DismissError())
        assert app.wait_until_shown().error is None


def test_the_page_carries_our_script_style_and_title(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer()
    response = get(app.url, "/")
    page = response.read().decode()
    assert "<title>tiny · CaRTS</title>" in page and "/static/page.js" in page and "/static/page.css" in page
    assert response.headers["X-Frame-Options"] == "DENY"
    for name, kind in (("page.js", "javascript"), ("page.css", "text/css"), ("icon.svg", "svg")):
        found = get(app.url, f"/static/{name}")
        assert found.status == 200 and kind in found.headers["Content-Type"]


@pytest.mark.parametrize(
    "path", ["/static/", "/static/../pyproject.toml", "/static/..%2fpyproject.toml", "/static//etc/passwd", "/../x"]
)
def test_no_file_outside_the_static_folder_is_served(open_viewer: Callable[..., ViewerApp], path: str) -> None:
    assert get(open_viewer().url, path).status == 404


def test_requests_for_another_host_or_from_another_site_are_refused(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer()
    assert get(app.url, "/", Host="evil.example").status == 403
    assert get(app.url, "/", Origin="http://evil.example").status == 403
    protocol = [Subprotocol("viser-v1.1.1")]
    for options in ({"origin": "http://evil.example"}, {"additional_headers": {"Host": "evil.example"}}):
        with pytest.raises(InvalidStatus) as refused:
            connect(app.url.replace("http", "ws"), subprotocols=protocol, **options)  # type: ignore[arg-type]
        assert refused.value.response.status_code == 403
    with connect(app.url.replace("http", "ws"), subprotocols=protocol, origin=app.url):  # type: ignore[arg-type]
        pass


def test_a_busy_port_moves_up_and_the_url_says_so(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer()
    taken = int(app.url.rsplit(":", 1)[1])
    with ViewerApp.open(app.sequence.path, port=taken) as second:
        assert second.url != app.url and get(second.url, "/").status == 200


def test_an_address_of_another_computer_is_refused_before_anything_is_opened() -> None:
    with pytest.raises(SettingsError, match="cannot listen on"):
        ViewerApp.open(Path("does not matter.toml"), host="192.0.2.7")


def test_a_sequence_that_does_not_open_is_an_error_that_names_it() -> None:
    with pytest.raises(SequenceError, match=r"nowhere\.toml"):
        ViewerApp.open(Path("nowhere.toml"))


def test_serve_ends_with_code_2_and_a_message_when_the_sequence_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        serve(Path("nowhere.toml"))
    assert ended.value.code == 2
    assert "nowhere.toml is missing" in capsys.readouterr().err


def test_serve_prints_the_address_and_ends_cleanly_on_ctrl_c(tiny_sequence: Callable[..., Path]) -> None:
    # A shell that runs the tests in the background makes its children ignore Ctrl-C, hence the second line.
    program = """
import signal, sys; from pathlib import Path; from carts_viewer.serving import serve
signal.signal(signal.SIGINT, signal.default_int_handler)
serve(Path(sys.argv[1]), port=0)
"""
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(tiny_sequence())], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    watchdog = threading.Timer(120, process.kill)
    watchdog.start()
    assert process.stdout is not None
    lines = iter(process.stdout.readline, "")
    ready = next(line for line in lines if "Ready" in line)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    watchdog.cancel()
    assert "http://127.0.0.1:" in ready
    assert process.returncode == 0 and "Traceback" not in errors


def test_closing_twice_and_closing_while_running_do_no_harm(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer()
    app.queue.put(intents.Run())
    app.close()
    app.close()


def _reopened(app: ViewerApp) -> ProjectState:
    app.close()
    with Project.open(app.sequence, app.project.path) as project:
        return project.state


def test_what_is_done_in_the_page_is_in_the_project_beside_the_sequence(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer()
    assert app.project.path == app.sequence.path.with_suffix(".carts").resolve()
    app.queue.put(intents.SetJoint("PSM1", 0, 0.1))
    assert app.wait_until_shown().unsaved and not app.project.state.steps
    app.queue.put(intents.Released())
    assert not app.wait_until_shown().unsaved
    assert _reopened(app).joints(0)["PSM1"].joint_positions[0] == pytest.approx(0.1)


def test_closing_saves_the_gesture_under_way(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer()
    app.queue.put(intents.SetJoint("PSM1", 0, 0.1))
    app.wait_until_shown()
    assert [step.name for step in _reopened(app).steps] == ["Move PSM1 yaw, frame 001"]


def test_a_gesture_that_nobody_ends_is_saved_all_the_same(
    open_viewer: Callable[..., ViewerApp], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(editing, "LONGEST_DRAFT", 0.2)
    app = open_viewer()
    app.queue.put(intents.SetJoint("PSM1", 0, 0.1))
    wait_for(lambda: len(app.project.state.steps) == 1 and not app.state.unsaved)


def test_a_second_viewer_of_the_same_project_saves_nothing_and_says_so(open_viewer: Callable[..., ViewerApp]) -> None:
    app = open_viewer()
    with ViewerApp.open(app.sequence.path, port=0) as second:
        assert "open for writing elsewhere" in (second.notice or "") and app.notice is None
        second.queue.put(intents.SetJoint("PSM1", 0, 0.1))
        second.queue.put(intents.Released())
        state = second.wait_until_shown()
        assert state.unsaved and state.pose.scene.joint_positions[0][0] == pytest.approx(0.1)
        second.queue.put(intents.MoveFrame(1))
        second.queue.put(intents.MoveFrame(-1))
        state = second.wait_until_shown()
        assert not state.unsaved and not state.project.joints(0) and state.error is None
    assert not app.project.state.steps


def test_the_shipped_sequence_has_its_project_among_the_users_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CARTS_DATA", str(tmp_path / "data"))
    storage = open_storage(Sequence.open(sample_sequence()))
    storage.close()
    assert storage.notice is None and storage.project.path.parent == tmp_path / "data"


def test_without_a_place_for_a_project_nothing_is_kept_and_the_page_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("CARTS_DATA", str(tmp_path / "file" / "data"))
    storage = open_storage(Sequence.open(sample_sequence()))
    assert "Nothing is kept" in (storage.notice or "") and storage.project.writable
    path = storage.project.path
    storage.close()
    assert not path.parent.exists()


def test_a_copy_that_was_rescued_is_said_when_its_project_is_opened(open_viewer: Callable[..., ViewerApp]) -> None:
    def rescued(folder: Path) -> None:
        for name in ("sequence.rescued-20260101-120000.carts", "sequence.rescued-20260102-120000-2.carts"):
            (folder / name).touch()
        # Neither is one: another project's, a folder, a copy that somebody named themselves.
        (folder / "other.rescued-20260101-120000.carts").touch()
        (folder / "sequence.rescued-20260103-120000.carts").mkdir()
        (folder / "sequence.rescued-mine.carts").touch()

    app = open_viewer(frames=1, prepare=rescued)
    newest = app.project.path.with_name("sequence.rescued-20260102-120000-2.carts")
    assert f"when sequence.carts was lost or damaged is in {newest} (and 1 earlier)" in (app.notice or "")
    assert f"--project '{newest}'" in (app.notice or "")
    app.queue.put(intents.SetJoint("PSM1", 0, 0.1))
    app.queue.put(intents.Released())
    assert not app.wait_until_shown().unsaved
    with RawTab(app.url):
        app.wait_until_shown()
        (saved,) = (panel for panel in app.view.display._panels if isinstance(panel, SavedPanel))
        assert saved._notice.visible and newest.name in saved._notice.content
        assert "<b>Saved</b> in sequence.carts" in saved._text.content


def test_a_project_of_another_sequence_is_refused(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    Project.open(Sequence.open(tiny_sequence(frames=2)), tmp_path / "other.carts").close()
    with pytest.raises(ProjectError, match="belongs to another sequence"):
        ViewerApp.open(tiny_sequence(frames=3), project=tmp_path / "other.carts", port=0)
