"""Live tracking loop: tracks the latest frame of a source and passes the result to sinks."""

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..model.scene import Scene
from ..rendering import Renderer
from ..settings.live import CURRENT
from .messages import LatestFrame, ResultMessage, Source, StreamFrame, encoded_masks
from .tracker import LiveEstimate, LiveTracker, LiveVerdict

_RECENT = 20
"""Number of recent frames from which the processing time of the next frame is predicted."""
_USUAL = 75
"""Percentile of recent processing times that is used as prediction."""
_FRESH = 0.01
"""Lower bound of the `patience` with which a frame is taken [s]."""


@dataclass(frozen=True)
class Tracked:
    """Frame with its estimate and age."""

    stream_frame: StreamFrame
    estimate: LiveEstimate
    age: float
    """Time since the arrival of the frame [s]."""
    interval: float = math.inf
    """Mean time between recent frames of the stream [s]."""

    @property
    def current(self) -> bool:
        """Whether the age is at most two frame intervals of the stream."""
        return self.age <= CURRENT * self.interval


Sink = Callable[[Tracked], None]
"""Callback for results, called on the tracker's thread."""


@dataclass
class LiveStatistics:
    """Statistics of a stream."""

    arrived: int = 0
    dropped: int = 0
    verdicts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(LiveVerdict, 0))
    ages: list[float] = field(default_factory=list)
    """Ages of the last results with a verdict other than `lost` [s]."""
    began: float = field(default_factory=time.monotonic)
    ended: float = 0.0

    _KEPT = 100_000

    def add(self, tracked: Tracked) -> None:
        """Count a result."""
        self.verdicts[tracked.estimate.verdict] += 1
        if tracked.estimate.verdict is not LiveVerdict.LOST:
            self.ages.append(tracked.age)
            del self.ages[: -self._KEPT]

    @property
    def tracked(self) -> int:
        """Number of frames with a result."""
        return sum(self.verdicts.values())

    def __str__(self) -> str:
        seconds = max((self.ended or time.monotonic()) - self.began, 1e-9)
        verdicts = ", ".join(f"{count} {verdict}" for verdict, count in self.verdicts.items())
        text = (
            f"{self.tracked} of {self.arrived} frames ({self.dropped} dropped), {self.tracked / seconds:.1f} per "
            "second: "
        )
        if not self.ages:
            return text + verdicts
        middle, late = 1000.0 * np.percentile(self.ages, (50, 95))
        return f"{text}{verdicts}. Latency: median {middle:.0f} ms, 95th percentile {late:.0f} ms"


def follow(
    source: Source, tracker: LiveTracker, sinks: Sequence[Sink], statistics: LiveStatistics | None = None
) -> LiveStatistics:
    """Track a stream until it ends; the source is always closed.

    Args:
        source: source of frames.
        tracker: tracker of the arms.
        sinks: callbacks that receive the results.
        statistics: statistics to update during tracking; by default new ones.

    Raises:
        CartsError: the stream failed, or a frame does not fit the scene.
    """
    statistics = statistics or LiveStatistics()
    latest, taken = LatestFrame(source), deque[float](maxlen=_RECENT)
    try:
        while True:
            # A frame whose result would be older than allowed is dropped.
            usual = float(np.percentile(list(taken), _USUAL)) if taken else 0.0
            stream_frame = latest.take(max(tracker.live.oldest_seconds - usual, _FRESH))
            if stream_frame is None:
                break
            estimate = tracker.track(stream_frame.frame, stream_frame.camera_poses)
            taken.append(estimate.seconds)
            age = time.monotonic() - stream_frame.arrived
            tracked = Tracked(stream_frame, estimate, age, latest.interval)
            statistics.add(tracked)
            statistics.arrived, statistics.dropped = latest.arrived, latest.dropped
            for sink in sinks:
                sink(tracked)
    finally:
        latest.close()
        statistics.ended = time.monotonic()
        statistics.arrived, statistics.dropped = latest.arrived, latest.dropped
    return statistics


class Results:
    """Converts results to messages.

    Args:
        scene: scene with the tracked cameras.
        masks: whether messages include masks, whose rendering takes about 10 ms per camera.
    """

    def __init__(self, scene: Scene, *, masks: bool = False) -> None:
        self._scene = scene
        self._renderers = {camera.name: Renderer(scene, cameras=[camera.name]) for camera in scene.cameras if masks}

    def message(self, tracked: Tracked) -> ResultMessage:
        """Convert a result to a message."""
        estimate, joints, frames = tracked.estimate, {}, {}
        T_world_base, T_camera_world = (
            values.double().cpu().numpy() for values in (estimate.state.T_world_base, estimate.state.T_view_world)
        )
        for index, arm in enumerate(self._scene.arms):
            known = zip(estimate.joint_positions[arm.name], estimate.joint_std[arm.name], strict=True)
            values = [(float(value), float(std) if np.isfinite(std) else None) for value, std in known]
            joints[arm.name] = dict(zip(arm.robot.joint_names, values, strict=True))
            frames[arm.name] = {
                camera.name: (T_camera_world[number] @ T_world_base[index]).tolist()
                for number, camera in enumerate(self._scene.cameras)
            }
        found = {name: one.segment(estimate.state.to("cpu"))[0] >= 0 for name, one in self._renderers.items()}
        return ResultMessage(
            id=estimate.frame_id,
            time=estimate.time,
            age=tracked.age,
            verdict=estimate.verdict.value,
            effort=estimate.effort.value,
            loss=estimate.loss,
            current=tracked.current,
            joints=joints,
            base_frames=frames,
            masks=encoded_masks(found),
        )
