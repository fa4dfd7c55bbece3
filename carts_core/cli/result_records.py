"""What stands in `results.json` beside the results of `carts optimize`: of each frame, what it was made from and is."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..errors import SettingsError
from ..export import KinematicsRow
from ..export.kinematics import position_values, std_values
from ..files import OutputPath, holds_file
from ..files.reading import TABLE, parse_json, read_bytes, typed
from ..fingerprints import fingerprint
from ..model.scene import Scene
from ..optimization import Assessment

_FORMAT = "carts-results/1"


@dataclass(frozen=True)
class Record:
    """Of one frame."""

    origin: Mapping[str, str]
    """Kind of input -> its fingerprint."""
    masks: Mapping[str, str]
    """Camera -> fingerprint of the mask's file."""
    row: str
    """Fingerprint of the row in the table."""
    threads: int
    """How many threads torch had; results do not depend on it."""
    verdict: str = ""
    """`good`, `doubtful` or `failed`; empty where it was not asked for."""
    reason: str = ""
    """For the verdict, one sentence."""
    probability: float | None = None
    """That the mask is wrong [1]."""
    not_determined: Sequence[str] | None = None
    """`ARM.JOINT` of the joints that the images leave open; None where no deviation is known."""


def judged(found: Assessment | None) -> dict[str, Any]:
    """The fields of a record that tell of a verdict."""
    if found is None:
        return {}
    return {"verdict": found.verdict.value, "reason": found.reason, "probability": round(found.probability, 6)}


def row_fingerprint(scene: Scene, row: KinematicsRow) -> str:
    """Of a row of the table, with the digits that it has there."""
    values = np.concatenate([position_values(scene, row), std_values(scene, row)])
    verdict = [row.verdict] if row.verdict else []
    return fingerprint(row.frame_id, row.source, [f"{value:.9g}" for value in values], *verdict)


def records_text(records: Mapping[str, Record]) -> str:
    """The file, one frame a line."""
    lines = [f"{json.dumps(frame_id)}: {json.dumps(asdict(record))}" for frame_id, record in records.items()]
    return f'{{"format": "{_FORMAT}", "frames": {{\n' + ",\n".join(lines) + "\n}}\n"


def read_records(path: OutputPath) -> dict[str, Record]:
    """Frame -> record. Nothing where the file is missing or damaged: then nothing there counts as known.

    Raises:
        SettingsError: a newer version of the program wrote the file.
    """
    if not holds_file(path):
        return {}
    try:
        content = parse_json(read_bytes(path.path, TABLE), finite=False)
        if content["format"] != _FORMAT:
            raise SettingsError(
                f"{path} has the format {content['format']!r}; this version knows {_FORMAT}. Use the version that "
                "wrote it, or name another folder with --output."
            )
        return typed(content["frames"], dict[str, Record])
    except (OSError, ValueError, TypeError, KeyError):
        return {}
