"""Warnings before anything is solved: robots and images that a network does not know."""

from pathlib import Path

import pytest
import torch

from carts_core.imaging.working_image import Window
from carts_core.networks import FeatureExtractor
from carts_core.optimization import DomainCheck, ImagePredictor, check_domain
from carts_core.recording import Sequence


@pytest.fixture
def shipped(sample_sequence_path: Path) -> Sequence:
    return Sequence.open(sample_sequence_path)


class SeesArmsEverywhere(ImagePredictor):
    """Takes all of every image for arms."""

    device, stride = torch.device("cpu"), 16

    def predict(self, images: torch.Tensor, given: torch.Tensor, window: Window) -> torch.Tensor:
        """See the class."""
        found = torch.zeros_like(given)
        found[:, 0] = 1.0
        return window.of(found)


def test_the_shipped_network_knows_the_shipped_recording(shipped: Sequence) -> None:
    found = check_domain(
        shipped.scene.with_cameras(["left"]), shipped.frame(3, cameras=["left"]), FeatureExtractor.load()
    )
    assert found.recognized is not None and found.recognized > 0.95 and found.elsewhere < 0.05
    assert found.warnings("left") == []


def test_a_network_that_knows_nothing_is_told_of_with_remedies(shipped: Sequence) -> None:
    found = check_domain(shipped.scene.with_cameras(["left"]), shipped.frame(3, cameras=["left"]), SeesArmsEverywhere())
    robot, image = found.warnings("left")
    assert "recognizes a rendering" in robot and "--observe masks" in robot and "carts train" in robot
    assert "% of the image" in image and "--observe masks" in image
    assert found.warnings("left", background=True) == [robot]


def test_an_overlap_just_below_what_is_usual_reads_as_less() -> None:
    (said,) = DomainCheck(0.9499, 0.0).warnings("left")
    assert "an overlap of 0.949 only (0.95 or more is usual)" in said


def test_no_arm_in_view_is_said_before_solving() -> None:
    (said,) = DomainCheck(None, 0.0).warnings("left")
    assert "no arm is in view" in said and "T_camera_world" in said
