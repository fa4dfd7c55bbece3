"""Two poses of a frame over one picture: swiped from side to side, or one for the other while a key is held."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from carts_core.model.scene import SceneState
from carts_viewer.layers import Rgba


class Against(StrEnum):
    """The pose that the present one is compared with; the value is what people read."""

    MEASURED = "Measured"
    BEFORE_RUN = "Before the run"


@dataclass(frozen=True)
class Compare:
    """What is compared, and how much of it is seen."""

    against: Against | None = None
    """None: nothing, but for a key that is held."""
    swipe: float = 0.5
    """Share of the picture's width, from its left side, that shows the other pose, 0..1."""
    peek: bool = False
    """Whether the other pose is shown all over, as long as a key is held."""

    @property
    def share(self) -> float:
        """Of the picture's width that shows the other pose, 0..1."""
        return 1.0 if self.peek else self.swipe if self.against is not None else 0.0


def other_pose(compare: Compare, measured: SceneState, before_run: SceneState | None) -> SceneState:
    """The pose that is compared with; the measured one where there was no run."""
    return before_run if compare.against is Against.BEFORE_RUN and before_run is not None else measured


def composed(own: Rgba, other: Rgba, share: float) -> Rgba:
    """The other overlay up to a share of the width, the own one beyond it, and a line between them."""
    column = round(share * own.shape[1])
    both = np.concatenate([other[:, :column], own[:, column:]], axis=1)
    if 0 < column < own.shape[1]:
        both[:, max(column - 1, 0) : column + 1] = 255
    return both
