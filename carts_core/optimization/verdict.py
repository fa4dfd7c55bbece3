"""Verdicts on the reliability of fits, sequences and calibrations, from image evidence; check of a network's domain."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.special import stdtr
from torch import Tensor

from ..imaging.working_image import Window, attention
from ..model.parts import COVERAGE, SURFACE_CHANNELS
from ..model.scene import Scene, SceneState
from ..networks.extractor import FeatureExtractor
from ..recording import Frame
from ..settings import SurfaceSolver
from ..threads import total
from .observability import Uncertainty
from .observation import MIN_AREA_RATIO, FrameImages
from .predictor import FramePredictor, SurfacePredictor, predictor_of
from .results import LIKELY, POSSIBLE, Verdict


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

_MIN_CHANGE_OVERLAP, _CHANGE_SLOPE = 0.6, 40.0
"""Minimum overlap with change among correct fits, and slope of the log odds below it."""

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
        bias += _CHANGE_SLOPE * max(0.0, _MIN_CHANGE_OVERLAP - arm.overlap_with_change)
    return bias + sum(weight * value for weight, value in zip(weights, values, strict=True))


_MARGIN, _RIM = 16, 8
"""Margin of the network's input around the arms, and distance within which predictions count [px of the working
image]."""

MIN_ARM_AREA, _INFORMATIVE = 2e-3, 0.3
"""Minimum area of a separately assessed arm, as a share of the images, and minimum share of an arm with informative
change [1].
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
    """Loss of the surface factor per pixel of the arms, without the prior [1]; see `Evaluation.loss`."""
    predicted: float
    """Share of the rendered arms' area that the unconditioned network also predicts as arms [1]."""
    changed: float | None
    """Share of the rendered arms that differs from the mean background [1]; None if the background is unknown or
    uninformative."""
    still_in_view: float = 1.0
    """Minimum ratio of an arm's area to its area at the start, over the arms of at least `MIN_ARM_AREA` at the start
    [1]; parts occluded by another arm count as in view. An arm of which less is in view may leave the image.
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

    @property
    def without_arms(self) -> bool:
        """Whether no arm is in view, neither at the start nor at the fit, and none is predicted elsewhere."""
        return max(self.start_area, self.area) < OUT_OF_VIEW and not arm_is_elsewhere(self)


@torch.no_grad()
def evidence(
    images: FrameImages, start: SceneState, end: SceneState, predictor: FramePredictor, loss: float
) -> Evidence:
    """Compute image evidence for and against a fit; runs the predictor twice, three times if an arm is out of view."""
    maps = images.renderer.surface_maps(end)
    covered = maps[:, COVERAGE].sum(1, keepdim=True)
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
        change = window.of(images.change.informative), window.of(images.change.differs)
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
    informative = change is not None and _share(change[0], rendered) > _INFORMATIVE
    areas = {arm: int((before_labels == arm).sum()) for arm in range(len(start.joint_positions))}
    visible = [arm for arm, pixels in areas.items() if pixels >= MIN_ARM_AREA * labels.size]
    in_view = [images.still_in_view(arm, (before_labels, start), (labels, end)) for arm in visible]
    return Evidence(
        **asdict(worst),
        area=total(covered) / covered.numel(),
        start_area=int((before_labels >= 0).sum()) / before_labels.size,
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
        seen = seen * images.change.differs
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
    """Pixel weights of each visible arm and its surroundings, excluding other arms; all pixels if `whole`."""
    labels = window.of(torch.from_numpy(arm_ids).to(weight.device))[:, None]
    arms = [labels == arm for arm in range(count)]
    shown = [arm for arm in arms if float((arm * weight).sum()) >= MIN_ARM_AREA * arm_ids.size]
    if whole or len(shown) < 2:
        silhouette = (labels >= 0).to(weight)
        return [weight if whole else _around(silhouette, images.scale) * weight]
    anyone = labels >= 0
    return [_around(arm.to(weight), images.scale) * weight * (arm | ~anyone) for arm in shown]


def _around(silhouette: Float[Tensor, "cameras 1 h w"], scale: float) -> Float[Tensor, "cameras 1 h w"]:
    return attention(silhouette, round(_RIM * scale))


def _of_arm(
    here: Tensor, rendered: Tensor, conditioned: Tensor, alone: Tensor, change: tuple[Tensor, Tensor] | None
) -> ArmEvidence:
    """Evidence on one arm from coverage maps under pixel weights.

    Args:
        rendered, conditioned, alone: rendered coverage, and coverage predicted with and without the condition.
    """
    rendered, conditioned, alone = rendered * here, conditioned * here, alone * here
    overlap = None
    if change is not None and _share(change[0], rendered) > _INFORMATIVE:
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


@dataclass(frozen=True)
class Assessment:
    """Verdict on a fit, with its reason."""

    verdict: Verdict
    reason: str
    """Reason as one sentence."""
    remedy: str
    """Remedy as one sentence; empty if none is needed."""
    probability: float
    """Probability that the mask is wrong (Dice below 0.9), calibrated on frames with ground truth [1]."""
    evidence: Evidence
    nothing_there: bool = False
    """Whether an arm is missing from the image or not detected, or the given mask is unusable."""

    @property
    def negligible_risk(self) -> bool:
        """Whether the probability of failure is so small that standard deviations need not account for it."""
        return self.verdict is Verdict.GOOD and self.probability < _UNCERTAIN

    def of(self, known: Uncertainty) -> Uncertainty:
        """Uncertainty that accounts for a wrong fit.

        The uncertainty of a certain fit is unchanged; that of a failed fit becomes the prior.
        """
        if self.negligible_risk:
            return known
        return known.doubted(1.0 if self.verdict is Verdict.FAILED else self.probability)


_UNCERTAIN = 0.1
"""Minimum probability of failure at which standard deviations account for a wrong fit [1]."""


def assess(found: Evidence) -> Assessment:
    """Verdict on the fit of a frame."""
    what = "The given mask" if found.masked else "The image"
    # The overlap with given masks is the Dice itself, so no margin is needed.
    doubtful_from = _UNCERTAIN if found.masked else POSSIBLE
    return _assessed(found, doubtful_from, f"{what} contradicts", f"{what} supports", "fit")


def assess_calibration(frames: Sequence[Evidence]) -> Assessment:
    """Verdict on a calibration, from the median evidence of its frames with measured joints.

    The threshold for doubt is lower than for a frame, since all frames depend on the calibration, and masks can be
    correct with a wrong calibration.
    """
    median = median_evidence(frames)
    what = "given masks" if median.masked else "images"
    found = _assessed(median, _UNCERTAIN, f"The {what} contradict", f"The {what} support", "calibration")
    if found.verdict is Verdict.GOOD or found.nothing_there:
        return found
    return replace(found, remedy=_CALIBRATION_REMEDY)


def _assessed(found: Evidence, doubtful_from: float, contradicts: str, supports: str, subject: str) -> Assessment:
    """Verdict on a fit or a calibration.

    Args:
        doubtful_from: minimum probability of failure for a doubtful verdict [1].
        contradicts, supports: subject and verb of the reason's sentence.
    """
    probability = 1.0 / (1.0 + math.exp(-log_odds_of_failure(found.loss, found, found.masked)))
    for applies, reason, remedy in _NOTHING_THERE:
        if applies(found):
            return Assessment(Verdict.FAILED, reason, remedy, max(probability, LIKELY), found, True)
    if probability >= LIKELY:
        reason = f"{contradicts} the {subject}: " + _weakest(found)
        return Assessment(Verdict.FAILED, reason, _REMEDY_FAILED, probability, found)
    if arm_is_elsewhere(found):
        reason = "An arm was fitted out of view, but an arm is detected elsewhere in the image."
    elif probability >= doubtful_from:
        reason = f"{supports} the {subject} only partly: " + _weakest(found)
    elif found.parts_predicted < _PART_UNSEEN:
        reason = "Only the shaft of an arm is predicted at its fitted pose, not its wrist or jaws."
    else:
        return Assessment(Verdict.GOOD, f"{supports} the {subject}.", "", probability, found)
    return Assessment(Verdict.DOUBTFUL, reason, _REMEDY, max(probability, POSSIBLE), found)


def arm_is_elsewhere(found: Evidence) -> bool:
    """Whether a fitted arm is out of view, but an arm is predicted elsewhere in the image."""
    return found.elsewhere >= _LOOKS_LIKE_ONE


_UNSEEN, _AT_RANDOM = 0.05, 0.5
"""Share of an arm below which it is not predicted, and agreement below which a prediction does not support the fit
[1]."""

_PART_UNSEEN = 0.2
"""Share of the rendered wrists, or jaws, below which they are not predicted [1]."""

_LOOKS_LIKE_ONE = 5e-3
"""Share of the images above which a prediction elsewhere may be the arm that is out of view [1]."""

_MOST, _MORE = 0.5, 2.0
"""Area of the arms fitted to a given mask, as a share of the images and as a multiple of their area at the start, above
which the mask does not show arms [1]."""

_NOTHING_THERE: tuple[tuple[Callable[[Evidence], bool], str, str], ...] = (
    (
        # A given mask may be far from the start.
        lambda found: max(found.start_area, found.area if found.masked else 0.0) < OUT_OF_VIEW,
        "No arm is in view: at the measured joints, the arms are outside the image or behind the camera.",
        "Check T_camera_world, T_world_base and the units of the joints, or leave the frame out.",
    ),
    (
        lambda found: found.masked and found.area > max(_MOST, _MORE * found.start_area),
        "The given mask covers most of the image, but the arms at the measured joints do not.",
        "Check that the mask is white on the arms and black elsewhere, not inverted, and has no transparency.",
    ),
    (
        lambda found: found.masked and found.predicted < _UNSEEN and found.agreement < _AT_RANDOM,
        "The given mask is empty at the expected position of the arms.",
        "Check that it belongs to this frame and is white on the arms and black elsewhere, or leave the frame out.",
    ),
    (
        lambda found: (
            found.predicted < _UNSEEN
            and found.agreement < _AT_RANDOM
            and (found.changed is None or found.changed < _UNSEEN)
        ),
        "No arm is detected at the expected position of the arms.",
        "Check that the image shows the arms (not black or occluded) and matches these kinematics.",
    ),
    (
        lambda found: found.still_in_view < MIN_AREA_RATIO,
        "An arm that was in view initially has left the image.",
        "Check that the image, or the fitted mask, shows all arms; place the arm roughly in the viewer and run again, "
        "or check T_camera_world and T_world_base.",
    ),
    (
        lambda found: found.changed is not None and found.changed < _UNSEEN,
        "The image equals the empty background at the expected position of the arms.",
        "Check that the image shows the arms and matches these kinematics, or leave the frame out.",
    ),
)

_REMEDY = (
    "Inspect the overlay. Run the optimizer if it has not run, place the arm in the viewer, or fit the frame with its "
    "neighbours (sequence mode; Solve in the viewer) if not done yet."
)
_REMEDY_FAILED = (
    "Run the optimizer. If it has run, place the arm roughly in the viewer and run again, check the calibration, or "
    "add an image of the empty scene to the sequence file (key background)."
)

_CALIBRATION_REMEDY = (
    "Check that robot, camera and joints match the images, start from a closer pose, or give masks (--observe masks)."
)


def _weakest(found: Evidence) -> str:
    """Description of the strongest evidence against a fit."""
    if found.masked:
        return "the rendering and the given mask differ."
    against = {
        "the network predicts the arms elsewhere.": found.agreement,
        "the network's prediction without the fit as prior differs from the fit.": found.unconditioned,
    }
    if found.overlap_with_change is not None:
        against["the difference from the empty background lies elsewhere."] = found.overlap_with_change
    return min(against, key=lambda reason: against[reason])


_TISSUE = 0.75, 0.55, 0.45
"""Uniform background of the rendering for the domain check, RGB."""

_NEAR = 40
"""Distance from the measured arms within which predictions are attributed to them [px of the working image]."""

RECOGNIZED, _ELSEWHERE = 0.95, 0.05
"""Minimum overlap for a rendering of a robot in the training domain, and share of an image above which false
predictions are harmful [1]."""

UNKNOWN_ROBOT_REMEDY = (
    "Give masks (--observe masks, or both), or train a network for this recording (`carts train`, --weights)."
)


def overlap_below_usual(overlap: float) -> str:
    """Description of an overlap below `RECOGNIZED`, rounded down."""
    return f"an overlap of only {math.floor(1000 * overlap) / 1000:.3f} ({RECOGNIZED} or more is usual)"


@dataclass(frozen=True)
class DomainCheck:
    """Check on one frame whether arms and images of a recording are in the network's domain."""

    recognized: float | None
    """Overlap (soft Dice) of a rendering of the arms over a uniform background with the network's unconditioned
    prediction from it [1]; None if no arm is in view."""
    elsewhere: float
    """Share of the image that is predicted as arms, far from the measured arms [1]."""

    def warnings(self, where: str, remedy: str = UNKNOWN_ROBOT_REMEDY, *, background: bool = False) -> list[str]:
        """Warnings before an optimization; empty if the network suits the recording.

        Args:
            remedy: remedy for a network that does not suit arms or images.
            background: whether the empty background is known, so that false detections in it are harmless.
        """
        found = []
        if self.recognized is None:
            place = "Check T_camera_world, T_world_base and the units of the joints."
            found.append(f"{where}: no arm is in view at the measured joints. {place}")
        elif self.recognized < RECOGNIZED:
            found.append(
                f"{where}: the network's prediction on a rendering of these arms has "
                f"{overlap_below_usual(self.recognized)}, so this robot or distance may be outside its training data. "
                f"{remedy}"
            )
        if self.elsewhere > _ELSEWHERE and not background:
            found.append(
                f"{where}: the network predicts arms in {100 * self.elsewhere:.0f} % of the image, far from the "
                f"measured arms, and no empty background is given. {remedy}"
            )
        return found


