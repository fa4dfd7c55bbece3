"""Long recordings: opening decodes few images, and browsing stays within the limit of the cache."""

from collections.abc import Iterator
from typing import Any

import pytest

from carts_core.recording import Sequence
from carts_core.recording.video import decoded_frames
from tools import bench_recordings

FRAMES = 30
IMAGE_BYTES = 160 * 120 * 3


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"WIDTH": 160, "HEIGHT": 120, "_PICTURES": FRAMES}.items():
            patch.setattr(bench_recordings, name, value)
        return bench_recordings.make_recording(tmp_path_factory.mktemp("recording"), FRAMES)


def test_images_and_video_of_a_recording_have_the_same_frames(recording):
    files, video = (Sequence.open(path) for path in recording.values())
    assert len(files) == len(video) == FRAMES
    assert (files.matching, video.matching is None) == (None, False)
    for index in (0, 16, FRAMES - 1):
        difference = files.frame(index).images["left"].astype(int) - video.frame(index).images["left"]
        assert abs(difference).mean() < 6
        neighbour = files.frame(index - 1 if index else 1).images["left"].astype(int)
        assert abs(difference).mean() < abs(neighbour - video.frame(index).images["left"]).mean()


def test_opening_decodes_no_image_file_and_one_frame_of_a_video(recording, monkeypatch):
    decoded = []

    def counted(*arguments: Any) -> Iterator[Any]:
        for frame in decoded_frames(*arguments):
            decoded.append(frame)
            yield frame

    def refuse(*arguments: object) -> None:
        raise AssertionError("an image was decoded")

    monkeypatch.setattr("carts_core.recording.images.cv2.imdecode", refuse)
    monkeypatch.setattr("carts_core.recording.video.decoded_frames", counted)
    files, video = (Sequence.open(path) for path in recording.values())
    assert len(decoded) == 1
    video.frame(0)
    assert len(decoded) == 1
    with pytest.raises(AssertionError, match="an image was decoded"):
        files.frame(0)


def test_browsing_keeps_no_more_than_the_cache_may_hold(recording, monkeypatch):
    monkeypatch.setattr("carts_core.recording.sequence.CACHE_BYTES", 10 * IMAGE_BYTES)
    for path in recording.values():
        sequence = Sequence.open(path)
        times, memory = bench_recordings.browse(sequence, range(FRAMES))
        assert len(times) == FRAMES and len(memory) == 5 and all(megabytes > 0 for megabytes in memory)
        assert sequence._cache._used <= 10 * IMAGE_BYTES
        cached = [index for index in range(FRAMES) if ("image", "left", "regular", index) in sequence._cache]
        assert len(cached) == 10 and cached[-1] == FRAMES - 1
