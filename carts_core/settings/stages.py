"""Stages of solvers as data, and the presets made of them."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated

from .ranges import Range, Ranged, Share


class Given(StrEnum):
    """State whose rendering the network is conditioned on."""

    START = "start"
    """Start of the run."""
    ESTIMATE = "estimate"
    """The present estimate."""


@dataclass(frozen=True)
class Observe(Ranged):
    """Predict the surface map of the images: per pixel the coverage of each part of the arms, and the
    normal (`carts_core.model.parts`). `Descend` and `AlignEdges` never call the network; a `RandomRestart` and a
    `PreferStart` observe once more, and verdicts (`OtherBackground`, `RejectFailed`) need it for their evidence.
    """

    scale: Annotated[float, Range(0.1, 8)] = 1.5
    """Size of the images relative to the working image, up to the camera's own size [1]."""
    given: Given = Given.ESTIMATE
    """The state that the network is conditioned on."""
    margin: Annotated[int, Range(0, 1000, "px")] = 16
    """Margin of the network's input around the arms of that state [px]."""
    attention: Annotated[int, Range(1, 1000, "px")] = 8
    """Distance from the arms of that state beyond which nothing counts, the paper's attention [px]."""
    haze: bool = True
    """Whether pixels under haze or smoke count less, by its transmission. A search does better with all pixels."""


@dataclass(frozen=True)
class Descend(Ranged):
    """Levenberg-Marquardt on the surface factor (rendered minus observed surface map) and the prior, under one blur."""

    blur: Annotated[float, Range(0, 40, "px")]
    """Deviation of the blur under which surface maps are compared [px]."""
    robust: Annotated[float, Range(1e-3, 100)] = 0.5
    """Difference of surface maps beyond which a pixel loses its weight (Geman-McClure's scale) [1]."""
    steps: Annotated[int, Range(1, 1000)] = 6
    """Largest number of steps [1]."""
    tolerance: Annotated[float, Range(0, 1, below=True)] = 1e-2
    """The stage ends when no more than this share of the objective is to be gained [1]."""


FINEST = Descend(blur=0.8)
"""The last descent; estimates are compared as it compares them."""


@dataclass(frozen=True)
class RandomRestart(Ranged):
    """Where the fit is bad or an arm was lost (it has left the image, or is where none was observed): draw random
    states, compare them with the whole image, and descend again from the best."""

    then: tuple["Stage", ...]
    """Stages from there. States are compared as in the first `Descend` of these."""
    if_loss: Annotated[float, Range(0, 10)] = 0.045
    """Cost per pixel of the arms, without the prior, from which a fit is bad [1]."""
    candidates: Annotated[int, Range(1, 10_000)] = 64
    """Random states per arm [1]."""
    deviation: Annotated[float, Range(0, 10, above=True)] = 1.8
    """Their deviation, in deviations of the prior (`SurfaceSolver.prior_deg` and its like) [1]."""
    scale: Annotated[float, Range(0.1, 8)] = 0.75
    """Of the whole image that they are compared with, as `Observe.scale` [1]."""


@dataclass(frozen=True)
class SilhouetteSearch(Ranged):
    """Where given masks are the target and the start is far from them: draw states, compare their silhouettes with the
    masks by distance, which needs no overlap, and go on from the nearest. Skipped where a network says where arms are.
    """

    if_overlap: Share = 0.8
    """Overlap of silhouettes and masks at the start (Dice) from which nothing is searched [1]."""
    starts: Annotated[int, Range(1, 100)] = 4
    """Largest number of searches [1]."""
    rounds: Annotated[int, Range(1, 1000)] = 10
    """Rounds of each; every round draws around the best of the one before [1]."""
    candidates: Annotated[int, Range(20, 10_000)] = 48
    """States per round; the first has more [1]."""
    joints_deg: Annotated[float, Range(0, 90, "deg", above=True)] = 6.0
    """Deviation of joints in the first round [deg]; `length_scale` turns it into metres."""
    frames_deg: Annotated[float, Range(0, 90, "deg", above=True)] = 15.0
    """Deviation of base frames and cameras in the first round [deg]; places deviate by what half of this angle is at
    the distance of the arms from the camera."""
    enough: Annotated[float, Range(0, 1000, "px")] = 1.5
    """Distance of silhouettes and masks at which no further search begins [px of the compared images]."""
    scale: Annotated[float, Range(0.1, 8)] = 0.5
    """Of the compared images, as `Observe.scale` [1]."""


