"""Robots that are wrong on purpose: refused where they enter, in words, and in good time."""

import time
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from carts_core.errors import RobotError
from carts_core.model import decimation
from carts_core.model.decimation import DecimationError, decimated
from carts_core.model.robot import Robot

BALL = '<mesh filename="ball.stl" scale="1 1 1"/>'
URDF = """<robot name="two">
  <link name="base"><visual><origin xyz="0 0 0" rpy="0 0 0"/><geometry>GEOMETRY</geometry></visual></link>
  <link name="tip"><visual><geometry><sphere radius="0.01"/></geometry></visual></link>
  <joint name="yaw" type="revolute"><parent link="base"/><child link="tip"/><origin xyz="0 0 0.1" rpy="0 0 0"/>
  <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""


@pytest.fixture
def urdf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CARTS_CACHE", str(tmp_path / "cache"))
    trimesh.creation.icosphere(subdivisions=1, radius=0.01).export(tmp_path / "ball.stl")
    path = tmp_path / "two.urdf"
    path.write_text(URDF.replace("GEOMETRY", BALL))
    return path


def refusal(path: Path, before: str = "", after: str = "") -> str:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after, 1))
    start = time.monotonic()
    with pytest.raises(RobotError) as caught:
        Robot.load(path)
    assert time.monotonic() - start < 10.0
    return str(caught.value)


def test_the_right_robot_loads(urdf: Path):
    robot = Robot.load(urdf)
    assert bool(robot.forward_kinematics(torch.zeros(1)).isfinite().all())


@pytest.mark.parametrize(
    ("before", "after", "part"),
    [
        ('lower="-1"', 'lower="nan"', "<limit lower='nan'>"),
        ('lower="-1"', 'lower="2"', "lower limit 2.0 above its upper limit 1.0"),
        ('xyz="0 0 1"', 'xyz="0 0 0"', "axis of joint 'yaw' has zero length"),
        ('xyz="0 0 0.1"', 'xyz="nan 0 0"', "<origin xyz='nan 0 0'>"),
        ('scale="1 1 1"', 'scale="0 0 0"', "<mesh scale='0 0 0'>"),
        ('scale="1 1 1"', 'scale="1e30 1e30 1e30"', "<mesh scale='1e30 1e30 1e30'>"),
        ('scale="1 1 1"', 'scale="1e5 1e5 1e5"', "exceed 100 m"),
        ('radius="0.01"', 'radius="-1"', "<sphere radius='-1'>"),
        ('<parent link="base"/>', '<parent link="none"/>', "parent link 'none', which does not exist"),
        ('<parent link="base"/>', '<parent link="tip"/>', "several links without a parent|loop"),
        ('<link name="tip">', '<link name="base">', "every link needs a unique name; missing or repeated: 'base'"),
        ("</robot>", '<link name="lone"/></robot>', "several links without a parent: base, lone"),
        ('type="revolute"', 'type="floating"', "is of type 'floating'; allowed:"),
        ("<axis", '<mimic joint="yaw"/><axis', "mimics itself"),
        ("<axis", '<mimic joint="none"/><axis', "mimics 'none', which is not a movable joint"),
        ('<robot name="two">', '<!DOCTYPE r [<!ENTITY a "b">]><robot name="two">', "entities"),
        ('<robot name="two">', "<robot>", "must be <robot name"),
        (
            '<robot name="two">',
            '<robot name="two" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="x"/>',
            "is a xacro file. Expand it first: xacro two.urdf > robot.urdf",
        ),
        ("<link", "<a>" * 50_000 + "</a>" * 50_000 + "<link", "nested more than 32 levels deep"),
    ],
)
def test_a_wrong_urdf_is_refused_in_words(urdf: Path, before: str, after: str, part: str):
    message = refusal(urdf, before, after)
    assert any(choice in message for choice in part.split("|")), message


def test_a_loop_of_links_is_refused(urdf: Path):
    loop = "".join(
        f'<link name="{a}"/><joint name="j{a}" type="fixed"><parent link="{b}"/><child link="{a}"/></joint>'
        for a, b in (("x", "y"), ("y", "x"))
    )
    assert "loop" in refusal(urdf, "</robot>", f"{loop}</robot>")


def test_a_huge_limit_means_none(urdf: Path):
    urdf.write_text(urdf.read_text().replace('lower="-1"', 'lower="-1e16"').replace('upper="1"', 'upper="1e16"'))
    assert Robot.load(urdf).joint_limits.tolist() == [[-np.inf, np.inf]]


def test_a_mesh_without_area_is_refused(urdf: Path):
    line = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    trimesh.Trimesh(line, [[0, 1, 2]], process=False).export(urdf.parent / "ball.stl")
    assert "zero area" in refusal(urdf)


def test_a_mesh_that_names_a_device_as_its_material_is_not_followed(urdf: Path):
    (urdf.parent / "zero.mtl").symlink_to("/dev/zero")
    (urdf.parent / "ball.obj").write_text("mtllib zero.mtl\nusemtl a\nv 0 0 0\nv 0 1 0\nv 1 0 0\nf 1 2 3\n")
    urdf.write_text(urdf.read_text().replace("ball.stl", "ball.obj"))
    assert len(Robot.load(urdf).meshes[0].faces) == 1


def test_a_texture_that_is_refused_prints_nothing(urdf: Path, caplog: pytest.LogCaptureFixture, capfd):
    (urdf.parent / "ball.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile large.png\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nproperty float s\nproperty float t\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0 0 0\n0.1 0 0 0 1\n0 0.1 0 1 1\n3 0 1 2\n"
    )
    (urdf.parent / "large.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + b"\0\1\0\0" * 2 + b"\x08\0\0\0\0")
    urdf.write_text(urdf.read_text().replace("ball.stl", "ball.ply"))
    assert len(Robot.load(urdf).meshes[0].faces) == 1
    assert caplog.records == [] and capfd.readouterr() == ("", "")


def test_decimation_that_takes_too_long_is_stopped(monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(0)
    vertices, faces = rng.normal(size=(100_000, 3)), rng.integers(0, 100_000, (300_000, 3))
    monkeypatch.setattr(decimation, "_SECONDS", 1.0)
    monkeypatch.setattr(decimation, "_SECONDS_PER_FACE", 0.0)
    start = time.monotonic()
    with pytest.raises(DecimationError, match="not simplified within 1 s"):
        decimated(vertices, faces, 0.1)
    assert time.monotonic() - start < 20.0


def test_decimation_gives_few_triangles_within_the_tolerance_and_says_how_far_they_are_off():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.01)
    tolerance = 8e-5
    vertices, faces, moved = decimated(np.array(ball.vertices), np.array(ball.faces), tolerance)
    assert 0 < moved <= tolerance
    assert len(faces) < 0.7 * len(ball.faces)
    # Between its vertices the ball itself lies a little inside the sphere.
    sag = 0.01 - np.linalg.norm(ball.triangles.mean(1), axis=1).min()
    points = np.concatenate([vertices, vertices[faces].mean(1)])
    assert np.abs(np.linalg.norm(points, axis=1) - 0.01).max() < tolerance + sag


def test_the_deviation_of_a_moved_mesh_is_how_far_it_was_moved():
    box = trimesh.creation.box((0.02, 0.03, 0.04))
    vertices, faces = np.array(box.vertices), np.array(box.faces)
    assert decimation.deviation(vertices, faces, vertices, faces) < 1e-12
    assert decimation.deviation(vertices, faces, vertices + np.array([0, 0, 1e-3]), faces) == pytest.approx(
        1e-3, rel=1e-6
    )
    assert decimation.deviation(vertices, faces, vertices * 1.1, faces) == pytest.approx(0.00269, rel=0.01)
