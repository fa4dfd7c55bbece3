"""Immutable snapshots of a project's state, queries for frames to review, and corrected recordings."""

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from ..model.scene import Scene, SceneState
from ..recording import Frame, Sequence
from .identity import SequenceIdentity
from .values import (
    CALIBRATION,
    UNREVIEWED,
    WHOLE_PROJECT,
    Edits,
    Figures,
    FitVerdict,
    JointCorrection,
    Key,
    Kind,
    Review,
    ReviewState,
    Source,
    check_edit,
)

V = TypeVar("V")


@dataclass(frozen=True)
class Step:
    """One undo step."""

    number: int
    """Step number, from 1 without gaps."""
    name: str
    time: float
    """Time of the step [s since 1970]."""


@dataclass(frozen=True)
class ExportRecord:
    """One finished export."""

    time: float
    """Time of completion [s since 1970]."""
    format: str
    path: str
    frames: int
    """Number of exported frames."""
    settings: str
    """Settings of the export, as JSON text."""


@dataclass(frozen=True)
class Entry:
    """Value, and the step that set it; the value is None if the step removed it."""

    step: int
    value: Any


@dataclass(frozen=True)
class Record:
    """Values of one frame, or of the whole project."""

    entries: Mapping[Key[Any], Entry]
    """Values that differ or have differed from the sequence."""
    figures: Mapping[int, Figures]
    """Quality figures by revision; see `ProjectState.revision`."""

    # Computed once per record. Successive states share records, so queries over all frames recompute few of them.
    @cached_property
    def review(self) -> Review:
        """Review state and note. Without a manual review, the state depends on the source of the joint positions."""
        said = next(self._values(Kind.REVIEW), Review())
        if said.state not in UNREVIEWED:
            return said
        return replace(said, state=ReviewState.OPTIMIZED if self._optimized else ReviewState.UNTOUCHED)

    @cached_property
    def sources(self) -> frozenset[Source]:
        """Sources of the corrected joint positions."""
        return frozenset(correction.provenance.source for correction in self._values(Kind.JOINTS))

    @cached_property
    def _optimized(self) -> bool:
        """Whether the joint positions are the result of an optimizer run; copied positions have no settings."""
        made = [correction.provenance for correction in self._values(Kind.JOINTS)]
        by_hand = any(one.source is Source.HAND for one in made)
        return not by_hand and any(one.settings is not None for one in made)

    @cached_property
    def is_keyframe(self) -> bool:
        """See `ProjectState.is_keyframe`."""
        return next((said.held for said in self._values(Kind.KEYFRAME)), Source.HAND in self.sources)

    @cached_property
    def is_kept(self) -> bool:
        """Whether propagation must not change the frame: a keyframe, or a manually accepted frame."""
        return self.is_keyframe or self.review.state is ReviewState.ACCEPTED

    def _values(self, kind: Kind) -> Iterator[Any]:
        return (e.value for key, e in self.entries.items() if key.kind is kind and e.value is not None)


_EMPTY = Record({}, {})
_MARKS = (Kind.KEYFRAME, Kind.REVIEW, Kind.VERDICT, Kind.IMPORTED_KEYPOINTS, Kind.IMPORTED_LABELS)
"""Kinds that describe frames and do not affect the fit of arms."""
_ACCEPTED = ReviewState.ACCEPTED
_ACCEPTED_WITH = {Kind.JOINTS, Kind.MASK_CORRECTION, Kind.PART_LABELS, *CALIBRATION}
"""Kinds that invalidate an acceptance when they change."""


