"""Where the frames of a sequence begin: of what a few of them see by themselves, what suits all of these best.

A single image may deceive (smoke, a tool in front), and the network sees what it is told to, so a wrong beginning would
be believed in every frame after it. Errors of kinematics are much the same in all frames; those of images are not.
"""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from ..data import Frame
from .parameters import ParameterVector
from .sight import Eye


def best_beginning(
    opinions: Mapping[int, Float[np.ndarray, " n"]],
    eye: Eye,
    open_frame: Callable[[int], tuple[Frame, ParameterVector]],
    allowance: float,
) -> Float[np.ndarray, " n"]:
    """The opinion with the lowest loss, mean over the frames that were asked.

    What does not suit the first of them is left out: the error may have jumped on the way to the others.

    Args:
        opinions: position of each frame that was asked -> the correction that it sees [rad].
        eye: looks at these frames again, told each opinion.
        open_frame: a frame and its unknowns.
        allowance: how many times as large as the lowest loss in the first frame one there may be [1].
    """
    corrections = list(opinions.values())
    losses = np.array([eye.losses(*open_frame(index), corrections) for index in opinions])
    suits = losses[0] <= allowance * losses[0].min()
    return corrections[int(np.where(suits, losses.mean(0), np.inf).argmin())]
