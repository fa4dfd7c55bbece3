"""Estimation of the delay between images and kinematics from their common motion.

Optical flow between two frames is nearly a linear function of the motion of points of the arms between the same times,
for any hand-eye calibration. Flow is regressed on motion at many delays, without camera poses or a network. The
estimate is the delay with the largest explained share; its standard deviation is computed by the jackknife over parts
of the recording.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from ..model.robot import Robot
from .sequence import Sequence

WIDTH = 192
"""Width at which images are compared [px]."""
_CELLS = 6, 5
"""Columns and rows of the grid over which flow is averaged."""
_MAX_FRAMES, _STRETCHES = 600, 4
"""Maximum number of frames that are read, and number of intervals over which they are distributed."""
_MIN_STEPS = 60
"""Minimum number of steps between frames."""
_MAX_STEP = 0.25
"""Maximum duration of a step between frames that counts as one motion [s]."""
_BLOCKS = 10
"""Number of blocks of the jackknife."""
_GRID = 0.02
"""Spacing of the initial grid of delays [s]."""
_WIDEST = 3.0
"""Maximum delay to which the search extends when the optimum is at the end of its range [s]."""
_PLAIN = 0.6
"""Explained share below which delays up to `_WIDEST` are also tried."""
_EQUAL, _APART = 0.05, 0.15
"""Maximum difference in explained share [1], and minimum distance [s], of equally good delays."""
_KEPT = 1e-4
"""Share of the maximum variance below which a direction of motion is ignored."""
_POSTURES = 3
"""Number of principal directions of link positions that modulate the flow."""
_RIDGE = 1e-3
_LEVER = 0.1
"""Lever arm by which rotations of a camera are converted to lengths [m]."""
_MIN_KNOWN_FRACTION = 0.5
"""Minimum share of the steps with logged rows."""
_STILL = 0.02
"""Minimum flow that counts as motion [px]."""
_MIN_EXPLAINED, _MIN_GAIN = 0.15, 0.1
"""Minimum share of flow explained by the best delay, and its smallest margin over other delays."""
_MAX_DEVIATION = 0.04
"""Maximum standard deviation of a reliable estimate [s]."""
_MIN_DEVIATION = 0.001
"""Lower bound of the reported standard deviation [s]."""
_WORTH_A_CHANGE = 3.0, 0.008
"""Minimum proposed change of the delay, in standard deviations and in seconds."""


@dataclass(frozen=True)
class TimeOffsetEstimate:
    """Estimated `time_offset`."""

    present: float
    """Current `time_offset` of the sequence [s]."""
    seconds: float
    """Estimated offset [s]."""
    deviation: float
    """Standard deviation of the estimate [s]."""
    explained: float
    """Share of the flow in held-out blocks explained by the estimate [1]."""
    explained_now: float
    """Share explained by the current offset; negative if worse than no prediction [1]."""
    problem: str | None
    """Reason why the estimate is unreliable, as a sentence; None for a reliable estimate."""
    others: tuple[float, ...] = ()
    """Other delays with nearly the same explained share [s]."""
    at_end: bool = False
    """Whether the estimate is at the end of the searched range."""

    @property
    def proposed(self) -> float | None:
        """Proposed new offset [s]; None to keep the current one."""
        deviations, least = _WORTH_A_CHANGE
        off = abs(self.seconds - self.present)
        return None if self.problem or off < max(deviations * self.deviation, least) else round(self.seconds, 4)

    def sentence(self) -> str:
        """Result as a sentence."""
        if self.problem:
            return f"The delay between images and kinematics is unknown: {self.problem}"
        found = f"{self.seconds:.3f} s ± {self.deviation:.3f} s"
        if self.proposed is None:
            return f"The time offset of {self.present:.3f} s agrees with the motion, which gives {found}."
        return (
            f"Proposed: time_offset = {self.proposed:.3f} ({found}) instead of {self.present:.3f} s. It explains "
            f"{100 * self.explained:.0f} % of the motion in the images instead of "
            f"{max(100 * self.explained_now, 0.0):.0f} %."
        )


def estimate_time_offset(
    sequence: Sequence,
    camera: str | None = None,
    *,
    domain: str | None = None,
    largest: float = 0.5,
    progress: Callable[[int, int], None] | None = None,
) -> TimeOffsetEstimate:
    """Estimate the `time_offset` of a sequence from the motion in its images; the sequence is not changed.

    Args:
        sequence: sequence whose rows are matched with frames by time.
        camera: camera of the images; the first one by default.
        domain: domain of the images; the first one by default.
        largest: search range around the current offset [s]; widened to 3 s if the best offset is at its end.
        progress: called with the number of frames read, and the total.
    """
    present = sequence.checked_matching().time_offset
    assert sequence.timestamps is not None
    frames, steps = _chosen(sequence.timestamps)
    if len(steps) < _MIN_STEPS:
        return _unknown(present, f"there are {len(steps)} steps between frames; at least {_MIN_STEPS} are needed.")
    flows = _flows(sequence, camera or sequence.scene.cameras[0].name, domain, frames, steps, progress)
    if np.sqrt((flows**2).mean()) < _STILL:
        return _unknown(present, "nothing moves in the images.")
    delays = _Delays(sequence, sequence.timestamps, steps, flows)
    found = delays.estimate(present, largest)
    if largest < _WIDEST and (found.at_end or found.explained < _PLAIN):
        # Nearly periodic motion has several maxima.
        return delays.estimate(present, _WIDEST)
    return found


def _unknown(present: float, problem: str) -> TimeOffsetEstimate:
    return TimeOffsetEstimate(present, present, float("inf"), 0.0, 0.0, problem)


def _chosen(times: Float[np.ndarray, " frames"]) -> tuple[list[int], Float[np.ndarray, "steps 2"]]:
    """Frames to read, and pairs of neighbouring frames that are close enough in time."""
    count, long = len(times), len(times) > _MAX_FRAMES
    length = _MAX_FRAMES // _STRETCHES if long else count
    starts = np.linspace(0, count - length, _STRETCHES if long else 1).astype(int)
    frames = sorted({int(start) + index for start in starts for index in range(length)})
    pairs = [(a, b) for a, b in pairwise(frames) if b == a + 1]
    near = [(a, b) for a, b in pairs if 0.0 < times[b] - times[a] <= _MAX_STEP]
    return frames, np.array(near, int).reshape(-1, 2)


def _flows(
    sequence: Sequence,
    camera: str,
    domain: str | None,
    frames: list[int],
    steps: np.ndarray,
    progress: Callable[[int, int], None] | None,
) -> Float[np.ndarray, "steps outputs"]:
    """Mean flow of each step in each cell of a grid [px at `WIDTH`]."""
    found = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    wanted = {int(after) for _, after in steps}
    before: np.ndarray | None = None
    flows = []
    for done, index in enumerate(frames):
        image = sequence.frame(index, domain, [camera]).images[camera]
        height = max(32, round(image.shape[0] * WIDTH / image.shape[1]))
        now = cv2.cvtColor(cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
        if index in wanted and before is not None:
            flow = found.calc(before, now, np.zeros((*now.shape, 2), np.float32))
            flows.append(cv2.resize(flow, _CELLS, interpolation=cv2.INTER_AREA).ravel())
        before = now
        if progress is not None:
            progress(done + 1, len(frames))
    return np.array(flows, np.float64)


class _Delays:
    """Regression of flow on motion as a function of the delay."""

    def __init__(self, sequence: Sequence, times: np.ndarray, steps: np.ndarray, flows: np.ndarray) -> None:
        self._sequence, self._begin, self._end = sequence, times[steps[:, 0]], times[steps[:, 1]]
        largest = np.quantile(np.abs(flows), 0.995, axis=0)
        self._flows = np.clip(flows, -largest, largest)
        self._blocks = np.arange(len(steps)) * _BLOCKS // len(steps)
        self._bases: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def estimate(self, present: float, largest: float) -> TimeOffsetEstimate:
        """Estimate the offset within `largest` of the current offset [s]."""
        steps = round(largest / _GRID)
        grid = [present + step * _GRID for step in range(-steps, steps + 1)]
        tried = {offset: parts for offset in grid if (parts := self._parts(offset)) is not None}
        if not tried:
            return _unknown(present, "the table has no rows at the times of the frames.")
        if not next(iter(tried.values()))[0].size:
            return _unknown(present, "no joint moves in the table.")
        curve = {offset: _predicted(parts) for offset, parts in tried.items()}
        best = max(curve, key=lambda offset: curve[offset])
        seconds = self._refined(best, np.ones(_BLOCKS, bool))
        without = np.array([self._refined(seconds, np.arange(_BLOCKS) != left) for left in range(_BLOCKS)])
        deviation = float(np.sqrt((_BLOCKS - 1) / _BLOCKS * np.square(without - np.mean(without)).sum()))
        others = _as_good(curve, best)
        at_end = best - 1.5 * _GRID < min(curve) or best + 1.5 * _GRID > max(curve)
        return TimeOffsetEstimate(
            present,
            seconds,
            max(deviation, _MIN_DEVIATION),
            curve[best],
            curve.get(present, 0.0),
            _problem(curve[best], list(curve.values()), abs(best - present) > largest - 1.5 * _GRID, deviation, others),
            others,
            at_end,
        )

    def _refined(self, around: float, blocks: np.ndarray) -> float:
        """Refine an offset [s], using a subset of the blocks."""

        def unexplained(offset: float) -> float:
            parts = self._parts(offset)
            if parts is None:
                return 1.0
            XX, XY, YY = (part[blocks].sum(0) for part in parts)
            return 1.0 - float((XY * _fitted(XX, XY)).sum() / max(float(YY), 1e-12))

        bounds = around - 1.5 * _GRID, around + 1.5 * _GRID
        from scipy.optimize import minimize_scalar  # noqa: PLC0415  takes 0.3 s

        found: Any = minimize_scalar(unexplained, bounds=bounds, method="bounded", options={"xatol": 2e-4})
        return float(found.x)

    def _parts(self, offset: float) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Normal equations of motion X and flow Y at an offset, by block: X^T X, X^T Y, |Y|^2; None if rows are
        missing."""
        places, motion = self._motion(offset)
        there = np.asarray(np.isfinite(motion).all(1))
        if there.mean() < _MIN_KNOWN_FRACTION:
            return None
        if self._bases is None:
            # The normalization is the same for all offsets, so that they are comparable.
            middle = places[there].mean(0)
            postures = _basis(places[there] - middle)[:, :_POSTURES]
            self._bases = _basis(motion[there]), middle, postures
        moves, middle, postures = self._bases
        X, around = np.nan_to_num(motion) @ moves, np.nan_to_num(places - middle) @ postures
        # The flow caused by a motion depends on the posture of the arms; a linear dependence is modelled.
        X = np.concatenate([X, *(X * posture[:, None] for posture in around.T)], 1)
        Y = np.where(there[:, None], self._flows, 0.0)
        inside = [self._blocks == block for block in range(_BLOCKS)]
        return (
            np.stack([X[rows].T @ X[rows] for rows in inside]),
            np.stack([X[rows].T @ Y[rows] for rows in inside]),
            np.array([np.square(Y[rows]).sum() for rows in inside]),
        )

    def _motion(self, offset: float) -> tuple[Float[np.ndarray, "steps inputs"], Float[np.ndarray, "steps inputs"]]:
        """Positions of link points, and motion of link points and camera mounts in each step [m]; NaN if not logged."""
        begin, end = (self._sequence.logged_at(times + offset) for times in (self._begin, self._end))
        places, moved = [], []
        for arm in self._sequence.scene.arms:
            first, last = (_points(arm.robot, at.joints[arm.name]) for at in (begin, end))
            places.append(0.5 * (first + last))
            moved.append(last - first)
        for camera in begin.mounts:
            Ts = np.linalg.inv(begin.mounts[camera]) @ end.mounts[camera]
            rotations = np.stack([Ts[:, 2, 1], Ts[:, 0, 2], Ts[:, 1, 0]], 1)
            moved.append(np.concatenate([Ts[:, :3, 3], _LEVER * rotations], 1))
        return np.concatenate(places, 1), np.concatenate(moved, 1)


