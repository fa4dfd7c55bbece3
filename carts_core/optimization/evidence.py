"""Image evidence for and against a fit, and the resulting log odds of failure."""

from dataclasses import asdict, dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..imaging.working_image import Window, attention
from ..model.parts import COVERAGE, SURFACE_CHANNELS
from ..model.scene import SceneState
from ..threads import total
from .observation import FrameImages
from .predictor import FramePredictor


@dataclass(frozen=True)
class ArmEvidence:
    """Evidence for and against the fit of one arm, from the pixels near it in all cameras."""

    residual: float
    """Squared difference of the rendered coverage and the coverage predicted with the fit as condition, relative to
    their mean area [1].
    """
    agreement: float
    """Overlap (soft Dice) of rendered and predicted coverage [1]."""
    unconditioned: float
    """Overlap (soft Dice) with the unconditioned prediction [1]."""
    overlap_with_change: float | None
    """Overlap (soft Dice) of the rendering with the change relative to the mean background [1]; None if unknown."""


_WITHOUT_CHANGE = (0.13, 23.8, 1.5, -3.25, -0.44)
_WITH_CHANGE = (0.99, 27.9, 0.81, -1.84, -0.42, -2.85)
"""Bias, and weights of loss, residual, agreement, unconditioned (and overlap with change) in the log odds of failure:
logistic regressions on 503 frames with ground truth, none held out; see docs/explanation/decisions.md.
"""

_LEAST_CHANGE, _CHANGE_SLOPE = 0.6, 40.0
"""Lowest overlap with change among correct fits, and slope of the log odds below it."""

_MASK_MIDDLE, _MASK_SLOPE = 0.8, 22.0
"""Overlap with a given mask at log odds 0, and slope of the log odds: a fit is good from 0.9 and doubtful below, since
a mask may have holes.
"""


def log_odds_of_failure(loss: float, arm: ArmEvidence, masked: bool) -> float:
    """Log odds that the mask is wrong (Dice below 0.9).

    Args:
        masked: whether given masks are the target.
    """
    if masked:
        return _MASK_SLOPE * (_MASK_MIDDLE - arm.agreement)
    values = [loss, arm.residual, arm.agreement, arm.unconditioned]
    bias, *weights = _WITHOUT_CHANGE
    if arm.overlap_with_change is not None:
        values.append(arm.overlap_with_change)
        bias, *weights = _WITH_CHANGE
        bias += _CHANGE_SLOPE * max(0.0, _LEAST_CHANGE - arm.overlap_with_change)
    return bias + sum(weight * value for weight, value in zip(weights, values, strict=True))


_MARGIN, _NEAR = 16, 8
"""Margin of the network's input around the arms, and distance within which predictions count [px of the working
image]."""

_SHOWN, _TELLING = 2e-3, 0.3
"""Minimum area of an arm that is assessed separately, as a share of the images, and minimum share of an arm with
informative change [1].
"""

_PART_SHOWN = 60.0
"""Minimum area of a part that is assessed separately [px of the working image]."""

OUT_OF_VIEW = 5e-4
"""Share of the images below which no arm is in view [1]."""


@dataclass(frozen=True)
class Evidence(ArmEvidence):
    """Evidence for and against a fit, without ground truth: for all arms, and for the arm with the worst fit."""

    area: float
    """Area of the rendered arms, as a share of the images [1]."""
    start_area: float
    """Area of the rendered arms at the start, as a share of the images [1]."""
    loss: float
    """Cost of the surface factor per pixel of the arms, without the prior [1]; see `Evaluation.loss`."""
    predicted: float
    """Share of the rendered arms in the network's unconditioned prediction [1]."""
    changed: float | None
    """Share of the rendered arms that differs from the mean background [1]; None if that is unknown."""
    still_in_view: float = 1.0
    """Smallest ratio of an arm's area to its area at the start, over the arms initially in view [1]; parts occluded by
    another arm count as in view.
    """
    elsewhere: float = 0.0
    """If an arm is out of view: predicted coverage far from the other arms that differs from the mean background, as a
    share of the images [1].
    """
    parts_predicted: float = 1.0
    """Minimum over wrists and jaws of the share of the rendered part that is predicted as that part [1]; 1 if hardly
    visible, and with given masks.
    """
    masked: bool = False
    """Whether the predictions are given masks, which are compared in the whole image."""


