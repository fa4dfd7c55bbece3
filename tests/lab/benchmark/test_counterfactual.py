"""Recorded frames under other conditions: what changes, and what must not."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from carts_core.errors import SettingsError
from carts_core.lab.benchmark import QUICK, real_source, sources
from carts_core.lab.benchmark.counterfactual import DISTANCE, Counterfactual, RealSurface
from carts_core.lab.synthesis import DOMAINS
from carts_core.recording import Sequence

SIZE = {"width": 160, "height": 120}


@pytest.fixture
def counterfactual(sequence: Sequence) -> Counterfactual:
    other = np.full((SIZE["height"], SIZE["width"], 3), (40, 160, 90), np.uint8)
    return Counterfactual(sequence, "left", other, seed=1)


def _image(recording: Counterfactual | Sequence, index: int, domain: str | None = None) -> np.ndarray:
    return recording.frame(index, domain, ["left"]).images["left"].astype(float)


def test_every_other_domain_alters_frame_and_background_and_nothing_else(
    sequence: Sequence, counterfactual: Counterfactual
) -> None:
    plain = sequence.frame(1, cameras=["left"])
    for domain in DOMAINS[1:]:
        frame = counterfactual.frame(1, domain)
        assert frame.domain == domain
        assert frame.masks is not None and plain.masks is not None
        assert np.array_equal(frame.masks["left"], plain.masks["left"])
        assert np.array_equal(frame.measured["PSM1"], plain.measured["PSM1"])
        assert np.abs(frame.images["left"].astype(float) - plain.images["left"]).mean() > 4.0, domain
        change = counterfactual.background("left", domain).astype(float) - sequence.background("left")
        assert np.abs(change).mean() > 4.0, domain
        assert np.array_equal(_image(counterfactual, 1, domain), _image(counterfactual, 1, domain)), domain


def test_another_background_leaves_the_instrument(sequence: Sequence, counterfactual: Counterfactual) -> None:
    masks = sequence.frame(0).masks
    assert masks is not None
    mask, seam = masks["left"].astype(np.uint8), np.ones((9, 9), np.uint8)
    inside, outside = cv2.erode(mask, seam).astype(bool), ~cv2.dilate(mask, seam).astype(bool)
    image = _image(counterfactual, 0, "background_change")
    assert inside.any() and np.abs(image - _image(sequence, 0))[inside].max() <= 1
    assert outside.any() and np.abs(image - (40, 160, 90))[outside].max() <= 1


def test_the_surface_lies_on_the_arm_in_the_mask_and_on_the_plane_elsewhere(sequence: Sequence) -> None:
    frame = sequence.frame(0)
    assert frame.masks is not None
    mask = frame.masks["left"]
    found = RealSurface(sequence.scene, [frame.measured])
    surface = found.of(mask, frame.measured)
    assert (surface.link[mask] >= 0).all() and (surface.link[~mask] == -1).all()
    assert np.allclose(surface.position[~mask][:, 2], 0.0, atol=1e-9)
    assert (surface.depth[mask] < DISTANCE).all()
    assert np.allclose(surface.position[..., 2], DISTANCE - surface.depth)
    assert np.allclose(np.linalg.norm(surface.normal, axis=-1), 1.0, atol=1e-4)
    on_link = np.linalg.inv(found.Ts_world_link(frame.measured)[int(surface.link[mask][0])])
    point = on_link @ np.append(surface.position[mask][0], 1.0)
    assert np.linalg.norm(point[:3]) < 0.6


def test_a_recording_without_masks_cannot_be_measured(tiny_sequence: Callable[..., Path]) -> None:
    with pytest.raises(SettingsError, match="no masks for camera 'left'"):
        real_source(tiny_sequence(frames=1, masks=False, **SIZE), QUICK)


def test_a_recording_opens_as_a_source_with_its_masked_frames(
    tiny_sequence: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sources, "backdrop", lambda width, height, seed: np.zeros((height, width, 3), np.uint8))
    path = tiny_sequence(frames=3, **SIZE)
    source = real_source(path, QUICK)
    assert source.frames == [0, 2] and source.camera == "left" and source.consecutive == [0, 1, 2]
    recording = source.open(lambda what, done, total: None)
    assert recording.frame(2, "smoke", ["left"]).domain == "smoke"
    path.write_text(path.read_text().replace('name = "tiny"', 'name = "other"', 1))
    assert real_source(path, QUICK).fingerprint != source.fingerprint