@torch.no_grad()
def check_domain(
    scene: Scene, frame: Frame, networks: FeatureExtractor | SurfacePredictor, settings: SurfaceSolver | None = None
) -> DomainCheck:
    """Check whether a network suits a frame; runs two predictions.

    Raises:
        SettingsError: an image is missing, or its size differs from that of its camera.
    """
    settings = settings or SurfaceSolver()
    predictor = predictor_of(networks).for_frame(frame, [camera.name for camera in scene.cameras])
    images = FrameImages.of(scene, frame.images, {}, settings, predictor)
    rendered = images.renderer(scene.state(frame.measured, predictor.device, frame.mounts))
    nothing = images.images.new_zeros(len(images.images), SURFACE_CHANNELS, *images.images.shape[-2:])
    whole = Window(0, 0, *images.size)

    def covered(pictures: Tensor) -> Tensor:
        return predictor.predict(pictures, nothing, whole)[:, COVERAGE].sum(1, keepdim=True).clamp(0.0, 1.0)

    arms = rendered.silhouette[:, None]
    tissue = torch.tensor(_TISSUE, device=arms.device)[:, None, None]
    overlap = None
    if bool(arms.any()):
        seen = covered(rendered.image * arms + tissue * (1.0 - arms))
        overlap = float(2.0 * torch.minimum(seen, arms).sum() / (seen.sum() + arms.sum()))
    far = 1.0 - attention((arms > 0).to(arms), round(_NEAR * images.scale))
    return DomainCheck(overlap, float((covered(images.images) * far).mean()))


