"""Digests of input files, which identify a training run or an image cache independently of the files' paths."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from ...files.reading import ROBOT, SEQUENCE, WEIGHTS, read_bytes
from ...model.robot import Robot
from ...recording import Sequence
from ...settings import TrainingConfig


def run_digests(config: TrainingConfig) -> dict[str, Any]:
    """Digests of the files of a run, by setting name; None for files that are not given.

    Raises:
        RobotError: a robot cannot be loaded.
        SequenceError: the recording cannot be read.
    """
    return {"start_digest": start_digest(config.start), **image_digests(config)}


def start_digest(start: Path | None) -> str | None:
    """Digest of a file of initial weights; None without one."""
    return None if start is None else _digest(read_bytes(start, WEIGHTS))


def image_digests(config: TrainingConfig) -> dict[str, Any]:
    """Digests of the files from which training images are generated; errors as in `run_digests`."""
    recording = config.images.recording
    return {
        "robots_digest": [_digest(read_bytes(Robot.load(path).urdf, ROBOT)) for path in config.robots],
        "recording_digest": None if recording is None else recording_digest(Sequence.open(recording)),
    }


def recording_digest(sequence: Sequence) -> str:
    """Digest of a sequence file, the measured joint positions and the poses of camera mounts."""
    mounts = [T for index in range(len(sequence)) for T in sequence.mounts(index).values()]
    # In single precision, rounding errors of different processors do not change the digest.
    values = (np.asarray(rows, np.float32).tobytes() for rows in (*sequence.measured.values(), *mounts))
    return _digest(read_bytes(sequence.path, SEQUENCE), *values)


def _digest(*contents: bytes) -> str:
    return hashlib.sha256(b"".join(contents)).hexdigest()[:16]
