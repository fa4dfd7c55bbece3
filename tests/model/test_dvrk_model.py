"""Robots from a small tree with the layout of dvrk_model, and from the real tree if available."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dvrk_tree import XACRO, write_model

from carts_core import package_imports as extras
from carts_core.cli.command_line import BAD_INPUT, main
from carts_core.decoders.meshes import MAX_FACES
from carts_core.errors import CartsError, RobotError
from carts_core.model.dvrk_model import dvrk_urdf, list_instruments
from carts_core.model.psm_kinematics import CLASSIC, JOINT_NAMES, SI, forward
from carts_core.model.robot import Robot
from carts_core.package_imports import require_package


@pytest.fixture
def model(tmp_path: Path) -> Path:
    write_model(tmp_path / "a checkout")
    return tmp_path / "a checkout"


def moved_by(robot: Robot, joints: np.ndarray, link: str) -> np.ndarray:
    positions = torch.zeros(len(joints), len(robot.joint_names), dtype=torch.float64)
    for column, name in enumerate(JOINT_NAMES):
        positions[:, robot.joint_index(name)] = torch.from_numpy(joints[:, column])
    return robot.link_transform(positions, link).numpy()


@pytest.mark.parametrize(("number", "geometry"), [("400093", CLASSIC), ("420093", SI)])
def test_the_command_writes_a_urdf_with_the_controllers_kinematics(model, tmp_path, monkeypatch, number, geometry):
    monkeypatch.chdir(tmp_path)
    main(["robot", str(model), "--instrument", number, "-o", "robots/x.urdf"])
    robot = Robot.load("robots/x.urdf")
    assert robot.joint_names == (*JOINT_NAMES, "jaw")
    assert robot.link_names == ("roll_link", "wrist_pitch_link", "jaw_link")
    joints = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 6))
    geometry = replace(geometry, wrist_length=0.0107)
    T_yaw_tip = np.linalg.inv(moved_by(robot, np.zeros((1, 6)), "wrist_yaw_link")) @ forward(np.zeros((1, 6)), geometry)
    tips = moved_by(robot, joints, "wrist_yaw_link") @ T_yaw_tip
    assert np.abs(tips - forward(joints, geometry)).max() < 1e-7


def test_without_an_instrument_the_command_lists_those_of_the_tree(model, capsys):
    main(["robot", str(model)])
    printed = capsys.readouterr().out
    assert "400093" in printed and "Potts Scissors" in printed and "boxes only" in printed


@pytest.mark.parametrize(
    ("number", "message"),
    [
        ("400001", r"only 5 mm boxes.*Instruments with meshes: 400093 \(Prograsp Forceps\), 420093"),
        ("123456", r"is not in .*It contains: 400001, 400093, 420093"),
    ],
)
def test_instruments_without_a_shape_and_unknown_ones_are_refused_in_words(model, number, message):
    with pytest.raises(RobotError, match=message):
        dvrk_urdf(model, number, model)


def test_git_lfs_pointers_are_told_from_meshes(model, capsys):
    (model / "meshes/part.obj").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    output = model.parent / "x.urdf"
    with pytest.raises(SystemExit) as stopped:
        main(["robot", str(model), "--instrument", "400093", "-o", str(output)])
    assert stopped.value.code == BAD_INPUT
    said = capsys.readouterr().err
    assert "Git LFS pointers" in said and "lfs pull" in said
    assert not output.exists()


def test_missing_and_broken_meshes_leave_nothing_behind(model):
    output = model.parent / "x.urdf"
    command = ["robot", str(model), "--instrument", "400093", "-o", str(output)]
    (model / "meshes/part.obj").write_text("nothing")
    with pytest.raises(SystemExit):
        main(command)
    (model / "meshes/part.obj").unlink()
    with pytest.raises(SystemExit):
        main(command)
    assert not output.exists()
    with pytest.raises(RobotError, match=r"lacks meshes of this instrument: meshes/part\.obj"):
        dvrk_urdf(model, "400093", model)


def test_a_file_is_replaced_only_on_request(model, tmp_path):
    output = tmp_path / "x.urdf"
    output.write_text("mine")
    with pytest.raises(SystemExit):
        main(["robot", str(model), "--instrument", "400093", "-o", str(output)])
    assert output.read_text() == "mine"
    main(["robot", str(model), "--instrument", "400093", "-o", str(output), "--overwrite"])
    assert output.read_text().startswith("<robot")


@pytest.mark.parametrize("content", ["[1", "[" * 50_000, "instruments: 3", "instruments: {'400006': {}}", "\xff"])
def test_a_tree_without_a_readable_table_is_refused(model, content):
    (model / "urdf/common/instruments/instruments.yaml").write_bytes(content.encode("latin-1"))
    with pytest.raises(RobotError, match="not a table of instruments"):
        list_instruments(model)


def test_another_folder_and_broken_macros_are_refused(model, tmp_path):
    with pytest.raises(RobotError, match="not a checkout of dvrk_model"):
        list_instruments(tmp_path)
    (model / "urdf/Classic/PSM1.urdf.xacro").write_text(f"{XACRO}<xacro:nothing/></robot>")
    with pytest.raises(RobotError, match="cannot be expanded"):
        dvrk_urdf(model, "400093", model)
    code = "[().__class__.__base__ for _ in [1]]"
    (model / "urdf/Classic/PSM1.urdf.xacro").write_text(f'{XACRO}<link name="${{{code}}}"/></robot>')
    with pytest.raises(RobotError, match="is not supported"):
        dvrk_urdf(model, "400093", model)
    (model / "urdf/Classic/PSM1.urdf.xacro").write_text(f'{XACRO}<link name="world"/></robot>')
    with pytest.raises(RobotError, match="has no link 'roll_link'"):
        dvrk_urdf(model, "400093", model)


def test_a_missing_extra_is_said_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    with pytest.raises(CartsError, match=r"requires the package xacrodoc, .*: pip install 'carts\[import\]'"):
        require_package("xacrodoc", "import")


@pytest.mark.parametrize("number", [pytest.param("400006", marks=pytest.mark.slow), "420093"])
def test_the_real_trees_instruments_have_the_controllers_kinematics(shared_dir, tmp_path, number):
    path = tmp_path / "psm.urdf"
    path.write_text(dvrk_urdf(shared_dir / "robots/dvrk_model", number, tmp_path))
    robot = Robot.load(path, max_faces=MAX_FACES)
    geometry = replace(CLASSIC if number < "42" else SI, wrist_length=0.0091 if number[3:] == "006" else 0.0107)
    limits = np.array(geometry.limits)
    joints = limits[:, 0] + np.random.default_rng(0).random((50, 6)) * (limits[:, 1] - limits[:, 0])
    T_tip_end = np.linalg.inv(forward(joints, geometry)) @ moved_by(robot, joints, "tool_tip_link")
    assert np.abs(T_tip_end - T_tip_end[0]).max() < 1e-7
    assert np.allclose(T_tip_end[0, :3, :3], np.eye(3), atol=1e-7)
