"""Reading of URDFs, and the kinematics of what was read, against another reader."""

import io
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import yourdfpy

from carts_core.errors import RobotError
from carts_core.model.kinematics import Kinematics
from carts_core.model.robot import Robot
from carts_core.model.urdf import Box, Cylinder, MeshFile, Sphere, Urdf, read_urdf
from carts_core.resources import shipped_robot

BRANCHED = """<robot name="branched">
  <material name="red"><color rgba="1 0 0 0.5"/></material>
  <link name="tip"><visual><geometry><sphere radius="0.01"/></geometry></visual></link>
  <link name="base">
    <visual><origin xyz="1 2 3" rpy="0.1 0.2 0.3"/><geometry><box size="1,2,3"/></geometry>
      <material name="red"/></visual>
    <visual><geometry><cylinder radius="0.1" length="2"/></geometry>
      <material name="own"><color rgba="0 1 0 1"/></material></visual>
    <visual><geometry><mesh filename="a.stl" scale="0.001"/></geometry><material name="unknown"/></visual>
  </link>
  <link name="arm"/><link name="slide"/><link name="finger"/><link name="plate"/>
  <joint name="grip" type="revolute"><parent link="slide"/><child link="finger"/><origin xyz="0 0 0.2" rpy="0 1 0"/>
    <axis xyz="0 0 -1"/><mimic joint="push" multiplier="-2" offset="0.3"/></joint>
  <joint name="turn" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="1 2 -2"/>
    <limit effort="1" velocity="1" lower="-1" upper="1"/></joint>
  <joint name="push" type="prismatic"><parent link="arm"/><child link="slide"/><origin xyz="0.3 0 0" rpy="1 2 3"/>
    <axis xyz="0 1 0"/><limit effort="1" velocity="1" lower="-0.1" upper="1e9"/></joint>
  <joint name="weld" type="fixed"><parent link="arm"/><child link="plate"/><origin rpy="0 0 0.5"/>
    <axis xyz="0 0 0"/></joint>
  <joint name="bend" type="revolute"><parent link="plate"/><child link="tip"/></joint>
</robot>"""


def read(text: str) -> Urdf:
    return read_urdf(ElementTree.fromstring(text))


def test_links_are_read_with_what_is_seen_of_them() -> None:
    tip, base, *_ = read(BRANCHED).links
    box, cylinder, mesh = base.visuals
    assert isinstance(box.shape, Box) and box.shape.size.tolist() == [1, 2, 3]
    assert box.rgba is not None and box.rgba.tolist() == [1, 0, 0, 0.5]
    assert cylinder.shape == Cylinder(0.1, 2.0) and cylinder.T_link_shape is None
    assert cylinder.rgba is not None and cylinder.rgba.tolist() == [0, 1, 0, 1]
    assert isinstance(mesh.shape, MeshFile) and mesh.shape.scale.tolist() == [0.001] * 3 and mesh.rgba is None
    assert tip.visuals[0].shape == Sphere(0.01) and tip.visuals[0].rgba is None


def test_joints_are_read_with_their_limits_and_an_axis_that_is_not_given_is_x() -> None:
    urdf = read(BRANCHED)
    assert urdf.root == "base" and [joint.name for joint in urdf.free_joints] == ["turn", "push", "bend"]
    joints = {joint.name: joint for joint in urdf.joints}
    assert joints["turn"].limits == joints["bend"].limits == (-np.inf, np.inf)
    assert joints["push"].limits == (-0.1, np.inf)
    assert np.allclose(joints["turn"].axis, np.array([1, 2, -2]) / 3) and joints["bend"].axis.tolist() == [1, 0, 0]
    order = [joint.name for joint in urdf.downwards()]
    assert sorted(order) == sorted(joints) and order.index("weld") < order.index("bend")


@pytest.mark.parametrize(
    ("before", "after", "part"),
    [
        ('<geometry><sphere radius="0.01"/></geometry>', "", "a <visual> without a <geometry>"),
        ('<geometry><sphere radius="0.01"/></geometry>', "<geometry/>", "a <visual> without a <geometry>"),
        ('<sphere radius="0.01"/>', '<capsule radius="0.01"/>', "a <geometry> of an unknown kind, <capsule>"),
        ('<sphere radius="0.01"/>', "<sphere/>", "a <sphere> without its radius"),
        ('<cylinder radius="0.1" length="2"/>', '<cylinder radius="0.1"/>', "a <cylinder> without its length"),
    ],
)
def test_what_is_missing_is_said(tmp_path: Path, before: str, after: str, part: str) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(BRANCHED.replace(before, after))
    with pytest.raises(RobotError) as caught:
        Robot.load(path)
    assert f"is not a readable URDF ({part}). Check it with a URDF viewer." in str(caught.value)


@pytest.mark.parametrize("text", [BRANCHED, shipped_robot().read_text()], ids=["branched", "shipped"])
def test_links_are_where_another_reader_has_them(text: str) -> None:
    # It wants numbers without commas.
    other = yourdfpy.URDF.load(io.BytesIO(text.replace("1,2,3", "1 2 3").encode()), load_meshes=False)
    urdf = read(text)
    kinematics = Kinematics(urdf, None, Path("robot.urdf"))
    assert kinematics.joint_names == tuple(other.actuated_joint_names)
    names = tuple(link.name for link in urdf.links)
    for positions in np.random.default_rng(0).uniform(-1, 1, (20, len(kinematics.joint_names))):
        other.update_cfg(positions)
        Ts = kinematics(torch.from_numpy(positions), names).numpy()
        expected = [other.get_transform(name, urdf.root) for name in names]
        np.testing.assert_allclose(Ts, expected, rtol=0, atol=1e-12)


def test_derivatives_are_those_of_finite_differences() -> None:
    kinematics = Kinematics(read(BRANCHED), None, Path("robot.urdf"))
    positions = torch.tensor([[0.3, 0.2, -0.7], [0.0, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda q: kinematics(q, ("finger", "tip")), positions)
