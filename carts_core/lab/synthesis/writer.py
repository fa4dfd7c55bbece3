"""The files of a synthetic sequence."""

import csv
import io
import json
import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ...errors import CartsError
from ...files import OutputPath, write_bytes, write_text
from ...model.camera import Camera
from ...model.instruments import SCHEME, SHIPPED
from ...model.scene import Arm
from ...resources import shipped_robot
from ...settings import SynthesisConfig


def frame_name(frame: int) -> str:
    """The id of a frame: 001 for the first."""
    return f"{frame + 1:03d}"


def write_image(path: OutputPath, image: UInt8[np.ndarray, "h w 3"], quality: int) -> None:
    """A JPEG file of an RGB picture, whole or not at all."""
    _write(path, ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])


def write_mask(path: OutputPath, mask: Bool[np.ndarray, "h w"]) -> None:
    """A PNG file of one bit per pixel, whole or not at all."""
    _write(path, ".png", mask.astype(np.uint8) * 255, [cv2.IMWRITE_PNG_BILEVEL, 1, cv2.IMWRITE_PNG_COMPRESSION, 9])


def write_table(
    path: OutputPath,
    arms: Sequence[Arm],
    times: Float[np.ndarray, " frames"],
    joints: Sequence[Float[np.ndarray, "frames dofs"]],
) -> None:
    """A CSV file with a row per frame: its id, its time [s], and the joint positions of every arm [rad, m]."""
    columns = [_column(arm, joint) for arm in arms for joint in arm.robot.joint_names]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["frame", "time", *columns])
    for frame, time in enumerate(times):
        values = np.concatenate([table_of_arm[frame] for table_of_arm in joints])
        table.writerow([frame_name(frame), f"{time:.4f}", *(f"{value:.7f}" for value in values)])
    write_text(path, text.getvalue())


def write_sequence_file(
    path: OutputPath, config: SynthesisConfig, output: Path, arms: Sequence[Arm], cameras: Sequence[Camera]
) -> None:
    """The sequence file that ties the others together; `output` is the folder that it will lie in."""
    domains = ", ".join(f'"{domain}"' for domain in config.domains)
    sections = [
        'format = "carts-sequence/1"\n'
        f"name = {json.dumps(config.name)}\n"
        f'description = "{_arms(arms)} over made-up tissue; carts synthesize, seed {config.seed}."\n'
        f"domains = [{domains}]\n",
        '[kinematics]\ntable = "kinematics.csv"\ntruth = "truth.csv"\nframe = "frame"\ntimestamp = "time"\n',
        *(_camera_section(camera) for camera in cameras),
        *(_arm_section(arm, config, output) for arm in arms),
    ]
    write_text(path, "\n".join(sections))


def _arms(arms: Sequence[Arm]) -> str:
    return "Two synthetic arms" if len(arms) > 1 else "A synthetic arm"


def _camera_section(camera: Camera) -> str:
    fx, fy, cx, cy = camera.intrinsics
    return (
        "[[cameras]]\n"
        f'name = "{camera.name}"\n'
        f'images = "images/{{domain}}/{camera.name}/{{frame}}.jpg"\n'
        f'masks = "masks/{camera.name}/{{frame}}.png"\n'
        f"size = [{camera.width}, {camera.height}]\n"
        f"K = {{ fx = {fx!r}, fy = {fy!r}, cx = {cx!r}, cy = {cy!r} }}\n"
        f"T_camera_world = {_matrix(camera.T_camera_world)}\n"
    )


def _arm_section(arm: Arm, config: SynthesisConfig, output: Path) -> str:
    columns = "\n".join(f'{joint} = "{_column(arm, joint)}"' for joint in arm.robot.joint_names)
    return (
        "[[arms]]\n"
        f'name = "{arm.name}"\n'
        f'robot = "{_robot_reference(config.robot, output)}"\n'
        f'base_link = "{arm.robot.base_link}"\n'
        f"T_world_base = {_matrix(arm.T_world_base)}\n"
        f"\n[arms.joints]\n{columns}\n"
    )


def _robot_reference(robot: Path, output: Path) -> str:
    if str(robot).startswith(SCHEME):
        return str(robot)
    if robot.resolve() == shipped_robot().resolve():
        return SCHEME + SHIPPED
    return Path(os.path.relpath(robot.resolve(), output.resolve())).as_posix()


def _column(arm: Arm, joint: str) -> str:
    return f"{arm.name}.{joint}"


def _matrix(values: np.ndarray) -> str:
    rows = [", ".join(f"{value:.12g}" for value in row) for row in values]
    return "[\n" + "".join(f"    [{row}],\n" for row in rows) + "]"


def _write(path: OutputPath, suffix: str, pixels: np.ndarray, options: list[int]) -> None:
    encoded, data = cv2.imencode(suffix, pixels, options)
    if not encoded:
        raise CartsError(f"{path} could not be encoded as {suffix}.")
    write_bytes(path, data.tobytes())
