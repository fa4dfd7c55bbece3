"""Stages of solvers as data, and presets of stages."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated

from .ranges import Range, Ranged, Share


class Given(StrEnum):
    """State on whose rendering the network is conditioned."""

    START = "start"
    """Initial state of the run."""
    ESTIMATE = "estimate"
    """The current estimate."""
    NOTHING = "nothing"
    """No state: the prediction from the image alone."""


@dataclass(frozen=True)
class Observe(Ranged):
    """Predict the surface map of the images: per pixel, the coverage of each part of the arms and the normal
    (`carts_core.model.parts`). `Descend` and `AlignEdges` do not run the network; `RandomRestart` and `PreferStart`
    make another observation, and verdicts (`RetryOtherBackground`, `RejectFailed`) run the network for their evidence.
    """

    scale: Annotated[float, Range(0.1, 8)] = 1.5
    """Size of the images relative to the working image, limited to the camera's resolution [1]."""
    given: Given = Given.ESTIMATE
    """State on which the network is conditioned."""
    margin: Annotated[int, Range(0, 1000, "px")] = 16
    """Margin of the network's input around the arms of that state [px]."""
    attention: Annotated[int, Range(1, 1000, "px")] = 8
    """Distance from the arms of that state beyond which pixels are ignored: the attention of the paper [px]."""
    haze: bool = True
    """Whether pixels under haze or smoke are weighted by its transmission. Searches work better with all pixels."""


@dataclass(frozen=True)
class Descend(Ranged):
    """Levenberg-Marquardt on the surface factor (rendered minus observed surface map) and the prior, under one blur."""

    blur: Annotated[float, Range(0, 40, "px")]
    """Standard deviation of the blur under which surface maps are compared [px]."""
    robust: Annotated[float, Range(1e-3, 100)] = 0.5
    """Scale of the robust weights (Geman-McClure): difference of surface maps beyond which a pixel is down-weighted
    [1]."""
    steps: Annotated[int, Range(1, 1000)] = 6
    """Maximum number of steps [1]."""
    tolerance: Annotated[float, Range(0, 1, below=True)] = 1e-2
    """The stage ends when the predicted relative reduction of the objective is below this [1]."""


FINEST = Descend(blur=0.8)
"""Settings of the final descent, also used to compare estimates."""


@dataclass(frozen=True)
class RandomRestart(Ranged):
    """If the fit is bad or an arm is lost (it has left the image, or no arm was observed at its position): draw random
    states, compare them with the whole image, and descend again from the best state."""

    then: tuple["Stage", ...]
    """Stages from the best state. Random states are compared as in the first `Descend` of these stages."""
    if_loss: Annotated[float, Range(0, 10)] = 0.045
    """Cost per arm pixel, without the prior, above which a fit is bad [1]."""
    candidates: Annotated[int, Range(1, 10_000)] = 64
    """Number of random states per arm [1]."""
    deviation: Annotated[float, Range(0, 10, above=True)] = 1.8
    """Standard deviation of the random states, relative to the prior standard deviation (such as
    `SurfaceSolver.prior_deg`) [1]."""
    scale: Annotated[float, Range(0.1, 8)] = 0.75
    """Scale of the whole image for the comparison, as in `Observe.scale` [1]."""
    given: Given = Given.START
    """State on which the network is conditioned."""


@dataclass(frozen=True)
class SilhouetteSearch(Ranged):
    """If given masks are the target and the start is far from them: draw states, compare silhouettes and masks by
    distance, which requires no overlap, and continue from the nearest state. Skipped if a network predicts the
    coverage.
    """

    if_overlap: Share = 0.8
    """Dice of silhouettes and masks at the start above which the search is skipped [1]."""
    starts: Annotated[int, Range(1, 100)] = 4
    """Maximum number of searches [1]."""
    rounds: Annotated[int, Range(1, 1000)] = 10
    """Rounds per search; each round draws states around the best states of the previous round [1]."""
    candidates: Annotated[int, Range(20, 10_000)] = 48
    """Number of states per round, except for a larger first round [1]."""
    joints_deg: Annotated[float, Range(0, 90, "deg", above=True)] = 6.0
    """Standard deviation of joints in the first round [deg]; `length_scale` converts it to metres."""
    frames_deg: Annotated[float, Range(0, 90, "deg", above=True)] = 15.0
    """Standard deviation of rotations of base frames and cameras in the first round [deg]; the standard deviation of
    translations is half this angle times the distance of the arms from the camera."""
    enough: Annotated[float, Range(0, 1000, "px")] = 1.5
    """Distance between silhouettes and masks below which no further search starts [px of the compared images]."""
    scale: Annotated[float, Range(0.1, 8)] = 0.5
    """Scale of the compared images, as in `Observe.scale` [1]."""


