"""What takes many frames at once: one calibration of a recording, and frames that are corrected as a sequence."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

from ...model.scene import Scene
from ...networks.extractor import FeatureExtractor
from ...optimization import Backgrounds, CalibrationOptimizer, SequenceOptimizer
from ...recording import Frame
from ...recording.background import spread
from ...rendering import Renderer
from .frame import Truth, start_of
from .measurement import Measurement
from .scope import Run
from .sources import Recording
from .timing import machine


def calibrated_scene(recording: Recording, camera: str, frames: int, extractor: FeatureExtractor) -> Scene:
    """The scene with base frames from so many frames of the recording, evenly spread, as one camera sees them.

    Neither masks nor true joint positions are looked at.
    """
    chosen = [recording.frame(index, cameras=[camera]) for index in spread(len(recording), frames)]
    optimizer = CalibrationOptimizer(
        recording.scene,
        chosen,
        extractor,
        cameras=[camera],
        backgrounds=Backgrounds.of(recording, [camera], "regular"),
    )
    for _ in optimizer:
        pass
    return optimizer.result().scene


def correct_together(
    runs: Iterable[Run],
    recording: Recording,
    extractor: FeatureExtractor,
    truths: Mapping[int, Truth],
    renderer: Renderer,
) -> list[Measurement]:
    """Correct frames as a sequence, and score them when all are done.

    Seconds are those spent on a frame over all visits, reading its image included.

    Args:
        runs: one per frame, of one domain and error at the start.
        recording: where the frames are from.
        extractor: the networks.
        truths: position of the frame -> what its estimate is compared with.
        renderer: of the camera that takes part, at its size.
    """
    by_frame = {run.frame: run for run in runs}
    (domain,) = {run.domain for run in by_frame.values()}
    scene, cameras = renderer.scene, [camera.name for camera in renderer.scene.cameras]

    def frame_at(index: int) -> Frame:
        frame = recording.frame(index, domain, cameras)
        return replace(frame, measured=start_of(scene, frame, by_frame[index], truths[index].measured_joints))

    stamps = recording.timestamps
    optimizer = SequenceOptimizer(
        scene,
        frame_at,
        {index: None if stamps is None else float(stamps[index]) for index in by_frame},
        extractor,
        backgrounds=Backgrounds.of(recording, cameras, domain),
    )
    for _ in optimizer:
        pass
    found = []
    for index, estimate in sorted(optimizer.estimates.items()):
        truth, state = truths[index], scene.state(frame_at(index).measured, mounts=frame_at(index).mounts)
        before = truth.score(state, None, None, renderer, 0.0)
        after = truth.score(estimate.state, estimate.uncertainty, estimate.loss, renderer, estimate.seconds)
        assessment = estimate.assessment
        found.append(
            Measurement(
                by_frame[index],
                after,
                (),
                (),
                estimate.start,
                machine(extractor.device),
                before,
                verdict=assessment and assessment.verdict.value,
                probability=assessment and assessment.probability,
                within=truth.within(scene, estimate.joint_positions, estimate.joint_std),
            )
        )
    return found
