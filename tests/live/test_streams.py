"""Streams: sources, the buffer of the latest frame, and errors that are sent to the client."""

import json
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import msgspec
import numpy as np
import pytest
from processes import eventually

from carts_core.errors import SettingsError
from carts_core.live import (
    Assembler,
    Camera,
    Effort,
    Folder,
    FrameMessage,
    ImageMessage,
    LiveEstimate,
    LiveVerdict,
    Replay,
    ResultMessage,
    Results,
    StreamError,
    StreamFrame,
    StreamServer,
    follow,
    packed,
)
from carts_core.live.messages import LARGEST, ErrorMessage, receive
from carts_core.recording import Frame, Sequence
from carts_core.settings.live import LiveSettings

RESULT = ResultMessage("a", 0.0, 0.0, "good", "small", 0.0, {}, {})
JOINTS = {"PSM1": {"yaw": 0.1, "insertion": 0.12}}


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(tiny_sequence(frames=3, width=160, height=128))


@pytest.fixture
def assembler(sequence: Sequence) -> Assembler:
    return Assembler(sequence, ("left",))


class Repeater:
    """Replacement of a tracker: returns measured values after a given time."""

    def __init__(self, sequence: Sequence, seconds: float = 0.0) -> None:
        # No machine is so slow that a frame that is not stale by intention is as old as this.
        self.live, self._scene, self._seconds = LiveSettings(oldest_seconds=30.0), sequence.scene, seconds
        self.frames: list[Frame] = []
        self.held = threading.Event()
        self.held.set()

    def track(self, frame: Frame, camera_poses: object = None) -> LiveEstimate:
        """An estimate."""
        self.frames.append(frame)
        assert self.held.wait(60)
        std = {name: np.full(len(values), np.nan) for name, values in frame.measured.items()}
        state = self._scene.state(frame.measured)
        time = frame.timestamp or 0.0
        good, small = LiveVerdict.GOOD, Effort.SMALL
        return LiveEstimate(frame.frame_id, time, good, small, 0.01, state, frame.measured, std, self._seconds)


class Given:
    """A source of moments, each of which comes after a wait."""

    def __init__(self, tracker: Repeater, *moments: tuple[Callable[[], object], StreamFrame]) -> None:
        self._tracker, self._moments = tracker, moments

    def __iter__(self) -> Iterator[StreamFrame]:
        for wait, moment in self._moments:
            wait()
            yield moment
        self._tracker.held.set()

    def close(self) -> None:
        """Nothing is open."""


def picture(sequence: Sequence, encoding: str = "png") -> ImageMessage:
    image = sequence.frame(0).images["left"]
    if encoding == "rgb8":
        return ImageMessage(image.tobytes(), "rgb8", image.shape[1], image.shape[0])
    return ImageMessage(cv2.imencode(f".{encoding}", image[..., ::-1])[1].tobytes(), encoding)  # pyright: ignore


