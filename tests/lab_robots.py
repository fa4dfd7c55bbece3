"""Small robots with joint names and limits of robots other than the PSM."""

from pathlib import Path

SO101 = {
    "shoulder_pan": (-1.92, 1.92),
    "shoulder_lift": (-1.92, 1.92),
    "elbow_flex": (-1.92, 1.92),
    "wrist_flex": (-1.92, 1.92),
    "wrist_roll": (-1.92, 1.92),
    "gripper": (-1.92, 1.92),
}
"""Joint -> limits [rad]."""
PANDA = {f"panda_joint{number}": (-2.8973, 2.8973) for number in range(1, 8)}


def write_urdf(path: Path, joints: dict[str, tuple[float, float]]) -> Path:
    """A chain of boxes of 5 cm."""
    box = '<visual><geometry><box size="0.01 0.01 0.05"/></geometry></visual>'
    links = "".join(f'<link name="link_{number}">{box}</link>' for number in range(len(joints) + 1))
    moving = "".join(
        f'<joint name="{name}" type="revolute"><parent link="link_{number}"/><child link="link_{number + 1}"/>'
        f'<origin xyz="0 0 0.05"/><axis xyz="{number % 2} {1 - number % 2} 0"/>'
        f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/></joint>'
        for number, (name, (low, high)) in enumerate(joints.items())
    )
    path.write_text(f'<?xml version="1.0"?><robot name="{path.stem}">{links}{moving}</robot>')
    return path
