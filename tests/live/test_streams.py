"""Frames come from anywhere, the newest counts, and what is wrong with a message is said to who sent it."""

import json
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

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
    Moment,
    Replay,
    ResultMessage,
    Results,
    StreamError,
    StreamServer,
    follow,
    packed,
)
from carts_core.live.messages import LARGEST, ErrorMessage, receive
from carts_core.recording import Frame, Sequence
from carts_core.settings.live import LiveSettings

JOINTS = {"PSM1": {"yaw": 0.1, "insertion": 0.12}}


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(tiny_sequence(frames=3, width=160, height=128))


@pytest.fixture
def assembler(sequence: Sequence) -> Assembler:
    return Assembler(sequence, ("left",))


class Repeater:
    """In place of a tracker: says that every frame is as measured, after some time."""

    def __init__(self, sequence: Sequence, seconds: float = 0.0) -> None:
        self.live, self._scene, self._seconds = LiveSettings(), sequence.scene, seconds
        self.frames: list[Frame] = []

    def track(self, frame: Frame, camera_poses: object = None) -> LiveEstimate:
        """An estimate."""
        time.sleep(self._seconds)
        self.frames.append(frame)
        std = {name: np.full(len(values), np.nan) for name, values in frame.measured.items()}
        state = self._scene.state(frame.measured)
        return LiveEstimate(
            frame.frame_id,
            frame.timestamp or 0.0,
            LiveVerdict.GOOD,
            Effort.SMALL,
            0.01,
            state,
            frame.measured,
            std,
            self._seconds,
        )


def picture(sequence: Sequence, encoding: str = "png") -> ImageMessage:
    image = sequence.frame(0).images["left"]
    if encoding == "rgb8":
        return ImageMessage(image.tobytes(), "rgb8", image.shape[1], image.shape[0])
    return ImageMessage(cv2.imencode(f".{encoding}", image[..., ::-1])[1].tobytes(), encoding)  # pyright: ignore


def test_a_replay_goes_at_the_speed_of_the_clock(sequence: Sequence) -> None:
    began = time.monotonic()
    moments = [(time.monotonic() - began, moment) for moment in Replay(sequence, ("left",), "regular", loops=2)]
    assert [moment.frame.frame_id for _, moment in moments] == ["001", "002", "003"] * 2
    times = [moment.frame.timestamp or 0.0 for _, moment in moments]
    np.testing.assert_allclose(times, np.arange(6) / 10, atol=1e-9)
    assert all(-1e-3 < passed - due < 2.0 for (passed, _), due in zip(moments, times, strict=True))


def test_a_slow_tracker_gets_the_newest_frame_and_the_others_are_dropped(sequence: Sequence) -> None:
    tracker = Repeater(sequence, seconds=0.25)
    statistics = follow(Replay(sequence, ("left",), "regular", rate=20.0, loops=8), tracker, [])  # pyright: ignore
    assert statistics.tracked == len(tracker.frames) < 10 and statistics.dropped >= 8
    assert statistics.tracked + statistics.dropped == statistics.arrived
    times = [frame.timestamp or 0.0 for frame in tracker.frames]
    assert all(after - before > 0.15 for before, after in pairwise(times[:-1]))


def test_a_frame_that_has_waited_too_long_is_not_tracked(sequence: Sequence) -> None:
    frame = sequence.frame(0)
    stale = [Moment(frame, arrived=time.monotonic() - 1.0)]

    class Stale:
        def __iter__(self) -> Iterator[Moment]:
            yield from stale
            time.sleep(0.3)
            yield Moment(frame)

        def close(self) -> None:
            """Nothing is open."""

    statistics = follow(Stale(), Repeater(sequence), [])  # pyright: ignore
    assert (statistics.arrived, statistics.dropped, statistics.tracked) == (2, 1, 1)


def test_a_frame_whose_result_would_be_too_old_at_the_usual_time_is_not_tracked(sequence: Sequence) -> None:
    frame = sequence.frame(0)

    class Uneven:
        def __iter__(self) -> Iterator[Moment]:
            yield Moment(frame)
            time.sleep(0.3)
            # It has waited for less than it may, but not for so much less as the tracker takes.
            yield Moment(replace(frame, frame_id="late"), arrived=time.monotonic() - 0.07)
            time.sleep(0.3)
            yield Moment(frame)

        def close(self) -> None:
            """Nothing is open."""

    tracker = Repeater(sequence, seconds=0.05)
    statistics = follow(Uneven(), tracker, [])  # pyright: ignore
    assert (statistics.dropped, statistics.tracked) == (1, 2) and "late" not in {one.frame_id for one in tracker.frames}


