"""Joint positions compared with a robot's limits: which unit, sign or order of columns would fit.

A position is beyond its limits when it exceeds them by more than a share of their range, since controllers report a
little more than a URDF allows. Only what is far beyond decides about units.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import combinations
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..files.reading import ROBOT, read_text
from ..model.instruments import robot_file
from ..model.robot import parsed_urdf

ANGLE_UNITS: Mapping[str, float] = {"rad": 1.0, "deg": float(np.pi / 180)}
"""[rad] of one unit; "percent" is not among them, since it counts from the middle of the limits."""
LENGTH_UNITS: Mapping[str, float] = {"m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3}
"""[m] of one unit."""
PERCENT = "percent"
"""Unit of -100 to 100 of the range of a joint."""
_BEYOND = 0.15
"""Share of the range of a joint by which positions may exceed its limits."""
FAR = 0.5
"""The same, beyond which a unit is wrong."""
_FEW = 0.02
"""Share of rows that may be beyond, as spikes of an encoder."""


@dataclass(frozen=True)
class Joint:
    """An independent joint of a robot."""

    name: str
    revolute: bool
    lower: float
    """[rad], [m]; infinite where not given."""
    upper: float

    @property
    def unit(self) -> str:
        """Its SI unit."""
        return "rad" if self.revolute else "m"

    def beyond(self, values: Float[np.ndarray, " rows"], share: float = _BEYOND) -> np.ndarray:
        """Which positions [rad], [m] exceed the limits by more than a share of their range."""
        if not np.isfinite([self.lower, self.upper]).all():
            return np.zeros(len(values), bool)
        margin = share * (self.upper - self.lower)
        return (values < self.lower - margin) | (values > self.upper + margin)

    def fits(self, values: Float[np.ndarray, " rows"], share: float = _BEYOND) -> bool:
        """Whether all positions but a few are within the limits."""
        return bool(self.beyond(values, share).mean() <= _FEW)

    def from_percent(self, values: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """Positions of -100 to 100 between the limits [rad], [m]."""
        return self.lower + (values + 100) / 200 * (self.upper - self.lower)


def joints_of(robot: str | Path) -> tuple[Joint, ...]:
    """The independent joints of a robot, in the order of its URDF.

    Raises:
        RobotError: it is missing or no URDF.
    """
    return _joints_of(robot_file(robot).absolute())


@lru_cache(maxsize=16)
def _joints_of(urdf: Path) -> tuple[Joint, ...]:
    found = []
    for joint in parsed_urdf(read_text(urdf, ROBOT), urdf).iter("joint"):
        kind = joint.get("type")
        if kind not in ("revolute", "continuous", "prismatic") or joint.find("mimic") is not None:
            continue
        limit = joint.find("limit")
        lower, upper = -np.inf, np.inf
        if limit is not None and kind != "continuous":
            lower, upper = float(limit.get("lower", "0")), float(limit.get("upper", "0"))
        if lower >= upper:
            lower, upper = -np.inf, np.inf
        found.append(Joint(joint.get("name", ""), kind != "prismatic", lower, upper))
    return tuple(found)


@dataclass(frozen=True)
class Misfit:
    """A joint whose positions are beyond its limits, and what would bring them within."""

    joint: Joint
    lowest: float
    """[rad], [m]"""
    highest: float
    remedies: tuple[str, ...] = field(default=())
    """Each "the other sign", a unit, or another joint's column, for people."""

    def sentence(self) -> str:
        """For people."""
        text = (
            f"{self.joint.name} is from {self.lowest:.4g} to {self.highest:.4g} {self.joint.unit}, and the robot's "
            f"limits are {self.joint.lower:.4g} to {self.joint.upper:.4g} {self.joint.unit}"
        )
        return f"{text}; {' or '.join(self.remedies)} would fit" if self.remedies else text


def misfits(
    joints: Sequence[Joint], values: Float[np.ndarray, "rows joints"], share: float = _BEYOND
) -> tuple[Misfit, ...]:
    """The joints whose positions [rad], [m] are beyond their limits."""
    wrong = [index for index, joint in enumerate(joints) if len(values) and not joint.fits(values[:, index], share)]
    order = _other_order(joints, values, wrong)
    return tuple(
        Misfit(
            joints[index],
            float(values[:, index].min()),
            float(values[:, index].max()),
            (*_remedies(joints[index], values[:, index]), *order),
        )
        for index in wrong
    )


def _remedies(joint: Joint, values: np.ndarray) -> tuple[str, ...]:
    """Units and signs with which positions that were read as SI units fit the limits, so that they still move there."""
    found = []
    if joint.fits(-values):
        found.append("the other sign")
    for unit, factor in (ANGLE_UNITS if joint.revolute else LENGTH_UNITS).items():
        if factor != 1.0 and joint.fits(values * factor) and not (found and unit != "deg"):
            found.append(f"{unit} (read as {values.min() * factor:.3g} to {values.max() * factor:.3g} {joint.unit})")
    return tuple(found)


def _other_order(joints: Sequence[Joint], values: np.ndarray, wrong: list[int]) -> tuple[str, ...]:
    """Orders of the columns in which all positions fit, where a sign alone does not mend each joint."""
    if not wrong or all(joints[index].fits(-values[:, index]) for index in wrong):
        return ()
    names = [joint.name for joint in joints]

    def fit(order: Sequence[int]) -> bool:
        return all(joint.fits(values[:, place]) for joint, place in zip(joints, order, strict=True))

    alphabetical = [sorted(names).index(name) for name in names]
    if alphabetical != list(range(len(names))) and fit(alphabetical):
        return ("the alphabetical order of the joints' names",)
    found = []
    for a, b in combinations(range(len(joints)), 2):
        order = list(range(len(joints)))
        order[a], order[b] = b, a
        if (a in wrong or b in wrong) and fit(order):
            found.append(f"the columns of {names[a]} and {names[b]} the other way round")
    return tuple(found)


def fits_roughly(joints: Sequence[Joint], columns: Sequence[np.ndarray], convert: Callable[..., np.ndarray]) -> bool:
    """Whether converted columns are nowhere far beyond the limits; the sign does not count."""
    for joint, values in zip(joints, columns, strict=True):
        converted = convert(joint, values)
        if not (joint.fits(converted, FAR) or joint.fits(-converted, FAR)):
            return False
    return True
