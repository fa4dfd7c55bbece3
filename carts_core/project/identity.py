"""Identity of a project's recording, and default path of its project file."""

import hashlib
import json
import os
import re
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..files.paths import home
from ..files.reading import SEQUENCE, TABLE, is_regular, parse_toml, read_text
from ..resources import sample_data_dir
from ..wording import counted

if TYPE_CHECKING:
    from ..recording import Sequence


@dataclass(frozen=True)
class SequenceIdentity:
    """Identity of a recording, independent of its location, calibration and name."""

    name: str = field(compare=False)
    """Name of the sequence."""
    frame_ids: tuple[str, ...]
    arms: Mapping[str, tuple[str, ...]]
    """Arm -> names of its joints, in the robot's order."""
    cameras: Mapping[str, tuple[int, int]]
    """Camera -> (width, height) of its images [px]."""
    kinematics_sha256: str
    """SHA-256 of the kinematics tables, independent of line endings."""

    @staticmethod
    def of(sequence: "Sequence") -> "SequenceIdentity":
        """Compute the identity of an open sequence; its kinematics tables are read again."""
        root = parse_toml(read_text(sequence.path, SEQUENCE))
        tables = [root["kinematics"]["table"], *(arm["table"] for arm in root["arms"] if arm.get("table"))]
        digest = hashlib.sha256()
        for table in tables:
            text = read_text(sequence.path.parent / table, TABLE)
            digest.update("\n".join([*text.splitlines(), ""]).encode())
        return SequenceIdentity(
            name=sequence.name,
            frame_ids=tuple(sequence.frame_ids),
            arms={arm.name: tuple(arm.robot.joint_names) for arm in sequence.scene.arms},
            cameras={camera.name: (camera.width, camera.height) for camera in sequence.scene.cameras},
            kinematics_sha256=digest.hexdigest(),
        )

    def to_json(self) -> str:
        """Encode the identity as JSON."""
        # `dataclasses.asdict` would copy every frame's id.
        return json.dumps(vars(self))

    @staticmethod
    def from_json(text: str) -> "SequenceIdentity":
        """Decode the result of `to_json`; `ValueError`, `TypeError` or `KeyError` for other strings."""
        values: dict[str, Any] = json.loads(text)
        return SequenceIdentity(
            name=values["name"],
            frame_ids=tuple(values["frame_ids"]),
            arms={name: tuple(joints) for name, joints in values["arms"].items()},
            cameras={name: (int(width), int(height)) for name, (width, height) in values["cameras"].items()},
            kinematics_sha256=values["kinematics_sha256"],
        )

    def difference(self, other: "SequenceIdentity") -> str | None:
        """First difference from `other`, as a clause; None for the same recording."""
        if len(self.frame_ids) != len(other.frame_ids):
            return f"{counted(len(self.frame_ids), 'frame')} in one and {len(other.frame_ids)} in the other"
        for index, (own, others) in enumerate(zip(self.frame_ids, other.frame_ids, strict=True)):
            if own != others:
                return f"frame number {index} is named {own!r} in one and {others!r} in the other"
        if self.arms != other.arms:
            return f"arms {_list(self.arms)} in one and {_list(other.arms)} in the other"
        if self.cameras != other.cameras:
            return f"cameras {_list(self.cameras)} in one and {_list(other.cameras)} in the other"
        if self.kinematics_sha256 != other.kinematics_sha256:
            return "the kinematics tables differ"
        return None


def _list(parts: Mapping[str, tuple]) -> str:
    return ", ".join(f"{name} ({' '.join(str(value) for value in values)})" for name, values in parts.items())


SUFFIX = ".carts"
_RESCUED = r"\.rescued-\d{8}-\d{6}(?:-\d+)?"
"""Pattern of the suffixes created by `rescue_paths`."""


def data_dir() -> Path:
    """Folder of user data: `$CARTS_DATA`, else `$XDG_DATA_HOME/carts`, else `~/.local/share/carts`."""
    if configured := os.environ.get("CARTS_DATA"):
        return Path(configured)
    return Path(os.environ.get("XDG_DATA_HOME") or home() / ".local" / "share") / "carts"


def default_path(sequence_file: Path) -> Path:
    """`NAME.carts` beside `NAME.toml`, or in `data_dir()` for the shipped sequence and read-only folders.

    An existing project beside the sequence is always used.
    """
    sequence_file = sequence_file.resolve()
    beside = sequence_file.with_suffix(SUFFIX)
    shipped = sequence_file.is_relative_to(sample_data_dir().resolve())
    if beside.exists() or (os.access(sequence_file.parent, os.W_OK) and not shipped):
        return beside
    # The name distinguishes sequences of the same name in different folders.
    folder = hashlib.sha256(str(sequence_file.parent).encode()).hexdigest()[:8]
    return data_dir() / f"{sequence_file.stem}-{folder}{SUFFIX}"


def rescue_paths(path: Path, when: float) -> Iterator[Path]:
    """Candidate paths for a rescued project: in its folder, in the user's data folder, and in the temporary folder."""
    stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(when))
    for folder in (path.parent, data_dir(), Path(tempfile.gettempdir())):
        for number in range(1, 20):
            again = "" if number == 1 else f"-{number}"
            yield folder / f"{path.stem}.rescued-{stamp}{again}{path.suffix}"


def rescued_copies(path: Path) -> list[Path]:
    """Rescued copies in the folder of a project, the newest first."""
    named = re.compile(re.escape(path.stem) + _RESCUED + re.escape(path.suffix))
    names = os.listdir(path.parent) if path.parent.is_dir() else []
    copies = (path.parent / name for name in sorted(names, reverse=True) if named.fullmatch(name))
    return [copy for copy in copies if is_regular(copy)]
