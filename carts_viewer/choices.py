"""Choices of a user: compared pose, range of sliders, target of a run, and presets of the solver."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal, get_args

import numpy as np

from carts_core.errors import SettingsError
from carts_core.model.scene import Arm, SceneState
from carts_core.optimization import GivenMasks
from carts_core.project import ProjectState
from carts_core.project.masks import project_masks
from carts_core.recording import Sequence as Recording
from carts_core.settings import SurfaceSolver
from carts_core.settings.stages import reduced
from carts_viewer.picture.layers import Rgba


class Against(StrEnum):
    """The pose that the present one is compared with; the value is the label in the page."""

    MEASURED = "Measured"
    BEFORE_RUN = "Before the run"


@dataclass(frozen=True)
class Compare:
    """The compared pose, and the share of the picture that shows it."""

    against: Against | None = None
    """None: no comparison, except while the key is held."""
    swipe: float = 0.5
    """Share of the picture's width, from its left side, that shows the other pose, 0..1."""
    peek: bool = False
    """Whether the other pose fills the image, while the key is held."""

    @property
    def share(self) -> float:
        """Share of the picture's width that shows the other pose, 0..1."""
        return 1.0 if self.peek else self.swipe if self.against is not None else 0.0


def other_pose(compare: Compare, measured: SceneState, before_run: SceneState | None) -> SceneState:
    """The pose that is compared with; the measured one if there was no run."""
    return before_run if compare.against is Against.BEFORE_RUN and before_run is not None else measured


def composed(own: Rgba, other: Rgba, share: float) -> Rgba:
    """The other overlay up to a share of the width, the present one beyond it, and a line between them."""
    column = round(share * own.shape[1])
    both = np.concatenate([other[:, :column], own[:, column:]], axis=1)
    if 0 < column < own.shape[1]:
        both[:, max(column - 1, 0) : column + 1] = 255
    return both


class Reach(StrEnum):
    """Range of the sliders around the measured values; the value is the label in the page."""

    NEAR = "± 5"
    FAR = "± 20"
    FULL = "Full range"

    @property
    def width(self) -> float:
        """Half width [deg] or [mm]."""
        return {Reach.NEAR: 5.0, Reach.FAR: 20.0, Reach.FULL: math.inf}[self]


@dataclass(frozen=True)
class JointRange:
    """Allowed range of a joint."""

    arm: str
    joint: str
    revolute: bool
    lower: float
    """[rad] or [m]; one turn to either side without limits."""
    upper: float

    @property
    def unit(self) -> str:
        """Unit in the page, ° or mm."""
        return "°" if self.revolute else "mm"

    def to_shown(self, value: float) -> float:
        """A joint position [rad, m] in the unit of the page [deg, mm]."""
        return math.degrees(value) if self.revolute else 1e3 * value

    def from_shown(self, shown: float) -> float:
        """A joint position [rad, m] from a value in the unit of the page [deg, mm]."""
        return math.radians(shown) if self.revolute else shown / 1e3


def joint_range(arm: Arm, joint: int) -> JointRange:
    """Range of the joint with this index."""
    lower, upper = (float(value) for value in arm.robot.joint_limits[joint])
    revolute = arm.robot.joint_types[joint] == "revolute"
    # A slider needs limits: without them, one turn or one metre to either side.
    room = math.pi if revolute else 1.0
    return JointRange(
        arm.name,
        arm.robot.joint_names[joint],
        revolute,
        lower if math.isfinite(lower) else -room,
        upper if math.isfinite(upper) else room,
    )


Observe = Literal["network", "masks", "both"]
Masks = Literal["recording", "imported", "painted"]


@dataclass(frozen=True)
class Observed:
    """Choice of the target of a run.

    Raises:
        SettingsError: a value is not one of the choices.
    """

    what: Observe = "network"
    """As `--observe`."""
    masks: Masks = "recording"
    """Source of the masks, if masks are fitted; as `--masks`."""

    def __post_init__(self) -> None:
        for value, allowed in ((self.what, get_args(Observe)), (self.masks, get_args(Masks))):
            if value not in allowed:
                raise SettingsError(f"{value!r} cannot be observed. Choose one of: {', '.join(allowed)}.")


@dataclass(frozen=True, eq=False)
class Target:
    """Target of a run: network predictions or masks, with the project's masks at its start."""

    observed: Observed = Observed()
    given: GivenMasks | None = None
    """The masks, if they are not those of the recording."""

    @staticmethod
    def of(observed: Observed, project: ProjectState, recording: Recording) -> "Target":
        """The target of a choice, with the present masks of a project."""
        if observed.what == "network" or observed.masks == "recording":
            return Target(observed)
        return Target(observed, project_masks(observed.masks, project, recording))

    def seen(self, recording: Recording, index: int, domain: str, cameras: Sequence[str]) -> list[str]:
        """Cameras whose images of a frame can be compared; with masks alone, those with a mask."""
        if self.observed.what != "masks":
            return list(cameras)
        if self.given is not None:
            return [name for name in cameras if self.given.there(index, name)]
        own = [name for name in cameras if recording.has_masks(name, domain)]
        there = recording.frame(index, domain, own).masks or {}
        return [name for name in own if name in there]


NETWORK = Target()
"""Predictions of the network."""


@dataclass(frozen=True)
class Preset:
    """A named set of solver settings."""

    meaning: str
    """When to use it, as text for the user."""
    changes: Callable[[SurfaceSolver], dict[str, Any]]
    """Changes to the default settings of a solver of surface maps; other solvers have only the default."""


PRESETS = {
    "Default": Preset("Default settings.", lambda _: {}),
    "Quick": Preset("Smaller images: faster, less accurate.", lambda solver: {"stages": reduced(solver.stages, 0.75)}),
    "Far off": Preset("Measured joints that are wrong by more than 3 degrees.", lambda _: {"prior_deg": 6.0}),
    "Well calibrated": Preset("Measured joints that are right to about a degree.", lambda _: {"prior_deg": 1.0}),
    "Smoke and haze": Preset("All haze is removed before images are compared.", lambda _: {"dehaze": 1.0}),
}
"""Presets by name, the default first."""
