"""Whether a fit can be relied on, as far as its images tell; nothing here knows how it was made."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import torch
from jaxtyping import Float
from torch import Tensor

from ..imaging.window import Window
from ..model.scene import SceneState
from ..model.surface import COVERAGE
from .frame_images import FrameImages
from .losses import attention
from .observability import Uncertainty
from .predictor import FramePredictor

_MARGIN, _NEAR = 16, 8
"""What the network is shown beyond the arms, and how far from them predictions count [px of the working image]."""


@dataclass(frozen=True)
class Evidence:
    """What images say of a fit, without any truth."""

    area: float
    """Of the rendered arms, as a share of the images [1]."""
    start_area: float
    """The same at the start [1]."""
    loss: float
    """Of the surface factor: its cost per pixel of the arms, without the prior [1]; see `Evaluation.loss`."""
    residual: float
    """Squared difference of what is rendered and what the network predicts, conditioned on the fit, as a share of
    their mean area [1]."""
    agreement: float
    """Overlap (soft Dice) of both [1]."""
    unconditioned: float
    """The same, the network conditioned on nothing [1]."""
    predicted: float
    """Share of the rendered arms that the network predicts, conditioned on nothing [1]."""
    changed: float | None
    """Share of the rendered arms that differs from the mean background; None where that is not known [1]."""
    overlap_with_change: float | None
    """Overlap (soft Dice) of what is rendered and what differs from the mean background, near the arms [1]."""
    still_in_view: float = 1.0
    """Of the arms in view at the start, the smallest share that one of them still has of its area then [1]."""
    masked: bool = False
    """Whether what is called predicted are given masks, which count in the whole image."""


@torch.no_grad()
def evidence(
    images: FrameImages, start: SceneState, end: SceneState, predictor: FramePredictor, loss: float
) -> Evidence:
    """What images say for and against a fit; runs the predictor twice.

    Args:
        images: of the cameras that take part.
        start, end: before and after the optimization.
        predictor: of surface maps.
        loss: of the fit.
    """
    before, maps = (images.renderer.surface_maps(state) for state in (start, end))
    covered, was = (part[:, COVERAGE].sum(1, keepdim=True) for part in (maps, before))
    margin = max(images.size) if predictor.masked else round(_MARGIN * images.scale)
    window = Window.around(covered.sum(1), margin, predictor.stride, images.size)
    rendered, weight = window.of(covered), window.of(images.weight)
    near = weight
    if not predictor.masked:
        near = attention((rendered > 0).to(rendered), round(_NEAR * images.scale)) * weight
    conditioned, alone = (
        predictor.predict(images.images, given, window)[:, COVERAGE].sum(1, keepdim=True) * near
        for given in (maps, torch.zeros_like(maps))
    )
    rendered = rendered * weight
    changed = None if images.changed is None else window.of(images.changed) * near
    return Evidence(
        area=float(covered.mean()),
        start_area=float(was.mean()),
        loss=loss,
        residual=float(2.0 * (rendered - conditioned).square().sum() / (rendered + conditioned).sum().clamp(min=1.0)),
        agreement=_overlap(rendered, conditioned),
        unconditioned=_overlap(rendered, alone),
        predicted=_share(alone, rendered),
        changed=None if changed is None else _share(changed, rendered),
        overlap_with_change=None if changed is None else _overlap(rendered, changed),
        still_in_view=_still_in_view(images, start, end),
        masked=predictor.masked,
    )


def _still_in_view(images: FrameImages, start: SceneState, end: SceneState) -> float:
    """See `Evidence.still_in_view`."""
    before, after = (images.renderer.segment(state) for state in (start, end))
    shares = [1.0]
    for arm in range(len(start.joint_positions)):
        if (was := int((before == arm).sum())) >= _OUT_OF_VIEW * before.size:
            shares.append(int((after == arm).sum()) / was)
    return min(shares)


def _overlap(one: Float[Tensor, "cameras 1 h w"], other: Float[Tensor, "cameras 1 h w"]) -> float:
    """Soft Dice of two maps in [0, 1]; 0 where both are empty."""
    return float(2.0 * torch.minimum(one, other).sum() / (one.sum() + other.sum()).clamp(min=1e-6))


def _share(part: Float[Tensor, "cameras 1 h w"], whole: Float[Tensor, "cameras 1 h w"]) -> float:
    """Share of a map in [0, 1] that another one has too; 0 of an empty one."""
    return float((part * whole).sum() / whole.sum().clamp(min=1e-6))


class Verdict(Enum):
    """How far a fit can be relied on."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    FAILED = "failed"


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

    def of(self, known: Uncertainty) -> Uncertainty:
        """What is known after the verdict, from what the curvature of the objective says.

        A good fit is taken at its word, of a failed one nothing is known beyond what was expected before.
        """
        if self.verdict is Verdict.GOOD:
            return known
        return known.doubted(self.probability if self.verdict is Verdict.DOUBTFUL else 1.0)


