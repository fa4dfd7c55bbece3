"""Recording of a stream as a sequence, with the corrections as its project."""

import logging
import queue
import threading
from collections.abc import Collection
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomlkit
from scipy.spatial.transform import Rotation

from ..errors import OutputError
from ..export.kinematics import KinematicsRow, joint_columns, kinematics_csv, position_values
from ..files import OutputPath, append_line, file_name, output_path, remove_file, synchronize, write_bytes, write_text
from ..files.reading import SEQUENCE, parse_toml, read_text
from ..model.camera import HALF_PIXEL
from ..model.instruments import SCHEME
from ..model.scene import Scene
from ..project import Edits, FitVerdict, JointCorrection, Key, Project, Provenance
from ..recording import Sequence
from ..recording.matching import ORIENTATION, POSITION
from ..recording.sequence_file import FORMAT
from ..wording import counted
from .loop import Tracked
from .messages import mounts_of
from .tracker import LiveVerdict

_log = logging.getLogger(__name__)

_WAITING = 32
"""Maximum number of frames waiting for the disk; further frames are not recorded."""
_AGAIN = "Fit the frame again without a time limit."
_VERDICTS = {
    LiveVerdict.GOOD: FitVerdict("good", "Fitted live."),
    LiveVerdict.DOUBTFUL: FitVerdict(
        "doubtful",
        "The fit failed during live tracking; joints are predicted from earlier frames.",
        _AGAIN,
        0.5,
    ),
    LiveVerdict.LOST: FitVerdict(
        "failed", "The arms were lost during live tracking; joints are the measured values.", _AGAIN, 1.0
    ),
}
"""Recorded verdicts; the probabilities are not calibrated, and are used only to sort the worst frames first."""


class Recorder:
    """Recorder that writes results to disk on a separate thread.

    The folder contains `images/CAMERA/FRAME.png`, `kinematics.csv` with the measured joints, `corrected.csv` with the
    corrected joints, `camera_CAMERA.csv` with the poses of each camera mount, `sequence.toml`, and at the end the
    project `sequence.carts`. The images of a frame are written before its rows. If the arms are lost, the measured
    joints are written with the verdict *failed*. Files are synchronized to disk at the end, since a hard disk performs
    few synchronizations per second; a crash of the machine may lose or damage the last half minute.

    Args:
        sequence: sequence with the arms and cameras.
        cameras: names of the tracked cameras.
        folder: new or empty folder.
        provenance: provenance of the corrections.

    Attributes:
        missed: number of frames that were not recorded because the disk was too slow.

    Raises:
        OutputError: the folder is not empty, or cannot be written.
    """

    def __init__(self, sequence: Sequence, cameras: tuple[str, ...], folder: Path, provenance: Provenance) -> None:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(f"--record {folder} exists. Choose a new folder.")
        self._scene, self._provenance, self._folder = sequence.scene.with_cameras(cameras), provenance, folder
        self._output = output_path(folder)
        self._sequence = sequence
        self._moving: set[str] = set()
        self._describe()
        self._waiting: queue.Queue[Tracked | None] = queue.Queue(_WAITING)
        self._edits: list[Edits] = []
        self._error: Exception | None = None
        self.missed = 0
        self._thread = threading.Thread(target=self._write, name="carts-live-recorder", daemon=True)
        self._thread.start()

    def __call__(self, tracked: Tracked) -> None:
        """Queue a result."""
        try:
            self._waiting.put_nowait(tracked)
        except queue.Full:
            self.missed += 1

    @property
    def shortfall(self) -> str:
        """Message about frames that were not recorded; empty if there are none."""
        return f"{counted(self.missed, 'frame')} not recorded, since the disk was too slow." if self.missed else ""

    def close(self) -> Path | None:
        """Finish writing; returns the sequence file, or None without frames.

        Raises:
            CartsError: a file could not be written. The frames before are in the recording.
        """
        self._waiting.put(None)
        self._thread.join()
        path = (self._output / "sequence.toml").path
        if not self._edits:
            # Without frames the folder remains empty, so that the same command can be repeated.
            remove_file(self._output / "sequence.toml")
            if self._error is not None:
                raise self._error
            return None
        self._write_project(path)
        if self._error is not None:
            text = f"{self._error} The {counted(len(self._edits), 'frame')} before this error are in {path}."
            raise OutputError(text) from self._error
        return path

    def _write_project(self, path: Path) -> None:
        project = Project.open(Sequence.open(path), path.with_suffix(".carts"))
        try:
            merged: Edits = {key: value for edits in self._edits for key, value in edits.items()}
            project.apply("Live", merged)
        finally:
            project.close()

    def _write(self) -> None:
        while (tracked := self._waiting.get()) is not None:
            if self._error is None:
                try:
                    self._write_one(tracked)
                except Exception as error:  # The stream continues.
                    _log.warning("Recording has stopped: %s", error)
                    self._error = error
        if self._edits:
            try:
                synchronize(self._output)
            except OutputError as error:
                self._error = self._error or error

    def _describe(self) -> None:
        """Write the sequence file, and update it when a camera begins to move."""
        write_text(self._output / "sequence.toml", _sequence_file(self._sequence, self._scene, self._moving))

    def _write_mounts(self, number: int, name: str, tracked: Tracked) -> None:
        """Write the mount pose of each camera, since every camera may begin to move."""
        mounts = mounts_of(self._scene, tracked.stream_frame.frame, tracked.stream_frame.camera_poses)
        for camera in self._scene.cameras:
            path = self._output / _motion_file(camera.name)
            if number == 0:
                _append(path, ",".join(["frame", *POSITION, *ORIENTATION]).encode())
            T = mounts.get(camera.name, np.eye(4))
            values = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
            _append(path, ",".join([name, *(f"{value:.9f}" for value in values)]).encode())
        if not mounts.keys() <= self._moving:
            self._moving |= mounts.keys()
            self._describe()

    def _write_one(self, tracked: Tracked) -> None:
        number, frame, estimate = len(self._edits), tracked.stream_frame.frame, tracked.estimate
        name = f"{number:06d}"
        for camera, image in frame.images.items():
            content = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
            write_bytes(self._output / "images" / file_name(camera) / f"{name}.png", content, sync=False)
        lost, verdict = estimate.verdict is LiveVerdict.LOST, _VERDICTS[estimate.verdict]
        measured = KinematicsRow(name, "measured", frame.measured, {}, verdict.verdict)
        corrected = KinematicsRow(name, "optimized", estimate.joint_positions, estimate.joint_std, verdict.verdict)
        lines = kinematics_csv(self._scene, [measured if lost else corrected]).splitlines()
        if number == 0:
            columns = ",".join(["frame", "time", *joint_columns(self._scene)])
            _append(self._output / "kinematics.csv", columns.encode())
            _append(self._output / "corrected.csv", lines[0].encode())
        self._write_mounts(number, name, tracked)
        positions = (f"{value:.9f}" for value in position_values(self._scene, measured))
        values = ",".join([name, f"{estimate.time:.6f}", *positions])
        _append(self._output / "kinematics.csv", values.encode())
        _append(self._output / "corrected.csv", lines[1].encode())
        edits: dict[Key[Any], Any] = {Key.verdict(number): verdict}
        if not lost:
            for arm in self._scene.arms:
                std = tuple(float(value) for value in estimate.joint_std[arm.name])
                joints = tuple(float(value) for value in estimate.joint_positions[arm.name])
                edits[Key.joints(number, arm.name)] = JointCorrection(joints, self._provenance, std)
        self._edits.append(edits)


