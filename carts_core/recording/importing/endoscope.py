"""A camera that moves, in a foreign recording: where its endoscope was, by the manipulator that holds it (ECM)."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ...model.camera import T_DVRK_OPENCV
from ...model.ecm_kinematics import forward
from .found import FoundMotion, Note
from .logs import Track, transforms

_MOVES = 5e-4, 0.1
"""[m], [deg] An endoscope that moves by less stands still."""


def endoscope_motion(
    poses: Track | None, joints: Track | None, start: float, note: Callable[[Note], None]
) -> FoundMotion | None:
    """The pose of the camera over time, in the world whose origin it is at the first image; None if it stands still.

    The tip of the ECM counts as the camera, with the dVRK's axes; what the camera's place on the tip differs from that,
    `carts calibrate` finds.

    Args:
        poses: of the ECM's tip in some fixed frame.
        joints: of the ECM, in place of poses.
        start: time of the first image [s].
        note: called with what was found.
    """
    chosen = poses if poses is not None else joints
    if chosen is None or len(chosen.times) < 2:
        return None
    Ts = transforms(chosen.values) if poses is not None else forward(chosen.values)
    there = np.asarray(np.isfinite(Ts).all((1, 2)))
    if there.sum() < 2:
        return None
    times, Ts = chosen.times[there], Ts[there]
    first = int(np.abs(times - start).argmin())
    relative = T_DVRK_OPENCV @ np.linalg.inv(Ts[first]) @ Ts @ T_DVRK_OPENCV
    way, turn = _extent(relative)
    if way <= _MOVES[0] and turn <= _MOVES[1]:
        note(Note("found", "the endoscope (ECM) stands still."))
        return None
    note(
        Note(
            "found",
            f"the endoscope (ECM) moves by up to {1e3 * way:.1f} mm and {turn:.1f} deg; a table has where the cameras "
            "are. Base frames hold for where it is at the first image.",
        )
    )
    note(
        Note(
            "guessed",
            "the camera is taken for the ECM's tip; let carts calibrate find its place there and the base frames.",
        )
    )
    return FoundMotion(times, relative)


def _extent(Ts: Float[np.ndarray, "rows 4 4"]) -> tuple[float, float]:
    """How far poses are at most from the first image's [m], [deg]."""
    turns = Rotation.from_matrix(Ts[:, :3, :3]).magnitude()
    return float(np.linalg.norm(Ts[:, :3, 3], axis=1).max()), float(np.degrees(turns.max()))
