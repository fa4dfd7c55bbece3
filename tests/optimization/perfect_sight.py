"""Eyes that are never wrong, in place of a trained network."""

import pytest
import torch
from torch.nn import functional

from carts_core.data import Sequence
from carts_core.optimization.window import Window
from carts_core.rendering import Renderer
from carts_core.scene import SceneState


class PerfectSight:
    """Stands in for the networks: sees the surface map of the truth, whatever it is shown."""

    device = torch.device("cpu")
    stride = 16

    def __init__(self, sequence: Sequence, truth: SceneState) -> None:
        self.maps = Renderer(sequence.scene, width=640, height=480).surface(truth).maps

    def surface(self, images: torch.Tensor, believed: torch.Tensor) -> torch.Tensor:
        """The truth, cut to the window that `believed` lies in."""
        width, height = self.size
        left, top = self.where
        window = Window(left, top, images.shape[3], images.shape[2])
        assert Window(0, 0, width, height).holds(window)
        return window.of(functional.interpolate(self.maps, (height, width), mode="area")).clone()

    where, size = (0, 0), (320, 240)

    def follow_windows(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Know which window of the image is looked at."""
        around = Window.around

        def remembered(*arguments) -> Window:
            window = around(*arguments)
            self.where, self.size = (window.left, window.top), arguments[3]
            return window

        monkeypatch.setattr(Window, "around", staticmethod(remembered))
