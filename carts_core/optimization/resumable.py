"""Frames that a stopped run has already solved are not solved again."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, is_dataclass
from typing import Any

import numpy as np

from ..checkpoint import Checkpoint
from ..files import OutputPath
from ..fingerprints import fingerprint
from ..recording import Frame
from ..settings import FreeParameters
from .error_model import Gaussian, Information
from .evidence import Evidence
from .measurement import FrameSolver, Measurement, SolvedAlone
from .variables import Variables


def sequence_checkpoint(path: OutputPath, made_with: str) -> Checkpoint:
    """The checkpoint of a `SequenceOptimizer`.

    Args:
        path: the file.
        made_with: fingerprint of scene, weights, settings and code; frames and what is expected of them need not be in.
    """
    return Checkpoint(path, made_with, (Measurement, Information, Evidence))


class ResumableFrameSolver(FrameSolver):
    """A `FrameSolver` that looks up in a checkpoint what it has solved before: the same to the last bit.

    Args:
        solver: that solves what is not there.
        checkpoint: made by `sequence_checkpoint`.
    """

    def __init__(self, solver: FrameSolver, checkpoint: Checkpoint) -> None:
        self._solver, self._checkpoint = solver, checkpoint

    def warm(
        self, frame: Frame, variables: Variables, expected: Gaussian, start: np.ndarray, *, wide: bool = False
    ) -> Measurement:
        """As `FrameSolver.warm`."""
        key = _key("warm", frame, expected, start, wide)
        return self._checkpoint.value(key, lambda: self._solver.warm(frame, variables, expected, start, wide=wide))

    def cold(
        self,
        frame: Frame,
        variables: Variables,
        expected: Gaussian,
        *,
        quick: bool = False,
        cancelled: Callable[[], bool] = lambda: False,
    ) -> Measurement:
        """As `FrameSolver.cold`."""
        key, options = _key("cold", frame, expected, quick), {"quick": quick, "cancelled": cancelled}
        return self._checkpoint.value(key, lambda: self._solver.cold(frame, variables, expected, **options))

    def alone(self, frame: Frame, variables: Variables) -> SolvedAlone | None:
        """As `FrameSolver.alone`; frames that failed only, so it is not kept."""
        return self._solver.alone(frame, variables)

    def at(self, frame: Frame, variables: Variables, expected: Gaussian, correction: np.ndarray) -> Measurement:
        """As `FrameSolver.at`."""
        key = _key("at", frame, expected, correction)
        return self._checkpoint.value(key, lambda: self._solver.at(frame, variables, expected, correction))

    def losses(self, frame: Frame, variables: Variables, corrections: Sequence[np.ndarray]) -> list[float]:
        """As `FrameSolver.losses`."""
        key = _key("losses", frame, *corrections)
        return self._checkpoint.value(key, lambda: self._solver.losses(frame, variables, corrections))

    def evidence(self, frame: Frame, variables: Variables, correction: np.ndarray, loss: float) -> Evidence:
        """As `FrameSolver.evidence`."""
        key = _key("evidence", frame, correction, loss)
        return self._checkpoint.value(key, lambda: self._solver.evidence(frame, variables, correction, loss))

    def base_frame_gain(
        self, frame: Frame, variables: Variables, correction: np.ndarray, free: FreeParameters
    ) -> float:
        """As `FrameSolver.base_frame_gain`; a few frames, so it is not kept."""
        return self._solver.base_frame_gain(frame, variables, correction, free)


def _key(method: str, frame: Frame, *arguments: Any) -> str:
    images = [(name, frame.images[name]) for name in sorted(frame.images)]
    measured = [(name, frame.measured[name]) for name in sorted(frame.measured)]
    masks = sorted((frame.masks or {}).items())
    return fingerprint(method, frame.index, images, masks, measured, _plain(arguments))


def _plain(arguments: Iterable[Any]) -> list[Any]:
    return [astuple(value) if is_dataclass(value) and not isinstance(value, type) else value for value in arguments]