def _append(path: OutputPath, line: bytes) -> None:
    append_line(path, line, sync=False)


def _motion_file(camera: str) -> str:
    return f"camera_{file_name(camera)}.csv"


def _sequence_file(sequence: Sequence, scene: Scene, moving: Collection[str]) -> str:
    """Content of the sequence file of the recording; images are undistorted."""
    folder = sequence.path.parent.resolve()
    described = parse_toml(read_text(sequence.path, SEQUENCE))["arms"]
    robots = {
        table["name"]: robot if (robot := table["robot"]).startswith(SCHEME) else str(folder / robot)
        for table in described
    }
    arms = [
        {
            "name": arm.name,
            "robot": robots[arm.name],
            "base_link": arm.robot.base_link,
            "T_world_base": np.asarray(arm.T_world_base).tolist(),
            "joints": {name: f"{arm.name}.{name}" for name in arm.robot.joint_names},
        }
        for arm in scene.arms
    ]
    cameras = []
    for camera in scene.cameras:
        entry = {
            "name": camera.name,
            "size": [camera.width, camera.height],
            "pixel_center": HALF_PIXEL,
            "T_camera_world": np.asarray(camera.T_camera_world).tolist(),
            "images": f"images/{file_name(camera.name)}/{{frame}}.png",
            "K": dict(zip(("fx", "fy", "cx", "cy"), map(float, camera.intrinsics), strict=True)),
        }
        motion = {"table": _motion_file(camera.name), "pose": "T_mount_world"}
        cameras.append({**entry, **({"motion": motion} if camera.name in moving else {})})
    table = {"table": "kinematics.csv", "frame_id": "{frame}", "timestamp": "time"}
    content = {"format": FORMAT, "name": f"{sequence.name} live", "kinematics": table, "arms": arms, "cameras": cameras}
    return f"# Recorded by carts live.\n{tomlkit.dumps(content)}"
