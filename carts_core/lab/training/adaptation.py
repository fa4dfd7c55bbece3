"""Adapting the shipped network to a recording: its robots, its cameras, its distances, its empty backgrounds."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from ...files import locked_folder, output_path, remove_file, write_bytes, write_text
from ...files.reading import WEIGHTS, read_bytes
from ...model.parts import PARTS
from ...recording import Sequence
from ...resources import shipped_weights
from ...settings import TrainingConfig
from .judging import Progress, judge
from .progress import TrainingResult

STEPS = 400
"""Steps of a run for which neither steps nor time are given: a busy machine takes longer and learns as much."""
_VALIDATION_EVERY = 40
BACKGROUNDS = "backgrounds"
"""Folder of a run with the empty backgrounds of the recording."""
_FROM_RECORDING = 0.5
"""Share of backgrounds that are parts of these."""
_LEARNING_RATE = 6e-4
_WARMUP = 15
_AVERAGE = 0.97
_SAMPLES = 48
_PATIENCE = 5


REFUSED = "refused.safetensors"
"""Weights of a run that are not offered."""


@dataclass(frozen=True)
class Offer:
    """What becomes of adapted weights."""

    weights: Path | None
    """To be used; None where something became worse."""
    refused: Path | None
    """Where weights are that are not offered."""
    worse: list[str]
    """What became worse."""
    lines: list[str]
    """Figures before and after, for people."""


def adapted_to(recording: Path, output: Path, given: TrainingConfig) -> TrainingConfig:
    """The settings of a run that adapts the surface network to a recording, and its backgrounds in `output`.

    Robots, start, steps and time are those of `given` where they are not its defaults.

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
    default, samples, every = TrainingConfig(), given.validation_samples, given.validation_every
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
        steps=given.steps if given.steps != default.steps else STEPS if given.minutes is None else 10**6,
        learning_rate=_LEARNING_RATE if given.learning_rate == default.learning_rate else given.learning_rate,
        warmup=_WARMUP,
        average=_AVERAGE,
        validation_samples=_SAMPLES if samples == default.validation_samples else samples,
        validation_every=every if every != default.validation_every else _VALIDATION_EVERY,
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
    parts = ", ".join(f"{part} {before[f'dice_{part}']:.3f} -> {now[f'dice_{part}']:.3f}" for part in PARTS)
    tips = f"tips {before['tip_error']:.1f} -> {now['tip_error']:.1f} px"
    normals = f"normals {before['normal_error_deg']:.1f} -> {now['normal_error_deg']:.1f} deg"
    return f"made images of this recording: {dice}; {parts}; {tips}; {normals}"


def offer(config: TrainingConfig, result: TrainingResult, progress: Progress, made: int, own: int) -> Offer:
    """Compare fits with the weights of the start and of a run; weights that are worse anywhere are put aside.

    Args:
        config: as from `adapted_to`.
        result: of the run.
        progress: called before every fit.
        made, own: how many made images, and frames of the recording.
    """
    assert config.start is not None
    aside = output_path(result.weights.parent, REFUSED)
    if not result.weights.is_file():
        return Offer(None, aside.path, ["the weights were refused before; see report/fits.json"], [])
    judgement = judge(config, config.start, result.weights, made=made, own=own, progress=progress)
    worse = judgement.worse()
    report = {"worse": worse, "figures": judgement.lines(), "made": made, "own": own}
    write_text(output_path(result.weights.parent, "report") / "fits.json", json.dumps(report, indent=1))
    if not worse:
        return Offer(result.weights, None, [], judgement.lines())
    # The page and later commands look for weights under their usual name only.
    write_bytes(aside, read_bytes(result.weights, WEIGHTS))
    remove_file(output_path(result.weights.parent, result.weights.name))
    return Offer(None, aside.path, worse, judgement.lines())
