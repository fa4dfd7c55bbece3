"""Frames of a sequence whose joint positions are given."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..model.scene import Scene
from .error_model import Information
from .sequence_estimate import FrameEstimate
from .variables import Variables

GivenPositions = Mapping[int, Mapping[str, ArrayLike]]
"""Position of a frame -> arm name -> a value for each joint."""


class Keyframes:
    """Joint positions that stay as they are, exact or up to a standard deviation.

    Args:
        scene: the arms.
        positions: joint positions [rad, m].
        std: standard deviations [rad, m]; those that are missing or NaN are 0.

    Raises:
        RobotError: an arm lacks joint positions, or has the wrong number.
    """

    def __init__(self, scene: Scene, positions: GivenPositions | None, std: GivenPositions | None) -> None:
        self._scene, self._positions, self._std = scene, _arrays(positions or {}), _arrays(std or {})
        for given in self._positions.values():
            scene.state(given)

    def __contains__(self, index: object) -> bool:
        return index in self._positions

    def __iter__(self) -> Iterator[int]:
        return iter(self._positions)

    def __len__(self) -> int:
        return len(self._positions)

    def correction(self, index: int, variables: Variables) -> tuple[Float[np.ndarray, " n"], Information]:
        """What a frame's measured values are corrected by, NaN for unknowns that are no joints, and how surely."""
        given, std = self._positions[index], self._deviations(index)
        correction = variables.joint_offsets([given[arm.name] for arm in self._scene.arms])
        farther = variables.joint_offsets([given[arm.name] + std[arm.name] for arm in self._scene.arms])
        return correction, Information.known(correction, farther - correction)

    def as_given(self, estimate: FrameEstimate) -> FrameEstimate:
        """The estimate of a frame, with the joint positions and deviations that it was given, if it was."""
        if estimate.index not in self:
            return estimate
        given = self._positions[estimate.index]
        state = self._scene.state(given, estimate.state.joint_positions[0].device)
        return replace(
            estimate,
            state=replace(estimate.state, joint_positions=state.joint_positions),
            joint_positions={arm.name: given[arm.name].copy() for arm in self._scene.arms},
            joint_std=self._deviations(estimate.index),
        )

    def _deviations(self, index: int) -> dict[str, Float[np.ndarray, " dofs"]]:
        known, given = self._std.get(index, {}), self._positions[index]
        return {arm.name: np.nan_to_num(known.get(arm.name, 0.0 * given[arm.name])) for arm in self._scene.arms}


def _arrays(given: GivenPositions) -> dict[int, dict[str, np.ndarray]]:
    return {
        index: {name: np.asarray(values, np.float64) for name, values in positions.items()}
        for index, positions in given.items()
    }
