"""What is shown: frame, domain, camera, overlay, playing."""

from dataclasses import dataclass

from carts_viewer.compare import Against
from carts_viewer.intents.base import Intent, Latest
from carts_viewer.joint_range import Reach
from carts_viewer.layers import Layer


@dataclass(frozen=True)
class Browsing(Intent):
    """An intent about what is shown: frame, domain, camera, overlay, playing."""


@dataclass(frozen=True)
class ShowFrame(Browsing, Latest):
    """Show the frame of this index (0-based)."""

    index: int


@dataclass(frozen=True)
class MoveFrame(Browsing):
    """Show the frame that is `by` frames further."""

    by: int


@dataclass(frozen=True)
class Play(Browsing):
    """Start or stop playing; None changes over."""

    on: bool | None = None


@dataclass(frozen=True)
class SetSpeed(Browsing, Latest):
    """Frames per second while playing."""

    fps: float


@dataclass(frozen=True)
class SetTimeOffset(Browsing, Latest):
    """Say how far the clocks of images and kinematics are apart: time in the table minus time of the image."""

    seconds: float


@dataclass(frozen=True)
class ShowDomain(Browsing, Latest):
    """Show the images of this domain; joints stay as they are."""

    domain: str


@dataclass(frozen=True)
class ShowCamera(Browsing, Latest):
    """Look through this camera; joints stay as they are."""

    camera: str


@dataclass(frozen=True)
class ShowBeside(Browsing):
    """Show the other cameras' images beside the active one's, or not; None changes over."""

    on: bool | None = None


@dataclass(frozen=True)
class SetReach(Browsing, Latest):
    """Let the joints' sliders reach so far from the measured values."""

    reach: Reach


@dataclass(frozen=True)
class SetRange(Browsing, Latest):
    """Choose the part of the sequence from the first to the last of these frames (0-based); None: all of it."""

    frames: tuple[int, int] | None


@dataclass(frozen=True)
class MarkRange(Browsing):
    """Begin, or end, the chosen part of the sequence at the shown frame."""

    end: bool = False


@dataclass(frozen=True)
class CompareWith(Browsing, Latest):
    """Compare the pose with another one; None: with none."""

    against: Against | None


@dataclass(frozen=True)
class SetSwipe(Browsing, Latest):
    """Show the other pose up to this share of the picture's width, 0..1."""

    share: float


@dataclass(frozen=True)
class Peek(Browsing):
    """Show the other pose all over, or no more."""

    on: bool


@dataclass(frozen=True)
class ShowLayer(Browsing, Latest):
    """Draw this layer over the frame."""

    layer: Layer


@dataclass(frozen=True)
class SetOpacity(Browsing, Latest):
    """Opacity of the layer, 0..1."""

    opacity: float