def test_what_ends_a_source_is_raised_where_frames_are_taken(sequence: Sequence) -> None:
    class Broken:
        def __iter__(self) -> Iterator[Moment]:
            yield Moment(sequence.frame(0))
            raise StreamError("the cable is out")

        def close(self) -> None:
            """Nothing is open."""

    with pytest.raises(StreamError, match="the cable is out"):
        follow(Broken(), Repeater(sequence), [])  # pyright: ignore


@pytest.mark.parametrize("encoding", ["png", "rgb8"])
def test_an_image_and_joints_make_a_frame_and_joints_stay(
    sequence: Sequence, assembler: Assembler, encoding: str
) -> None:
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
        ({"joints": {"PSM1": {"elbow": 0.0}}}, "joint 'elbow' at 0.0; its joints are"),
        ({"joints": {"PSM1": {"yaw": float("nan")}}}, "joint 'yaw' at nan"),
        ({"joints": {"PSM1": {"yaw": 1e300}}}, "joint 'yaw' at 1e\\+300; .* at most 12.6 rad"),
        ({"joints": {"PSM1": {"insertion": 141.0}}}, "joint 'insertion' at 141.0; .* and 2 m"),
        ({"camera_poses": {"left": [[1.0]]}}, "camera_poses of 'left' has shape"),
        ({"camera_poses": {"left": (2 * np.eye(4)).tolist()}}, "camera_poses of 'left' is not rigid"),
        ({"camera_poses": {"up": np.eye(4).tolist()}}, "the cameras are left"),
        ({"joints": JOINTS, "images": {"right": ImageMessage(b"")}}, "has no image of camera 'left'"),
        ({"joints": JOINTS, "images": {"left": ImageMessage(b"no image")}}, "cannot be decoded"),
        ({"joints": JOINTS, "images": {"left": ImageMessage(b"123", "rgb8", 2, 1)}}, "3 bytes are not 2 x 1 pixels"),
        ({"joints": JOINTS, "images": {"left": ImageMessage(b"123", "rgb8", 1, 1)}}, "the camera has 160 x 128"),
    ],
)
def test_what_is_wrong_with_a_message_is_said(assembler: Assembler, values: dict, message: str) -> None:
    with pytest.raises(StreamError, match=message):
        assembler.moment(FrameMessage(0.0, **values))


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
    sender, watcher = (socket.create_connection(("127.0.0.1", server.port), timeout=20) for _ in range(2))
    time.sleep(0.3)
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
        (struct.pack(">I", LARGEST + 1), "67108865 bytes was announced; 67108864 are allowed"),
        (struct.pack(">I", 3) + b"abc", "a message cannot be read"),
        (packed(FrameMessage(0.0, {"PSM9": {}})), "there is no arm 'PSM9'"),
        (struct.pack(">I", 2) + msgspec.msgpack.encode({"a": 1})[:2], "a message cannot be read"),
    ],
)
def test_a_sender_of_nonsense_is_told_why_and_others_stay_connected(
    assembler: Assembler, content: bytes, message: str
) -> None:
    server = StreamServer(assembler, 0)
    try:
        other = socket.create_connection(("127.0.0.1", server.port), timeout=20)
        sender = socket.create_connection(("127.0.0.1", server.port), timeout=20)
        sender.sendall(content)
        (answer,) = _answers(sender)
        assert isinstance(answer, ErrorMessage) and message in answer.message
        server.send(ResultMessage("a", 0.0, 0.0, "good", "small", 0.0, {}, {}))
        assert isinstance(next(_answers(other)), ResultMessage)
    finally:
        server.close()


def test_a_client_that_never_reads_holds_nobody_up(assembler: Assembler) -> None:
    server = StreamServer(assembler, 0)
    try:
        with socket.create_connection(("127.0.0.1", server.port), timeout=20):
            time.sleep(0.2)
            large, began = (
                ResultMessage("a", 0.0, 0.0, "good", "small", 0.0, {}, {}, {"left": bytes(10**6)}),
                time.time(),
            )
            for _ in range(60):
                server.send(large)
            assert time.time() - began < 10
    finally:
        server.close()


