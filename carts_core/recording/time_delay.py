"""Estimation of the delay between images and kinematics from their common motion.

Optical flow between two frames is nearly a linear function of the motion of points of the arms between the same times,
for any hand-eye calibration. Flow is regressed on motion at many delays, without camera poses or a network. The
estimate is the delay with the largest explained share; its standard deviation is computed by the jackknife over parts
of the recording. Arms whose delays differ are estimated by coordinate ascent, each given the motion of the others.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from .matching import at_times, neighbours
from .sequence import Sequence

WIDTH = 192
"""Width at which images are compared [px]."""
LARGEST = 3.0
"""Default half-width of the search range [s]."""
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
_NEAR = 0.05
"""Half-width of the range of the refinement around a delay [s]."""
_EQUAL, _SIMILAR = 0.1, 0.25
"""Maximum relative excess of unexplained flow of equally good delays, and of candidates before all predictors are
used."""
_MIN_SHARE = 0.5
"""Minimum explained share of such a delay, as a fraction of that of the best delay."""
_APART = 0.15
"""Minimum distance of equally good delays [s]."""
_SIGNIFICANT = 2.0
"""Minimum gain by separate clocks, in standard errors of the mean over blocks."""
_ROUNDS = 4
"""Maximum number of rounds of the coordinate ascent."""
_KEPT = 1e-4
"""Share of the maximum variance below which a direction of motion is ignored."""
_POSTURES = 3
"""Number of principal directions of link positions that modulate the flow."""
_RIDGE = 1e-2
"""Weight of the ridge penalty on regression coefficients, relative to the mean diagonal entry of X^T W X [1]."""
_SPARE = 2.0
"""Time before and after the search range for which rows are used [s]."""
_LEVER = 0.1
"""Lever arm by which rotations of a camera are converted to lengths [m]."""
_MIN_KNOWN_FRACTION = 0.5
"""Minimum share of the steps with logged rows."""
_STILL = 0.02
"""Minimum root mean square of the flow that counts as motion [px at `WIDTH`]."""
_MIN_EXPLAINED, _MIN_GAIN = 0.15, 0.1
"""Minimum share of flow explained by the best delay, and its minimum relative reduction of the unexplained share
compared with the median over the delays."""
_MAX_DEVIATION = 0.02
"""Maximum standard deviation of a reliable estimate [s]: half of a frame interval at 25 frames/s."""
_MIN_DEVIATION = 0.001
"""Lower bound of the reported standard deviation [s]."""
_WORTH_A_CHANGE = 3.0, 0.008
"""Minimum proposed change of the delay, in standard deviations and in seconds."""


@dataclass(frozen=True)
class TimeOffsetEstimate:
    """Estimated time offset of all tables, or of one arm."""

    present: float
    """Current offset [s]."""
    seconds: float
    """Estimated offset [s]."""
    deviation: float
    """Standard deviation of the estimate [s]."""
    explained: float
    """Share of the flow in held-out blocks explained by the estimate [1]; for one arm, of the flow that the motion of
    the others does not explain."""
    explained_now: float
    """Share explained by the current offset; negative if worse than no prediction [1]."""
    problem: str | None
    """Reason why the estimate is unreliable, as a sentence; None for a reliable estimate."""
    others: tuple[float, ...] = ()
    """Other delays with nearly the same explained share [s], the best first."""
    arm: str = ""
    """Arm with an offset of its own; empty for all tables."""
    alone: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Arm -> offsets that fit equally well if the arm has a separate clock [s], for an estimate of all tables."""

    @property
    def proposed(self) -> float | None:
        """Proposed new offset [s]; None to keep the current one."""
        deviations, least = _WORTH_A_CHANGE
        off = abs(self.seconds - self.present)
        return None if self.problem or off < max(deviations * self.deviation, least) else round(self.seconds, 4)

    @property
    def choices(self) -> dict[str, tuple[float, ...]]:
        """Equally good offsets [s] of all tables, under the empty name, and of arms; empty without ambiguity."""
        return {**({self.arm: (self.seconds, *self.others)} if self.others else {}), **self.alone}

    def sentence(self) -> str:
        """Result as a sentence."""
        of, about = (f" of {self.arm}", f"{self.arm}: ") if self.arm else ("", "")
        alone = "; ".join(f"{arm} {_listed(offsets)}" for arm, offsets in self.alone.items())
        alone = f" With a clock of its own, an arm could also have another offset: {alone}." if alone else ""
        if self.problem:
            return f"The delay between images and kinematics{of} is unknown: {self.problem}{alone}"
        found = f"{self.seconds:.3f} s ± {self.deviation:.3f} s"
        if self.proposed is None:
            text = f"The time offset{of} of {self.present:.3f} s agrees with the motion, which gives {found}."
            return f"{text}{alone}"
        return (
            f"{about}Proposed: time_offset = {self.proposed:.3f} ({found}) instead of {self.present:.3f} s. It "
            f"explains {100 * self.explained:.0f} % of the motion in the images instead of "
            f"{max(100 * self.explained_now, 0.0):.0f} %.{alone}"
        )


