"""How likely the evidence makes it that a fit is wrong: weights that were fitted to frames of known truth."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ArmEvidence:
    """What images say of one arm of a fit, near it; of all cameras together."""

    residual: float
    """Squared difference of what is rendered and what the network predicts, conditioned on the fit, as a share of
    their mean area [1]."""
    agreement: float
    """Overlap (soft Dice) of both [1]."""
    unconditioned: float
    """The same, the network conditioned on nothing [1]."""
    overlap_with_change: float | None
    """Overlap (soft Dice) of what is rendered and what differs from the mean background; None where that is not known
    [1]."""


_WITHOUT_CHANGE = (0.13, 23.8, 1.5, -3.25, -0.44)
_WITH_CHANGE = (0.99, 27.9, 0.81, -1.84, -0.42, -2.85)
"""Bias, and weights of loss, residual, agreement, unconditioned (and overlap with change) in the log odds of a failure:
logistic regressions over 503 frames of known truth, see docs/explanation/decisions.md; none of them is held out."""

_LEAST_CHANGE, _CHANGE_SLOPE = 0.6, 40.0
"""Overlap with change that every right fit had, and how fast the log odds rise below it."""

_MASK_MIDDLE, _MASK_SLOPE = 0.8, 22.0
"""Overlap with a given mask at which a fit is as likely right as wrong, and how fast the log odds fall beyond it: it is
good from 0.9 on, since the mask is what is wanted, and doubtful below, since a mask may have holes."""


def log_odds_of_failure(loss: float, arm: ArmEvidence, masked: bool) -> float:
    """Log odds that the mask is wrong (Dice below 0.9).

    Args:
        loss: of the fit; see `Evidence.loss`.
        arm: the evidence on the arm that the image speaks most against.
        masked: whether it is about given masks.
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