_MANY, _MAX_FAILED_FRACTION = 0.1, 0.5
"""Share of unreliable frames above which a sequence is doubtful, and share of failed frames above which it has failed
[1]."""

_LEVEL = 0.05
"""Family-wise significance level of the tests for deteriorated measures [1]."""

_SCATTER, _SCATTER_FREEDOM = 0.01, 4
"""Prior standard deviation of the change of a measure between frames, and degrees of freedom of this prior [1]."""

_BETTER_HIGHER = ("agreement", "unconditioned", "overlap_with_change")
_BETTER_LOWER = ("residual", "loss")


@dataclass(frozen=True)
class SequenceAssessment:
    """Verdict on frames that were corrected jointly."""

    verdict: Verdict
    reason: str
    """Reason as one sentence."""
    remedy: str
    """Remedy as one sentence; empty if none is needed."""
    probability: float
    """Probability that the mask is wrong, averaged over the frames [1]."""
    counts: Mapping[str, int]
    """Verdict -> number of frames."""


def assess_sequence(frames: Sequence[Assessment]) -> SequenceAssessment:
    """Verdict on a sequence of at least one frame; frames without arms are counted, but not judged."""
    named = {verdict.value: sum(frame.verdict is verdict for frame in frames) for verdict in Verdict}
    # Frames without an arm say nothing about the others, unless no frame shows an arm.
    frames = [frame for frame in frames if not frame.evidence.without_arms] or frames
    counts = Counter(frame.verdict for frame in frames)
    probability = float(np.mean([frame.probability for frame in frames]))
    against = Counter((frame.reason, frame.remedy) for frame in frames if frame.verdict is not Verdict.GOOD)
    share = len(frames) - counts[Verdict.GOOD]
    if counts[Verdict.FAILED] >= _MAX_FAILED_FRACTION * len(frames):
        verdict = Verdict.FAILED
    elif share > _MANY * len(frames):
        verdict = Verdict.DOUBTFUL
    else:
        return SequenceAssessment(Verdict.GOOD, "The images support the fit.", "", probability, named)
    (reason, remedy), _ = against.most_common(1)[0]
    summary = f"{share} of {len(frames)} frames are unreliable. Most frequent reason: {reason}"
    return SequenceAssessment(verdict, summary, remedy, probability, named)


