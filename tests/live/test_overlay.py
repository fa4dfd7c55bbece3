"""The overlay for a surgeon's console, in pipes that another thread reads."""

import os
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import av
import cv2
import numpy as np
import pytest
from tiny import recorded_mask

from carts_core.live import KeyedOverlay, LiveVerdict, StreamFrame, Tracked
from carts_core.live.overlay import COLOURS, KEY, keyed
from carts_core.live.tracker import Effort, LiveEstimate
from carts_core.recording import Sequence
from carts_core.rendering import Renderer


def tracked(sequence: Sequence, index: int, verdict: LiveVerdict) -> Tracked:
    frame = sequence.frame(index)
    state, std = sequence.scene.state(frame.measured), {arm: 0 * values for arm, values in frame.measured.items()}
    what = frame.frame_id, 0.0, verdict, Effort.SMALL, 0.01, state, frame.measured, std, 0.0
    return Tracked(StreamFrame(frame), LiveEstimate(*what), 0.0)


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(tiny_sequence(frames=2, width=160, height=128, cameras=("left", "right")))


def read(pipe: BinaryIO, pictures: list[np.ndarray]) -> None:
    """Read all pictures from a pipe until its writer ends, RGB."""
    os.set_blocking(pipe.fileno(), True)
    with pipe, av.open(pipe, "r", format="yuv4mpegpipe") as container:
        pictures.extend(frame.to_ndarray(format="rgb24") for frame in container.decode(video=0))


def eroded(mask: np.ndarray, size: int) -> np.ndarray:
    square = np.ones((size, size))
    return cv2.erode(mask.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0


def pictures_of(sequence: Sequence, result: Tracked, folder: Path) -> dict[str, np.ndarray]:
    """Picture of a result in the pipe of each camera."""
    pipes = {camera.name: folder / camera.name for camera in sequence.scene.cameras}
    pictures: dict[str, list[np.ndarray]] = {name: [] for name in pipes}
    for pipe in pipes.values():
        os.mkfifo(pipe)
    ends = {name: os.fdopen(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK), "rb") for name, pipe in pipes.items()}
    overlay = KeyedOverlay(sequence, pipes)
    threads = [threading.Thread(target=read, args=(ends[name], pictures[name])) for name in pipes]
    for thread in threads:
        thread.start()
    overlay(result)
    overlay.close()
    for thread in threads:
        thread.join(60.0)
    return {name: picture for name, (picture,) in pictures.items()}


@pytest.mark.parametrize(
    ("verdict", "current"), [*((verdict, True) for verdict in LiveVerdict), (LiveVerdict.GOOD, False)]
)
def test_another_program_reads_outlines_on_green(
    sequence: Sequence, tmp_path: Path, verdict: LiveVerdict, current: bool
) -> None:
    age = 0.0 if current else 1.0
    result = replace(tracked(sequence, 1, verdict), age=age, interval=0.1)
    for name, picture in pictures_of(sequence, result, tmp_path).items():
        mask = Renderer(sequence.scene, cameras=[name]).segment(result.estimate.state)[0] >= 0
        inner, smaller = (eroded(mask, size) for size in (7, 3))
        outer = cv2.dilate(mask.astype(np.uint8), np.ones((7, 7))) > 0
        # Colours come back from YUV to a few grey levels.
        np.testing.assert_allclose(picture[inner | ~outer], np.broadcast_to(KEY, picture[inner | ~outer].shape), atol=3)
        rim = mask & ~smaller
        wanted = COLOURS.get(verdict if current else LiveVerdict.DOUBTFUL, KEY)
        np.testing.assert_allclose(picture[rim], np.broadcast_to(wanted, picture[rim].shape), atol=3)
        assert rim.sum() > 50 and inner.any()


def test_outlines_reach_the_border_of_distorted_images(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    lens = "distortion = [-0.7, 0.4, 0.0, 0.0]\n"
    sequence = Sequence.open(tiny_sequence(frames=1, width=160, height=128, edit=lambda text: text + lens))
    camera, result = sequence.recorded_camera("left"), tracked(sequence, 0, LiveVerdict.GOOD)
    (tmp_path / "pipes").mkdir()
    picture = pictures_of(sequence, result, tmp_path / "pipes")["left"]
    state = result.estimate.state
    expected = keyed(recorded_mask(sequence.scene, state, camera), LiveVerdict.GOOD)
    inside = Renderer(sequence.scene).segment(state)[0] >= 0
    cut = keyed(camera.distorted_mask(inside), LiveVerdict.GOOD)
    assert (np.abs(picture - expected.astype(int)) > 3).any(2).sum() < 20 < (cut != expected).any(2).sum()


def test_tracking_continues_if_the_reader_ends(
    sequence: Sequence, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pipes = {name: tmp_path / name for name in ("left", "right")}
    for pipe in pipes.values():
        os.mkfifo(pipe)
    left, right = (os.open(pipe, os.O_RDONLY | os.O_NONBLOCK) for pipe in pipes.values())
    overlay = KeyedOverlay(sequence, pipes)
    os.close(left)
    for index in (0, 1, 0):
        overlay(tracked(sequence, index, LiveVerdict.GOOD))
    # The other pipe ends, so that its reader does not show an old outline.
    os.set_blocking(right, True)
    with os.fdopen(right, "rb") as other:
        other.read()
    overlay.close()
    assert [record.message for record in caplog.records] == [
        "A reader of the overlay has exited; tracking continues without an overlay."
    ]


def test_a_reader_that_does_not_read_delays_nothing(sequence: Sequence, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "left")
    reader = os.open(tmp_path / "left", os.O_RDONLY | os.O_NONBLOCK)
    overlay = KeyedOverlay(sequence, {"left": tmp_path / "left"})
    for index in (0, 1) * 20:
        overlay(tracked(sequence, index, LiveVerdict.GOOD))
    overlay.close()
    os.close(reader)
