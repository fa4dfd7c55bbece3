"""Recorded frames under other conditions: what changes, and what must not."""

import cv2
import numpy as np
import pytest

from carts_core.lab.benchmark.counterfactual import Counterfactual
from carts_core.lab.synthesis import DOMAINS
from carts_core.recording import Sequence

SIZE = {"width": 160, "height": 120}


@pytest.fixture
def counterfactual(sequence: Sequence) -> Counterfactual:
    other = np.full((SIZE["height"], SIZE["width"], 3), (40, 160, 90), np.uint8)
    return Counterfactual(sequence, "left", other, seed=1)


def _image(recording: Counterfactual | Sequence, index: int, domain: str | None = None) -> np.ndarray:
    return recording.frame(index, domain, ["left"]).images["left"].astype(float)


def test_domains_alter_images_and_nothing_else(sequence: Sequence, counterfactual: Counterfactual) -> None:
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