def test_a_replay_runs_in_real_time(sequence: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    replay, now = Replay(sequence, ("left",), "regular", loops=2), [5.0]

    def wait(seconds: float) -> bool:
        now[0] += seconds
        return False

    monkeypatch.setattr("carts_core.live.sources.time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(replay, "_closed", SimpleNamespace(wait=wait))
    moments = iter(replay)
    found = [next(moments) for _ in range(4)]
    assert [moment.frame.frame_id for moment in found] == ["001", "002", "003", "001"]
    np.testing.assert_allclose([moment.frame.timestamp or 0.0 for moment in found], np.arange(4) / 10, atol=1e-9)
    assert now[0] == pytest.approx(5.3)
    now[0] += 0.25
    assert [moment.frame.frame_id for moment in moments] == ["003"]


def test_a_slow_tracker_gets_the_newest_frame_and_the_others_are_dropped(sequence: Sequence) -> None:
    tracker = Repeater(sequence)
    tracker.held.clear()
    frames = [replace(sequence.frame(0), frame_id=str(number)) for number in range(5)]

    def begun() -> None:
        eventually(lambda: bool(tracker.frames))

    source = Given(
        tracker, (lambda: None, StreamFrame(frames[0])), *((begun, StreamFrame(frame)) for frame in frames[1:])
    )
    statistics = follow(source, tracker, [])  # pyright: ignore
    assert [frame.frame_id for frame in tracker.frames] == ["0", "4"]
    assert (statistics.arrived, statistics.tracked, statistics.dropped) == (5, 2, 3)


@pytest.mark.parametrize(("seconds", "waited"), [(0.0, 100.0), (20.0, 15.0)])
def test_a_frame_that_would_be_too_old_is_not_tracked(sequence: Sequence, seconds: float, waited: float) -> None:
    """Because it has waited for longer than it may, or for longer than the tracker usually leaves."""
    tracker, frame = Repeater(sequence, seconds), sequence.frame(0)
    late = StreamFrame(replace(frame, frame_id="late"), arrived=time.monotonic() - waited)

    def begun() -> None:
        eventually(lambda: bool(tracker.frames))

    moments = ((lambda: None, StreamFrame(frame)), (begun, late), (lambda: time.sleep(0.3), StreamFrame(frame)))
    statistics = follow(Given(tracker, *moments), tracker, [])  # pyright: ignore
    assert (statistics.dropped, statistics.tracked) == (1, 2) and "late" not in {one.frame_id for one in tracker.frames}


def test_frames_that_all_arrive_late_are_tracked_nevertheless(sequence: Sequence) -> None:
    """As on a machine that needs longer to decode an image than the tracker leaves."""
    tracker, late = Repeater(sequence, 20.0), StreamFrame(sequence.frame(0), arrived=time.monotonic() - 30.0)

    def after(count: int) -> Callable[[], object]:
        return lambda: eventually(lambda: len(tracker.frames) == count)

    follow(Given(tracker, *((after(count), late) for count in range(3))), tracker, [])  # pyright: ignore
    assert len(tracker.frames) == 3


def test_what_ends_a_source_is_raised_where_frames_are_taken(sequence: Sequence) -> None:
    class Broken:
        def __iter__(self) -> Iterator[StreamFrame]:
            yield StreamFrame(sequence.frame(0))
            raise StreamError("the cable is out")

        def close(self) -> None:
            """Nothing is open."""

    with pytest.raises(StreamError, match="the cable is out"):
        follow(Broken(), Repeater(sequence), [])  # pyright: ignore


@pytest.mark.parametrize("encoding", ["png", "rgb8"])
def test_an_image_and_joints_make_a_frame(sequence: Sequence, assembler: Assembler, encoding: str) -> None:
    image = {"left": picture(sequence, encoding)}
    assert assembler.moment(FrameMessage(0.0, images=image)) is None, "no joints yet"
    assert assembler.moment(FrameMessage(0.1, joints=JOINTS)) is None, "no image"
    moment = assembler.moment(FrameMessage(0.2, images=image, id="a"))
    assert moment is not None and moment.frame.frame_id == "a" and moment.frame.timestamp == 0.2
    np.testing.assert_array_equal(moment.frame.images["left"], sequence.frame(0).images["left"])
    names = sequence.scene.arms[0].robot.joint_names
    found = dict(zip(names, moment.frame.measured["PSM1"], strict=True))
    assert found["yaw"] == 0.1 and found["insertion"] == 0.12
    T = np.eye(4).tolist()
    moved = assembler.moment(FrameMessage(0.3, images=image, camera_poses={"left": T}))
    assert moved is not None and np.array_equal(moved.camera_poses["left"], np.eye(4)) and not moment.camera_poses


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"joints": {"PSM9": {}}}, "there is no arm 'PSM9'; the arms are PSM1"),
        ({"joints": {"PSM1": {"elbow": 0.0}}}, "joint 'elbow' is 0.0. Give values for the joints"),
        ({"joints": {"PSM1": {"yaw": float("nan")}}}, "joint 'yaw' is nan"),
        ({"joints": {"PSM1": {"yaw": 1e300}}}, "joint 'yaw' is 1e\\+300. .* at most 12.6 rad"),
        ({"joints": {"PSM1": {"insertion": 141.0}}}, "joint 'insertion' is 141.0. .* or 2 m"),
        ({"camera_poses": {"left": [[1.0]]}}, "camera_poses of 'left' has shape"),
        ({"camera_poses": {"left": (2 * np.eye(4)).tolist()}}, "camera_poses of 'left' is not rigid"),
        ({"camera_poses": {"up": np.eye(4).tolist()}}, "the cameras are left"),
        ({"joints": JOINTS, "images": {"right": ImageMessage(b"")}}, "has no image of camera 'left'"),
        ({"joints": JOINTS, "images": {"left": ImageMessage(b"no image")}}, "cannot be decoded"),
        (
            {"joints": JOINTS, "images": {"left": ImageMessage(b"123", "rgb8", 2, 1)}},
            "3 bytes do not match 2 x 1 pixels",
        ),
        ({"joints": JOINTS, "images": {"left": ImageMessage(b"123", "rgb8", 1, 1)}}, "the camera has 160 x 128"),
    ],
)
def test_what_is_wrong_with_a_message_is_said(assembler: Assembler, values: dict, message: str) -> None:
    with pytest.raises(StreamError, match=message):
        assembler.moment(FrameMessage(0.0, **values))


