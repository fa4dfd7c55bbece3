"""The optimizer: running it, its settings, what it may move."""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

from carts_viewer.intents.base import Intent, Latest


@dataclass(frozen=True)
class Optimizing(Intent):
    """An intent about the optimizer of the shown frame."""


@dataclass(frozen=True)
class Run(Optimizing):
    """Optimize until it stops, or go on where it was paused."""


@dataclass(frozen=True)
class Pause(Optimizing):
    """Hold the optimizer after the current iteration."""


@dataclass(frozen=True)
class RunOrPause(Optimizing):
    """Run when not running, else pause."""


@dataclass(frozen=True)
class Step(Optimizing):
    """Do one iteration."""


@dataclass(frozen=True)
class Reset(Optimizing):
    """Go back to where the run started."""


@dataclass(frozen=True)
class Assess(Optimizing):
    """Say how well the shown pose fits the images, and move nothing."""


@dataclass(frozen=True)
class SetSetting(Optimizing):
    """Change one field of the optimizer's settings."""

    name: str
    value: Any

    @property
    def key(self) -> Hashable:
        """One slot per field."""
        return (SetSetting, self.name)


@dataclass(frozen=True)
class ResetSettings(Optimizing):
    """Set all settings of the chosen solver to those of a preset."""

    preset: str
    """One of `presets.PRESETS`."""


@dataclass(frozen=True)
class SetFreeJoint(Optimizing):
    """Let the optimizer move one joint, or not."""

    arm: str
    joint: str
    on: bool

    @property
    def key(self) -> Hashable:
        """One slot per joint."""
        return (SetFreeJoint, self.arm, self.joint)


@dataclass(frozen=True)
class SetFreeGroup(Optimizing):
    """Let the optimizer move base frames, extrinsics or intrinsics (`group`), or not."""

    group: str
    on: bool

    @property
    def key(self) -> Hashable:
        """One slot per group."""
        return (SetFreeGroup, self.group)


@dataclass(frozen=True)
class SetCameras(Optimizing, Latest):
    """Optimize in all cameras, or in the shown one."""

    every: bool


@dataclass(frozen=True)
class SetObserved(Optimizing, Latest):
    """Have runs fit predictions of the network, masks or both."""

    what: str
    """One of `observing.Observe`."""
    masks: str
    """One of `observing.Masks`."""
