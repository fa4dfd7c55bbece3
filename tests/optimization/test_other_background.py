"""A frame that failed is run again with its empty background treated the other way."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from carts_core.evaluation import dice
from carts_core.imaging.working_image import Window
from carts_core.model.parts import COVERAGE
from carts_core.optimization import FrameOptimizer, ImagePredictor, SurfaceSolver, Verdict
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.settings.stages import OtherBackground

SIZE = {"width": 320, "height": 240}
ASIDE = 24
"""How far off the predictor sees arms before the room [px]."""


class SeesArmsAsideBeforeRooms(ImagePredictor):
    """Sees nothing in the empty room, arms aside of where they are before it, and in place before a blurred one."""

    device, stride = torch.device("cpu"), 16

    def __init__(self, parts: torch.Tensor) -> None:
        self.parts = parts
        """Coverage of every part [1, parts, height, width]."""

    def predict(self, images: torch.Tensor, given: torch.Tensor, window: Window) -> torch.Tensor:
        """See the class."""
        found = torch.zeros_like(given)
        size = images.shape[-2:]
        parts = torch.nn.functional.interpolate(self.parts, size, mode="area")
        mask = parts[0].sum(0)
        if float(images[..., mask > 0.9].mean()) < 0.2:
            before_nothing = float(images[:, 0, :8, :8].std()) < 0.02
            found[:, COVERAGE] = parts if before_nothing else parts.roll(ASIDE * size[1] // SIZE["width"], -1)
        return window.of(found)


@pytest.mark.parametrize("again", [True, False])
def test_what_overlaps_more_with_the_change_against_the_background_is_kept(
    tiny_sequence: Callable[..., Path], again: bool
) -> None:
    sequence = Sequence.open(tiny_sequence(frames=1, **SIZE))
    scene, frame = sequence.scene.with_cameras(["left"]), sequence.frame(0, cameras=["left"])
    assert frame.truth is not None
    renderer = Renderer(scene)
    mask = renderer.segment(scene.state(frame.truth))[0] >= 0
    rng = np.random.default_rng(0)
    room = rng.integers(70, 130, (SIZE["height"], SIZE["width"], 3)).astype(np.uint8)
    image = room.copy()
    image[mask] = 10
    settings = SurfaceSolver()
    if not again:
        settings = replace(settings, stages=tuple(s for s in settings.stages if not isinstance(s, OtherBackground)))
    optimizer = FrameOptimizer(
        scene,
        replace(frame, images={"left": image}),
        {"left": room},
        SeesArmsAsideBeforeRooms(renderer.surface_maps(scene.state(frame.truth))[:, COVERAGE]),
        settings=settings,
        live=False,
    )
    list(optimizer)
    assert optimizer.best is not None and optimizer.assessment is not None
    found = dice(renderer.segment(optimizer.best.state)[0] >= 0, mask)
    assert (optimizer.assessment.verdict is Verdict.GOOD) == again
    assert (found > 0.95) == again
    optimizer.reset()
    list(optimizer)
    assert dice(renderer.segment(optimizer.best.state)[0] >= 0, mask) == found
