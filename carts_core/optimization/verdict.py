"""Whether a fit can be relied on, as far as its images tell; nothing here knows how it was made."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from .evidence import OUT_OF_VIEW, Evidence
from .failure import log_odds_of_failure
from .frame_images import HAS_LEFT
from .observability import Uncertainty


class Verdict(Enum):
    """How far a fit can be relied on."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    FAILED = "failed"

    @classmethod
    def of(cls, probability: float) -> "Verdict":
        """What a probability of failure [1] alone calls for."""
        if probability >= _LIKELY:
            return cls.FAILED
        return cls.DOUBTFUL if probability >= _POSSIBLE else cls.GOOD


@dataclass(frozen=True)
class Assessment:
    """A verdict, and what speaks for it."""

    verdict: Verdict
    reason: str
    """One sentence for people."""
    remedy: str
    """What to try, one sentence; empty where nothing has to be."""
    probability: float
    """That the mask is wrong (Dice below 0.9), as calibrated on frames of known truth [1]."""
    evidence: Evidence
    nothing_there: bool = False
    """Whether no arm is in view or seen at all, so that nothing could be fitted."""

    @property
    def certain(self) -> bool:
        """Whether the fit is good, and so likely right that its deviations need not allow for a wrong fit."""
        return self.verdict is Verdict.GOOD and self.probability < _UNCERTAIN

    def of(self, known: Uncertainty) -> Uncertainty:
        """What is known after the verdict, from what the curvature of the objective says.

        A certain fit is taken at its word, of a failed one nothing is known beyond what was expected before.
        """
        if self.certain:
            return known
        return known.doubted(1.0 if self.verdict is Verdict.FAILED else self.probability)


_UNCERTAIN, _POSSIBLE, _LIKELY = 0.1, 0.13, 0.5
"""Probability of failure from which deviations allow for a wrong fit, a fit is doubtful, and it has failed [1]; why, is
in docs/explanation/decisions.md."""


def assess(found: Evidence, *, strict: bool = False) -> Assessment:
    """The verdict that the evidence calls for.

    Args:
        found: the evidence.
        strict: whether a fit is doubtful as soon as its deviations allow for a wrong one; so it always is with given
            masks, whose overlap is the Dice itself.
    """
    doubtful_from = _UNCERTAIN if strict or found.masked else _POSSIBLE
    probability = _probability_of_failure(found)
    for applies, reason, remedy in _NOTHING_THERE:
        if applies(found):
            return Assessment(Verdict.FAILED, reason, remedy, max(probability, _LIKELY), found, True)
    what = "given mask" if found.masked else "image"
    if probability >= _LIKELY:
        reason = f"The {what} contradicts the fit: " + _weakest(found)
        return Assessment(Verdict.FAILED, reason, _REMEDY_FAILED, probability, found)
    if arm_is_elsewhere(found):
        reason = "An arm is out of view where it was fitted, and something that looks like an arm is elsewhere."
        return Assessment(Verdict.DOUBTFUL, reason, _REMEDY, max(probability, _POSSIBLE), found)
    if probability >= doubtful_from:
        reason = f"The {what} supports the fit only in part: " + _weakest(found)
        return Assessment(Verdict.DOUBTFUL, reason, _REMEDY, max(probability, _POSSIBLE), found)
    if found.parts_predicted < _PART_UNSEEN:
        reason = "The wrist or the jaws of an arm are not predicted where they were fitted, so only the shaft is."
        return Assessment(Verdict.DOUBTFUL, reason, _REMEDY, max(probability, _POSSIBLE), found)
    return Assessment(Verdict.GOOD, f"The {what} supports the fit.", "", probability, found)


def arm_is_elsewhere(found: Evidence) -> bool:
    """Whether an arm is out of view where it was fitted, and something that looks like an arm is in the image."""
    return found.elsewhere >= _LOOKS_LIKE_ONE


_UNSEEN, _AT_RANDOM = 0.05, 0.5
"""Share of an arm below which nothing of it is predicted, and
agreement below which a prediction says nothing of the fit [1]."""

_PART_UNSEEN = 0.2
"""Share of the rendered wrists, or jaws, below which they are not predicted [1]."""

_LOOKS_LIKE_ONE = 5e-3
"""Share of the images from which what looks like an arm may be the one that is out of view [1]."""

_MOST, _MORE = 0.5, 2.0
"""Share of the images, and multiple of what arms cover as measured, from which a fit follows no mask of arms [1]."""

_NOTHING_THERE: tuple[tuple[Callable[[Evidence], bool], str, str], ...] = (
    (
        lambda found: found.start_area < OUT_OF_VIEW,
        "No arm is in view: as measured, the arms lie outside of the image or behind the camera.",
        "Check T_camera_world, T_world_base and the units of the joints, or leave the frame out.",
    ),
    (
        lambda found: found.masked and found.area > max(_MOST, _MORE * found.start_area),
        "The given mask covers most of the image, which the arms as measured do not.",
        "Check that the mask is white on the arms and black elsewhere, not the other way round, without transparency.",
    ),
    (
        lambda found: found.masked and found.predicted < _UNSEEN and found.agreement < _AT_RANDOM,
        "The given mask shows nothing where the arms should be.",
        "Check that it belongs to this frame and is white on the arms and black elsewhere, or leave the frame out.",
    ),
    (
        lambda found: (
            found.predicted < _UNSEEN
            and found.agreement < _AT_RANDOM
            and (found.changed is None or found.changed < _UNSEEN)
        ),
        "Nothing that looks like an arm is seen where the arms should be.",
        "Check that the image shows them (not black, not covered) and that it belongs to these kinematics.",
    ),
    (
        lambda found: found.still_in_view < HAS_LEFT,
        "An arm that was in view at the start has left the image.",
        "See that the image, or the mask that is fitted, shows all arms; set the arm roughly by hand and run again, or "
        "check T_camera_world and T_world_base.",
    ),
    (
        lambda found: found.changed is not None and found.changed < _UNSEEN,
        "The image does not differ from the empty background where the arms should be.",
        "Check that the image shows the arms and belongs to these kinematics, or leave the frame out.",
    ),
)

_REMEDY = (
    "Look at the overlay. Run the optimizer if it has not run, set the arm by hand, or fit the frame together with its "
    "neighbours (sequence mode; Solve in the page) if that is not done."
)
_REMEDY_FAILED = (
    "Run the optimizer, or if it has run, set the arm roughly by hand and run again, check the calibration, or name an "
    "image of the empty scene in the recording's file (background)."
)


def _weakest(found: Evidence) -> str:
    """What speaks most against a fit, in words."""
    if found.masked:
        return "what is rendered and the given mask differ."
    against = {
        "what the network predicts lies elsewhere.": found.agreement,
        "the network, which is shown the fit as a hint, predicts something else without it.": found.unconditioned,
    }
    if found.overlap_with_change is not None:
        against["what differs from the empty background lies elsewhere."] = found.overlap_with_change
    return min(against, key=lambda reason: against[reason])


def _probability_of_failure(found: Evidence) -> float:
    return 1.0 / (1.0 + math.exp(-log_odds_of_failure(found.loss, found, found.masked)))