@dataclass(frozen=True)
class AlignEdges(Ranged):
    """Move the outlines of the arms to image edges, weighted against the other factors. Skipped if given masks are the
    target, since they define the outlines."""

    steps: Annotated[int, Range(1, 1000)] = 24
    """Maximum number of steps [1]."""
    weight: Annotated[float, Range(0, 100, above=True)] = 0.3
    """Weight of a squared distance to an edge, per outline pixel [1/px^2]."""


@dataclass(frozen=True)
class AlignRegions(Ranged):
    """Move the outlines of the arms to where colours, learnt in earlier frames, and edges of the image indicate them,
    without the network. Only for frames without the network, in `SequenceSettings.between`."""

    steps: Annotated[int, Range(1, 1000)] = 6
    """Number of steps [1]."""
    weight: Annotated[float, Range(0, 100, above=True)] = 0.5
    """Weight of a squared distance, per outline pixel [1/px^2]."""
    reach: Annotated[float, Range(0.1, 100, "px")] = 2.0
    """Standard deviation of the expected distance between outline and image [px]; smaller for the last steps."""
    odds: Annotated[float, Range(0, 10)] = 0.3
    """Exponent of the odds of colours [1]; below 1, since colours of neighbouring pixels are correlated."""
    edges: Annotated[float, Range(0, 10)] = 1.0
    """Exponent of the squared strength of edges [1]."""
    floor: Annotated[float, Range(1e-3, 1e5)] = 200.0
    """Squared difference of colours (8 bits) across an edge that counts as noise [1]."""
    spread: Annotated[float, Range(0.1, 100, "px")] = 1.0
    """Standard deviation of the distance along a line at which its weight is halved [px]."""
    robust: Annotated[float, Range(0.1, 100, "px")] = 2.0
    """Distance at which the weight of a line is reduced to a quarter [px]."""


@dataclass(frozen=True)
class PreferStart(Ranged):
    """Return to the start if it explains the image equally well; skipped if calibration parameters are free."""

    improvement: Annotated[float, Range(0, 1e6, above=True)] = 5.0
    """Minimum improvement of the objective for which the estimate is kept [1]."""
    ratio: Annotated[float, Range(1, 100)] = 1.25
    """Multiple of the estimate's cost above which the start is rejected [1]."""
    edges: Annotated[float, Range(1, 100)] = 1.12
    """Multiple of the estimate's edge distance above which the start is rejected [1]; exactly correct starts are below
    this multiple in 39 of 40 synthetic frames."""
    overlap: Share = 0.9
    """Dice of the silhouettes of start and estimate below which the start is not considered [1]."""


@dataclass(frozen=True)
class RetryOtherBackground:
    """If the fit has failed and the empty background is known: repeat it with the other background mode (replaced in
    the image, or subtracted from the predictions). The second run is kept if it has not failed and its arms overlap
    more with the change relative to the background, which false detections do not affect."""

    then: tuple["Stage", ...]
    """Stages from the start."""


@dataclass(frozen=True)
class IgnoreOccluders:
    """Propose an ignore mask of occluders from contradicting pixels, and repeat the optimization without these
    pixels."""

    then: tuple["Stage", ...]
    """Stages from the start, run if a mask was proposed."""


@dataclass(frozen=True)
class Evaluate:
    """Re-evaluate the current estimate at the `FINEST` stage; the estimate is not changed."""


@dataclass(frozen=True)
class RejectFailed:
    """Assess the best point as good, doubtful or failed. Unless it is good, its standard deviations account for a wrong
    fit. If it failed, return to the start, unless arms are visible and the start fits the
    image even less."""


@dataclass(frozen=True)
class FirstOrder(Ranged):
    """Gradient descent on a loss of image features, as in the paper."""

    share: Annotated[float, Range(0, 1, above=True)] = 0.5
    """Share of the planned iterations [1]."""
    attention: Annotated[int, Range(1, 400, "px")] = 10
    """Dilation of the silhouette [px]."""
    blur: Annotated[float, Range(0, 20, "px")] = 0.6
    """Standard deviation of the lens blur applied to the rendering before comparison [px]."""


Stage = (
    Observe
    | Descend
    | RandomRestart
    | SilhouetteSearch
    | AlignEdges
    | AlignRegions
    | PreferStart
    | RetryOtherBackground
    | IgnoreOccluders
    | Evaluate
    | RejectFailed
    | FirstOrder
)


def first_descend(stages: tuple[Stage, ...]) -> Descend:
    """First descent of a solver; `FINEST` without a descent."""
    return next((stage for stage in stages if isinstance(stage, Descend)), FINEST)


def first_observe(stages: tuple[Stage, ...]) -> Observe:
    """First observation of a solver; the default observation if the solver has none."""
    return next((stage for stage in stages if isinstance(stage, Observe)), Observe())


_FAR = Observe(margin=27, attention=27, haze=False)
"""Observation for joint errors of several degrees."""


