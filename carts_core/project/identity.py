"""Which recording a project belongs to: enough to tell recordings apart, and what its edits may refer to."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..files.reading import SEQUENCE, TABLE, parse_toml, read_text
from ..wording import counted

if TYPE_CHECKING:
    from ..recording import Sequence


@dataclass(frozen=True)
class SequenceIdentity:
    """What stays the same when a recording is moved, or when its calibration or its name are corrected in its file."""

    name: str = field(compare=False)
    """For people."""
    frame_ids: tuple[str, ...]
    arms: Mapping[str, tuple[str, ...]]
    """Arm -> names of its joints, in the robot's order."""
    cameras: Mapping[str, tuple[int, int]]
    """Camera -> (width, height) of its images [px]."""
    kinematics_sha256: str
    """Of the kinematics tables as they lie on disk, line ends aside."""

    @staticmethod
    def of(sequence: "Sequence") -> "SequenceIdentity":
        """The identity of an open sequence; reads its kinematics tables once more."""
        return SequenceIdentity(
            name=sequence.name,
            frame_ids=tuple(sequence.frame_ids),
            arms={arm.name: tuple(arm.robot.joint_names) for arm in sequence.scene.arms},
            cameras={camera.name: (camera.width, camera.height) for camera in sequence.scene.cameras},
            kinematics_sha256=_kinematics_sha256(Path(sequence.path)),
        )

    def to_json(self) -> str:
        """As text; `from_json` reads it."""
        # `dataclasses.asdict` would copy every frame's id.
        return json.dumps(vars(self))

    @staticmethod
    def from_json(text: str) -> "SequenceIdentity":
        """What `to_json` wrote.

        Raises:
            ValueError, TypeError, KeyError: it is something else.
        """
        values: dict[str, Any] = json.loads(text)
        return SequenceIdentity(
            name=values["name"],
            frame_ids=tuple(values["frame_ids"]),
            arms={name: tuple(joints) for name, joints in values["arms"].items()},
            cameras={name: (int(width), int(height)) for name, (width, height) in values["cameras"].items()},
            kinematics_sha256=values["kinematics_sha256"],
        )

    def difference(self, other: "SequenceIdentity") -> str | None:
        """In words, the first thing in which `other` is another recording; None if it is the same."""
        if len(self.frame_ids) != len(other.frame_ids):
            return f"{counted(len(self.frame_ids), 'frame')} against {len(other.frame_ids)}"
        for index, (own, others) in enumerate(zip(self.frame_ids, other.frame_ids, strict=True)):
            if own != others:
                return f"frame number {index} is called {own!r} against {others!r}"
        if self.arms != other.arms:
            return f"arms {_list(self.arms)} against {_list(other.arms)}"
        if self.cameras != other.cameras:
            return f"cameras {_list(self.cameras)} against {_list(other.cameras)}"
        if self.kinematics_sha256 != other.kinematics_sha256:
            return "the kinematics tables differ"
        return None


def _list(parts: Mapping[str, tuple]) -> str:
    return ", ".join(f"{name} ({' '.join(str(value) for value in values)})" for name, values in parts.items())


def _kinematics_sha256(sequence_file: Path) -> str:
    root = parse_toml(read_text(sequence_file, SEQUENCE))
    tables = [root["kinematics"]["table"], *(arm["table"] for arm in root["arms"] if arm.get("table"))]
    digest = hashlib.sha256()
    for table in tables:
        text = read_text(sequence_file.parent / table, TABLE)
        digest.update("\n".join([*text.splitlines(), ""]).encode())
    return digest.hexdigest()