@dataclass(frozen=True, eq=False)
class ProjectState:
    """Immutable snapshot of a project."""

    identity: SequenceIdentity
    steps: tuple[Step, ...] = ()
    """History, oldest step first; steps after `position` are undone and can be redone."""
    position: int = 0
    """Number of steps in effect."""
    records: Mapping[int, Record] = field(default_factory=dict)
    """Frame -> record; an edit copies only this mapping and the affected records."""
    exports: tuple[ExportRecord, ...] = ()

    def get(self, key: Key[V]) -> V | None:
        """Value of a key; None if the value of the sequence applies."""
        entry = self._record(key.frame).entries.get(key)
        return None if entry is None else entry.value

    def changed(self, edits: Edits) -> dict[Key[Any], Any]:
        """Edits that change values. A given verdict equal to the stored one is included if it is outdated, or if the
        inputs of its frame's fit change.

        Changing an accepted frame withdraws its acceptance in the same step, unless an edit sets its review.
        """
        changed = {key: value for key, value in edits.items() if self.get(key) != value}
        moved = {key.frame for key in changed if key.kind not in _MARKS}
        for key, value in edits.items():
            if (
                key.kind is Kind.VERDICT
                and value is not None
                and (key.frame in moved or self.verdict(key.frame) != value)
            ):
                changed[key] = value
        return {**changed, **{key: review for key, review in self._withdrawn(changed).items() if key not in edits}}

    def _withdrawn(self, changed: Edits) -> dict[Key[Any], Any]:
        """Reviews that withdraw the acceptance of frames affected by these changes."""
        frames = {key.frame for key in changed if key.kind in _ACCEPTED_WITH}
        if WHOLE_PROJECT in frames:
            frames = set(self.records) - {WHOLE_PROJECT}
        reviews = {frame: self.review(frame) for frame in frames}
        open_ones = {i: replace(r, state=ReviewState.UNTOUCHED) for i, r in reviews.items() if r.state is _ACCEPTED}
        return {Key.review(i): None if review == Review() else review for i, review in open_ones.items()}

    def values(self, kind: Kind) -> dict[Key[Any], Any]:
        """All values of one kind."""
        entries = (item for record in self.records.values() for item in record.entries.items())
        return {key: entry.value for key, entry in entries if key.kind is kind and entry.value is not None}

    def joints(self, frame: int) -> dict[str, JointCorrection]:
        """Corrected joint positions of a frame by arm."""
        found = {arm: self.get(Key.joints(frame, arm)) for arm in self.identity.arms}
        return {arm: correction for arm, correction in found.items() if correction is not None}

    def same_calibration(self, other: "ProjectState") -> bool:
        """Whether the values of the whole project, such as base frames, are unchanged between two states."""
        return self.records.get(WHOLE_PROJECT) is other.records.get(WHOLE_PROJECT)

    def same_pose(self, other: "ProjectState", frame: int) -> bool:
        """Whether the joint positions of a frame and the calibration are unchanged between two states."""
        return self.joints(frame) == other.joints(frame) and self.same_calibration(other)

    def review(self, frame: int) -> Review:
        """Review state and note of a frame; see `Record.review`."""
        return self._record(frame).review

    def verdict(self, frame: int) -> FitVerdict | None:
        """Verdict on a frame's fit; None if the fit has changed since then."""
        entry = self._record(frame).entries.get(Key.verdict(frame))
        return None if entry is None or entry.step < self.revision(frame) else entry.value

    def entry_at_last_change(self, key: Key[V], value: V) -> Entry:
        """Entry for a value that is assigned to the step that last changed its frame, so that undo affects both."""
        known = self._record(key.frame).entries.get(key)
        return Entry(max(self.revision(key.frame), 0 if known is None else known.step), value)

    def is_keyframe(self, frame: int) -> bool:
        """Whether the frame is a keyframe, by the user's choice or, by default, because its joint positions were set
        manually."""
        return self._record(frame).is_keyframe

    @cached_property
    def kept_frames(self) -> tuple[int, ...]:
        """Sorted frames that propagation must not change: keyframes and manually accepted frames."""
        return tuple(sorted(i for i, record in self.records.items() if i != WHOLE_PROJECT and record.is_kept))

    def figures(self, frame: int) -> Figures | None:
        """Quality figures of a frame; None if the frame has changed since their computation."""
        return self._record(frame).figures.get(self.revision(frame))

    def revision(self, frame: int) -> int:
        """Last step that changed the inputs of the frame's figures; 0 without such a step."""
        entries = self._record(frame).entries.items()
        own = max((entry.step for key, entry in entries if key.kind not in _MARKS), default=0)
        return max(own, self._calibration_revision)

    def regained(
        self, past: "ProjectState", edits: Edits
    ) -> tuple[dict[Key[FitVerdict], FitVerdict], dict[int, Figures]]:
        """Verdicts and figures of the frames that edits restore to an earlier state."""
        after = self.after(Step(self.position + 1, "", 0.0), edits)
        changed = {key.frame for key in edits if key.kind not in _MARKS}
        frames = set(past.records) - {WHOLE_PROJECT} if WHOLE_PROJECT in changed else changed
        same = [frame for frame in sorted(frames) if after._fitted(frame) == past._fitted(frame)]
        verdicts = {Key.verdict(frame): past.verdict(frame) for frame in same}
        figures = {frame: past.figures(frame) for frame in same}
        return (
            {key: verdict for key, verdict in verdicts.items() if verdict is not None},
            {frame: known for frame, known in figures.items() if known is not None},
        )

    def _fitted(self, frame: int) -> dict[Key[Any], Any]:
        """Values that affect a frame's verdict and figures."""
        entries = (*self._record(frame).entries.items(), *self._record(WHOLE_PROJECT).entries.items())
        return {key: e.value for key, e in entries if key.kind not in _MARKS and e.value is not None}

    @property
    def undoable(self) -> Step | None:
        """Step that `Project.undo` undoes, or None."""
        return self.steps[self.position - 1] if self.position else None

    @property
    def redoable(self) -> Step | None:
        """Step that `Project.redo` redoes, or None."""
        return self.steps[self.position] if self.position < len(self.steps) else None

    def after(self, step: Step, edits: Edits) -> "ProjectState":
        """State after one more step, without redoable steps."""
        state = self
        if self.redoable is not None:
            records = {
                frame: Record(record.entries, {r: value for r, value in record.figures.items() if r <= self.position})
                for frame, record in self.records.items()
            }
            state = replace(self, steps=self.steps[: self.position], records=records)
        changed = {key: Entry(step.number, value) for key, value in edits.items()}
        return replace(state.with_entries(changed), steps=(*state.steps, step), position=step.number)

    def with_entries(self, changed: Mapping[Key[Any], Entry | None]) -> "ProjectState":
        """State with entries replaced under these keys; None removes an entry."""
        by_frame: defaultdict[int, dict[Key[Any], Entry | None]] = defaultdict(dict)
        for key, entry in changed.items():
            by_frame[key.frame][key] = entry
        records = dict(self.records)
        for frame, entries in by_frame.items():
            record = self._record(frame)
            merged = {**record.entries, **entries}
            records[frame] = Record({key: e for key, e in merged.items() if e is not None}, record.figures)
        return replace(self, records=records)

    def with_figures(self, figures: Mapping[tuple[int, int], Figures]) -> "ProjectState":
        """State with figures added, by (frame, revision)."""
        records = dict(self.records)
        for (frame, revision), value in figures.items():
            record = records.get(frame, _EMPTY)
            records[frame] = Record(record.entries, {**record.figures, revision: value})
        return replace(self, records=records)

    @cached_property
    def _calibration_revision(self) -> int:
        entries = self._record(WHOLE_PROJECT).entries.items()
        return max((entry.step for key, entry in entries if key.kind not in _MARKS), default=0)

    def _record(self, frame: int) -> Record:
        return self.records.get(frame, _EMPTY)