def reduced(stages: tuple[Stage, ...], scale: float) -> tuple[Stage, ...]:
    """Stages with the scale of observations limited to `scale`."""
    return tuple(replace(s, scale=min(s.scale, scale)) if isinstance(s, Observe) else s for s in stages)


_COARSE = Descend(blur=8.0, robust=2.0, tolerance=0.06)
_MEDIUM = Descend(blur=3.0, tolerance=0.06)
_FINE = Descend(blur=1.6, tolerance=0.06)
_RESTART = RandomRestart(then=(Descend(blur=8.0), _FAR, Descend(blur=3.0)))

SEARCH: tuple[Stage, ...] = (
    SilhouetteSearch(),
    # The first estimate uses a small image and is fast.
    Observe(scale=0.75, margin=27, attention=27, haze=False),
    _COARSE,
    # The network is conditioned on the start again, so that errors of the first pass are not reinforced.
    Observe(given=Given.START, margin=27, attention=27, haze=False),
    _MEDIUM,
    _RESTART,
    Observe(),
    _MEDIUM,
    _FINE,
)
"""Stages from measured kinematics to a fine estimate."""

_FITTED: tuple[Stage, ...] = (*SEARCH, AlignEdges(), Observe(), FINEST)
_ALONE: tuple[Stage, ...] = (*_FITTED, AlignEdges(), PreferStart())

FRAME: tuple[Stage, ...] = (*_ALONE, RetryOtherBackground(then=_ALONE), Evaluate(), RejectFailed())
"""Stages for a single frame (default).

`SilhouetteSearch` acts only if given masks are the target, `RandomRestart` only if the fit is bad, and
`RetryOtherBackground` only if the fit has failed and the empty background is known. Once the budget of evaluations is
spent, all stages except `RejectFailed` are skipped.
"""

OCCLUDED: tuple[Stage, ...] = (
    *(*_FITTED, IgnoreOccluders(then=_FITTED), AlignEdges(), PreferStart(), Evaluate(), RejectFailed()),
)
"""Stages for a single frame, repeated without pixels of probable occluders."""

NONE: tuple[Stage, ...] = (Observe(), Evaluate(), RejectFailed())
"""Evaluation of the start only ("CaRTS without optimization")."""

COLD: tuple[Stage, ...] = (*SEARCH, Observe(), FINEST)
"""Stages for a frame of a sequence without a prediction, from its measured kinematics; `WARM` follows."""

_WIDE = Observe(margin=27, attention=27)
"""Observation with a larger margin around the arms."""

WARM_WIDE: tuple[Stage, ...] = (_WIDE, Descend(blur=0.8, steps=2), AlignEdges())
"""Like `WARM`, for a frame whose state is farther from its prediction."""

WARM: tuple[Stage, ...] = (
    Observe(scale=0.6, margin=10, attention=10),
    Descend(blur=1.2, steps=1),
    AlignEdges(steps=6),
)
"""Stages for a frame of a sequence or stream whose state is near its prediction: one small observation, one step, and
edge alignment."""

BETWEEN: tuple[Stage, ...] = (AlignRegions(),)
"""Stage for a frame of a sequence or stream without the network."""

SETTLE: tuple[Stage, ...] = (Observe(), Descend(blur=0.8, steps=8, tolerance=1e-3), AlignEdges(steps=8))
"""Stages for the frames after a search in a live stream, from the last correction to convergence."""

LIVE_SEARCH: tuple[Stage, ...] = (
    SilhouetteSearch(),
    # The network is not conditioned on a state, since all states may be wrong.
    RandomRestart(
        then=(Descend(blur=16.0, robust=2.0), _COARSE, Descend(blur=3.0)),
        candidates=16,
        deviation=0.72,
        given=Given.NOTHING,
    ),
    SETTLE[0],
    _MEDIUM,
    _FINE,
    # The frames after a search converge (`SETTLE`).
    replace(FINEST, steps=2),
    SETTLE[-1],
)
"""Stages for a frame of a live stream with lost arms, under a prior that is wider than that of other frames."""

SIGHT: tuple[Stage, ...] = (Observe(scale=0.5, given=Given.NOTHING, haze=False),)
"""Observation that decides whether a frame of a live stream shows arms."""

COMPARE: tuple[Stage, ...] = (Observe(scale=1.25, margin=27, attention=27), Evaluate())
"""Stages that compare a given state with a frame, in a smaller image."""

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
"""Stages of a calibration over many frames."""

FEATURES: tuple[Stage, ...] = (FirstOrder(attention=20, blur=1.6), FirstOrder())
"""Stages for losses of image features: a wide attention first, and the final attention for the second half of the
iterations."""

PAPER: tuple[Stage, ...] = (FirstOrder(share=1.0, blur=0.0),)
"""Stage of the paper, with one attention and without blur."""
