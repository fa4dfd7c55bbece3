"""What is exported of each frame."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from jaxtyping import Bool, UInt8
from numpy import ndarray

from ..errors import SequenceError
from ..recording import Sequence
from .kinematics import KinematicsRow


@dataclass(frozen=True)
class ExportFrame(KinematicsRow):
    """One frame: which one, where the arms are, who says so, and masks where somebody corrected them."""

    index: int = field(kw_only=True)
    """0-based position in the sequence."""
    review: str | None = field(default=None, kw_only=True)
    """What a person said of the frame, such as accepted; None where nobody could."""
    dice: float | None = field(default=None, kw_only=True)
    """Dice with the masks that the recording has, the least of its cameras [1]; None where not known."""
    masks: Mapping[str, Bool[ndarray, "height width"]] = field(default_factory=dict, kw_only=True)
    """Camera -> where arms are visible, at the camera's size; a camera without an entry gets the rendered mask."""
    part_labels: Mapping[str, UInt8[ndarray, "height width"]] = field(default_factory=dict, kw_only=True)
    """Camera -> number of the class (`carts_core.model.parts.PartClass`) that a pixel was painted as, 0 for none. What
    was painted belongs to that part whatever is rendered there, and to the mask."""


def measured_frames(sequence: Sequence, indices: Iterable[int]) -> list[ExportFrame]:
    """Frames with the joint positions that the sequence measured."""
    return [
        ExportFrame(
            sequence.frame_ids[index],
            "measured",
            {arm: positions[index] for arm, positions in sequence.measured.items()},
            index=index,
        )
        for index in indices
    ]


def corrected_frames(sequence: Sequence, indices: Iterable[int], rows: Iterable[KinematicsRow]) -> list[ExportFrame]:
    """Those of the frames `indices` that have a row, with its joint positions.

    Raises:
        SequenceError: a row is of a frame that the sequence does not have, or two are of the same.
    """
    known = set(sequence.frame_ids)
    by_id: dict[str, KinematicsRow] = {}
    for row in rows:
        if row.frame_id not in known:
            raise SequenceError(
                f"the kinematics are of frame {row.frame_id!r}, which {sequence.path} does not have. "
                "Give the table that was made from this sequence."
            )
        if row.frame_id in by_id:
            raise SequenceError(f"the kinematics have frame {row.frame_id!r} twice. Remove one of the rows.")
        by_id[row.frame_id] = row
    chosen = ((index, by_id[sequence.frame_ids[index]]) for index in indices if sequence.frame_ids[index] in by_id)
    return [
        ExportFrame(row.frame_id, row.source, row.joint_positions, row.joint_std, row.verdict, index=index)
        for index, row in chosen
    ]
