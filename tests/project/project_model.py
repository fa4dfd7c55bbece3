"""A small recording, edits of it, and a project that keeps everything in plain Python, to compare the real one with."""

import random
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from carts_core.project import (
    CorrectedIntrinsics,
    CorrectedTransform,
    Figures,
    IgnoreRegion,
    JointCorrection,
    Key,
    Keyframe,
    Kind,
    MaskCorrection,
    Project,
    ProjectState,
    Provenance,
    Review,
    ReviewState,
    SequenceIdentity,
    Source,
)

HAND = Provenance(Source.HAND)
OPTIMIZER = Provenance.made_by_optimizer({"solver": "adam", "iterations": 60}, "ab" * 32)
IDENTITY = SequenceIdentity(
    name="small",
    frame_ids=("001", "002", "003"),
    arms={"PSM1": ("yaw", "pitch", "insertion"), "PSM2": ("yaw", "pitch")},
    cameras={"left": (8, 6)},
    kinematics_sha256="0" * 64,
)
FRAMES = range(len(IDENTITY.frame_ids))


def _mask(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((6, 8)) < 0.4


def _moved(x: float) -> CorrectedTransform:
    return CorrectedTransform(((1, 0, 0, x), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)), HAND)


def _possible_edits() -> list[tuple[Key, Any]]:
    """Every key with each of a few values; few, so that edits often repeat or take back one another."""
    pairs: list[tuple[Key, Any]] = []
    for frame in FRAMES:
        for arm, joints in IDENTITY.arms.items():
            for number, provenance in enumerate((HAND, OPTIMIZER)):
                positions = tuple(0.1 * number + 1e-3 * joint for joint in range(len(joints)))
                pairs.append((Key.joints(frame, arm), JointCorrection(positions, provenance, positions)))
        pairs += [(Key.mask_correction(frame, "left"), MaskCorrection.of(_mask(seed), ~_mask(seed))) for seed in (1, 2)]
        pairs += [(Key.ignore_region(frame, "left"), IgnoreRegion.of(_mask(seed))) for seed in (3, 4)]
        pairs += [(Key.review(frame), Review(state, note)) for state in ReviewState for note in ("", "dünn\0 \ud800")]
        pairs += [(Key.keyframe(frame), Keyframe(held)) for held in (False, True)]
    for arm in IDENTITY.arms:
        pairs += [(Key.base_frame(arm), _moved(x)) for x in (0.1, 0.2)]
    pairs += [(Key.extrinsics("left"), _moved(0.3))]
    pairs += [(Key.intrinsics("left"), CorrectedIntrinsics((800.0, 800.0, cx, 3.0), HAND)) for cx in (4.0, 4.5)]
    keys = dict.fromkeys(key for key, _ in pairs)
    return pairs + [(key, None) for key in keys]


POSSIBLE_EDITS = _possible_edits()


@dataclass
class ProjectModel:
    """Expected content of a project: the complete state after every step."""

    snapshots: list[dict[Key, Any]] = field(default_factory=lambda: [{}])
    names: list[str] = field(default_factory=list)
    position: int = 0
    figures: dict[tuple[int, int], Figures] = field(default_factory=dict)
    exports: list[str] = field(default_factory=list)

    def apply(self, name: str, edits: Mapping[Key, Any], figures: Mapping[int, Figures] | None = None) -> None:
        """One gesture."""
        before = self.snapshots[self.position]
        after = {key: value for key, value in {**before, **edits}.items() if value is not None}
        after = {key: value for key, value in self._withdrawn(before, after, edits).items() if value is not None}
        if after == before:
            self.record_figures(figures or {})
            return
        self.snapshots[self.position + 1 :] = [after]
        self.names[self.position :] = [name]
        self.figures = {key: value for key, value in self.figures.items() if key[1] <= self.position}
        self.position += 1
        self.record_figures(figures or {})

    @staticmethod
    def _withdrawn(before: Mapping[Key, Any], after: Mapping[Key, Any], edits: Mapping[Key, Any]) -> dict[Key, Any]:
        """The state after an edit, without the acceptance of frames that it has changed."""
        seen = (Kind.JOINTS, Kind.MASK_CORRECTION, Kind.BASE_FRAME, Kind.EXTRINSICS, Kind.INTRINSICS)
        changed = {key.frame for key in {*before, *after} if before.get(key) != after.get(key) and key.kind in seen}
        result = dict(after)
        for frame in FRAMES if -1 in changed else changed:
            review = after.get(Key.review(frame))
            if review is not None and review.state is ReviewState.ACCEPTED and Key.review(frame) not in edits:
                result[Key.review(frame)] = Review(note=review.note) if review.note else None
        return result

    def go_to(self, position: int) -> None:
        """Undo or redo, as far as there is something."""
        self.position = min(max(position, 0), len(self.names))

    def record_figures(self, figures: Mapping[int, Figures]) -> None:
        """Figures of frames as they now are."""
        self.figures.update({(frame, self._revision(frame)): value for frame, value in figures.items()})

    def visible(self) -> dict[str, Any]:
        """Everything that can be read."""
        current = {frame: self.figures.get((frame, self._revision(frame))) for frame in FRAMES}
        return {
            "values": self.snapshots[self.position],
            "names": self.names,
            "position": self.position,
            "figures": {frame: value for frame, value in current.items() if value is not None},
            "exports": self.exports,
        }

    def _revision(self, frame: int) -> int:
        """The last step at which something that shows in the frame was different afterwards."""
        for step in range(self.position, 0, -1):
            if self._shown(step, frame) != self._shown(step - 1, frame):
                return step
        return 0

    def _shown(self, step: int, frame: int) -> dict[Key, Any]:
        marks = (Kind.REVIEW, Kind.KEYFRAME)
        shown = self.snapshots[step].items()
        return {key: value for key, value in shown if key.frame in (frame, -1) and key.kind not in marks}


def visible(state: ProjectState) -> dict[str, Any]:
    """The same of a real project."""
    current = {frame: state.figures(frame) for frame in FRAMES}
    return {
        "values": {key: value for kind in Kind for key, value in state.values(kind).items()},
        "names": [step.name for step in state.steps],
        "position": state.position,
        "figures": {frame: value for frame, value in current.items() if value is not None},
        "exports": [record.path for record in state.exports],
    }


def act(seed: int, number: int, target: Project | ProjectModel) -> None:
    """Do the random action of this number to a project or to a model."""
    rng = random.Random(f"{seed} {number}")
    what = rng.random()
    if what < 0.6:
        edits = dict(rng.choices(POSSIBLE_EDITS, k=rng.choice((1, 1, 1, 2, 30))))
        figures = {rng.choice(FRAMES): Figures(loss=rng.random())} if rng.random() < 0.5 else None
        target.apply(f"edit {number}", edits, figures)
    elif what < 0.85:
        move = rng.choice((-3, -1, -1, 1, 1, 2))
        if isinstance(target, Project):
            target.go_to(min(max(target.state.position + move, 0), len(target.state.steps)))
        else:
            target.go_to(target.position + move)
    elif what < 0.95:
        figures = {rng.choice(FRAMES): Figures(rng.random(), rng.random())}
        if isinstance(target, Project):
            target.record_figures(figures, target.state)
        else:
            target.record_figures(figures)
    elif isinstance(target, Project):
        target.log_export("coco", Path(f"out {number}"), 3, {"polygons": True})
    else:
        target.exports.append(f"out {number}")
