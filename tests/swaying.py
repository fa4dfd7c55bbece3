"""Video of oscillating arms, and logs of their joints with separate clocks."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from tiny import tiny_scene
from videos import write_video

from carts_core.model.robot import Robot
from carts_core.model.scene import Arm, Scene
from carts_core.rendering import Renderer

SIZE = 320, 240
LOGS = "log.csv", "log2.csv"
_FREQUENCIES = 0.23, 0.41, 0.77, 1.3
_NOISE = 3.0


def swaying_joints(robot: Robot, times: np.ndarray, seed: int, period: float | None = None) -> np.ndarray:
    """Joint positions [times, dofs] of a smooth, reproducible motion; periodic if a period [s] is given."""
    rng = np.random.default_rng(seed)
    joints = np.tile(tiny_scene(robot, 1, ("left",), *SIZE).truth[0], (len(times), 1))
    for column, kind in enumerate(robot.joint_types):
        for frequency in _FREQUENCIES:
            size = (0.01 if kind == "prismatic" else 0.06) * rng.normal() / (1 + 2 * frequency)
            rate = frequency * (1 + 0.2 * rng.normal())
            rate = rate if period is None else (1 + _FREQUENCIES.index(frequency)) / period
            joints[:, column] += size * np.sin(2 * np.pi * (rate * times + rng.random()))
    return joints


def _opposite(scene: Scene) -> Arm:
    """A second arm that enters the view from the other side: the first one turned about the viewing axis."""
    T_camera_base = scene.cameras[0].T_camera_world @ scene.arms[0].T_world_base
    T_camera_base = np.diag([-1.0, -1.0, 1.0, 1.0]) @ T_camera_base
    T_camera_base[:3, 3] += (0.012, 0.008, 0.0)
    return replace(
        scene.arms[0], name="PSM2", T_world_base=np.linalg.inv(scene.cameras[0].T_camera_world) @ T_camera_base
    )


def write_swaying(
    folder: Path,
    robot: Robot,
    seed: int = 1,
    seconds: float = 10.0,
    rate: float = 30.0,
    *,
    periods: tuple[float | None, ...] = (None,),
) -> Path:
    """`left.mp4` and the log of each arm (`log.csv`, `log2.csv`) with the same clock, and the sequence file; gives the
    file. Each arm has a motion of its own, which is periodic if it has a period [s]."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = tiny_scene(robot, 1, ("left",), *SIZE).scene
    if len(periods) > 1:
        scene = replace(scene, arms=(scene.arms[0], _opposite(scene)))
    renderer = Renderer(scene, width=SIZE[0], height=SIZE[1])
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(0, 255, (30, 40, 3)).astype(np.float32)
    background = 0.4 * cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC) + (120, 70, 60)
    times = np.arange(0.0, seconds, 1 / rate)
    images = []
    motions = [swaying_joints(robot, times, seed + 100 * n, period) for n, period in enumerate(periods)]
    for joints in zip(*motions, strict=True):
        with torch.no_grad():
            rendering = renderer(scene.state(dict(zip(("PSM1", "PSM2"), joints, strict=False))))
        cover = rendering.silhouette[0].numpy()[..., None]
        arm = 255 * rendering.image[0].permute(1, 2, 0).numpy()
        image = cover * arm + (1 - cover) * background + rng.normal(0, _NOISE, background.shape)
        images.append(image.clip(0, 255).astype(np.uint8))
    write_video(folder / "left.mp4", images, milliseconds=[round(1000 * time) for time in times])
    for n, period in enumerate(periods):
        write_log(folder / LOGS[n], robot, seed + 100 * n, seconds, period=period)
    columns = "\n".join(f'{name} = "{name}"' for name in robot.joint_names)
    (folder / "sequence.toml").write_text(
        'format = "carts-sequence/1"\n[frames]\nvideo = "left.mp4"\n[kinematics]\ntable = "log.csv"\n'
        'timestamp = "stamp"\n'
        + "".join(
            f'[[arms]]\nname = "{arm.name}"\nrobot = "builtin:psm_lnd"\ntable = "{log}"\n'
            f"T_world_base = {arm.T_world_base.tolist()}\n[arms.joints]\n{columns}\n"
            for arm, log in zip(scene.arms, LOGS, strict=False)
        )
        + f'[[cameras]]\nname = "left"\nsize = {list(SIZE)}\nK = {scene.cameras[0].K.tolist()}\n'
        f'T_camera_world = {scene.cameras[0].T_camera_world.tolist()}\nimages = "left.mp4"\n'
    )
    return folder / "sequence.toml"


def write_log(
    path: Path, robot: Robot, seed: int, seconds: float, late: float = 0.0, period: float | None = None
) -> None:
    """Log of a motion with a delay: values stamped t were measured `late` seconds earlier."""
    stamps = np.arange(-1.0, seconds + 1.0, 0.01)
    with path.open("w", newline="") as handle:
        table = csv.writer(handle)
        table.writerow(["stamp", *robot.joint_names])
        for stamp, joints in zip(stamps, swaying_joints(robot, stamps - late, seed, period), strict=True):
            table.writerow([f"{stamp:.6f}", *(f"{value:.9f}" for value in joints)])
