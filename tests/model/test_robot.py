"""Robots from URDF files: forward kinematics, mimic joints, meshes, errors."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import yourdfpy

from carts_core.decoders.meshes import MAX_FACES
from carts_core.errors import RobotError
from carts_core.model.decimation import deviation
from carts_core.model.link_mesh import mesh_path
from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_core.model.robot import Robot
from carts_core.resources import shipped_robot

LENGTH_RCC, LENGTH_TOOL, PITCH_TO_YAW, YAW_TO_TIP = 0.4318, 0.4162, 0.0091, 0.0102
HALF = np.pi / 2


def dh_row(alpha: float, a: float, d: float, theta: float) -> np.ndarray:
    """A row of a modified Denavit-Hartenberg table as a transform."""
    ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
    return np.array(
        [[ct, -st, 0, a], [st * ca, ct * ca, -sa, -d * sa], [st * sa, ct * sa, ca, d * ca], [0, 0, 0, 1]], dtype=float
    )


def psm_tip(q: np.ndarray) -> np.ndarray:
    """T_base_tip of the classic PSM by its published table."""
    rows = [
        (HALF, 0, 0, q[0] + HALF),
        (-HALF, 0, 0, q[1] - HALF),
        (HALF, 0, q[2] - LENGTH_RCC, 0),
        (0, 0, LENGTH_TOOL, q[3]),
        (-HALF, 0, 0, q[4] - HALF),
        (-HALF, PITCH_TO_YAW, 0, q[5] - HALF),
        (-HALF, 0, YAW_TO_TIP, HALF),
    ]
    return np.linalg.multi_dot([dh_row(*row) for row in rows])


def random_positions(count: int) -> np.ndarray:
    """Six joint positions of a PSM each [rad, m]."""
    rng = np.random.default_rng(0)
    low, high = [-1.5, -0.75, 0.05, -2.5, -1.3, -1.3], [1.5, 0.75, 0.24, 2.5, 1.3, 1.3]
    return rng.uniform(low, high, (count, 6))


def largest_error(robot: Robot, joints: tuple[str, ...], tip_link: str, dtype: torch.dtype) -> float:
    six = random_positions(1000)
    q = np.zeros((len(six), len(robot.joint_names)))
    for column, name in enumerate(joints):
        q[:, robot.joint_index(name)] = six[:, column]
    T_base_tip = robot.link_transform(torch.tensor(q, dtype=dtype), tip_link).numpy()
    truth = np.stack([psm_tip(row) for row in six])
    error = float(np.abs(T_base_tip[:, :3, 3] - truth[:, :3, 3]).max())
    print(f"{tip_link}, {dtype}, {len(six)} poses: off by {error:.1e} m at most")
    return error


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_forward_kinematics_of_the_shipped_psm_is_the_dh_formula(shipped_psm: Robot, dtype: torch.dtype) -> None:
    assert largest_error(shipped_psm, JOINT_NAMES, "tool_tip_link", dtype) < 1e-6


SURROL = tuple(f"psm_{name}_joint" for name in ("yaw", "pitch_back", "main_insertion"))
SURROL += tuple(f"psm_tool_{name}_joint" for name in ("roll", "pitch", "yaw"))


@pytest.mark.parametrize(
    ("name", "base_link", "joints", "tip_link"),
    [
        ("psm_classic_lnd", "PSM1_base_link", JOINT_NAMES, "PSM1_tool_tip_link"),
        ("psm_surrol", "psm_remote_center_link", SURROL, "psm_tool_tip_link"),
    ],
)
def test_forward_kinematics_of_other_models_is_the_dh_formula(
    shared_dir: Path, name: str, base_link: str, joints: tuple[str, ...], tip_link: str
) -> None:
    robot = Robot.load(shared_dir / f"robots/{name}/psm.urdf", base_link=base_link, max_faces=MAX_FACES)
    assert largest_error(robot, joints, tip_link, torch.float32) < 1e-6


def test_mimic_joints_are_folded_into_the_joint_that_they_follow(shipped_psm: Robot) -> None:
    assert shipped_psm.joint_names == ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw", "jaw")
    open_jaw = torch.zeros(7)
    open_jaw[-1] = 0.6
    first = shipped_psm.link_transform(open_jaw, "jaw_1_link")
    second = shipped_psm.link_transform(open_jaw, "jaw_2_link")
    between = first[:3, :3].T @ second[:3, :3]
    angle = torch.arccos((between.trace() - 1) / 2)
    assert float(angle) == pytest.approx(0.6, abs=1e-5)


def test_batches_of_any_shape_agree_with_single_configurations(shipped_psm: Robot) -> None:
    q = torch.rand(2, 3, 7) * 0.2
    batch = shipped_psm.forward_kinematics(q)
    assert batch.shape == (2, 3, len(shipped_psm.link_names), 4, 4)
    assert torch.allclose(batch[1, 2], shipped_psm.forward_kinematics(q[1, 2]))


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda robot: robot.forward_kinematics(torch.zeros(5)), "got 5 joint positions .* 7 degrees of freedom: yaw"),
        (lambda robot: robot.joint_index("elbow"), r"has no joint 'elbow'.*yaw, pitch, insertion"),
        (lambda robot: robot.link_transform(torch.zeros(7), "tip"), r"no link 'tip'\. Its links: .*tool_tip_link"),
    ],
)
def test_what_a_robot_lacks_is_said_with_what_it_has(shipped_psm: Robot, ask: Callable, message: str) -> None:
    with pytest.raises(RobotError, match=message):
        ask(shipped_psm)


def test_a_missing_mesh_names_the_file_and_the_remedy(tmp_path: Path) -> None:
    text = shipped_robot().read_text()
    first = text.split('filename="')[1].split('"')[0]
    urdf = tmp_path / "psm.urdf"
    urdf.write_text(text)
    with pytest.raises(RobotError, match=f"(?s)mesh .*{Path(first).name} is missing.*Add the file"):
        Robot.load(urdf)


def test_a_file_that_is_no_urdf_is_named(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text("not XML")
    with pytest.raises(RobotError, match=r"robot\.urdf is not a readable URDF"):
        Robot.load(path)


def test_a_base_link_that_moves_is_refused() -> None:
    with pytest.raises(RobotError, match="moves with a joint"):
        Robot.load(shipped_robot(), base_link="roll_link")


def test_meshes_come_from_the_cache_the_second_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CARTS_CACHE", str(tmp_path))
    lines: list[str] = []
    first = Robot.load(shipped_robot(), progress=lines.append)
    assert lines and list(tmp_path.glob("*.npz"))
    lines.clear()
    second = Robot.load(shipped_robot(), progress=lines.append)
    assert not lines
    for a, b in zip(first.meshes, second.meshes, strict=True):
        assert np.array_equal(a.vertices, b.vertices) and np.array_equal(a.faces, b.faces)


def test_a_changed_material_is_not_taken_from_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CARTS_CACHE", str(tmp_path / "cache"))
    (tmp_path / "arm.urdf").write_text(BRANCHED.replace('<sphere radius="0.01"/>', '<mesh filename="part.obj"/>'))
    faces = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl paint\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "part.obj").write_text(f"mtllib paint.mtl\n{faces}")
    for colour in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)):
        (tmp_path / "paint.mtl").write_text("newmtl paint\nKd {} {} {}\n".format(*colour))
        (mesh,) = Robot.load(tmp_path / "arm.urdf").meshes
        assert np.allclose(mesh.color, colour)


def test_a_damaged_cache_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CARTS_CACHE", str(tmp_path))
    Robot.load(shipped_robot())
    (cached,) = tmp_path.glob("*.npz")
    cached.write_bytes(cached.read_bytes()[:100])
    assert len(Robot.load(shipped_robot()).meshes) > 0


def instrument_of(urdf: Path, *meshes: str) -> Path:
    """The shipped robot with some of its meshes only: decimating each takes a second."""
    lines = shipped_robot().read_text().splitlines()
    kept = [line for line in lines if "<visual>" not in line or any(f"/{name}.ply" in line for name in meshes)]
    urdf.write_text("\n".join(kept).replace("meshes/", f"{shipped_robot().parent}/meshes/"))
    return urdf


@pytest.mark.slow
def test_decimation_keeps_to_the_tolerance_of_an_instrument(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CARTS_CACHE", str(tmp_path))
    urdf = instrument_of(tmp_path / "instrument.urdf", "shaft_tube", "shaft_clevis")
    whole = Robot.load(urdf)
    assert len(whole.meshes) == 2
    lines: list[str] = []
    robot = Robot.load(urdf, max_faces=1000, progress=lines.append)
    assert sum(len(mesh.faces) for mesh in robot.meshes) == robot.decimation.after < 0.8 * robot.decimation.before
    assert 0 < robot.decimation.deviation <= 2e-4
    assert any("the surface moves by at most" in line for line in lines)
    for mesh, original in zip(robot.meshes, whole.meshes, strict=True):
        moved = deviation(mesh.vertices, mesh.faces, original.vertices, original.faces)
        assert moved <= 2.2e-4
    assert Robot.load(urdf, max_faces=1000).decimation == robot.decimation


def test_decimation_of_a_robot_keeps_to_a_thousandth_of_its_reach(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.3).apply_translation((0, 0, 0.7))
    ball.export(tmp_path / "ball.stl")
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="base"/><link name="hand"><visual><geometry><mesh filename="ball.stl"/>'
        '</geometry></visual></link><joint name="turn" type="revolute"><parent link="base"/><child link="hand"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    robot = Robot.load(tmp_path / "arm.urdf", max_faces=2000)
    reach = 1.0
    assert robot.decimation.after < robot.decimation.before / 2
    assert 2e-4 < robot.decimation.deviation <= 1.2e-3 * reach


def test_a_urdf_that_xacro_made_is_no_xacro_though_it_declares_the_namespace(tmp_path: Path) -> None:
    expanded = shipped_robot().read_text().replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ')
    (tmp_path / "arm.urdf").write_text(expanded.replace("meshes/", f"{shipped_robot().parent}/meshes/"))
    assert len(Robot.load(tmp_path / "arm.urdf").meshes) == len(Robot.load(shipped_robot()).meshes)


BRANCHED = """<robot name="branched">
  <link name="tip"><visual><geometry><sphere radius="0.01"/></geometry></visual></link>
  <link name="base"/><link name="arm"/><link name="slide"/><link name="finger"/><link name="plate"/>
  <joint name="grip" type="revolute"><parent link="slide"/><child link="finger"/><origin xyz="0 0 0.2" rpy="0 1 0"/>
    <axis xyz="0 0 -1"/><mimic joint="push" multiplier="-2" offset="0.3"/></joint>
  <joint name="turn" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="1 2 -2"/></joint>
  <joint name="push" type="prismatic"><parent link="arm"/><child link="slide"/><origin xyz="0.3 0 0" rpy="1 2 3"/>
    <axis xyz="0 1 0"/><limit effort="1" velocity="1" lower="-0.1" upper="1e9"/></joint>
  <joint name="weld" type="fixed"><parent link="arm"/><child link="plate"/><origin rpy="0 0 0.5"/></joint>
  <joint name="bend" type="revolute"><parent link="plate"/><child link="tip"/></joint>
