"""The solvers that ship, each a tuple of stages to be read from top to bottom.

What a stage does and what its numbers mean is in the module `stages` beside this one; terms are in docs/glossary.md. A
network predicts what each pixel shows of the arms, given a rendering of a state that it is conditioned on (`Observe`);
`Descend` then fits the rendering to that prediction, under less and less blur.
"""

from dataclasses import replace

from .stages import (
    FINEST,
    AlignEdges,
    Descend,
    Evaluate,
    FirstOrder,
    Given,
    IgnoreOccluders,
    Observe,
    OtherBackground,
    PreferStart,
    RandomRestart,
    RejectFailed,
    SilhouetteSearch,
    Stage,
)

_FAR = Observe(margin=27, attention=27, haze=False)
"""An observation that has to find arms which are several degrees off."""


def reduced(stages: tuple[Stage, ...], scale: float) -> tuple[Stage, ...]:
    """The same stages with no observation at more than `scale` times the working image."""
    return tuple(replace(s, scale=min(s.scale, scale)) if isinstance(s, Observe) else s for s in stages)


_COARSE = Descend(blur=8.0, robust=2.0, tolerance=0.06)
_MEDIUM = Descend(blur=3.0, tolerance=0.06)
_FINE = Descend(blur=1.6, tolerance=0.06)
_RESTART = RandomRestart(then=(Descend(blur=8.0), _FAR, Descend(blur=3.0)))

SEARCH: tuple[Stage, ...] = (
    SilhouetteSearch(),
    # A small image first: a good estimate is there soon.
    Observe(scale=0.75, margin=27, attention=27, haze=False),
    _COARSE,
    # Conditioned on the start again, so that an error of the first pass is not confirmed by itself.
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
"""As `WARM`, for a frame that may be farther from where it is expected."""

WARM: tuple[Stage, ...] = (
    Observe(scale=0.6, margin=10, attention=10),
    Descend(blur=1.2, steps=1),
    AlignEdges(steps=6),
)
"""A frame of a sequence or stream, near where its neighbours let expect it: one small observation, one step, and the
outlines."""

LIVE_SEARCH: tuple[Stage, ...] = reduced(SEARCH[: SEARCH.index(_RESTART) + 1], 1.0)
"""A frame of a live stream whose arms are lost; `WARM` follows."""

COMPARE: tuple[Stage, ...] = (Observe(scale=1.25, margin=27, attention=27), Evaluate())
"""How well a given state fits a frame, in a smaller image."""

CALIBRATION: tuple[Stage, ...] = (
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