@dataclass(frozen=True)
class AlignEdges(Ranged):
    """Move the outlines of the arms to edges of the image, weighed against the surface factor. Skipped where given
    masks are the target: they say where outlines are."""

    steps: Annotated[int, Range(1, 1000)] = 24
    """Largest number of steps [1]."""
    weight: Annotated[float, Range(0, 100, above=True)] = 0.3
    """Of a squared distance from an edge, per pixel of the outline [1/px^2]."""


@dataclass(frozen=True)
class PreferStart(Ranged):
    """Return to the start if it explains the image as well as the estimate, unless a calibration is free."""

    improvement: Annotated[float, Range(0, 1e6, above=True)] = 5.0
    """Least improvement of the objective that keeps the estimate [1]."""
    ratio: Annotated[float, Range(1, 100)] = 1.25
    """Beyond this many times the estimate's cost, the start never explains the image as well [1]."""
    edges: Annotated[float, Range(1, 100)] = 1.12
    """Beyond this many times the estimate's distance of outlines to edges, it does not either [1]: what a start that is
    exactly right stays below in 39 of 40 synthetic frames."""
    overlap: Share = 0.9
    """Dice of both silhouettes below which the start is not tried [1]."""


@dataclass(frozen=True)
class OtherBackground:
    """Where the fit has failed and the empty background is known: run again with that background treated the other way
    (replaced in the image, or taken off what the network predicts). Kept is the second run if it has not failed, and
    its arms overlap more with what differs from the background, which false detections cannot help."""

    then: tuple["Stage", ...]
    """Stages from the start."""


@dataclass(frozen=True)
class IgnoreOccluders:
    """Propose an ignore mask of occluders from contradicting pixels, and run again without these."""

    then: tuple["Stage", ...]
    """Stages from the start, if a mask was proposed."""


@dataclass(frozen=True)
class Evaluate:
    """Compare the present estimate once more, as `FINEST` does, for the record."""


@dataclass(frozen=True)
class RejectFailed:
    """Judge the best point: good, doubtful or failed. Deviations of what is not good allow for a wrong fit. Where it
    failed, go back to the start, unless the image contradicts that even more."""


@dataclass(frozen=True)
class FirstOrder(Ranged):
    """Gradient descent on a loss of image features, as in the paper."""

    share: Annotated[float, Range(0, 1, above=True)] = 0.5
    """Of the planned iterations [1]."""
    attention: Annotated[int, Range(1, 400, "px")] = 10
    """Dilation of the silhouette [px]."""
    blur: Annotated[float, Range(0, 20, "px")] = 0.6
    """Deviation of the lens blur of the rendering before it is compared [px]."""


Stage = (
    Observe
    | Descend
    | RandomRestart
    | SilhouetteSearch
    | AlignEdges
    | PreferStart
    | OtherBackground
    | IgnoreOccluders
    | Evaluate
    | RejectFailed
    | FirstOrder
)


def first_descend(stages: tuple[Stage, ...]) -> Descend:
    """The first descent of a solver, the finest one if it has none."""
    return next((stage for stage in stages if isinstance(stage, Descend)), FINEST)


def first_observe(stages: tuple[Stage, ...]) -> Observe:
    """The first observation of a solver, the default one if it has none."""
    return next((stage for stage in stages if isinstance(stage, Observe)), Observe())


_FAR = Observe(margin=27, attention=27, haze=False)
"""Observation for arms that are several degrees off."""


