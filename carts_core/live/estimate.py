"""What a tracker says of a frame."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float

from ..model.scene import SceneState


class LiveVerdict(StrEnum):
    """How far an estimate can be relied on."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    """The image does not fit for the moment: what is shown is what the frames before let expect."""
    LOST = "lost"
    """Nothing is known but the measured values and what they were off by when the arms were last seen."""


class Effort(StrEnum):
    """What was done with a frame."""

    SMALL = "small"
    FULL = "full"
    SEARCH = "search"


@dataclass(frozen=True)
class LiveEstimate:
    """One frame, in the light of those before it."""

    frame_id: str
    time: float
    """When it was taken [s]."""
    verdict: LiveVerdict
    effort: Effort
    loss: float
    """Of the surface factor [1]."""
    state: SceneState
    joint_positions: Mapping[str, Float[np.ndarray, " dofs"]]
    """Arm name -> [rad, m]."""
    joint_std: Mapping[str, Float[np.ndarray, " dofs"]]
    """Arm name -> standard deviation [rad, m]; NaN where a joint is not free."""
    seconds: float
    """Spent on it [s]."""