def estimate_time_offsets(
    sequence: Sequence,
    camera: str | None = None,
    *,
    domain: str | None = None,
    largest: float = LARGEST,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[TimeOffsetEstimate, ...]:
    """Estimate the time offsets of a sequence from the motion in its images; the sequence is not changed.

    Args:
        sequence: sequence whose rows are matched with frames by time.
        camera: camera of the images; the first one by default.
        domain: domain of the images; the first one by default.
        largest: half-width of the search range around the current offset [s].
        progress: called with the number of frames read, and the total.

    Returns:
        One estimate for all tables, or one for each arm that moves if their offsets differ; then, an estimate without
        an arm is that of the motion of the cameras.
    """
    present = sequence.checked_matching().time_offset
    assert sequence.timestamps is not None
    camera = camera or sequence.scene.cameras[0].name
    frames, steps = _chosen(sequence.timestamps, sequence.frames_of(camera))
    if len(steps) < _MIN_STEPS:
        return _unknown(present, f"there are {len(steps)} steps between frames; at least {_MIN_STEPS} are needed.")
    flows = _flows(sequence, camera, domain, frames, steps, progress)
    if np.sqrt((flows**2).mean()) < _STILL:
        return _unknown(present, "nothing moves in the images.")
    return _Delays(sequence, steps, flows, largest).estimate()


def offsets_to_write(found: tuple[TimeOffsetEstimate, ...], sequence: Sequence) -> dict[str, float]:
    """Proposed values of `time_offset` [s]: of `[frames]` under the empty name, and of arms; empty to keep all."""
    if all(each.proposed is None for each in found):
        return {}
    new = {each.arm: each.present if each.proposed is None else each.proposed for each in found}
    shared = new.pop("", sequence.checked_matching().time_offset)
    return {"": shared, **{arm: round(seconds - shared, 4) for arm, seconds in new.items()}}


def _unknown(present: float, problem: str) -> tuple[TimeOffsetEstimate, ...]:
    return (TimeOffsetEstimate(present, present, float("inf"), 0.0, 0.0, problem),)


def _chosen(times: Float[np.ndarray, " frames"], recorded: list[int]) -> tuple[list[int], Int[np.ndarray, "steps 2"]]:
    """Frames to read, and pairs of neighbouring frames that are close enough in time.

    Args:
        times: time of each frame [s].
        recorded: frames with an image.
    """
    count, long = len(recorded), len(recorded) > _MAX_FRAMES
    length = _MAX_FRAMES // _STRETCHES if long else count
    starts = np.linspace(0, count - length, _STRETCHES if long else 1).astype(int)
    places = sorted({int(start) + index for start in starts for index in range(length)})
    pairs = [(recorded[a], recorded[b]) for a, b in pairwise(places) if b == a + 1]
    near = [(a, b) for a, b in pairs if 0.0 < times[b] - times[a] <= _MAX_STEP]
    return [recorded[place] for place in places], np.array(near, int).reshape(-1, 2)


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


class _Clock:
    """Motion of the arms and cameras whose logs share a clock, as predictors of flow."""

    def __init__(
        self, sequence: Sequence, arms: tuple[str, ...], cameras: tuple[str, ...], steps: np.ndarray, largest: float
    ) -> None:
        assert sequence.timestamps is not None
        self.name = "" if cameras or not arms else arms[0]
        self.present = sequence.checked_matching().time_offset + sum(sequence.arm_time_offsets[arm] for arm in arms)
        """Current time offset [s]."""
        self._sequence, self._cameras = sequence, cameras
        self._steps = [sequence.timestamps[steps[:, side]] + sequence.checked_matching().time_offset for side in (0, 1)]
        self._tables = [_link_points(sequence, arm, self._steps[0], largest + _SPARE) for arm in arms]
        self._bases: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        self._predictors: dict[float, tuple[list[np.ndarray], np.ndarray]] = {}

    def at(self, shift: float) -> tuple[list[Float[np.ndarray, "steps inputs"]], Bool[np.ndarray, " steps"]]:
        """Predictors of the flow at a shift from the current offset [s], and whether rows are logged then.

        The first predictors are those of a constant posture.
        """
        if shift not in self._predictors:
            self._predictors[shift] = self._computed(shift)
        return self._predictors[shift]

    def _computed(self, shift: float) -> tuple[list[np.ndarray], np.ndarray]:
        places, motion = self._motion(shift)
        there = np.asarray(np.isfinite(motion).all(1))
        if there.mean() < _MIN_KNOWN_FRACTION:
            return [np.empty((len(there), 0))], np.zeros_like(there)
        if self._bases is None:
            # The normalization is the same for all offsets, so that they are comparable.
            middle = places[there].mean(0)
            postures = _basis(places[there] - middle)[:, :_POSTURES]
            self._bases = _basis(motion[there]), middle, postures
        moves, middle, postures = self._bases
        X, around = np.nan_to_num(motion) @ moves, np.nan_to_num(places - middle) @ postures
        # The flow caused by a motion depends on the posture of the arms; a linear dependence is modelled.
        return [X, *(X * posture[:, None] for posture in around.T)], there

    def _motion(self, shift: float) -> tuple[Float[np.ndarray, "steps inputs"], Float[np.ndarray, "steps inputs"]]:
        """Positions of link points, and motion of link points and camera mounts in each step [m]; NaN if not logged."""
        places, moved = [np.empty((len(self._steps[0]), 0))], []
        for times, points in self._tables:
            first, last = (at_times(at + shift, times, points) for at in self._steps)
            places.append(0.5 * (first + last))
            moved.append(last - first)
        if self._cameras:
            begin, end = (self._sequence.logged_at(at + shift).mounts for at in self._steps)
            for camera in self._cameras:
                Ts = np.linalg.inv(begin[camera]) @ end[camera]
                rotations = np.stack([Ts[:, 2, 1], Ts[:, 0, 2], Ts[:, 1, 0]], 1)
                moved.append(np.concatenate([Ts[:, :3, 3], _LEVER * rotations], 1))
        return np.concatenate(places, 1), np.concatenate(moved, 1)


class _Delays:
    """Regression of flow on motion, as a function of the shift of each clock from its current offset [s]."""

    def __init__(self, sequence: Sequence, steps: np.ndarray, flows: np.ndarray, largest: float) -> None:
        extreme = np.quantile(np.abs(flows), 0.995, axis=0)
        self._flows = np.clip(flows, -extreme, extreme)
        self._inside = [np.flatnonzero(np.arange(len(steps)) * _BLOCKS // len(steps) == n) for n in range(_BLOCKS)]
        count = round(largest / _GRID)
        self._grid, self._largest = [step * _GRID for step in range(-count, count + 1)], largest
        self._shared = sequence.checked_matching().time_offset
        arms, cameras = tuple(arm.name for arm in sequence.scene.arms), sequence.moving_cameras
        groups = [(arms, cameras)] if len(arms) == 1 else [*(((arm,), ()) for arm in arms), ((), cameras)]
        self._clocks = [_Clock(sequence, own, moving, steps, largest) for own, moving in groups if own or moving]

    def estimate(self) -> tuple[TimeOffsetEstimate, ...]:
        """One estimate for all clocks, or one for each that moves if their shifts differ."""
        every = [*range(len(self._clocks))]
        together = self._curve([0.0 for _ in every], every)
        if not together:
            return _unknown(self._shared, "the table has no rows at the times of the frames.")
        moving = [n for n in every if self._clocks[n].at(next(iter(together)))[0][0].size]
        if not moving:
            return _unknown(self._shared, "no joint moves in the table.")
        common = self._estimate([0.0 for _ in every], every, together)
        if len(moving) == 1:
            return (common,)
        same = common.seconds - common.present
        starts = (
            [same if n in moving else None for n in every],
            [self._alone(n) if n in moving else None for n in every],
        )
        shifts, _ = max((self._ascended(start, moving) for start in starts), key=lambda found: found[1])
        for n in moving * _ROUNDS:
            shifts[n] = None if shifts[n] is None else self._refined(shifts, [n], shifts[n] or 0.0)
        found = tuple(self._estimate(shifts, [n]) for n in moving)
        if _differ(found) and self._is_better(shifts, starts[0]):
            return found
        named = {}
        for n, each in zip(moving, found, strict=True):
            offsets, own = (each.seconds, *each.others), starts[1][n]
            known = (*offsets, common.seconds)
            # If the offset is ambiguous, the best one without the motion of the others is named, too.
            if common.others and own is not None and min(abs(self._shared + own - offset) for offset in known) > _APART:
                offsets = (*offsets, self._shared + self._refined([None] * len(every), [n], own))
            if len(offsets) > 1 or _differ((each, replace(common, explained=1.0))):
                named[each.arm] = offsets
        return (replace(common, alone=named),)

    def _is_better(self, shifts: list[float | None], others: list[float | None]) -> bool:
        """Whether shifts explain more of the flow than others: much more, or significantly in a paired test over
        held-out blocks."""
        own, other = self._compared(shifts, others)
        gain = other - own
        significant = float(gain.mean()) > _SIGNIFICANT * float(gain.std(ddof=1)) / np.sqrt(_BLOCKS)
        return significant or bool((1.0 + _EQUAL) * own.sum() < other.sum())

    def _alone(self, clock: int) -> float | None:
        """Best shift of a clock without the motion of the others."""
        curve = self._curve([None] * len(self._clocks), [clock])
        return _best(curve) if curve else None

    def _ascended(self, shifts: list[float | None], moving: list[int]) -> tuple[list[float | None], float]:
        """Coordinate ascent from shifts: the result, and its explained share."""
        shifts = list(shifts)
        for _ in range(_ROUNDS):
            before = list(shifts)
            for clock in moving:
                if curve := self._curve(shifts, [clock]):
                    shifts[clock] = _best(curve)
            if shifts == before:
                break
        return shifts, self._share(shifts)

    def _curve(self, shifts: list[float | None], moved: list[int]) -> dict[float, float]:
        """Share explained at each common shift of the clocks `moved`; without shifts at which most steps lack rows.

        Predictors are those of a constant posture: they are less accurate and less ambiguous in periodic motion.
        """
        shares = {shift: self._share(_with(shifts, moved, shift)) for shift in self._grid}
        return {shift: share for shift, share in shares.items() if np.isfinite(share)}

    def _share(self, shifts: list[float | None]) -> float:
        """Share of the flow in held-out blocks explained with a constant posture; minus infinity if most lack rows."""
        logged = self._logged(shifts)
        if logged.mean() < _MIN_KNOWN_FRACTION:
            return -np.inf
        parts = self._equations(shifts, logged.astype(float), constant=True)
        return 1.0 - float(_unexplained(*parts).sum()) / max(float(parts[2].sum()), 1e-12)

    def _estimate(
        self, shifts: list[float | None], moved: list[int], curve: dict[float, float] | None = None
    ) -> TimeOffsetEstimate:
        """Estimate of the common shift of the clocks `moved`, given the shifts of the others."""
        curve = curve or self._curve(shifts, moved)
        shift, *others = self._peaks(shifts, moved, curve)
        explained, now = (self._explained(shifts, moved, at) for at in (shift, 0.0))
        parts = np.array([self._refined(shifts, moved, shift, left) for left in range(_BLOCKS)])
        deviation = float(np.sqrt((_BLOCKS - 1) / _BLOCKS * np.square(parts - np.mean(parts)).sum()))
        clock = self._clocks[moved[0]] if len(moved) == 1 < len(self._clocks) else None
        present, arm = (self._shared, "") if clock is None else (clock.present, clock.name)
        gain = 1.0 - (1.0 - max(curve.values())) / (1.0 - float(np.median([*curve.values()])))
        at_end = abs(shift) > self._largest - 1.5 * _GRID
        as_good = tuple(present + other for other in others)
        problem = _problem(explained, gain, at_end, deviation, present + shift, as_good)
        deviation = max(deviation, _MIN_DEVIATION)
        return TimeOffsetEstimate(present, present + shift, deviation, explained, now, problem, as_good, arm)

    def _peaks(self, shifts: list[float | None], moved: list[int], curve: dict[float, float]) -> list[float]:
        """Refined common shifts that explain nearly the same share [s], the best first.

        Peaks of the curve are compared by the product of the unexplained flows with the predictors of a constant
        posture, which are less ambiguous in periodic motion, and with all predictors, whose model error is smaller, at
        common steps. The first is the peak that explains most at its own steps.
        """
        maxima = _maxima(curve)
        constant = self._ratios(shifts, moved, maxima, _best(curve), constant=True)
        enough = (1.0 + _SIMILAR) * min(constant)
        unexplained = {
            self._refined(shifts, moved, at): own for at, own in zip(maxima, constant, strict=True) if own <= enough
        }
        gains = {peak: self._explained(shifts, moved, peak) for peak in unexplained}
        best = max(gains, key=lambda peak: gains[peak])
        peaks = [peak for peak in gains if peak == best or gains[peak] >= _MIN_SHARE * gains[best]]
        ratios = self._ratios(shifts, moved, peaks, best)
        product = {peak: unexplained[peak] * ratio for peak, ratio in zip(peaks, ratios, strict=True)}
        enough = (1.0 + _EQUAL) * min(product.values())
        others = sorted((peak for peak in peaks if product[peak] <= enough), key=lambda peak: product[peak])
        peaks = list(dict.fromkeys([best, *others]))
        return [peak for n, peak in enumerate(peaks) if all(abs(peak - other) > _APART for other in peaks[:n])]

    def _ratios(
        self, shifts: list[float | None], moved: list[int], peaks: list[float], best: float, *, constant: bool = False
    ) -> list[float]:
        """Unexplained flow at each peak relative to that at `best`, over the steps with rows logged at both."""
        pairs = (
            self._compared(_with(shifts, moved, peak), _with(shifts, moved, best), constant=constant) for peak in peaks
        )
        return [float(own.sum() / max(other.sum(), 1e-12)) for own, other in pairs]

    def _explained(self, shifts: list[float | None], moved: list[int], at: float) -> float:
        """Share explained by the clocks `moved` at a common shift, of the flow that the others do not explain."""
        own, other = self._compared(_with(shifts, moved, at), _with(shifts, moved, None))
        return 1.0 - float(own.sum() / max(other.sum(), 1e-12)) if other.any() else -np.inf

    def _compared(
        self, shifts: list[float | None], others: list[float | None], *, constant: bool = False
    ) -> tuple[Float[np.ndarray, " blocks"], Float[np.ndarray, " blocks"]]:
        """Unexplained squared flow in held-out blocks at two sets of shifts, over the steps logged at both."""
        common = np.asarray(self._logged(shifts) & self._logged(others), float)
        own, other = (_unexplained(*self._equations(each, common, constant=constant)) for each in (shifts, others))
        return own, other

    def _refined(self, shifts: list[float | None], moved: list[int], around: float, left: int | None = None) -> float:
        """Refine a common shift by robust regression [s]; without one block of steps if given.

        The steps and their weights are the same at all shifts, because a step whose rows end within the range would
        cause a jump. Weights are those of the Cauchy loss, since the model errors of fast steps are large.
        """
        blocks = np.arange(_BLOCKS) != (-1 if left is None else left)
        logged = [self._logged(_with(shifts, moved, around + end)) for end in (-_NEAR, 0.0, _NEAR)]
        weights = self._weights(_with(shifts, moved, around), np.all(logged, axis=0))
        from scipy.optimize import minimize_scalar  # noqa: PLC0415  takes 0.3 s

        def explained(shift: float) -> float:
            XX, XY, _ = (part[blocks].sum(0) for part in self._equations(_with(shifts, moved, shift), weights))
            return -float((XY * _fitted(XX, XY)).sum())

        bounds = around - _NEAR, around + _NEAR
        found: Any = minimize_scalar(explained, bounds=bounds, method="bounded", options={"xatol": 2e-4})
        return float(found.x)

    def _logged(self, shifts: list[float | None]) -> Bool[np.ndarray, " steps"]:
        known = [clock.at(shift)[1] for clock, shift in zip(self._clocks, shifts, strict=True) if shift is not None]
        return np.all([np.ones(len(self._flows), bool), *known], axis=0)

    def _predictors(self, shifts: list[float | None], *, constant: bool = False) -> Float[np.ndarray, "steps inputs"]:
        found = [clock.at(shift)[0] for clock, shift in zip(self._clocks, shifts, strict=True) if shift is not None]
        none = np.empty((len(self._flows), 0))
        return np.concatenate([none, *(X for all_X in found for X in all_X[: 1 if constant else None])], 1)

    def _weights(self, shifts: list[float | None], steps: Bool[np.ndarray, " steps"]) -> Float[np.ndarray, " steps"]:
        """Cauchy weights of the given steps for the fit at some shifts; 0 for other steps."""
        X = self._predictors(shifts)
        XX, XY, _ = (part.sum(0) for part in self._equations(shifts, steps.astype(float)))
        errors = np.square(self._flows - X @ _fitted(XX, XY)).sum(1)
        return steps / (1.0 + errors / max(float(np.median(errors[steps])), 1e-12)) if steps.any() else 0.0 * errors

    def _equations(
        self, shifts: list[float | None], weights: Float[np.ndarray, " steps"], *, constant: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Normal equations of motion X and flow Y with weights W, by block: X^T W X, X^T W Y, trace(Y^T W Y).

        Args:
            constant: use only the predictors of a constant posture.
        """
        X, Y = self._predictors(shifts, constant=constant), self._flows
        XW, YW = X * weights[:, None], Y * weights[:, None]
        return (
            np.stack([X[rows].T @ XW[rows] for rows in self._inside]),
            np.stack([XW[rows].T @ Y[rows] for rows in self._inside]),
            np.array([(Y[rows] * YW[rows]).sum() for rows in self._inside]),
        )


def _with(shifts: list[float | None], moved: list[int], shift: float | None) -> list[float | None]:
    return [shift if clock in moved else own for clock, own in enumerate(shifts)]


def _best(curve: dict[float, float]) -> float:
    return max(curve, key=lambda shift: curve[shift])


def _differ(found: tuple[TimeOffsetEstimate, ...]) -> bool:
    """Whether shifts that the motion explains differ by more than a change that is worth proposing."""
    deviations, least = _WORTH_A_CHANGE
    known = [each for each in found if each.explained >= _MIN_EXPLAINED]
    return any(
        abs((a.seconds - a.present) - (b.seconds - b.present))
        > max(deviations * np.hypot(a.deviation, b.deviation), least)
        for a, b in combinations(known, 2)
    )


def _maxima(curve: dict[float, float]) -> list[float]:
    """Shifts at the maximum and at local maxima of the explained share."""
    best, shifts = _best(curve), sorted(curve)
    local = [
        at
        for low, at, high in zip(shifts, shifts[1:], shifts[2:], strict=False)
        if curve[at] >= max(curve[low], curve[high])
    ]
    return list(dict.fromkeys([best, *local]))


def _basis(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "columns directions"]:
    """Principal directions of the rows, in units of the largest standard deviation."""
    _, sizes, directions = np.linalg.svd(values, full_matrices=False)
    kept = sizes**2 > _KEPT * sizes[0] ** 2
    return directions[kept].T / (sizes[0] / np.sqrt(len(values)))


def _link_points(
    sequence: Sequence, arm: str, wanted: Float[np.ndarray, " steps"], reach: float
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows coordinates"]]:
    """Centres of the links of an arm in its base frame [m], and their times [s], within `reach` of query times [s]."""
    times, joints = sequence.logged_rows(arm)
    assert times is not None
    robot = sequence.scene.arm(arm).robot
    before, after = neighbours(wanted, times)
    near = np.minimum(np.abs(times - wanted[before]), np.abs(wanted[after] - times)) <= reach
    times, joints = times[near], joints[near]
    Ts = robot.forward_kinematics(joints)
    middles = [Ts[:, mesh.link, :3, :3] @ mesh.vertices.mean(0) + Ts[:, mesh.link, :3, 3] for mesh in robot.meshes]
    return times, np.concatenate(middles, 1)


def _unexplained(XX: np.ndarray, XY: np.ndarray, YY: np.ndarray) -> Float[np.ndarray, " blocks"]:
    """Squared flow [px^2] of each block that the fit to the other blocks does not explain."""
    B = _fitted(XX.sum(0) - XX, XY.sum(0) - XY)
    return YY - 2 * (XY * B).sum((1, 2)) + (B * (XX @ B)).sum((1, 2))


def _fitted(XX: np.ndarray, XY: np.ndarray) -> np.ndarray:
    size = XX.shape[-1]
    ridge = _RIDGE * np.trace(XX, axis1=-2, axis2=-1) / max(size, 1)
    return np.linalg.solve(XX + ridge[..., None, None] * np.eye(size), XY)


def _listed(offsets: tuple[float, ...]) -> str:
    return ", ".join(f"{offset:.3f} s" for offset in offsets)


def _problem(
    explained: float, gain: float, at_end: bool, deviation: float, seconds: float, others: tuple[float, ...]
) -> str | None:
    if explained < _MIN_EXPLAINED or gain < _MIN_GAIN:
        return "the motion of the arms does not explain the motion in the images. Check columns, signs and units."
    if at_end:
        return "the best delay is at the end of the search range. Give a larger range, or check the clocks."
    if others:
        listed = _listed((seconds, *others))
        return f"several delays are equally good ({listed}), as for periodic motion. Choose one of them."
    if deviation > _MAX_DEVIATION:
        return f"the delays of parts of the recording differ (± {deviation:.2f} s). Check the clocks."
    return None