</robot>"""


def test_links_are_where_another_library_has_them_and_an_axis_that_is_not_given_is_x(tmp_path: Path) -> None:
    path = tmp_path / "branched.urdf"
    path.write_text(BRANCHED)
    robot, other = Robot.load(path), yourdfpy.URDF.load(str(path), load_meshes=False)
    assert robot.joint_names == tuple(other.actuated_joint_names) == ("turn", "push", "bend")
    assert robot.joint_limits.tolist() == [[-np.inf, np.inf], [-0.1, np.inf], [-np.inf, np.inf]]
    for positions in np.random.default_rng(0).uniform(-1, 1, (20, 3)):
        other.update_cfg(positions)
        for link in ("tip", "arm", "slide", "finger", "plate"):
            T, of_tensor = (robot.link_transform(q, link) for q in (positions, torch.from_numpy(positions)))
            np.testing.assert_allclose(T, other.get_transform(link, "base"), rtol=0, atol=1e-6)
            np.testing.assert_allclose(T, of_tensor, rtol=0, atol=1e-6)


def test_derivatives_of_transforms_are_those_of_finite_differences(tmp_path: Path) -> None:
    path = tmp_path / "branched.urdf"
    path.write_text(BRANCHED)
    robot = Robot.load(path)
    positions = torch.tensor([[0.3, 0.02, -0.7], [0.0, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    for link in ("finger", "tip"):
        assert torch.autograd.gradcheck(lambda q, link=link: robot.link_transform(q, link), positions)


TETRAHEDRON = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><contributor/><unit name="any" meter="{metres}"/><up_axis>{axis}</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">0 0 0 {size} 0 0 0 {size} 0 0 0 {size}</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""


@pytest.mark.parametrize("axis", ["Y_UP", "Z_UP"])
@pytest.mark.parametrize(("metres", "unit"), [("0.001", "mm"), ("0.0254", "inch"), ("1", "m")])
def test_collada_units_are_applied_and_up_axes_reported(tmp_path: Path, metres: str, unit: str, axis: str) -> None:
    size = 0.03 / float(metres)
    (tmp_path / "tip.dae").write_text(TETRAHEDRON.format(metres=metres, axis=axis, size=size))
    (tmp_path / "robot.urdf").write_text(
        '<robot name="r"><link name="base"/><link name="tip"><visual><geometry><mesh filename="tip.dae"/></geometry>'
        '</visual></link><joint name="j" type="revolute"><parent link="base"/><child link="tip"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    robot = Robot.load(tmp_path / "robot.urdf")
    assert np.ptp(robot.meshes[0].vertices, axis=0) == pytest.approx([0.03] * 3, rel=1e-5)
    # As in RViz, coordinates stay as they are in the file, and <origin> turns them.
    assert robot.meshes[0].vertices.min() == pytest.approx(0.0, abs=1e-9)
    said = " ".join(robot.remarks)
    assert ("scaled by the unit of the COLLADA file" in said) == (unit != "m")
    assert (f"up axis {axis} of the COLLADA file is ignored" in said) == (axis == "Y_UP")


TRANSLUCENT = """<robot name="r"><material name="glass"><color rgba="1 0 0 0.5"/></material>
<link name="base"><visual><geometry><sphere radius="0.01"/></geometry></visual>
<visual><geometry><sphere radius="0.05"/></geometry><material name="glass"/></visual></link>
<link name="tip"><visual><geometry><sphere radius="0.01"/></geometry><material name=""><color rgba="1 0 0 ALPHA"/>
</material></visual></link><joint name="j" type="revolute"><parent link="base"/><child link="tip"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