def by_revision(state: ProjectState, figures: Mapping[int, Figures]) -> dict[tuple[int, int], Figures]:
    """Figures by frame and revision in this state; `ProjectError` for an unknown frame."""
    for frame in figures:
        check_edit(state.identity, Key.review(frame), None)
    return {(frame, state.revision(frame)): value for frame, value in figures.items()}


def step_at(state: ProjectState, number: int) -> tuple[Step, ...]:
    """The step with this number as a tuple; empty if it does not exist."""
    return state.steps[max(number - 1, 0) : number]


def frames_in(state: ProjectState, review_states: Collection[ReviewState]) -> list[int]:
    """Sorted indices of the frames in one of these review states."""
    return [index for index in range(len(state.identity.frame_ids)) if state.review(index).state in review_states]


def by_hand(state: ProjectState, frame: int) -> bool:
    """Whether the frame's arms were moved manually and the frame is not reviewed."""
    record = state.records.get(frame)
    untouched = record is not None and record.review.state is ReviewState.UNTOUCHED
    return record is not None and untouched and Source.HAND in record.sources


def next_unreviewed(state: ProjectState, after: int, step: int = 1, within: range | None = None) -> int | None:
    """Next frame without review, cyclically; None if all frames are reviewed.

    Args:
        after: index of the current frame, which is considered last.
        step: 1 forwards, -1 backwards.
        within: range to search, which contains the current frame; None for all frames.
    """
    frames = within or range(len(state.identity.frame_ids))
    place = after - frames.start
    around = (frames[(place + step * offset) % len(frames)] for offset in range(1, len(frames) + 1))
    return next((index for index in around if state.review(index).state in UNREVIEWED), None)


