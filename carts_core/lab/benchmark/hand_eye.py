"""Hand-eye calibration of a robot that no network was trained on: how often it is right, or says that it is not.

The robot of `seven_joint_arm` is seen in ten poses; its base frame is put off by an angle and a distance, each in a
random direction. Given masks need no network; the network alone sees the robot in a made room of the held-out half.
"""

import json
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from roma import rotmat_to_rotvec, rotvec_to_rotmat

from ...files import OutputPath, write_text
from ...files.reading import VALUES, parse_json, read_bytes
from ...html import Cell, Table
from ...networks.extractor import FeatureExtractor
from ...optimization import CalibrationOptimizer, FreeParameters, MaskPredictor
from ...wording import counted
from .fingerprints import code_fingerprint
from .rooms import made_rooms
from .seven_joint_arm import arm_views
from .tables import NOTHING
from .target import Target, make_target

_VIEWS = 10
_STARTS = 10
"""Of each condition, before it can be called met."""
_FREE = FreeParameters(joints=False, base_frames=True)
_CODE = ("lab/benchmark/hand_eye.py", "lab/benchmark/seven_joint_arm.py", "lab/benchmark/rooms.py")


@dataclass(frozen=True)
class HandEyeCondition:
    """Starts of one kind, and how near the base frame has to come."""

    name: str
    angle_deg: float
    """How far the base frame is turned at the start [deg]."""
    distance: float
    """And moved [m]."""
    masks: bool
    """Whether masks are the target; otherwise what the network sees."""
    most_deg: float
    most_distance: float
    """[m]"""


CONDITIONS = (
    HandEyeCondition("masks, 15 degrees and 10 cm", 15.0, 0.1, True, 0.3, 3e-3),
    HandEyeCondition("masks, 30 degrees and 20 cm", 30.0, 0.2, True, 0.3, 3e-3),
    HandEyeCondition("network, 5 degrees and 5 cm", 5.0, 0.05, False, 0.5, 5e-3),
)


@dataclass(frozen=True)
class HandEyeRun:
    """What came of one start."""

    condition: str
    seed: int
    """Of the views and the start."""
    angle_deg: float
    """Of the base frame that was found against the true one [deg]."""
    distance: float
    """Between their origins [m]."""
    verdict: str


def known_hand_eye(path: OutputPath, extractor: FeatureExtractor) -> list[HandEyeRun]:
    """Runs that this code and these weights have written to `path`; none if there are no such."""
    try:
        stored = parse_json(read_bytes(path.path, VALUES))
        return [HandEyeRun(**run) for run in stored["runs"]] if stored["of"] == _of(extractor) else []
    except (OSError, ValueError, KeyError, TypeError):
        return []


def measure_hand_eye(
    path: OutputPath, extractor: FeatureExtractor, starts: int, say: Callable[[str], None] = lambda line: None
) -> list[HandEyeRun]:
    """Calibrate from so many starts of each condition that are not in `path` yet, and write them there one by one."""
    runs = known_hand_eye(path, extractor)
    done = {(run.condition, run.seed) for run in runs}
    for condition in CONDITIONS:
        for seed in range(starts):
            if (condition.name, seed) not in done:
                say(f"hand-eye: {condition.name}, {seed + 1} of {starts}")
                runs.append(_run(condition, seed, extractor))
                write_text(path, json.dumps({"of": _of(extractor), "runs": [asdict(run) for run in runs]}, indent=1))
    return runs


def hand_eye_table(runs: list[HandEyeRun]) -> Table | None:
    """How many starts ended near enough, and the verdicts on the others."""
    rows = []
    for condition in CONDITIONS:
        if found := [run for run in runs if run.condition == condition.name]:
            right = [run for run in found if _near(run, condition)]
            others = Counter(run.verdict for run in found if run not in right)
            cells = (
                condition.name,
                f"{len(right)} of {len(found)}",
                f"{max(run.angle_deg for run in right):.2f}" if right else NOTHING,
                f"{1e3 * max(run.distance for run in right):.1f}" if right else NOTHING,
                ", ".join(f"{count} {verdict}" for verdict, count in others.items()),
            )
            rows.append(tuple(map(Cell, cells)))
    caption = (
        f"A drawn robot of seven joints, which no network was trained on, in {_VIEWS} poses of 640 x 480 pixels; only "
        "its base frame is free. Largest errors are those of the starts that ended near enough."
    )
    header = ("target and start", "near enough", "largest angle [deg]", "largest distance [mm]", "verdicts on others")
    return Table("Hand-eye calibration of another robot", caption, header, tuple(rows)) if rows else None


def hand_eye_targets(runs: list[HandEyeRun]) -> list[Target]:
    """The lines of the table of targets about hand-eye calibration."""
    found = []
    for condition in CONDITIONS:
        own = [run for run in runs if run.condition == condition.name]
        right = [run for run in own if _near(run, condition) or (not condition.masks and run.verdict == "failed")]
        within = f"{condition.most_deg:g} degrees and {1e3 * condition.most_distance:g} mm"
        found.append(
            make_target(
                f"hand-eye from {condition.name}: within {within}" + ("" if condition.masks else ", or called failed"),
                0.9 if condition.masks else 1.0,
                len(right) / len(own) if own else None,
                counted(len(own), "start"),
                at_least=True,
                text=lambda value: f"{100 * value:.0f} %",
                complete=len(own) >= _STARTS,
            )
        )
    return found


def _near(run: HandEyeRun, condition: HandEyeCondition) -> bool:
    return run.angle_deg <= condition.most_deg and run.distance <= condition.most_distance


def _run(condition: HandEyeCondition, seed: int, extractor: FeatureExtractor) -> HandEyeRun:
    rooms = [room for room in made_rooms() if room.half == "held-out"]
    room = rooms[seed % len(rooms)].draw(640, 480)
    rng = np.random.default_rng((seed, round(condition.angle_deg)))
    axis, direction = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    off = np.eye(4)
    off[:3, :3] = rotvec_to_rotmat(torch.tensor(np.radians(condition.angle_deg) * axis)).numpy()
    off[:3, 3] = condition.distance * direction
    with tempfile.TemporaryDirectory() as folder:
        views = arm_views(Path(folder), _VIEWS, seed, room)
    (arm,) = views.scene.arms
    wrong = replace(views.scene, arms=(replace(arm, T_world_base=arm.T_world_base @ off),))
    networks = MaskPredictor() if condition.masks else extractor
    optimizer = CalibrationOptimizer(wrong, views.frames, networks, free=_FREE)
    for _ in optimizer:
        pass
    assert optimizer.assessment is not None
    left = np.linalg.inv(arm.T_world_base) @ optimizer.result().scene.arms[0].T_world_base
    angle = float(rotmat_to_rotvec(torch.tensor(left[:3, :3])).norm().rad2deg())
    verdict = optimizer.assessment.verdict.value
    return HandEyeRun(condition.name, seed, angle, float(np.linalg.norm(left[:3, 3])), verdict)


def _of(extractor: FeatureExtractor) -> list[str]:
    return [extractor.fingerprint, code_fingerprint(), code_fingerprint(_CODE)]