def without_knowledge(found: Assessment, known: Sequence[DomainCheck]) -> Assessment:
    """Verdict on a calibration; a doubtful calibration counts as failed if the robot is outside the network's
    domain."""
    recognized = [one.recognized for one in known if one.recognized is not None]
    if found.verdict is not Verdict.DOUBTFUL or not recognized or float(np.median(recognized)) >= RECOGNIZED:
        return found
    reason = (
        f"{found.reason.rstrip('.')}, and the network's prediction on a rendering of these arms has "
        f"{overlap_below_usual(float(np.median(recognized)))}."
    )
    return replace(found, verdict=Verdict.FAILED, reason=reason, remedy=UNKNOWN_ROBOT_REMEDY)


def median_evidence(frames: Sequence[Evidence]) -> Evidence:
    """Median of each measure over frames; None for a measure that a frame lacks."""
    values = {}
    for field in fields(Evidence):
        known = [value for frame in frames if (value := getattr(frame, field.name)) is not None]
        values[field.name] = float(np.median(known)) if len(known) == len(frames) else None
    return Evidence(**values | {"masked": all(frame.masked for frame in frames)})


def worse_in(before: Sequence[Evidence], after: Sequence[Evidence]) -> list[str]:
    """Names of the measures in which frames fit significantly worse than before.

    One-sided moderated t-tests (Smyth, Linear models and empirical Bayes methods for assessing differential expression,
    2004) with Holm's correction for several tests (A simple sequentially rejective multiple test procedure, 1979).

    Args:
        before, after: evidence of the same frames, in the same order.
    """
    chances = {}
    for names, sign in ((_BETTER_HIGHER, -1.0), (_BETTER_LOWER, 1.0)):
        for name in names:
            pairs = [(getattr(a, name), getattr(b, name)) for a, b in zip(before, after, strict=True)]
            if not any(None in pair for pair in pairs):
                chances[name] = _chance(sign * np.array([new - old for old, new in pairs]))
    found: list[str] = []
    for name, chance in sorted(chances.items(), key=lambda item: item[1]):
        if chance * (len(chances) - len(found)) > _LEVEL:
            break
        found.append(name)
    return found


def _chance(rises: Float[np.ndarray, " frames"]) -> float:
    """p-value of the mean increase under the null hypothesis of no increase [1]."""
    freedom = len(rises) - 1 + _SCATTER_FREEDOM
    squares = ((rises - rises.mean()) ** 2).sum() + _SCATTER_FREEDOM * _SCATTER**2
    return float(stdtr(freedom, -rises.mean() / np.sqrt(squares / freedom / len(rises))))
