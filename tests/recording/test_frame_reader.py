"""FrameReader: the next frames are decoded in advance, on one thread that ends."""

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from carts_core.errors import SequenceError
from carts_core.recording import FrameReader, Sequence
from carts_core.recording import sequence as module

FRAMES = 60
MAIN = threading.current_thread()


class Watched:
    """A sequence that notes which frames are read in advance, and can be made to wait before each of them."""

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence
        self.scene = sequence.scene
        self.ahead: list[int] = []
        self.threads: set[threading.Thread] = set()
        self.held: set[int] = set()
        self.reached = threading.Event()
        self.go_on = threading.Event()

    def __len__(self) -> int:
        return len(self.sequence)

    def frame(self, index: int, domain: str, cameras: list[str]):
        if (thread := threading.current_thread()) is not MAIN:
            self.ahead.append(index)
            self.threads.add(thread)
            if index in self.held:
                self.reached.set()
                assert self.go_on.wait(30)
        return self.sequence.frame(index, domain, cameras)


@pytest.fixture
def watched(tiny_sequence: Callable[..., Path]) -> Watched:
    return Watched(Sequence.open(tiny_sequence(frames=FRAMES, width=32, height=24)))


@pytest.fixture
def reader(watched: Watched):
    reader = FrameReader(watched)  # type: ignore[arg-type]
    yield reader
    watched.go_on.set()
    reader.close()


def finish(reader: FrameReader) -> None:
    """Wait until everything planned was read."""
    if (thread := reader._thread) is not None:
        thread.join(30)
    assert reader._thread is None and not reader._plan


def test_the_frames_ahead_come_from_memory(watched, reader):
    folder = watched.sequence.path.parent / "regular/left"
    reader.frame(20, "regular", "left")
    finish(reader)
    expected = {index: watched.sequence.frame(index).images["left"] for index in range(21, 29)}
    folder.rename(folder.with_name("gone"))
    for index in range(21, 29):
        assert np.array_equal(reader.frame(index, "regular", "left").images["left"], expected[index])
    finish(reader)
    with pytest.raises(SequenceError, match=r"030.png is missing"):
        reader.frame(29, "regular", "left")


@pytest.mark.parametrize(
    ("path", "planned"),
    [
        ((20, 19), [*range(18, 10, -1), 20]),
        ((20, 19, 19), [*range(18, 10, -1), 20]),
        ((20, 30), [40, 50, 20]),
        ((20, 19, 50), [*range(51, 59), 49]),
        ((0, 1), [*range(2, 10), 0]),
        ((0, 59), [58]),
        ((58, 59), [58]),
    ],
)
def test_the_neighbours_are_those_in_the_direction_of_travel(watched, reader, path, planned):
    for index in path:
        finish(reader)
        watched.ahead.clear()
        reader.frame(index, "regular", "left")
    finish(reader)
    assert watched.ahead == planned


def test_an_error_is_for_who_asks_for_that_frame(watched, reader):
    image = watched.sequence.path.parent / "regular/left/022.png"
    content = image.read_bytes()
    image.write_bytes(content[:100])
    reader.frame(20, "regular", "left")
    finish(reader)
    assert 21 in watched.ahead and 22 in watched.ahead
    with pytest.raises(SequenceError, match=r"022.png is damaged"):
        reader.frame(21, "regular", "left")
    assert reader.frame(22, "regular", "left").index == 22
    image.write_bytes(content)
    assert reader.frame(21, "regular", "left").index == 21


def test_closing_ends_the_thread_and_reads_nothing_more_in_advance(watched, reader):
    watched.held = {21}
    reader.frame(20, "regular", "left")
    assert watched.reached.wait(30)
    (thread,) = watched.threads
    closing = threading.Thread(target=reader.close)
    closing.start()
    watched.go_on.set()
    closing.join(30)
    assert not thread.is_alive() and watched.ahead == [21]
    assert reader.frame(30, "regular", "left").index == 30
    assert reader._thread is None
    reader.close()


def test_no_more_is_read_in_advance_than_half_of_the_cache_holds(watched, reader, monkeypatch):
    monkeypatch.setattr(module, "CACHE_BYTES", 2 * 3 * (4 * 32 * 24))
    reader.frame(20, "regular", "left")
    finish(reader)
    assert watched.ahead[-4:] == [21, 22, 23, 19]