@torch.no_grad()
def evidence(
    images: FrameImages, start: SceneState, end: SceneState, predictor: FramePredictor, loss: float
) -> Evidence:
    """Collect image evidence for and against a fit; runs the predictor twice."""
    before, maps = (images.renderer.surface_maps(state) for state in (start, end))
    covered, was = (part[:, COVERAGE].sum(1, keepdim=True) for part in (maps, before))
    margin = max(images.size) if predictor.masked else round(_MARGIN * images.scale)
    window = Window.around(covered.sum(1), margin, predictor.stride, images.size)
    parts, parts_alone = (
        predictor.predict(images.images, given, window)[:, COVERAGE] for given in (maps, torch.zeros_like(maps))
    )
    conditioned, alone = parts.sum(1, keepdim=True), parts_alone.sum(1, keepdim=True)
    rendered, weight = window.of(covered), window.of(images.weight)
    before_labels, labels = images.renderer.segment(start), images.renderer.segment(end)
    change = None
    if images.change is not None:
        change = window.of(images.change.telling), window.of(images.change.surely)
    found = [
        _of_arm(here, rendered, conditioned, alone, change)
        for here in _places(images, labels, len(end.joint_positions), window, weight, whole=predictor.masked)
    ]
    worst = max(found, key=lambda arm: log_odds_of_failure(loss, arm, predictor.masked))
    rendered = rendered * weight
    shares = []
    for part in range(1, parts.shape[1]):  # The first part is the shaft.
        shown = window.of(maps[:, COVERAGE])[:, [part]] * weight
        if total(shown) >= _PART_SHOWN:
            shares.append(_share(parts[:, [part]].clamp(0.0, 1.0), shown))
    informative = change is not None and _share(change[0], rendered) > _TELLING
    areas = {arm: int((before_labels == arm).sum()) for arm in range(len(start.joint_positions))}
    visible = [arm for arm, pixels in areas.items() if pixels >= OUT_OF_VIEW * labels.size]
    in_view = [images.still_in_view(arm, (before_labels, start), (labels, end)) for arm in visible]
    return Evidence(
        **asdict(worst),
        area=total(covered) / covered.numel(),
        start_area=total(was) / was.numel(),
        loss=loss,
        predicted=_share(alone, rendered),
        changed=_share(change[1], rendered * change[0]) if change is not None and informative else None,
        still_in_view=min([1.0, *in_view]),
        elsewhere=_elsewhere(images, labels, len(end.joint_positions), predictor),
        parts_predicted=1.0 if predictor.masked else min(shares, default=1.0),
        masked=predictor.masked,
    )


def _elsewhere(
    images: FrameImages, arm_ids: Int[np.ndarray, "cameras h w"], arms: int, predictor: FramePredictor
) -> float:
    """See `Evidence.elsewhere`."""
    if predictor.masked or all((arm_ids == arm).any() for arm in range(arms)):
        return 0.0
    labels = torch.from_numpy(arm_ids).to(images.weight.device)[:, None]
    nothing = images.images.new_zeros(len(labels), SURFACE_CHANNELS, *labels.shape[-2:])
    seen = predictor.predict(images.images, nothing, Window(0, 0, *images.size))[:, COVERAGE].sum(1, keepdim=True)
    if images.change is not None:
        seen = seen * images.change.surely
    far = 1.0 - attention((labels >= 0).to(seen), round(_MARGIN * images.scale))
    return total(seen * far * images.weight) / seen.numel()


def _places(
    images: FrameImages,
    arm_ids: Int[np.ndarray, "cameras h w"],
    count: int,
    window: Window,
    weight: Float[Tensor, "cameras 1 h w"],
    *,
    whole: bool,
) -> list[Float[Tensor, "cameras 1 h w"]]:
    """Pixel weights at and around each visible arm, excluding other arms; all pixels if `whole`."""
    labels = window.of(torch.from_numpy(arm_ids).to(weight.device))[:, None]
    arms = [labels == arm for arm in range(count)]
    shown = [arm for arm in arms if float(arm.sum()) >= _SHOWN * arm_ids.size]
    if whole or len(shown) < 2:
        silhouette = (labels >= 0).to(weight)
        return [weight if whole else _around(silhouette, images.scale) * weight]
    anyone = labels >= 0
    return [_around(arm.to(weight), images.scale) * weight * (arm | ~anyone) for arm in shown]


def _around(silhouette: Float[Tensor, "cameras 1 h w"], scale: float) -> Float[Tensor, "cameras 1 h w"]:
    return attention(silhouette, round(_NEAR * scale))


def _of_arm(
    here: Tensor, rendered: Tensor, conditioned: Tensor, alone: Tensor, change: tuple[Tensor, Tensor] | None
) -> ArmEvidence:
    """Evidence on one arm from coverage maps under pixel weights.

    Args:
        rendered, conditioned, alone: coverage: rendered, predicted with condition, and predicted without.
    """
    rendered, conditioned, alone = rendered * here, conditioned * here, alone * here
    overlap = None
    if change is not None and _share(change[0], rendered) > _TELLING:
        overlap = _overlap(rendered * change[0], change[1] * change[0] * here)
    return ArmEvidence(
        residual=2.0 * total((rendered - conditioned).square()) / max(total(rendered + conditioned), 1.0),
        agreement=_overlap(rendered, conditioned),
        unconditioned=_overlap(rendered, alone),
        overlap_with_change=overlap,
    )


def _overlap(one: Float[Tensor, "cameras 1 h w"], other: Float[Tensor, "cameras 1 h w"]) -> float:
    """Soft Dice of two maps in [0, 1]; 0 if both are empty."""
    return 2.0 * total(torch.minimum(one, other)) / max(total(one) + total(other), 1e-6)


def _share(part: Float[Tensor, "cameras 1 h w"], whole: Float[Tensor, "cameras 1 h w"]) -> float:
    """Share of `whole` covered by `part`, both in [0, 1]; 0 if `whole` is empty."""
    return total(part * whole) / max(total(whole), 1e-6)