def assess(found: Evidence) -> Assessment:
    """The verdict that the evidence calls for."""
    probability = _probability_of_failure(found)
    for applies, reason, remedy in _NOTHING_THERE:
        if applies(found):
            return Assessment(Verdict.FAILED, reason, remedy, max(probability, _LIKELY), found, True)
    if probability >= _LIKELY:
        return Assessment(
            Verdict.FAILED, "The image contradicts the fit: " + _weakest(found), _REMEDY_FAILED, probability, found
        )
    if probability >= _POSSIBLE:
        return Assessment(
            Verdict.DOUBTFUL, "The image supports the fit only in part: " + _weakest(found), _REMEDY, probability, found
        )
    return Assessment(Verdict.GOOD, "The image supports the fit.", "", probability, found)


_WITHOUT_CHANGE = (2.472, 12.044, 3.853, -6.32, 0.0)
_WITH_CHANGE = (8.427, 6.783, 2.379, -4.861, -3.073, -5.614)
"""Bias, and weights of loss, residual, agreement, unconditioned (and overlap with change) in the log odds of a failure:
logistic regressions over frames of known truth, none of them held out."""

_MASK_MIDDLE, _MASK_SLOPE = 0.8, 22.0
"""Overlap with a given mask at which a fit is as likely right as wrong, and how fast the log odds fall beyond it: it is
good from 0.9 on, since the mask is what is wanted, and doubtful below, since a mask may have holes."""

_POSSIBLE, _LIKELY = 0.1, 0.5
"""Probability of failure from which a fit is doubtful, and from which it has failed [1]."""

_OUT_OF_VIEW, _UNSEEN, _AT_RANDOM = 5e-4, 0.05, 0.5
"""Share of the images below which no arm is in view, share of an arm below which nothing of it is predicted, and
agreement below which a prediction says nothing of the fit [1]."""

_LEFT = 0.3
"""Share of its area at the start below which an arm has left the image [1]."""

_NOTHING_THERE: tuple[tuple[Callable[[Evidence], bool], str, str], ...] = (
    (
        lambda found: found.start_area < _OUT_OF_VIEW,
        "No arm is in view: as measured, the arms lie outside of the image or behind the camera.",
        "Check T_camera_world, T_world_base and the units of the joints, or leave the frame out.",
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
        lambda found: found.still_in_view < _LEFT,
        "An arm that was in view at the start has left the image.",
        "Set it roughly by hand and run again, or check T_camera_world and T_world_base.",
    ),
    (
        lambda found: found.changed is not None and found.changed < _UNSEEN,
        "The image does not differ from the empty background where the arms should be.",
        "Check that the image shows the arms and belongs to these kinematics, or leave the frame out.",
    ),
)

_REMEDY = "Look at the overlay; set the arm by hand, or correct the frame in sequence mode."
_REMEDY_FAILED = "Set the arm roughly by hand and run again, check the calibration, or give an image of the background."


def _weakest(found: Evidence) -> str:
    """What speaks most against a fit, in words."""
    if found.masked:
        return "what is rendered and the given mask differ."
    against = {
        "what the network predicts lies elsewhere.": found.agreement,
        "without the fit as a hint, the network predicts something else.": found.unconditioned,
    }
    if found.overlap_with_change is not None:
        against["what differs from the empty background lies elsewhere."] = found.overlap_with_change
    return min(against, key=lambda reason: against[reason])


def _probability_of_failure(found: Evidence) -> float:
    if found.masked:
        return 1.0 / (1.0 + math.exp(_MASK_SLOPE * (found.agreement - _MASK_MIDDLE)))
    values = [found.loss, found.residual, found.agreement, found.unconditioned]
    bias, *weights = _WITHOUT_CHANGE
    if found.overlap_with_change is not None:
        values.append(found.overlap_with_change)
        bias, *weights = _WITH_CHANGE
    return 1.0 / (1.0 + math.exp(-(bias + sum(w * v for w, v in zip(weights, values, strict=True)))))
