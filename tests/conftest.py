"""What several tests need: reference data where it is present, and small sequences made on the spot."""

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from carts_core.camera import Camera
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence, shipped_robot
from carts_core.robot import Robot
from carts_core.scene import Arm, Scene
from carts_core.threads import leave_a_core_free

ROOT = Path(__file__).resolve().parents[1]
FOCAL_PER_WIDTH = 1.2
BIAS = 0.01
"""What the measured revolute joints are off by [rad]; prismatic ones are off by a tenth of the number [m]."""


@pytest.fixture(scope="session", autouse=True)
def _mesh_cache_beside_the_tests(pytestconfig: pytest.Config) -> Iterator[None]:
    """Decimated meshes are cached between test runs, but not in the home folder."""
    assert pytestconfig.cache is not None
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CARTS_CACHE", str(pytestconfig.cache.mkdir("meshes")))
        yield


@pytest.fixture(scope="session", autouse=True)
def _as_many_threads_as_the_command_uses() -> None:
    leave_a_core_free()


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Reference data and third-party robots beside the checkout; tests that need them are skipped without them."""
    path = ROOT.parent / "shared"
    if not path.is_dir():
        pytest.skip("the reference data are not beside this checkout")
    return path


@pytest.fixture(scope="session")
def sample_sequence_path() -> Path:
    """The shipped sequence file."""
    return sample_sequence()


@pytest.fixture(scope="session")
def shipped_psm() -> Robot:
    """The shipped PSM with a Large Needle Driver."""
    return Robot.load(shipped_robot())


@dataclass(frozen=True)
class TinyScene:
    """What the tiny sequences show: one arm before one or two cameras, and its true joint positions."""

    scene: Scene
    truth: np.ndarray
    measured: np.ndarray


def _look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    rotation = np.stack([right, np.cross(forward, right), forward])
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3], T_camera_world[:3, 3] = rotation, -rotation @ eye
    return T_camera_world


def _tip(robot: Robot, joint_positions: np.ndarray) -> np.ndarray:
    """Middle of the robot's last link [m], which is a jaw of the instrument."""
    T_base_link = robot.forward_kinematics(torch.tensor(joint_positions))[robot.meshes[-1].link].numpy()
    return T_base_link[:3, :3] @ robot.meshes[-1].vertices.mean(0) + T_base_link[:3, 3]


@cache
def tiny_scene(robot: Robot, frames: int, cameras: tuple[str, ...], width: int, height: int) -> TinyScene:
    """One arm whose instrument's tip is in the middle of every camera's view."""
    prismatic = np.array([kind == "prismatic" for kind in robot.joint_types])
    rest = np.where(prismatic, 0.15, 0.0)
    sway = np.linspace(-1.0, 1.0, frames)[:, None] if frames > 1 else np.zeros((1, 1))
    truth = rest + sway * np.where(prismatic, 0.004, 0.06)
    tip = _tip(robot, rest)
    axis = tip / np.linalg.norm(tip)
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    views = []
    for number, name in enumerate(cameras):
        eye = tip - 0.06 * axis + 0.09 * side + 0.006 * number * np.cross(axis, side)
        intrinsics = (FOCAL_PER_WIDTH * width, FOCAL_PER_WIDTH * width, width / 2, height / 2)
        views.append(Camera(name, width, height, intrinsics, _look_at(eye, tip - 0.01 * axis, -axis)))
    signs = np.where(np.arange(len(robot.joint_names)) % 2, -1.0, 1.0)
    measured = truth + signs * np.where(prismatic, 0.1 * BIAS, BIAS)
    return TinyScene(Scene((Arm("PSM1", robot, np.eye(4)),), tuple(views)), truth, measured)


def _write_table(path: Path, robot: Robot, positions: np.ndarray) -> None:
    with path.open("w", newline="") as handle:
        writer = csv.writer(handle)
        writer.writerow(["frame", "time", *robot.joint_names])
        for row, values in enumerate(positions):
            writer.writerow([row + 1, f"{row / 10:.3f}", *(f"{value:.9f}" for value in values)])


@dataclass(frozen=True)
class TinyImage:
    """One image of a tiny sequence."""

    camera: str
    row: int
    image: np.ndarray
    """[height, width, 3] in [0, 1]: the arm at its true joint positions, before a smooth background."""
    mask: np.ndarray


