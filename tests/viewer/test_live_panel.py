"""A live stream in the page: followed, not edited, recorded, and the recording comes back afterwards."""

import shutil
import socket
from collections.abc import Iterator

import cv2
import numpy as np
import psutil
import pytest
from playwright.sync_api import expect
from viewer_tab import OpenTab, place_of
from waiting import eventually

from carts_core.live import FrameMessage, ImageMessage, packed
from carts_core.recording import Sequence
from carts_core.resources import sample_sequence
from carts_viewer import tabs
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.panels.fit import live_text
from tools.raw_tab import RawTab

SECONDS = 120.0
"""For the networks to be there, on a busy machine."""


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ViewerApp]:
    folder = tmp_path_factory.mktemp("live") / "recording"
    shutil.copytree(sample_sequence().parent, folder)
    # Without times of its images, a replay has a field for their rate.
    lines = (folder / "sequence.toml").read_text().splitlines()
    (folder / "sequence.toml").write_text("\n".join(line for line in lines if not line.startswith("timestamp")) + "\n")
    with pytest.MonkeyPatch.context() as patch, ViewerApp.open(folder / "sequence.toml", port=0) as app:
        patch.setattr(tabs, "RECONNECT_TIME", 1e6)  # Streams of the first tab go on after its page was closed.
        app.wait_until_shown(SECONDS)
        yield app


@pytest.mark.browser
def test_a_replay_is_followed_recorded_and_cannot_be_edited(app: ViewerApp, open_tab: OpenTab) -> None:
    tab = open_tab(app)
    tab.open("Live")
    expect(tab.page.get_by_label("Images per second")).to_have_value("30")
    tab.page.get_by_label("Images per second").fill("10")
    tab.page.get_by_label("Record").check()
    tab.page.get_by_label("Repeat").check()
    tab.button("Start")
    expect(tab.page.get_by_text("Live: good")).to_be_visible(timeout=1000 * SECONDS)
    assert tab.state.streaming
    joints = tab.state.pose.scene.joint_positions
    tab.place_in_viewer.put(intents.Perturb(3.0, seed=0))
    expect(tab.page.get_by_text("A live stream cannot be edited").first).to_be_visible()
    eventually(lambda: tab.state.pose.scene.joint_positions, lambda now: now is not joints)
    assert not tab.state.project.position
    # The next frame may take the scores away between two looks at them.
    scores = eventually(lambda: tab.state.scores)
    assert scores is not None and scores.dice is not None and scores.dice > 0.9
    # However slow the machine is, more than two frames are recorded.
    seen: set[str] = set()
    eventually(lambda: seen.add(tab.state.frame.frame_id) or len(seen), lambda frames: frames > 3)
    tab.button("Stop")
    expect(tab.page.get_by_text("Recorded: carts view")).to_be_visible()
    assert not tab.state.streaming
    assert tab.state.frame.frame_id == app.tabs.first.controller.state.frame.frame_id
    (recorded,) = app.project.path.parent.glob("*_live_*/sequence.toml")
    assert len(Sequence.open(recorded)) > 2


def test_another_program_sends_frames_and_gets_results(app: ViewerApp) -> None:
    sequence = Sequence.open(app.project.path.with_name("sequence.toml"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        free = taken.getsockname()[1]
    app.queue.put(intents.StartLive(f"socket:{free}"))
    eventually(lambda: app.state.live and app.state.live.text, lambda text: f"port {free}" in (text or ""), SECONDS)
    frame = sequence.frame(0)
    images = {name: _png(image) for name, image in frame.images.items()}
    joints = {
        arm.name: dict(zip(arm.robot.joint_names, map(float, frame.measured[arm.name]), strict=True))
        for arm in sequence.scene.arms
    }
    with socket.create_connection(("127.0.0.1", free)) as connection:
        for number in range(3):
            connection.sendall(packed(FrameMessage(float(number), joints=joints, images=images, id=f"sent {number}")))
        eventually(lambda: app.state.frame.frame_id.startswith("sent"), timeout=SECONDS)
        live = eventually(lambda: app.state.live, lambda live: live is not None and not live.busy, SECONDS)
        assert live is not None and app.state.frame.frame_id.startswith("sent") and app.state.verdict is None
        connection.settimeout(SECONDS)
        assert connection.recv(1)  # the result of a frame, for who sent it
        silent = eventually(lambda: app.state.live, lambda live: live is not None and live.silent > 1.0, SECONDS)
        assert silent is not None and "no new frame" in live_text(silent) and "good" not in live_text(silent)
        connection.sendall(packed(FrameMessage(3.0, joints=joints, images=images, id="sent again")))
        eventually(lambda: app.state.frame.frame_id, lambda name: name == "sent again", SECONDS)
        assert app.state.live is not None and not app.state.live.silent
    app.queue.put(intents.StopLive())
    eventually(lambda: app.state.streaming, lambda on: not on)
    assert app.state.frame.frame_id == sequence.frame_ids[0]


def test_the_recording_is_shown_again_if_the_solver_process_ends(app: ViewerApp) -> None:
    app.queue.put(intents.StartLive("replay", rate=10.0, repeat=True))
    eventually(lambda: app.state.live, lambda live: live is not None and live.on and not live.busy, SECONDS)
    # The solvers of other viewers of this test run may run as well; the newest is this viewer's.
    running = (child for child in psutil.Process().children() if child.status() != psutil.STATUS_ZOMBIE)
    solvers = [child for child in running if "serve()" in " ".join(child.cmdline())]
    max(solvers, key=lambda child: child.create_time()).kill()
    eventually(lambda: app.state.error or "", lambda error: "ended unexpectedly (SIGKILL" in error, SECONDS)
    eventually(lambda: app.state.streaming, lambda on: not on)
    assert app.state.frame.frame_id == app.sequence.frame_ids[0]
    app.queue.put(intents.DismissError())
    app.queue.put(intents.StartLive("replay", rate=10.0))
    eventually(lambda: app.state.live, lambda live: live is not None and live.on and not live.busy, SECONDS)
    app.queue.put(intents.StopLive())
    eventually(lambda: app.state.streaming, lambda on: not on)


def test_the_stream_of_a_closed_tab_ends(app: ViewerApp, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tabs, "RECONNECT_TIME", 0.0)
    with RawTab(app.url, key="live") as raw:
        place = place_of(app, raw)
        place.put(intents.StartLive("replay", rate=10.0, repeat=True))
        eventually(lambda: place.controller.state.live, lambda live: live and live.on and not live.busy, SECONDS)
    eventually(lambda: place.controller.state.streaming, lambda on: not on, SECONDS)


def test_a_port_in_use_and_a_source_that_the_page_does_not_open_are_refused(app: ViewerApp) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        for source, words in (
            (f"socket:{taken.getsockname()[1]}", "cannot be used"),
            ("folder:/etc", "carts live"),
            ("camera:0", "--joints-port"),
            ("carrier pigeon", "is unknown"),
        ):
            app.queue.put(intents.StartLive(source))
            eventually(lambda: app.state.error or "", lambda error, words=words: words in error, SECONDS)
            assert not app.state.streaming
            app.queue.put(intents.DismissError())
            eventually(lambda: app.state.error, lambda error: error is None)


def _png(image: np.ndarray) -> ImageMessage:
    return ImageMessage(cv2.imencode(".png", image[..., ::-1])[1].tobytes(), "png")