def between_kept(state: ProjectState, frame: int, within: range | None = None) -> range:
    """Range between the neighbouring kept frames, inclusive; see `ProjectState.kept_frames`.

    Without a neighbouring kept frame, the range extends to the first or last frame of the sequence, or of `within` if
    it contains the frame.
    """
    frames = range(len(state.identity.frame_ids)) if within is None or frame not in within else within
    kept = [index for index in state.kept_frames if index in frames]
    before, after = bisect_left(kept, frame), bisect_right(kept, frame)
    first = kept[before - 1] if before else frames[0]
    last = kept[after] if after < len(kept) else frames[-1]
    return range(first, last + 1)


def worst_first(state: ProjectState, frames: Iterable[int] | None = None) -> list[int]:
    """Frames, by default all, sorted from the worst to the best fit; frames without a measure come last, in order.

    The measure is 1 - Dice if any frame has a Dice, else the probability of failure if any frame has a verdict, else
    the loss.
    """
    indices = list(range(len(state.identity.frame_ids)) if frames is None else frames)
    dice, failure, loss = {}, {}, {}
    for index in indices:
        figures, verdict = state.figures(index), state.verdict(index)
        if verdict is not None:
            failure[index] = verdict.failure
        if figures is not None and figures.dice is not None:
            dice[index] = 1.0 - figures.dice
        if figures is not None and figures.loss is not None:
            loss[index] = figures.loss
    judged = dice or failure or loss
    return sorted(indices, key=lambda index: -judged.get(index, -math.inf))


_SOURCE_ORDER = (Source.HAND, Source.PROPAGATED, Source.OPTIMIZER, Source.MEASURED)
"""Precedence of sources for a frame whose arms have different sources."""


def corrected_sequence(sequence: Sequence, project: ProjectState) -> Sequence:
    """Recording with the project's time offset, calibration and joint positions; `SequenceError` if a frame has no
    matching table row."""
    offset = project.get(Key.time_offset())
    if offset is not None and sequence.matching is not None and offset.seconds != sequence.matching.time_offset:
        sequence = sequence.with_time_offset(offset.seconds)
    measured = {name: rows.copy() for name, rows in sequence.measured.items()}
    for index in project.records.keys() & set(range(len(sequence))):
        for name, found in project.joints(index).items():
            measured[name][index] = found.joint_positions
    return sequence.corrected(calibrated_scene(sequence.scene, project), measured)


def calibrated_scene(scene: Scene, project: ProjectState) -> Scene:
    """Scene with the project's corrected base frames, extrinsics and intrinsics."""
    arms, cameras = [], []
    for arm in scene.arms:
        base = project.get(Key.base_frame(arm.name))
        arms.append(arm if base is None else replace(arm, T_world_base=np.array(base.transform)))
    for camera in scene.cameras:
        extrinsics, intrinsics = project.get(Key.extrinsics(camera.name)), project.get(Key.intrinsics(camera.name))
        moved = camera if extrinsics is None else replace(camera, T_camera_world=np.array(extrinsics.transform))
        cameras.append(moved if intrinsics is None else replace(moved, intrinsics=intrinsics.intrinsics))
    return replace(scene, arms=tuple(arms), cameras=tuple(cameras))


def source_of(project: ProjectState, frame: int) -> Source:
    """Source of the joint positions of a frame."""
    sources = {correction.provenance.source for correction in project.joints(frame).values()}
    return next((source for source in _SOURCE_ORDER if source in sources), Source.MEASURED)


def corrected_state(scene: Scene, frame: Frame, project: ProjectState) -> SceneState:
    """State of a frame under the project's calibration, with corrected joint positions if available, else measured
    joint positions."""
    measured = {name: frame.measured[name] for name in project.identity.arms}
    corrected = {name: found.joint_positions for name, found in project.joints(frame.index).items()}
    return calibrated_scene(scene, project).state({**measured, **corrected}, device=None, mounts=frame.mounts)
