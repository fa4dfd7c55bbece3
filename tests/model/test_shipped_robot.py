"""The procedural PSM: its files, its kinematics, and its likeness to an independent model of the same instrument."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import yourdfpy
from scipy.spatial import KDTree

from carts_core.decoders.meshes import MAX_FACES
from carts_core.model.robot import Robot
from carts_core.rendering import visibility
from carts_core.resources import shipped_robot
from tools import shipped_robot as cad

JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw", "jaw")
MESHES = sorted((shipped_robot().parent / "meshes").glob("*.ply"))


@pytest.fixture(scope="module")
def regenerated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("psm")
    cad.write(folder)
    return folder


def _load(path: Path) -> trimesh.Trimesh:
    mesh = trimesh.load(path, process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


@pytest.fixture(scope="module")
def model() -> yourdfpy.URDF:
    return yourdfpy.URDF.load(str(shipped_robot()), load_meshes=False)


def _random_positions(count: int, seed: int) -> np.ndarray:
    limits = np.array([*(row.limits for row in cad.DH_TABLE if row.kind != "fixed"), cad.JAW_LIMITS])
    return np.random.default_rng(seed).uniform(limits[:, 0], limits[:, 1], (count, len(JOINTS)))


def test_regenerated_urdf_is_the_shipped_one(regenerated: Path) -> None:
    assert (regenerated / "psm_lnd.urdf").read_text() == shipped_robot().read_text()


def test_no_mesh_is_shipped_that_the_script_does_not_write(regenerated: Path) -> None:
    assert [path.name for path in MESHES] == sorted(path.name for path in (regenerated / "meshes").iterdir())


@pytest.mark.parametrize("path", MESHES, ids=lambda path: path.stem)
def test_regenerated_mesh_has_the_shipped_geometry(path: Path, regenerated: Path) -> None:
    shipped, again = _load(path), _load(regenerated / "meshes" / path.name)
    assert len(shipped.faces) == len(again.faces)
    assert KDTree(shipped.vertices).query(again.vertices)[0].max() < 1e-6
    assert KDTree(again.vertices).query(shipped.vertices)[0].max() < 1e-6
    assert shipped.area == pytest.approx(again.area, rel=1e-6)


def test_meshes_are_small_and_closed() -> None:
    assert sum(path.stat().st_size for path in shipped_robot().parent.rglob("*")) < 1_000_000
    for path in MESHES:
        mesh = _load(path)
        assert mesh.is_watertight, path.name
        assert mesh.volume > 0, path.name


def _silhouette(robot: Robot, q: np.ndarray, T_camera_base: np.ndarray) -> np.ndarray:
    Ts_base_link = robot.forward_kinematics(torch.tensor(q)).numpy()
    vertices, faces, count = [], [], 0
    for mesh in robot.meshes:
        T_camera_link = T_camera_base @ Ts_base_link[mesh.link]
        vertices.append(mesh.vertices @ T_camera_link[:3, :3].T + T_camera_link[:3, 3])
        faces.append(mesh.faces + count)
        count += len(mesh.vertices)
    face_ids, _ = visibility(np.concatenate(vertices), np.concatenate(faces), (600, 600, 320, 240), 640, 480)
    return face_ids >= 0


def _view(robot: Robot, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """T_camera_base of an endoscope 60 to 150 mm from the wrist that does not look along the shaft."""
    wrist = robot.link_transform(torch.tensor(q), "wrist_yaw_link").numpy()[:3, 3]
    shaft = robot.link_transform(torch.tensor(q), "roll_link").numpy()[:3, 2]
    while True:
        forward = rng.normal(size=3)
        forward /= np.linalg.norm(forward)
        if abs(forward @ shaft) < 0.9:
            break
    right = np.cross(forward, shaft)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    T_camera_base = np.eye(4)
    T_camera_base[:3, :3] = rotation
    T_camera_base[:3, 3] = -rotation @ (wrist - rng.uniform(0.06, 0.15) * forward)
    return T_camera_base


def test_silhouette_is_that_of_an_independent_model(shared_dir: Path) -> None:
    ours = Robot.load(shipped_robot())
    other = Robot.load(shared_dir / "robots/psm_classic_lnd/psm.urdf", base_link="PSM1_base_link", max_faces=MAX_FACES)
    assert other.joint_names == JOINTS
    rng, dice = np.random.default_rng(1), []
    for q in _random_positions(20, seed=1):
        T_camera_base = _view(ours, q, rng)
        a, b = _silhouette(ours, q, T_camera_base), _silhouette(other, q, T_camera_base)
        assert b.sum() > 2000
        dice.append(2 * (a & b).sum() / (a.sum() + b.sum()))
    assert np.mean(dice) > 0.975
    assert min(dice) > 0.96
    print(f"Dice with the independent model: mean {np.mean(dice):.4f}, lowest {min(dice):.4f}")
