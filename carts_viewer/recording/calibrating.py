"""Calibration over the recording as a job: it begins with the clicked points, reports, and can be stopped."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from carts_core.errors import CartsError
from carts_core.model.scene import Scene
from carts_core.networks import FeatureExtractor
from carts_core.optimization import CalibrationIterate, CalibrationOptimizer, CalibrationResult
from carts_core.optimization.hand_eye import HandEyePrior
from carts_core.recording import Sequence, spread
from carts_core.settings import CALIBRATION
from carts_core.settings.optimization import Inference

FRAMES = 20
"""Frames that take part, spread evenly."""


@dataclass(frozen=True)
class Progress:
    """How far a job is."""

    text: str
    """For people."""
    share: float
    """Of its stages, in [0, 1]."""
    scene: Scene | None = None
    """With the calibration so far."""
    result: CalibrationResult | None = None
    """At its end."""
    error: str = ""
    """Why it failed, for people; empty if it did not."""
    ended: bool = False


STOPPED = Progress("Stopped; the calibration from your points is as it was.", 0.0, ended=True)
"""The end of a calibration whose result nobody wants."""


class CalibrationJob:
    """One calibration on a thread of its own."""

    def __init__(
        self,
        sequence: Sequence,
        scene: Scene,
        *,
        known: HandEyePrior,
        weights: tuple[Path, ...],
        device: str,
        inference: Inference,
        report: Callable[[Progress], None],
    ) -> None:
        """Begin.

        Args:
            sequence: the recording.
            scene: its arms and cameras, with the calibration to begin with.
            known: what that calibration leaves open.
            weights: weights files.
            device: where the networks run.
            inference: who runs the surface network.
            report: called on the job's thread with every progress, the last one `ended`.
        """
        self._sequence, self._scene, self._known = sequence, scene, known
        self._weights, self._device = weights, device
        self._inference: Inference = inference
        self._report = report
        self._cancelled = threading.Event()
        self._thread = threading.Thread(target=self._run, name="carts-calibration", daemon=True)
        self._thread.start()

    def cancel(self) -> None:
        """Stop soon, without a result."""
        self._cancelled.set()

    @property
    def cancelled(self) -> bool:
        """Whether it was stopped, be it as it ended."""
        return self._cancelled.is_set()

    def join(self, timeout: float | None = None) -> None:
        """Wait until it has ended.

        Args:
            timeout: [s]
        """
        self._thread.join(timeout)

    def _run(self) -> None:
        try:
            result = self._calibrate()
        except CartsError as error:
            self._report(Progress("", 0.0, error=str(error), ended=True))
        except Exception as error:
            self._report(Progress("", 0.0, error=f"The calibration failed: {error!r}", ended=True))
        else:
            self._report(result)

    def _calibrate(self) -> Progress:
        self._report(Progress("Loading the networks", 0.0))
        extractor = FeatureExtractor.load(*self._weights, device=self._device, inference=self._inference)
        self._report(Progress("Reading images", 0.0))
        frames = []
        for index in spread(len(self._sequence), FRAMES):
            if self.cancelled:
                return STOPPED
            frames.append(self._sequence.frame(index))
        held = [camera.name for camera in self._scene.cameras if camera.name not in self._known.free_cameras]
        free = replace(CALIBRATION, locked_cameras=tuple(held))
        optimizer = CalibrationOptimizer(
            self._scene, frames, extractor, free=free, known_base_frames=self._known.base_covariances
        )
        last: CalibrationIterate | None = None
        for iterate in optimizer:
            if self.cancelled:
                return STOPPED
            last = iterate
            text = f"Stage {iterate.stage + 1} of {iterate.stages}, step {iterate.index + 1}, loss {iterate.loss:.4f}"
            self._report(Progress(text, iterate.stage / iterate.stages, iterate.scene))
        if last is None:
            return Progress("", 0.0, error="The calibration made no step.", ended=True)
        result = optimizer.result()
        return Progress("Calibrated", 1.0, result.scene, result, ended=True)


def as_plain(scene: Scene) -> dict[str, Any]:
    """A calibration as a draft keeps it."""
    return {
        "arms": {arm.name: arm.T_world_base.tolist() for arm in scene.arms},
        "cameras": {camera.name: camera.T_camera_world.tolist() for camera in scene.cameras},
        "intrinsics": {camera.name: list(camera.intrinsics) for camera in scene.cameras},
    }
