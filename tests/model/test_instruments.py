"""The built-in instruments: their files, their kinematics, their parts, and their likeness to real meshes."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from carts_core.cli.command_line import main
from carts_core.decoders.meshes import MAX_FACES
from carts_core.errors import RobotError, SequenceError
from carts_core.model.dvrk_model import dvrk_urdf
from carts_core.model.instruments import INSTRUMENTS, Instrument, builtin_urdf
from carts_core.model.instruments.builtin import instrument_of
from carts_core.model.keypoints import keypoints
from carts_core.model.parts import PARTS, link_parts
from carts_core.model.psm_kinematics import forward
from carts_core.model.robot import Robot
from carts_core.model.scene import Arm
from carts_core.recording import Sequence
from carts_core.rendering import visibility
from carts_core.rendering.portrait import portrait
from carts_core.resources import sample_sequence

CLASSIC = [instrument.name for instrument in INSTRUMENTS]
JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw", "jaw")
DVRK_MODEL = Path(__file__).parents[3] / "shared" / "robots" / "dvrk_model"


@pytest.fixture(scope="module", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CARTS_CACHE", str(tmp_path_factory.mktemp("cache")))
        builtin_urdf.cache_clear()
        yield
    builtin_urdf.cache_clear()


@cache
def loaded(name: str) -> Robot:
    return Robot.load(f"builtin:{name}")


@pytest.mark.parametrize("name", [*CLASSIC, "large_needle_driver_si", "mega_needle_driver_si", "cautery_hook_si"])
def test_an_instrument_has_the_joints_and_the_kinematics_of_its_arm(name: str) -> None:
    robot = loaded(name)
    instrument, geometry = instrument_of(name)
    assert robot.joint_names == JOINTS[: 7 if instrument.has_jaws else 6]
    low, high = robot.joint_limits.T
    positions = np.random.default_rng(0).uniform(low, high, (50, len(low)))
    Ts = robot.link_transform(torch.from_numpy(positions), "wrist_yaw_link").numpy()
    expected = forward(positions[:, :6], geometry)
    np.testing.assert_allclose(Ts[:, :3, 3], expected[:, :3, 3], rtol=0, atol=1e-8)
    # The tip frame's z points along the closed jaws, which is y of the link that they turn on.
    np.testing.assert_allclose(Ts[:, :3, 1], expected[:, :3, 2], rtol=0, atol=1e-8)


@pytest.mark.parametrize("instrument", INSTRUMENTS, ids=lambda instrument: instrument.name)
def test_meshes_are_closed_small_and_of_the_stated_length(instrument: Instrument) -> None:
    robot = loaded(instrument.name)
    assert all(mesh.closed for mesh in robot.meshes)
    assert 3_000 < sum(len(mesh.faces) for mesh in robot.meshes) < 12_000
    joints = torch.zeros(len(robot.joint_names), dtype=torch.float64)
    Ts, hinge = robot.forward_kinematics(joints), robot.link_transform(joints, "wrist_yaw_link").numpy()
    T_hinge_links = np.linalg.inv(hinge) @ Ts.numpy()
    end = max((mesh.vertices @ T_hinge_links[mesh.link, 1, :3] + T_hinge_links[mesh.link, 1, 3]).max()
              for mesh in robot.meshes)  # fmt: skip
    assert end == pytest.approx(instrument.length * 1e-3, abs=6e-4)
    parts = {name: PARTS[part] for name, part in zip(robot.link_names, link_parts(robot), strict=True)}
    assert parts["roll_link"] == "shaft"
    assert parts["wrist_pitch_link"] == "wrist"
    assert {part for name, part in parts.items() if name.startswith("jaw")} == {"jaws"}
    named = [point.name for point in keypoints(Arm("arm", robot, np.eye(4)))]
    assert ("jaw 1 tip" in named) == instrument.has_jaws


def test_jaws_open_to_opposite_sides_and_do_not_overlap() -> None:
    for name in ("debakey_forceps", "clip_applier"):
        robot = loaded(name)
        first, second = (
            np.concatenate([mesh.vertices for mesh in robot.meshes if robot.link_names[mesh.link] == link])
            for link in ("jaw_1_link", "jaw_2_link")
        )
        beyond_the_hub = 0.012
        assert (first[first[:, 1] > beyond_the_hub, 0] <= 0).all()
        assert (second[second[:, 1] > beyond_the_hub, 0] >= 0).all()


def test_the_same_files_are_made_again_and_a_damaged_one_is_replaced() -> None:
    urdf = builtin_urdf("cautery_hook")
    mesh = urdf.parent / "meshes" / "tip_electrode.ply"
    whole = mesh.read_bytes()
    mesh.write_bytes(b"not a mesh")
    builtin_urdf.cache_clear()
    assert builtin_urdf("cautery_hook") == urdf
    assert mesh.read_bytes() == whole


def test_an_unknown_name_is_answered_with_the_nearest_one() -> None:
    with pytest.raises(RobotError, match=r"no robot 'builtin:scissors'.*`carts robots` lists"):
        Robot.load("builtin:scissors")
    with pytest.raises(RobotError, match="Did you mean 'builtin:cautery_hook"):
        Robot.load("builtin:cautery_hok")


def test_a_sequence_file_names_an_instrument(tmp_path: Path) -> None:
    sample = sample_sequence()
    text = sample.read_text().replace("builtin:psm_lnd", "builtin:curved_scissors")
    for name in ("images", "masks", "kinematics.csv", "truth.csv"):
        (tmp_path / name).symlink_to(sample.parent / name)
    (tmp_path / "sequence.toml").write_text(text)
    assert Sequence.open(tmp_path / "sequence.toml").scene.arms[0].robot.name == "curved_scissors"
    (tmp_path / "sequence.toml").write_text(text.replace("curved_scissors", "curved_scissor"))
    with pytest.raises(SequenceError, match="Did you mean 'builtin:curved_scissors"):
        Sequence.open(tmp_path / "sequence.toml")


def test_the_command_lists_every_instrument(capsys: pytest.CaptureFixture[str]) -> None:
    main(["robots"])
    shown = capsys.readouterr().out
    assert all(instrument.name in shown for instrument in INSTRUMENTS)


def test_a_portrait_shows_the_tip_whole_before_its_backdrop() -> None:
    image = portrait(loaded("clip_applier"), 160, 120)
    backdrop = image == image[0, -1]
    assert 0.03 < (~backdrop.all(-1)).mean() < 0.5
    assert backdrop[:, -8:].all()
    assert backdrop[:4].all()
    assert backdrop[-4:].all()


SLOW = pytest.mark.slow


@pytest.mark.skipif(not DVRK_MODEL.is_dir(), reason="dvrk_model is not beside this checkout")
@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("maryland_bipolar_forceps", "400172"),
        pytest.param("mega_needle_driver", "400194", marks=SLOW),
        pytest.param("prograsp_forceps", "400093", marks=SLOW),
        pytest.param("cautery_hook", "400183", marks=SLOW),
        pytest.param("cautery_spatula", "400184", marks=SLOW),
        pytest.param("clip_applier_si", "420327", marks=SLOW),
    ],
)
def test_silhouettes_are_like_those_of_the_real_meshes(name: str, number: str, tmp_path: Path) -> None:
    urdf = tmp_path / "real.urdf"
    urdf.write_text(dvrk_urdf(DVRK_MODEL, number, tmp_path))
    # Decimating a real one would take a minute.
    ours, real = loaded(name), Robot.load(urdf, max_faces=MAX_FACES)
    rng = np.random.default_rng(1)
    overlaps = []
    for _ in range(8):
        joints = np.r_[0.0, 0.0, 0.1, rng.uniform(-2, 2), rng.uniform(-0.7, 0.7, 2), rng.uniform(0, 0.6)]
        masks = [_tip_mask(robot, joints[: len(robot.joint_names)]) for robot in (ours, real)]
        overlaps.append((masks[0] & masks[1]).sum() / (masks[0] | masks[1]).sum())
    assert np.mean(overlaps) > 0.85


def _tip_mask(robot: Robot, joints: np.ndarray) -> np.ndarray:
    """What is seen beyond the shaft's tube, from the side."""
    q = torch.from_numpy(joints)
    shaft = robot.link_transform(q, "insertion_link").numpy()
    T_camera_base = np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0.12], [0, 0, 0, 1.0]]) @ np.linalg.inv(shaft)
    pitch = T_camera_base @ robot.link_transform(q, "wrist_pitch_link").numpy()[:, 3]
    T_camera_base[:3, 3] -= (pitch[0] + 0.005, 0, 0)
    Ts, vertices, faces, count = T_camera_base @ robot.forward_kinematics(q).numpy(), [], [], 0
    for mesh in robot.meshes:
        vertices.append(mesh.vertices @ Ts[mesh.link, :3, :3].T + Ts[mesh.link, :3, 3])
        faces.append(mesh.faces + count)
        count += len(mesh.vertices)
    width, height = 480, 400
    ids, _ = visibility(np.concatenate(vertices), np.concatenate(faces), (1200, 1200, 140, 200), width, height)
    return ids >= 0