def _as_good(curve: dict[float, float], best: float) -> tuple[float, ...]:
    """Other local maxima of the explained share that are nearly as high, as for periodic motion."""
    offsets = sorted(curve)
    shares = [curve[offset] for offset in offsets]
    peaks = [
        offset
        for index, offset in enumerate(offsets[1:-1], start=1)
        if shares[index] >= max(shares[index - 1], shares[index + 1])
    ]
    enough = curve[best] - _EQUAL * abs(curve[best])
    return tuple(offset for offset in peaks if abs(offset - best) > _APART and curve[offset] >= enough)


def _basis(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "columns directions"]:
    """Whitened principal directions of the rows."""
    _, sizes, directions = np.linalg.svd(values, full_matrices=False)
    kept = sizes**2 > _KEPT * sizes[0] ** 2
    return directions[kept].T / (sizes[kept] / np.sqrt(len(values)))


def _points(robot: Robot, joints: Float[np.ndarray, "rows dofs"]) -> Float[np.ndarray, "rows coordinates"]:
    """Centres of the links in the arm's base frame [m]."""
    Ts = robot.forward_kinematics(np.nan_to_num(joints))
    middles = [Ts[:, mesh.link, :3, :3] @ mesh.vertices.mean(0) + Ts[:, mesh.link, :3, 3] for mesh in robot.meshes]
    return np.where(np.isfinite(joints).all(1, keepdims=True), np.concatenate(middles, 1), np.nan)