@pytest.mark.parametrize(("alpha", "named"), [("0.4", "base, tip: "), ("1", "base: ")])
def test_links_with_omitted_translucent_visuals_are_named(tmp_path: Path, alpha: str, named: str) -> None:
    (tmp_path / "robot.urdf").write_text(TRANSLUCENT.replace("ALPHA", alpha))
    for _ in range(2):  # The second robot is read from the cache.
        robot = Robot.load(tmp_path / "robot.urdf")
        assert {robot.link_names[mesh.link] for mesh in robot.meshes} == ({"base"} if alpha != "1" else {"base", "tip"})
        (remark,) = robot.remarks
        assert remark.startswith(f"{named}visuals with an alpha below 0.99 are omitted.")


def test_a_mesh_of_another_package_is_not_loaded(tmp_path: Path) -> None:
    inside = "meshes/visual/base.stl"
    mine, other = tmp_path / "share/ur_description" / inside, tmp_path / "share/mount_description" / inside
    urdf = tmp_path / "share/mount_description/urdf"
    for path in (mine, other, urdf / "x"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
    assert mesh_path(urdf, f"package://ur_description/{inside}") == mine
    assert mesh_path(urdf, f"package://mount_description/{inside}") == other
    # A package that was renamed is found as before.
    assert mesh_path(urdf, f"package://unknown/{inside}") == other


def screws(count: int, sections: int) -> trimesh.Trimesh:
    """A part of many small round pieces, which a tight tolerance leaves with nearly all of their triangles."""
    rng = np.random.default_rng(4)
    places = rng.uniform((-0.03, -0.02, -0.01), (0.03, 0.02, 0.01), (count, 3))
    pieces = [trimesh.creation.cylinder(0.0015, 0.004, sections=sections).apply_translation(at) for at in places]
    joined = trimesh.util.concatenate(pieces)
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def test_meshes_with_far_too_many_triangles_are_simplified_further_and_that_is_said(tmp_path: Path) -> None:
    mesh = screws(30, 64)
    mesh.export(tmp_path / "part.stl")
    (tmp_path / "robot.urdf").write_text(
        '<robot name="printed"><link name="base"/><link name="part"><visual><geometry><mesh filename="part.stl"/>'
        '</geometry></visual></link><joint name="j" type="revolute"><parent link="base"/><child link="part"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    robot = Robot.load(tmp_path / "robot.urdf", max_faces=300, tolerance=1e-5)
    found = robot.meshes[0]
    assert len(mesh.faces) > 10 * 300 and len(found.faces) <= 5 * 300
    measured = deviation(np.array(mesh.vertices), np.array(mesh.faces), found.vertices.astype(float), found.faces)
    assert measured <= robot.decimation.deviation + 1e-6
    assert 1e-5 < robot.decimation.deviation < 3e-3
    assert robot.remarks == (f"{robot.decimation}.",) and "the surface moves by at most" in robot.remarks[0]
