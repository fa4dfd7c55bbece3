"""What a run fits: predictions of the network, masks, or both."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from carts_core.errors import SettingsError
from carts_core.optimization import GivenMasks
from carts_core.project import ProjectState
from carts_core.project.masks import project_masks
from carts_core.recording import Sequence as Recording

Observe = Literal["network", "masks", "both"]
Masks = Literal["recording", "imported", "painted"]


@dataclass(frozen=True)
class Observed:
    """What somebody has chosen to be fitted.

    Raises:
        SettingsError: a value is none of those that there are.
    """

    what: Observe = "network"
    """As `--observe`."""
    masks: Masks = "recording"
    """Which masks, where any are fitted; as `--masks`."""

    def __post_init__(self) -> None:
        for value, allowed in ((self.what, get_args(Observe)), (self.masks, get_args(Masks))):
            if value not in allowed:
                raise SettingsError(f"{value!r} cannot be observed. Choose one of: {', '.join(allowed)}.")


@dataclass(frozen=True, eq=False)
class Target:
    """What a run fits, as it was when it began: the project's masks of that moment."""

    observed: Observed = Observed()
    given: GivenMasks | None = None
    """The masks, where they are not those of the recording."""

    @staticmethod
    def of(observed: Observed, project: ProjectState, recording: Recording) -> "Target":
        """What is chosen, with the masks that a project holds now."""
        if observed.what == "network" or observed.masks == "recording":
            return Target(observed)
        return Target(observed, project_masks(observed.masks, project, recording))

    def seen(self, recording: Recording, index: int, domain: str, cameras: Sequence[str]) -> list[str]:
        """Those of the cameras whose images of a frame can be compared: with masks alone, those that have one."""
        if self.observed.what != "masks":
            return list(cameras)
        if self.given is not None:
            return [name for name in cameras if self.given.there(index, name)]
        own = [name for name in cameras if recording.has_masks(name, domain)]
        there = recording.frame(index, domain, own).masks or {}
        return [name for name in own if name in there]


NETWORK = Target()
"""What the network sees."""