def _predicted(parts: tuple[np.ndarray, np.ndarray, np.ndarray]) -> float:
    """Share of the flow explained in cross-validation over blocks; negative if worse than no prediction [1]."""
    XX, XY, YY = parts
    unexplained = 0.0
    for left in range(_BLOCKS):
        others = np.arange(_BLOCKS) != left
        B = _fitted(XX[others].sum(0), XY[others].sum(0))
        unexplained += float(YY[left] - 2 * (XY[left] * B).sum() + (B * (XX[left] @ B)).sum())
    return 1.0 - unexplained / max(float(YY.sum()), 1e-12)


def _fitted(XX: np.ndarray, XY: np.ndarray) -> np.ndarray:
    return np.linalg.solve(XX + _RIDGE * np.trace(XX) / len(XX) * np.eye(len(XX)), XY)


def _problem(
    explained: float, curve: list[float], at_end: bool, deviation: float, others: tuple[float, ...]
) -> str | None:
    if explained < _MIN_EXPLAINED or explained - float(np.median(curve)) < _MIN_GAIN:
        return "the motion of the arms does not explain the motion in the images. Check columns, signs and units."
    if at_end:
        return "the best delay is at the end of the search range. Give a larger range, or check the clocks."
    if others:
        listed = ", ".join(f"{offset:.2f} s" for offset in others[:3])
        return f"other delays are as good ({listed}), as for periodic motion. Use a part with other motion."
    if deviation > _MAX_DEVIATION:
        return f"the delays of parts of the recording differ (± {deviation:.2f} s). Check the clocks."
    return None
