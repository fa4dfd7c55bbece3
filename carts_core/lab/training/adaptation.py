"""Adapting the shipped network to a recording: its robots, its cameras, its distances, its empty backgrounds."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from ...files import locked_folder, output_path, write_bytes
from ...recording import Sequence
from ...resources import shipped_weights
from ...settings import TrainingConfig

MINUTES = 15.0
"""Time of a run for which none is given [min]."""
BACKGROUNDS = "backgrounds"
"""Folder of a run with the empty backgrounds of the recording."""
_FROM_RECORDING = 0.5
"""Share of backgrounds that are parts of these."""
_LEARNING_RATE = 6e-4
_WARMUP = 15
_AVERAGE = 0.97
_SAMPLES = 48
_PATIENCE = 5


def adapted_to(recording: Path, output: Path, given: TrainingConfig) -> TrainingConfig:
    """The settings of a run that adapts the surface network to a recording, and its backgrounds in `output`.

    Robots, start and time are those of `given` where they are not its defaults.

    Args:
        recording: sequence file; no image of it but the empty background is learnt from.
        output: folder of the run, which is made once the recording could be read.
        given: settings for everything else.

    Raises:
        SequenceError: the recording cannot be read.
        OutputError: `output` cannot be written to.
        BusyError: another run writes there.
    """
    sequence = Sequence.open(recording)
    with locked_folder(output):
        found = _write_backgrounds(sequence, output)
    default, samples = TrainingConfig(), given.validation_samples
    robots = tuple(dict.fromkeys(arm.robot.urdf for arm in sequence.scene.arms))
    images = replace(
        given.images,
        recording=recording.absolute(),
        photographs=output / BACKGROUNDS if found else given.images.photographs,
        from_photographs=_FROM_RECORDING if found else given.images.from_photographs,
        two_arms=given.images.two_arms if len(sequence.scene.arms) > 1 else 0.0,
    )
    return replace(
        given,
        network="surface",
        robots=robots if given.robots == default.robots else given.robots,
        start=given.start or shipped_weights()[1],
        steps=10**6 if given.steps == default.steps else given.steps,
        minutes=given.minutes or MINUTES,
        learning_rate=_LEARNING_RATE if given.learning_rate == default.learning_rate else given.learning_rate,
        warmup=_WARMUP,
        average=_AVERAGE,
        validation_samples=_SAMPLES if samples == default.validation_samples else samples,
        validation_minutes=1.0,
        patience=_PATIENCE,
        images=images,
    )


def _write_backgrounds(sequence: Sequence, output: Path) -> int:
    """Write the empty backgrounds of a sequence's cameras; gives how many can be estimated."""
    found = 0
    for camera in sequence.scene.cameras:
        background = sequence.mean_background(camera.name)
        if background.problem is None:
            _, content = cv2.imencode(".png", background.image[..., ::-1])
            write_bytes(output_path(output, BACKGROUNDS, f"{found}.png"), content.tobytes())
            found += 1
    return found


def gain(before: dict[str, float], now: dict[str, float]) -> str:
    """What a run has reached, for people; figures are those of the surface network's validation."""
    share = (1 - now["dice"]) / (1 - before["dice"]) if before["dice"] < 1 else np.nan
    dice = f"Dice {before['dice']:.3f} -> {now['dice']:.3f}, {share:.0%} of the error is left"
    normals = f"normals {before['normal_error_deg']:.1f} -> {now['normal_error_deg']:.1f} deg"
    return f"made images of this recording: {dice}; {normals}"