# Many tests ask for the same small pictures, so each is rendered once.
@cache
def tiny_images(robot: Robot, frames: int, cameras: tuple[str, ...], width: int, height: int) -> tuple[TinyImage, ...]:
    """Every image of a tiny sequence."""
    tiny = tiny_scene(robot, frames, cameras, width, height)
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    background = np.stack([0.55 + 0.1 * x, 0.3 + 0.1 * y, 0.25 + 0.05 * x * y], -1)
    images = []
    for camera in cameras:
        renderer = Renderer(tiny.scene, width=width, height=height, cameras=[camera])
        for row, joint_positions in enumerate(tiny.truth):
            with torch.no_grad():
                rendering = renderer(tiny.scene.state({"PSM1": joint_positions}))
            cover = rendering.silhouette[0].numpy()[..., None]
            image = cover * rendering.image[0].permute(1, 2, 0).numpy() + (1 - cover) * background
            images.append(TinyImage(camera, row, image.clip(0, 1), cover[..., 0] > 0.5))
    return tuple(images)


def _write_images(folder: Path, images: tuple[TinyImage, ...], domains: tuple[str, ...]) -> None:
    for entry in images:
        name = f"{entry.camera}/{entry.row + 1:03d}.png"
        for kind in ("masks", *domains):
            (folder / kind / entry.camera).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / "masks" / name), entry.mask.astype(np.uint8) * 255)
        for number, domain in enumerate(domains):
            pixels = np.rint(255 * entry.image / (1 + number)).astype(np.uint8)
            cv2.imwrite(str(folder / domain / name), pixels[..., ::-1])


def _sequence_toml(tiny: TinyScene, domains: tuple[str, ...], robot: str, masks: bool, truth: bool) -> str:
    joints = "\n".join(f'{name} = "{name}"' for name in tiny.scene.arms[0].robot.joint_names)
    lines = [
        'format = "carts-sequence/1"',
        'name = "tiny"',
        f"domains = {list(domains)}",
        "[kinematics]",
        'table = "kinematics.csv"',
        'frame_id = "{frame:03d}"',
        'timestamp = "time"',
        'truth = "truth.csv"' if truth else "",
        "[[arms]]",
        'name = "PSM1"',
        f'robot = "{robot}"',
        "[arms.joints]",
        joints,
    ]
    for camera in tiny.scene.cameras:
        lines += [
            "[[cameras]]",
            f'name = "{camera.name}"',
            f"size = [{camera.width}, {camera.height}]",
            f"K = {camera.K.tolist()}",
            f"T_camera_world = {camera.T_camera_world.tolist()}",
            'images = "{domain}/{camera}/{frame}.png"',
            'masks = "masks/{camera}/{frame}.png"' if masks else "",
        ]
    return "\n".join(lines) + "\n"


@pytest.fixture
def tiny_sequence(tmp_path: Path, shipped_psm: Robot) -> Callable[..., Path]:
    """Factory of small valid sequences of the shipped robot in a folder of the test's own.

    Args (all optional): `frames`, `domains` (each darker than the one before), `cameras`, `width`, `height` [px],
    `masks`, `truth`, and `edit`, which gets the sequence file's text and returns the text that is written.
    Files: `sequence.toml`, `kinematics.csv`, `truth.csv`, `DOMAIN/CAMERA/001.png`, `masks/CAMERA/001.png`.
    """

    def make(
        *,
        frames: int = 3,
        domains: tuple[str, ...] = ("regular",),
        cameras: tuple[str, ...] = ("left",),
        width: int = 96,
        height: int = 72,
        masks: bool = True,
        truth: bool = True,
        edit: Callable[[str], str] = str,
    ) -> Path:
        tiny = tiny_scene(shipped_psm, frames, cameras, width, height)
        _write_table(tmp_path / "kinematics.csv", shipped_psm, tiny.measured)
        _write_table(tmp_path / "truth.csv", shipped_psm, tiny.truth)
        _write_images(tmp_path, tiny_images(shipped_psm, frames, cameras, width, height), domains)
        path = tmp_path / "sequence.toml"
        path.write_text(edit(_sequence_toml(tiny, domains, "builtin:psm_lnd", masks, truth)))
        return path

    return make
