"""The one immutable state of the app: what is shown, what is being done. The worker replaces it, panels read it."""

from dataclasses import dataclass, field
from enum import StrEnum

from carts_core.data import Frame
from carts_core.optimization import FreeParameters, Iterate, OptimizerSettings
from carts_core.scene import SceneState
from carts_viewer.layers import Layer


class Source(StrEnum):
    """Where the shown joint positions of a frame come from."""

    MEASURED = "measured"
    EDITED = "edited"
    OPTIMIZED = "optimized"


class Phase(StrEnum):
    """What the optimizer is doing."""

    IDLE = "idle"
    RUNNING = "running"
    PAUSED = "paused"


@dataclass(frozen=True, eq=False)
class Pose:
    """Where the arms and cameras are in one frame, and who says so."""

    scene: SceneState
    """Joint positions, base frames, extrinsics and intrinsics of the whole scene."""
    source: Source


@dataclass(frozen=True)
class Scores:
    """How close a pose is to the truth; None where the frame has none."""

    dice: float | None = None
    """Overlap of the rendered and the true mask in the shown camera, 0..1."""
    joint_degrees: float | None = None
    """Mean absolute error of the revolute joints [deg]."""


@dataclass(frozen=True)
class Curves:
    """One entry per iterate of the current run."""

    loss: tuple[float, ...] = ()
    scores: tuple[Scores, ...] = ()
    seconds: tuple[float, ...] = ()
    """Duration of each iteration [s]."""


@dataclass(frozen=True, eq=False)
class Maps:
    """What the optimizer saw at the shown pose, at its working resolution."""

    iterate: Iterate
    cameras: tuple[str, ...]
    """The cameras that the iterate's maps belong to, in their order."""


@dataclass(frozen=True)
class RunState:
    """The optimizer's doings."""

    phase: Phase = Phase.IDLE
    curves: Curves = field(default_factory=Curves)
    reason: str | None = None
    """Why the run stopped, for people."""


@dataclass(frozen=True)
class ExportState:
    """A running export of all frames."""

    done: int
    total: int


@dataclass(frozen=True, eq=False)
class ViewState:
    """Everything the page shows."""

    index: int
    frame: Frame
    """The shown frame; holds at least the image of `camera`."""
    domain: str
    camera: str
    pose: Pose
    layer: Layer
    opacity: float
    settings: OptimizerSettings
    free: FreeParameters
    settings_error: str | None = None
    """Why the last change of a setting was not accepted."""
    every_camera: bool = False
    """Whether a run uses all cameras or only the shown one."""
    playing: bool = False
    fps: float = 10.0
    run: RunState = field(default_factory=RunState)
    maps: Maps | None = None
    """Of the shown pose, frame and domain; None while nobody needs them."""
    scores: Scores | None = None
    """Of the shown pose; None until they are computed, which is after its picture has been sent."""
    undoable: int = 0
    """How many changes can be taken back."""
    busy: str | None = None
    """What the worker is preparing, for people."""
    export: ExportState | None = None
    error: str | None = None
