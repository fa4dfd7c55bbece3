"""Small model tree with the layout of dvrk_model."""

from pathlib import Path

XACRO = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="PSM1">'
JOINT = '<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>{rest}</joint>'
AXIS = '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/>'
MESH = '<visual><geometry><mesh filename="package://dvrk_model/meshes/part.obj"/></geometry></visual>'
TURN = "-1.5708 -1.5708 0.0"


def arm(instrument: str) -> str:
    """Arm whose shapes are omitted, and instrument whose shapes are kept."""
    joints = [
        JOINT.format(name="yaw", parent="world", child="PSM1_yaw_link", rest=AXIS),
        JOINT.format(name="insertion", parent="PSM1_yaw_link", child="PSM1_adaptor_link", rest=AXIS),
        JOINT.format(
            name="roll",
            parent="PSM1_adaptor_link",
            child="PSM1_roll_link",
            rest=f'<origin xyz="0 0 {0.4162 if instrument.startswith("400") else 0.4670}" rpy="0 0 0"/>{AXIS}',
        ),
        JOINT.format(
            name="wrist_pitch",
            parent="PSM1_roll_link",
            child="PSM1_wrist_pitch_link",
            rest=f'<origin xyz="0 0 0" rpy="{TURN}"/>{AXIS}',
        ),
        JOINT.format(
            name="wrist_yaw",
            parent="PSM1_wrist_pitch_link",
            child="PSM1_wrist_yaw_link",
            rest=f'<origin xyz="0.0107 0 0" rpy="{TURN}"/>{AXIS}',
        ),
        JOINT.format(name="jaw", parent="PSM1_wrist_yaw_link", child="PSM1_jaw_link", rest=AXIS),
    ]
    box = '<visual><geometry><box size="0.005 0.005 0.005"/></geometry></visual>'
    links = [
        '<link name="world"/>',
        f'<link name="PSM1_yaw_link">{MESH}</link>',
        f'<link name="PSM1_adaptor_link">{MESH}</link>',
        f'<link name="PSM1_roll_link">{MESH}</link>',
        f'<link name="PSM1_wrist_pitch_link">{MESH}<collision/></link>',
        '<link name="PSM1_wrist_yaw_link"/>',
        f'<link name="PSM1_jaw_link">{box}{MESH}</link>',
    ]
    return f'{XACRO}<xacro:arg name="instrument" default=""/>{"".join(links)}{"".join(joints)}</robot>'


def write_model(folder: Path) -> None:
    """Two arms, each with one instrument, and an instrument without a shape."""
    table = folder / "urdf/common/instruments/instruments.yaml"
    (table.parent / "tip").mkdir(parents=True)
    (table.parent / "tip/tip_093.urdf.xacro").touch()
    table.write_text(
        "instruments:\n"
        "  '400093': {housing: Classic, tip: '093', name: Prograsp Forceps}\n"
        "  '420093': {housing: Si, tip: '093', name: Prograsp Forceps}\n"
        "  '400001': {housing: Classic, tip: '001', name: Potts Scissors}\n"
    )
    for generation, number in (("Classic", "400093"), ("Si", "420093")):
        (folder / "urdf" / generation).mkdir()
        (folder / "urdf" / generation / "PSM1.urdf.xacro").write_text(arm(number))
    (folder / "meshes").mkdir()
    (folder / "meshes/part.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n", encoding="utf-8"
    )
