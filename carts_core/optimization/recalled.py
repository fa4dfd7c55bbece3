"""Looks at frames that a stopped run has already taken are not taken again."""

from collections.abc import Iterable, Sequence
from dataclasses import astuple, is_dataclass
from typing import Any

import numpy as np

from ..checkpoint import Checkpoint
from ..data import Frame
from ..files import OutputPath
from ..fingerprints import fingerprint
from .error_model import Gaussian, Information
from .parameters import ParameterVector
from .sight import Eye, Sight


def sequence_checkpoint(path: OutputPath, made_with: str) -> Checkpoint:
    """The checkpoint of a `SequenceOptimizer`.

    Args:
        path: the file.
        made_with: fingerprint of scene, weights, settings and code; frames and what is expected of them need not be in.
    """
    return Checkpoint(path, made_with, (Sight, Information))


class RecallingEye(Eye):
    """An `Eye` that looks up in a checkpoint what it has seen before: the same to the last bit.

    Args:
        eye: that looks where there is nothing to look up.
        checkpoint: made by `sequence_checkpoint`.
    """

    def __init__(self, eye: Eye, checkpoint: Checkpoint) -> None:
        self._eye, self._checkpoint = eye, checkpoint

    def warm(self, frame: Frame, parameters: ParameterVector, expected: Gaussian, start: np.ndarray) -> Sight:
        """As `Eye.warm`."""
        key = _key("warm", frame, expected, start)
        return self._checkpoint.value(key, lambda: self._eye.warm(frame, parameters, expected, start))

    def cold(self, frame: Frame, parameters: ParameterVector, expected: Gaussian, *, quick: bool = False) -> Sight:
        """As `Eye.cold`."""
        key = _key("cold", frame, expected, quick)
        return self._checkpoint.value(key, lambda: self._eye.cold(frame, parameters, expected, quick=quick))

    def at(self, frame: Frame, parameters: ParameterVector, expected: Gaussian, correction: np.ndarray) -> Sight:
        """As `Eye.at`."""
        key = _key("at", frame, expected, correction)
        return self._checkpoint.value(key, lambda: self._eye.at(frame, parameters, expected, correction))

    def losses(self, frame: Frame, parameters: ParameterVector, corrections: Sequence[np.ndarray]) -> list[float]:
        """As `Eye.losses`."""
        key = _key("losses", frame, *corrections)
        return self._checkpoint.value(key, lambda: self._eye.losses(frame, parameters, corrections))


def _key(method: str, frame: Frame, *arguments: Any) -> str:
    images = [(name, frame.images[name]) for name in sorted(frame.images)]
    measured = [(name, frame.measured[name]) for name in sorted(frame.measured)]
    return fingerprint(method, frame.index, images, measured, _plain(arguments))


def _plain(arguments: Iterable[Any]) -> list[Any]:
    return [astuple(value) if is_dataclass(value) and not isinstance(value, type) else value for value in arguments]