def connected(server: StreamServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.port), timeout=60)


def _answers(connection: socket.socket) -> Iterator[ResultMessage | ErrorMessage]:
    stream = connection.makefile("rb")
    while len(header := stream.read(4)) == 4:
        content = stream.read(struct.unpack(">I", header)[0])
        yield msgspec.msgpack.decode(content, type=ResultMessage | ErrorMessage)


def test_every_client_of_the_socket_gets_every_result(sequence: Sequence, assembler: Assembler) -> None:
    server, results = StreamServer(assembler, 0), Results(sequence.scene, masks=True)
    assert server._listener.getsockname()[0] == "127.0.0.1"
    thread = threading.Thread(
        target=follow,
        args=(server, Repeater(sequence), [lambda tracked: server.send(results.message(tracked))]),
        daemon=True,
    )
    thread.start()
    sender, watcher = (connected(server) for _ in range(2))
    eventually(lambda: len(server._clients) == 2)
    for number in range(3):
        message = FrameMessage(float(number), JOINTS, {"left": picture(sequence)}, id=f"frame {number}")
        sender.sendall(packed(message))
        for connection in (sender, watcher):
            answer = next(_answers(connection))
            assert isinstance(answer, ResultMessage) and answer.id == f"frame {number}" and answer.age < 20
            assert answer.joints["PSM1"]["yaw"] == (0.1, None)
            np.testing.assert_allclose(
                answer.base_frames["PSM1"]["left"], sequence.scene.cameras[0].T_camera_world, atol=1e-6
            )
            mask = cv2.imdecode(np.frombuffer(answer.masks["left"], np.uint8), cv2.IMREAD_GRAYSCALE)
            assert mask is not None and mask.shape == (128, 160) and 0 < (mask == 255).sum() < mask.size
    server.close()
    thread.join(20)
    assert not thread.is_alive() and list(_answers(watcher)) == []


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (struct.pack(">I", LARGEST + 1), "67108865 bytes; the limit is 67108864"),
        (struct.pack(">I", 3) + b"abc", "a message cannot be read"),
        (packed(FrameMessage(0.0, {"PSM9": {}})), "there is no arm 'PSM9'"),
        (struct.pack(">I", 2) + msgspec.msgpack.encode({"a": 1})[:2], "a message cannot be read"),
    ],
)
def test_invalid_messages_are_answered_with_an_error(assembler: Assembler, content: bytes, message: str) -> None:
    server = StreamServer(assembler, 0)
    try:
        other, sender = connected(server), connected(server)
        sender.sendall(content)
        (answer,) = _answers(sender)
        assert isinstance(answer, ErrorMessage) and message in answer.message
        server.send(RESULT)
        assert isinstance(next(_answers(other)), ResultMessage)
    finally:
        server.close()