def _accepted(server: StreamServer) -> bool:
    """Whether one more client gets a result."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=20) as client:
        time.sleep(0.1)
        server.send(ResultMessage("a", 0.0, 0.0, "good", "small", 0.0, {}, {}))
        return isinstance(next(_answers(client), None), ResultMessage)


def test_connections_that_were_closed_before_the_first_result_keep_no_places(assembler: Assembler) -> None:
    server = StreamServer(assembler, 0)
    try:
        for _ in range(40):
            socket.create_connection(("127.0.0.1", server.port), timeout=20).close()
        time.sleep(0.3)
        assert _accepted(server)
    finally:
        server.close()


def test_silent_clients_make_room_when_all_places_are_taken(
    assembler: Assembler, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = StreamServer(assembler, 0)
    silent = [socket.create_connection(("127.0.0.1", server.port), timeout=20) for _ in range(16)]
    try:
        time.sleep(0.2)
        with socket.create_connection(("127.0.0.1", server.port), timeout=20) as late:
            (answer,) = _answers(late)
            assert isinstance(answer, ErrorMessage) and "16 clients are connected" in answer.message
        monkeypatch.setattr("carts_core.live.sources._SILENCE", 0.2)
        time.sleep(0.3)
        silent[0].sendall(packed(FrameMessage(0.1, JOINTS)))
        time.sleep(0.1)
        assert _accepted(server)
        assert isinstance(next(_answers(silent[0])), ResultMessage)
        assert sum(next(_answers(each), None) is None for each in silent[1:]) == 1
    finally:
        server.close()
        for each in silent:
            each.close()


def test_a_sender_that_has_ended_its_side_gets_the_result_of_its_last_frame(assembler: Assembler) -> None:
    server = StreamServer(assembler, 0)
    try:
        with socket.create_connection(("127.0.0.1", server.port), timeout=20) as sender:
            sender.sendall(packed(FrameMessage(0.0, JOINTS)))
            sender.shutdown(socket.SHUT_WR)
            time.sleep(0.2)
            server.send(ResultMessage("a", 0.0, 0.0, "good", "small", 0.0, {}, {}))
            assert [type(answer) for answer in _answers(sender)] == [ResultMessage]
    finally:
        server.close()


def test_a_broken_connection_ends_without_an_error_for_others(assembler: Assembler) -> None:
    one, other = socket.socketpair()
    other.sendall(struct.pack(">I", 10) + b"abc")
    other.close()
    with pytest.raises(StreamError, match="ended within a message"):
        receive(one)


def test_a_folder_that_fills_is_followed_from_name_to_name(
    sequence: Sequence, assembler: Assembler, tmp_path: Path
) -> None:
    folder, found = tmp_path / "stream", []
    folder.mkdir()
    source = Folder(assembler, ("left",), folder)

    def fill() -> None:
        for number in range(3):
            cv2.imwrite(str(folder / f"{number:03d}.png"), sequence.frame(number).images["left"][..., ::-1])
            (folder / "part").write_text(json.dumps({"type": "frame", "time": number / 10, "joints": JOINTS}))
            (folder / "part").rename(folder / f"{number:03d}.json")
            time.sleep(0.3)
        source.close()

    thread = threading.Thread(target=fill)
    thread.start()
    found = [moment.frame for moment in source]
    thread.join()
    assert [frame.frame_id for frame in found][-1] == "002" and len(found) >= 2
    np.testing.assert_array_equal(found[-1].images["left"], sequence.frame(2).images["left"])
    with pytest.raises(SettingsError, match="is no folder"):
        Folder(assembler, ("left",), folder / "003.json")


def test_what_cannot_be_used_in_a_folder_is_left_out(
    sequence: Sequence, assembler: Assembler, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source, image = Folder(assembler, ("left",), tmp_path), sequence.frame(0).images["left"][..., ::-1]
    usable = json.dumps({"type": "frame", "time": 0.0, "joints": JOINTS})

    def fill() -> None:
        (tmp_path / "000.json").write_text(usable)
        for number, content in enumerate(["{", usable.replace("PSM1", "PSM9"), usable], 1):
            time.sleep(0.2)
            cv2.imwrite(str(tmp_path / f"{number:03d}.png"), image)
            (tmp_path / f"{number:03d}.json").write_text(content)
        time.sleep(0.2)
        source.close()

    thread = threading.Thread(target=fill)
    thread.start()
    found = [moment.frame.frame_id for moment in source]
    thread.join()
    assert found == ["003"]
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 3 and all(text.startswith("A frame is left out: ") for text in said)
    assert "no image 000.left.png or 000.png" in said[0] and "PSM9" in said[2]


def test_a_video_is_shown_at_its_own_rate_with_joints_from_elsewhere(
    sequence: Sequence, assembler: Assembler, tmp_path: Path
) -> None:
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
