"""Where a sequence starts: of what a few frames measure alone, what suits all of these best.

A single image may mislead (smoke, a tool in front), and the network is conditioned on the estimate, so a wrong start
would be confirmed in every frame after it. Errors of kinematics are much the same in all frames; those of images are
not.
"""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float

from ..recording import Frame
from .measurement import FrameSolver
from .variables import Variables


def initial_correction(
    corrections: Mapping[int, Float[np.ndarray, " n"]],
    solver: FrameSolver,
    open_frame: Callable[[int], tuple[Frame, Variables]],
    allowance: float,
) -> Float[np.ndarray, " n"]:
    """The correction with the lowest loss, mean over the frames that were solved alone.

    What does not suit the first of them is left out: the error may have jumped on the way to the others.

    Args:
        corrections: position of each of these frames -> the correction that it measured [rad].
        solver: compares each correction with each of these frames.
        open_frame: a frame and its unknowns.
        allowance: how many times as large as the lowest loss in the first frame one there may be [1].
    """
    candidates = list(corrections.values())
    losses = np.array([solver.losses(*open_frame(index), candidates) for index in corrections])
    suits = losses[0] <= allowance * losses[0].min()
    return candidates[int(np.where(suits, losses.mean(0), np.inf).argmin())]