def test_a_client_that_never_reads_holds_nobody_up(assembler: Assembler) -> None:
    server = StreamServer(assembler, 0)
    try:
        with connected(server):
            eventually(lambda: len(server._clients) == 1)
            for _ in range(60):  # Beyond what a socket holds, it would wait here for ever.
                server.send(msgspec.structs.replace(RESULT, masks={"left": bytes(10**6)}))
    finally:
        server.close()


def test_a_client_that_never_reads_is_disconnected_at_the_end(
    assembler: Assembler, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("carts_core.live.sources._LINGER", 0.1)
    server = StreamServer(assembler, 0)
    with connected(server) as client:
        eventually(lambda: len(server._clients) == 1)
        for _ in range(8):
            server.send(msgspec.structs.replace(RESULT, masks={"left": bytes(10**7)}))
        server.close()
        eventually(lambda: not server._clients)
        with suppress(ConnectionError):
            while client.recv(1 << 20):
                pass


def _accepted(server: StreamServer) -> bool:
    """Whether one more client gets a result."""
    with connected(server) as client:
        address = client.getsockname()

        def registered() -> bool:
            for other in list(server._clients):
                with suppress(OSError):  # It is gone.
                    if other.getpeername() == address:
                        return True
            return False

        eventually(lambda: registered() or bool(select.select([client], [], [], 0)[0]))
        server.send(RESULT)
        return isinstance(next(_answers(client), None), ResultMessage)


def test_silent_clients_are_replaced_by_new_ones(assembler: Assembler, monkeypatch: pytest.MonkeyPatch) -> None:
    server = StreamServer(assembler, 0)
    monkeypatch.setattr("carts_core.live.sources._SILENCE", 1000.0)
    silent = [connected(server) for _ in range(16)]
    try:
        eventually(lambda: len(server._clients) == 16)
        with connected(server) as late:
            (answer,) = _answers(late)
            assert isinstance(answer, ErrorMessage) and "16 clients are connected" in answer.message
        monkeypatch.setattr("carts_core.live.sources._SILENCE", 0.0)
        silent[0].sendall(packed(FrameMessage(0.1, JOINTS)))
        eventually(lambda: any(client.sends for client in list(server._clients.values())))
        assert _accepted(server)
        assert isinstance(next(_answers(silent[0])), ResultMessage)
        assert sum(next(_answers(each), None) is None for each in silent[1:]) == 1
    finally:
        server.close()
        for each in silent:
            each.close()


def test_a_half_closed_sender_gets_its_last_result(assembler: Assembler, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("carts_core.live.sources._LINGER", 1000.0)
    server = StreamServer(assembler, 0)
    try:
        with connected(server) as sender:
            sender.sendall(packed(FrameMessage(0.0, JOINTS)))
            sender.shutdown(socket.SHUT_WR)
            eventually(lambda: any(client.sends for client in list(server._clients.values())))
            server.send(RESULT)
            answers = _answers(sender)
            assert isinstance(next(answers), ResultMessage)
            server.close()
            assert list(answers) == []
    finally:
        server.close()


@pytest.mark.parametrize("stops", [False, True])
def test_a_half_closed_sender_gets_a_late_result_unless_the_server_stops(
    sequence: Sequence, assembler: Assembler, monkeypatch: pytest.MonkeyPatch, stops: bool
) -> None:
    monkeypatch.setattr("carts_core.live.sources._LINGER", 0.0)
    server = StreamServer(assembler, 0)
    try:
        with connected(server) as sender:
            sender.sendall(packed(FrameMessage(0.5, JOINTS, {"left": picture(sequence)}, id="late")))
            sender.shutdown(socket.SHUT_WR)
            assert next(iter(server)).frame.frame_id == "late"
            assert not select.select([sender], [], [], 1.0)[0], "the connection is open"
            if not stops:
                server.send(RESULT)
                server.send(msgspec.structs.replace(RESULT, id="late", time=0.5))
                answers = list(_answers(sender))
                assert [answer.id for answer in answers if isinstance(answer, ResultMessage)] == ["a", "late"]
            server.close()
            assert list(_answers(sender)) == []
    finally:
        server.close()


def test_a_broken_connection_ends_without_an_error_for_others(assembler: Assembler) -> None:
    one, other = socket.socketpair()
    other.sendall(struct.pack(">I", 10) + b"abc")
    other.close()
    with pytest.raises(StreamError, match="closed within a message"):
        receive(one)


def put(folder: Path, name: str, content: str, image: np.ndarray | None = None) -> None:
    """Write a frame into a folder, its JSON file last."""
    if image is not None:
        cv2.imwrite(str(folder / f"{name}.png"), image[..., ::-1])
    (folder / "part").write_text(content)
    (folder / "part").rename(folder / f"{name}.json")


def test_a_growing_folder_is_followed(sequence: Sequence, assembler: Assembler, tmp_path: Path) -> None:
    source, found = Folder(assembler, ("left",), tmp_path), list[Frame]()

    def fill() -> None:
        for number in range(3):
            message = json.dumps({"type": "frame", "time": number / 10, "joints": JOINTS})
            put(tmp_path, f"{number:03d}", message, sequence.frame(number).images["left"])
            eventually(lambda number=number: len(found) > number)
        source.close()

    thread = threading.Thread(target=fill)
    thread.start()
    for moment in source:
        found.append(moment.frame)
    thread.join()
    assert [frame.frame_id for frame in found] == ["000", "001", "002"]
    np.testing.assert_array_equal(found[-1].images["left"], sequence.frame(2).images["left"])
    with pytest.raises(SettingsError, match="is not a folder"):
        Folder(assembler, ("left",), tmp_path / "002.json")


def test_a_folder_that_takes_long_to_list_is_listed_less_often(
    assembler: Assembler, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, now, pauses = Folder(assembler, ("left",), tmp_path), [0.0], list[float]()

    def clock() -> float:
        now[0] += 0.5
        return now[0]

    def wait(seconds: float) -> bool:
        pauses.append(seconds)
        return len(pauses) == 3

    monkeypatch.setattr("carts_core.live.sources.time", SimpleNamespace(monotonic=clock))
    monkeypatch.setattr(source, "_closed", SimpleNamespace(wait=wait))
    assert list(source) == [] and pauses == [0.01, 0.5, 0.5]


def test_what_cannot_be_used_in_a_folder_is_left_out(
    sequence: Sequence, assembler: Assembler, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source, image = Folder(assembler, ("left",), tmp_path), sequence.frame(0).images["left"]
    usable = json.dumps({"type": "frame", "time": 0.0, "joints": JOINTS})

    def fill() -> None:
        put(tmp_path, "000", usable)
        for number, content in enumerate(["{", usable.replace("PSM1", "PSM9"), usable], 1):
            eventually(lambda number=number: len(caplog.records) >= number)
            put(tmp_path, f"{number:03d}", content, image)

    thread = threading.Thread(target=fill)
    thread.start()
    assert next(iter(source)).frame.frame_id == "003"
    thread.join()
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 3 and all(text.startswith("A frame is skipped: ") for text in said)
    assert "no image 000.left.png or 000.png" in said[0] and "PSM9" in said[2]


def test_a_video_is_replayed_at_its_own_rate(sequence: Sequence, assembler: Assembler, tmp_path: Path) -> None:
    path = str(tmp_path / "video.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (160, 128))
    for _ in range(6):
        writer.write(sequence.frame(0).images["left"][..., ::-1])
    writer.release()
    assembler.moment(FrameMessage(0.0, JOINTS))
    began = time.monotonic()
    moments = list(Camera(assembler, "left", path))
    assert len(moments) == 6 and time.monotonic() - began > 0.2
    with pytest.raises(SettingsError, match="cannot open"):
        Camera(assembler, "left", str(tmp_path / "missing.avi"))
