"""Real instruments in other rooms: what changes, and what must not."""

import cv2
import numpy as np

from carts_core.lab.benchmark.rooms import AnotherRoom, Room, made_rooms
from carts_core.recording import Sequence

GREEN = Room("green", "tuning", lambda width, height: np.full((height, width, 3), (40, 160, 90), np.uint8))


def test_no_kind_of_room_serves_tuning_and_is_held_out() -> None:
    kinds = {
        half: {room.name.split()[0] for room in made_rooms() if room.half == half} for half in ("tuning", "held-out")
    }
    assert kinds["tuning"] and kinds["held-out"] and not kinds["tuning"] & kinds["held-out"]


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
