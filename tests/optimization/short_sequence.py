"""A predictor that sees the truth of a short sequence, and the optimizer of that sequence."""

from copy import copy
from typing import Self

import torch
from perfect_predictor import PerfectPredictor

from carts_core.optimization import SequenceOptimizer, SequenceSettings
from carts_core.recording import Frame, Sequence

FRAMES = 6
ALONE = SequenceSettings(initial_frames=1, between=())
"""Settings of one initial frame, in which the predictor looks at every frame."""
ARM = "PSM1"


class Truths(PerfectPredictor):
    """Sees the truth of the frame that was read last."""

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence
        truths = [sequence.scene.state(sequence.frame(index).truth or {}) for index in range(len(sequence))]
        self.all = [PerfectPredictor(sequence, truth).maps for truth in truths]
        self.blind: set[int] = set()
        self.read: list[int] = []

    def fresh(self) -> Self:
        """The same, as if nothing had been read or hidden."""
        other = copy(self)
        other.all, other.blind, other.read = list(self.all), set(), []
        return other

    def load(self, index: int) -> Frame:
        self.read.append(index)
        self.maps = torch.zeros_like(self.all[index]) if index in self.blind else self.all[index]
        return self.sequence.frame(index)


def optimizer(truths: Truths, **arguments) -> SequenceOptimizer:
    times = {index: float(index) / 10 for index in range(FRAMES)}
    return SequenceOptimizer(truths.sequence.scene, truths.load, times, truths, **arguments)
