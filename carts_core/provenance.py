"""Provenance of results: fingerprints of inputs, and checkpoints of intermediate results.

The key of an entry in a checkpoint is a hash of all inputs of the computation, so entries do not depend on the order of
computation, and a changed input invalidates an entry. Truncated or altered lines are ignored.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from .errors import OutputError, SettingsError
from .files import OutputPath, append_line, holds_file, remove_file, write_text
from .files.paths import as_output
from .files.reading import TABLE, parse_json, read_bytes, typed
from .model.camera import Camera
from .model.robot import Robot
from .model.scene import Scene
from .stopping import finished_first

_NOT_CODE = {"bench.py", "cli.py", "wording.py"}
_PROBES = (0.0, 0.1, -0.2)
"""Joint positions at which the links of two robots are compared [rad, m]."""


def fingerprint(*parts: bytes | str | float | np.ndarray | Iterable) -> str:
    """SHA-256 of numbers, strings, arrays (with dtype and shape), and tuples of these."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            content = np.ascontiguousarray(part)
            kind, data = f"array {content.dtype.str} {content.shape}", content.tobytes()
        elif isinstance(part, bytes):
            kind, data = "bytes", part
        elif isinstance(part, Iterable) and not isinstance(part, str):
            kind, data = "tuple", fingerprint(*part).encode()
        else:
            kind, data = type(part).__name__, (part if isinstance(part, str) else repr(part)).encode()
        digest.update(f"{kind} {len(data)}\n".encode())
        digest.update(data)
    return digest.hexdigest()


@cache
def code_fingerprint(patterns: tuple[str, ...]) -> str:
    """SHA-256 of the source code of modules, given by patterns such as `rendering/**/*.py`, except `_NOT_CODE`."""
    package = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    for pattern in patterns:
        for path in sorted(package.glob(pattern)):
            if path.name not in _NOT_CODE:
                digest.update(path.relative_to(package).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def robot_fingerprint(robot: Robot) -> str:
    """Fingerprint of a robot's joints, kinematics and meshes."""
    probes = np.tile(np.array(_PROBES, np.float64)[:, None], len(robot.joint_names))
    meshes = [(mesh.link, mesh.vertices, mesh.normals, mesh.faces, mesh.color) for mesh in robot.meshes]
    return fingerprint(
        robot.joint_names,
        robot.joint_types,
        robot.joint_limits,
        robot.link_names,
        robot.forward_kinematics(probes),
        meshes,
    )


def calibration_fingerprint(scene: Scene, cameras: Iterable[Camera]) -> str:
    """Fingerprint of the poses of arms and cameras, and of the cameras' intrinsics.

    Args:
        cameras: cameras of the recorded images, with distortion.
    """
    arms = [(arm.name, arm.robot.base_link, np.asarray(arm.T_world_base)) for arm in scene.arms]
    views = [
        (camera.name, camera.width, camera.height, camera.intrinsics, camera.distortion, camera.T_camera_world)
        for camera in cameras
    ]
    return fingerprint(arms, views)


_FORMAT = "carts-checkpoint/1"
_DIGITS = 32
Value = TypeVar("Value")


class Checkpoint:
    """File of intermediate results.

    Args:
        made_with: fingerprint of the common inputs; a file with a different fingerprint is replaced.
        classes: frozen dataclasses that values may contain, in addition to numbers, lists and float64 arrays.

    Attributes:
        recalled: number of values read from the file.
    """

    def __init__(self, path: OutputPath, made_with: str, classes: Sequence[type]) -> None:
        self._path, self._made_with = path, made_with
        self._classes = {kind.__name__: kind for kind in classes}
        self._entries = self._read()
        self._begun = bool(self._entries)
        self.recalled = 0

    def value(self, key: str, compute: Callable[[], Value]) -> Value:
        """Return the stored value of a key, or compute and store it.

        Raises:
            OutputError: the file cannot be written.
        """
        if key in self._entries:
            self.recalled += 1
            return self._decoded(self._entries[key])
        found = compute()
        with finished_first():
            if not self._begun:
                write_text(self._path, f"{_FORMAT} {self._made_with}\n")
                self._begun = True
            text = json.dumps(_encoded(found))
            append_line(self._path, f"{key} {fingerprint(key, text)[:_DIGITS]} {text}".encode())
        return found

    def remove(self) -> None:
        """Remove the file after the results are written."""
        remove_file(self._path)

    def _read(self) -> dict[str, Any]:
        if not holds_file(self._path):
            return {}
        try:
            lines = self._path.path.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError as error:
            raise OutputError(
                f"{self._path} cannot be read ({error.strerror}). Remove the file to start over."
            ) from error
        if not lines or lines[0] != f"{_FORMAT} {self._made_with}":
            return {}
        entries = {}
        for line in lines[1:]:
            key, _, rest = line.partition(" ")
            check, _, text = rest.partition(" ")
            if check == fingerprint(key, text)[:_DIGITS]:
                entries[key] = json.loads(text)
        return entries

    def _decoded(self, value: Any) -> Any:
        if isinstance(value, list):
            return [self._decoded(part) for part in value]
        if not isinstance(value, Mapping):
            return value
        if "array" in value:
            return np.array(value["array"], np.float64).reshape(value["shape"])
        return self._classes[value["class"]](**{name: self._decoded(part) for name, part in value["fields"].items()})


def _encoded(value: Any) -> Any:
    """Encode a value as JSON, without loss of float64 precision."""
    if isinstance(value, np.ndarray):
        assert value.dtype == np.float64
        return {"array": value.ravel().tolist(), "shape": value.shape}
    if is_dataclass(value) and not isinstance(value, type):
        parts = {field.name: _encoded(getattr(value, field.name)) for field in fields(value)}
        return {"class": type(value).__name__, "fields": parts}
    if isinstance(value, list):
        return [_encoded(part) for part in value]
    return value


RESULTS_FORMAT = "carts-results/1"


@dataclass(frozen=True)
class Record:
    """Provenance of a frame's result."""

    origin: Mapping[str, str]
    """Kind of input -> its fingerprint."""
    masks: Mapping[str, str]
    """Camera -> fingerprint of its mask file."""
    row: str
    """Fingerprint of the row in the table."""
    threads: int
    """Number of torch threads; results do not depend on it."""
    verdict: str = ""
    """`good`, `doubtful` or `failed`; empty without an assessment."""
    reason: str = ""
    """Reason for the verdict, as a sentence."""
    probability: float | None = None
    """Probability that the mask is wrong [1]."""
    not_determined: Sequence[str] | None = None
    """`ARM.JOINT` of each joint not determined by the images; None without standard deviations."""


def read_records(path: OutputPath | Path) -> dict[str, Record]:
    """Read records by frame; empty if the file is missing or damaged. `SettingsError` if a newer version wrote it."""
    if not holds_file(path):
        return {}
    try:
        content = parse_json(read_bytes(as_output(path).path, TABLE), finite=False)
        if content["format"] != RESULTS_FORMAT:
            raise SettingsError(
                f"{path} has the format {content['format']!r}; this version supports {RESULTS_FORMAT}. Use the version "
                "that wrote the file, or choose another folder with --output."
            )
        return typed(content["frames"], dict[str, Record])
    except (OSError, ValueError, TypeError, KeyError):
        return {}