def reduced(stages: tuple[Stage, ...], scale: float) -> tuple[Stage, ...]:
    """The same stages with no observation at more than `scale` times the working image."""
    return tuple(replace(s, scale=min(s.scale, scale)) if isinstance(s, Observe) else s for s in stages)


_COARSE = Descend(blur=8.0, robust=2.0, tolerance=0.06)
_MEDIUM = Descend(blur=3.0, tolerance=0.06)
_FINE = Descend(blur=1.6, tolerance=0.06)
_RESTART = RandomRestart(then=(Descend(blur=8.0), _FAR, Descend(blur=3.0)))

SEARCH: tuple[Stage, ...] = (
    SilhouetteSearch(),
    # A small image first, for a fast first estimate.
    Observe(scale=0.75, margin=27, attention=27, haze=False),
    _COARSE,
    # Conditioned on the start again, so that an error of the first pass does not confirm itself.
    Observe(given=Given.START, margin=27, attention=27, haze=False),
    _MEDIUM,
    _RESTART,
    Observe(),
    _MEDIUM,
    _FINE,
)
"""From measured kinematics to a fine estimate."""

_FITTED: tuple[Stage, ...] = (*SEARCH, AlignEdges(), Observe(), FINEST)
_ALONE: tuple[Stage, ...] = (*_FITTED, AlignEdges(), PreferStart())

FRAME: tuple[Stage, ...] = (*_ALONE, OtherBackground(then=_ALONE), Evaluate(), RejectFailed())
"""One frame alone: the default.

`SilhouetteSearch` acts only where given masks are the target, `RandomRestart` only where the fit is bad, and
`OtherBackground` only where it has failed and the empty background is known. Once the evaluations are used up, all
stages but `RejectFailed` are skipped.
"""

OCCLUDED: tuple[Stage, ...] = (
    *(*_FITTED, IgnoreOccluders(then=_FITTED), AlignEdges(), PreferStart(), Evaluate(), RejectFailed()),
)
"""One frame alone, run again without pixels that probably show an occluder."""

NONE: tuple[Stage, ...] = (Observe(), Evaluate(), RejectFailed())
"""Nothing moves: the start is compared ("CaRTS without optimization")."""

COLD: tuple[Stage, ...] = (*SEARCH, Observe(), FINEST)
"""A frame of a sequence of which only the measured kinematics are known; `WARM` follows."""

_WIDE = Observe(margin=27, attention=27)
"""An observation with more room around the arms."""

WARM_WIDE: tuple[Stage, ...] = (_WIDE, Descend(blur=0.8, steps=2), AlignEdges())
"""As `WARM`, for a frame that may be farther from its prediction."""

WARM: tuple[Stage, ...] = (
    Observe(scale=0.6, margin=10, attention=10),
    Descend(blur=1.2, steps=1),
    AlignEdges(steps=6),
)
"""A frame of a sequence or stream near its prediction: one small observation, one step, and the outlines."""

LIVE_SEARCH: tuple[Stage, ...] = reduced(SEARCH[: SEARCH.index(_RESTART) + 1], 1.0)
"""A frame of a live stream whose arms are lost; `WARM` follows."""

COMPARE: tuple[Stage, ...] = (Observe(scale=1.25, margin=27, attention=27), Evaluate())
"""Comparison of a given state with a frame, in a smaller image."""

CALIBRATION_STAGES: tuple[Stage, ...] = (
    SilhouetteSearch(),
    _FAR,
    Descend(blur=8.0),
    Descend(blur=3.0),
    Observe(),
    Descend(blur=3.0),
    Descend(blur=1.6),
    Observe(),
    replace(FINEST, steps=12, tolerance=1e-4),
)
"""Many frames that share base frames and cameras."""

FEATURES: tuple[Stage, ...] = (FirstOrder(attention=20, blur=1.6), FirstOrder())
"""Losses of image features: a wide attention first, the final one for the second half of the iterations."""

PAPER: tuple[Stage, ...] = (FirstOrder(share=1.0, blur=0.0),)
"""The paper's: one attention, no blur."""
