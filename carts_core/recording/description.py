"""What a sequence file says, read and checked: cameras with their images, arms with their joint positions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..model.camera import FARTHEST
from ..model.robot import Robot
from ..model.scene import Arm, Light, Scene
from ..wording import shown
from .calibration import resolve_robot, take_transform
from .camera_input import CameraInput, take_camera_input
from .frame_list import FrameList
from .joints import take_joints
from .matching import JointSamples, TimeMatching
from .rows import Rows, take_rows
from .toml_table import TomlTable, check_file_name, read_toml

FORMAT = "carts-sequence/1"
"""Value of the key `format`."""

_BRIGHTEST = 1e3
"""Largest value of the keys of `[light]` that are numbers."""


@dataclass(frozen=True)
class ArmInput:
    """An arm and its joint positions."""

    arm: Arm
    measured_joints: tuple[str, ...]
    measured: JointSamples
    truth: JointSamples | None


@dataclass(frozen=True)
class Description:
    """A sequence file, read and checked."""

    path: Path
    name: str
    scene: Scene
    domains: tuple[str, ...]
    frames: FrameList
    matching: TimeMatching | None
    """How joint positions are matched with frames by time; None where every row of the tables is a frame."""
    cameras: Mapping[str, CameraInput]
    arms: Mapping[str, ArmInput]
    remarks: tuple[str, ...] = ()
    """What is changed about images and masks before they are used, and what is unusual about calibrations."""

    def at_frames(self, samples: JointSamples) -> Float[np.ndarray, "frames dofs"]:
        """The joint positions of every frame [rad, m].

        Raises:
            SequenceError: a frame has no row near enough in time.
        """
        return samples.positions if self.matching is None else samples.at_times(self.frames, self.matching)

    def mounts(self) -> dict[str, Float[np.ndarray, "frames 4 4"]]:
        """Camera -> T_mount_world of every frame [m], of the cameras that move.

        Raises:
            SequenceError: a frame has no row near enough in time.
        """
        moving = {name: camera.motion for name, camera in self.cameras.items() if camera.motion is not None}
        poses = {
            name: motion.Ts_world_mount if self.matching is None else motion.at_times(self.frames, self.matching)
            for name, motion in moving.items()
        }
        return {name: np.linalg.inv(Ts) for name, Ts in poses.items()}


def read_description(path: Path, progress: Callable[[str], None] | None = None) -> Description:
    """Read a sequence file and everything that it points at, images excepted.

    Args:
        path: the TOML file.
        progress: called with a line for people while robots are loaded.

    Raises:
        SequenceError: the file or something it points at is missing or wrong.
        RobotError: a robot or one of its meshes is missing or wrong.
    """
    root = read_toml(path)
    root.take_choice("format", (FORMAT,), "(none)")
    name = root.take("name", str, path.stem)
    check_file_name(root, "name", "is", name)
    root.take("description", str, "")
    domains = _take_domains(root)
    frames_section = root.take_table("frames") if "frames" in root else None
    rows = take_rows(root.take_table("kinematics"), frames_section)
    light = _take_light(root.take_table("light"))
    robots: dict[tuple[Path, str | None], Robot] = {}
    arms = [_take_arm(table, rows, robots, progress) for table in root.take_tables("arms")]
    cameras = [take_camera_input(table, rows, domains) for table in root.take_tables("cameras")]
    root.finish()
    scene = Scene(tuple(entry.arm for entry in arms), tuple(entry.camera for entry in cameras), light)
    remarks = tuple(remark for camera in cameras for remark in camera.remarks())
    remarks += tuple(dict.fromkeys(f"{robot.name}: {text}" for robot in robots.values() for text in robot.remarks))
    if progress is not None:
        for remark in remarks:
            progress(f"note: {remark}")
    return Description(
        path=path,
        name=name,
        scene=scene,
        domains=domains,
        frames=rows.frames,
        matching=rows.matching,
        cameras={entry.camera.name: entry for entry in cameras},
        arms={entry.arm.name: entry for entry in arms},
        remarks=remarks,
    )


def _take_domains(root: TomlTable) -> tuple[str, ...]:
    domains = root.take("domains", list, ["regular"])
    if not domains or not all(isinstance(domain, str) and domain for domain in domains):
        raise root.error("domains", f'is {shown(domains)}. Give names, say domains = ["regular", "smoke"].')
    if len(set(domains)) < len(domains):
        raise root.error("domains", f"names one twice: {', '.join(domains)}.")
    for domain in domains:
        check_file_name(root, "domains", "has", domain)
    return tuple(domains)


def _take_light(table: TomlTable) -> Light:
    values: dict[str, Any] = {}
    for setting in fields(Light):
        if setting.name in table:
            value = table.take(setting.name, list if setting.name == "position" else float)
            values[setting.name] = tuple(value) if isinstance(value, list) else float(value)
        else:
            table.take(setting.name, object, None)
    table.finish()
    position = values.get("position", (0.0, 0.0, 0.0))
    if len(position) != 3 or not all(isinstance(value, int | float) and abs(value) <= FARTHEST for value in position):
        raise table.error("position", f"must be three numbers [m] within {FARTHEST:g}, in the camera's frame.")
    for key, value in values.items():
        if key != "position" and not 0.0 <= value <= _BRIGHTEST:
            raise table.error(key, f"is {value:g}, but must be 0 to {_BRIGHTEST:g}.")
    return Light(**values)


def _take_arm(
    table: TomlTable,
    rows: Rows,
    robots: dict[tuple[Path, str | None], Robot],
    progress: Callable[[str], None] | None,
) -> ArmInput:
    name = table.take("name", str)
    urdf = resolve_robot(table)
    base_link = table.take("base_link", str, None)
    if (key := (urdf.resolve(), base_link)) not in robots:
        robots[key] = Robot.load(urdf, base_link=base_link, progress=progress)
    robot = robots[key]
    T_world_base = take_transform(table, "T_world_base", np.eye(4).tolist())
    columns = take_joints(table, robot)
    measured, truth = rows.measured_of(table, columns), rows.truth_of(table, columns)
    table.finish()
    return ArmInput(Arm(name, robot, T_world_base), columns.measured, measured, truth)
