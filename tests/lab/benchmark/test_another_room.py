"""Real instruments in other rooms: what changes, and what must not."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from carts_core.errors import SettingsError
from carts_core.lab.benchmark import QUICK, plan, room_sources
from carts_core.lab.benchmark.rooms import AnotherRoom, Room, made_rooms, photographs
from carts_core.recording import Sequence

SIZE = {"width": 160, "height": 120}
GREEN = Room("green", "tuning", lambda width, height: np.full((height, width, 3), (40, 160, 90), np.uint8))


def test_made_rooms_are_pictures_of_their_own_and_the_same_each_time() -> None:
    rooms = made_rooms()
    pictures = [room.draw(64, 48) for room in rooms]
    assert all(picture.shape == (48, 64, 3) and picture.std() > 3 for picture in pictures)
    assert np.array_equal(rooms[0].draw(64, 48), pictures[0])
    assert len({picture.tobytes() for picture in pictures}) == len(rooms)


def test_no_kind_of_room_serves_tuning_and_is_held_out() -> None:
    kinds = {
        half: {room.name.split()[0] for room in made_rooms() if room.half == half} for half in ("tuning", "held-out")
    }
    assert kinds["tuning"] and kinds["held-out"] and not kinds["tuning"] & kinds["held-out"]


def test_photographs_fill_the_image_and_every_other_one_is_held_out(tmp_path: Path) -> None:
    for name, shape in (("a.png", (40, 90, 3)), ("b.png", (300, 100, 3))):
        cv2.imwrite(str(tmp_path / name), np.full(shape, 120, np.uint8))
    rooms = photographs(tmp_path)
    assert [(room.name, room.half) for room in rooms] == [("a", "tuning"), ("b", "held-out")]
    assert all(room.draw(64, 48).shape == (48, 64, 3) for room in rooms)


def test_a_folder_without_photographs_is_an_error_that_says_what_to_give(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"has no photographs. Give a folder with .*\.png"):
        photographs(tmp_path)


def test_the_instrument_is_put_into_the_room_and_nothing_else_is_left_of_the_old_one(sequence: Sequence) -> None:
    recording = AnotherRoom(sequence, [GREEN], seed=1)
    before, frame = sequence.frame(1, cameras=["left"]), recording.frame(1, GREEN.domain, ["left"])
    assert before.masks is not None and frame.masks is not None
    mask, seam = before.masks["left"], np.ones((9, 9), np.uint8)
    assert np.array_equal(frame.masks["left"], mask)
    inside, outside = cv2.erode(mask.astype(np.uint8), seam) > 0, cv2.dilate(mask.astype(np.uint8), seam) == 0
    old, new = before.images["left"].astype(float), frame.images["left"].astype(float)
    assert np.abs(new[outside] - (40, 160, 90)).mean() < 8
    assert np.corrcoef(new[inside].ravel(), old[inside].ravel())[0, 1] > 0.9
    assert np.abs(recording.background("left", GREEN.domain).astype(float) - (40, 160, 90)).mean() < 6


def test_the_benchmark_plans_rooms_for_every_camera_with_masks(tiny_sequence: Callable[..., Path]) -> None:
    path = tiny_sequence(frames=3, **SIZE)
    (source,) = room_sources(path, None, QUICK)
    assert source.name == "rooms left" and source.rooms == [room.domain for room in made_rooms()[:: QUICK.room_share]]
    runs = plan(QUICK, [source])
    assert {run.method for run in runs} == {"ours", "acs"} and len(runs) == 2 * len(source.rooms) * len(source.frames)
    recording = source.open(lambda what, done, total: None)
    assert recording.frame(source.frames[0], source.rooms[0], ["left"]).domain == source.rooms[0]
