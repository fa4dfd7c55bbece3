"""Whether a sequence or a calibration can be relied on, from what each of its frames says."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float
from scipy.special import stdtr

from .evidence import Evidence
from .familiarity import RECOGNIZED, UNKNOWN_ROBOT_REMEDY, Familiarity, overlap_below_usual
from .verdict import Assessment, Verdict, assess

_MANY, _MOST = 0.1, 0.5
"""Share of frames not to be relied on from which a sequence is doubtful, and share of failed ones from which it has
failed [1]."""

_LEVEL = 0.05
"""Probability that any of the measures is called worse where all differences are chance [1]."""

_SCATTER, _SCATTER_FREEDOM = 0.01, 4
"""Usual deviation of a measure's change from frame to frame, and how many degrees of freedom it counts as [1]: with few
frames their own scatter is hardly known, and with one frame not at all."""

_BETTER_HIGHER = ("agreement", "unconditioned", "overlap_with_change")
_BETTER_LOWER = ("residual", "loss")

_CALIBRATION_REMEDY = (
    "Check that robot, camera and joints are those of the images, start from a pose that is nearer, or give masks "
    "(--observe masks)."
)


@dataclass(frozen=True)
class SequenceAssessment:
    """A verdict on frames that were corrected together."""

    verdict: Verdict
    reason: str
    """One sentence for people."""
    remedy: str
    """What to try, one sentence; empty where nothing has to be."""
    probability: float
    """Mean of the frames' probabilities that their masks are wrong [1]."""
    counts: Mapping[str, int]
    """Verdict -> frames."""


def assess_sequence(frames: Sequence[Assessment]) -> SequenceAssessment:
    """The verdict on a sequence of at least one frame.

    Args:
        frames: the verdicts on its frames.
    """
    counts = Counter(frame.verdict for frame in frames)
    named = {verdict.value: counts[verdict] for verdict in Verdict}
    probability = float(np.mean([frame.probability for frame in frames]))
    against = Counter((frame.reason, frame.remedy) for frame in frames if frame.verdict is not Verdict.GOOD)
    share = len(frames) - counts[Verdict.GOOD]
    if counts[Verdict.FAILED] >= _MOST * len(frames):
        verdict = Verdict.FAILED
    elif share > _MANY * len(frames):
        verdict = Verdict.DOUBTFUL
    else:
        return SequenceAssessment(Verdict.GOOD, "The images support the fit.", "", probability, named)
    (reason, remedy), _ = against.most_common(1)[0]
    summary = f"{share} of {len(frames)} frames are not to be relied on, most of them for this: {reason}"
    return SequenceAssessment(verdict, summary, remedy, probability, named)


def assess_calibration(frames: Sequence[Evidence]) -> Assessment:
    """The verdict on a calibration, from the median evidence of its frames, with joints as measured.

    All frames rely on it, and its masks can be right while it is off, so it is doubtful earlier than a frame.

    Args:
        frames: the evidence of each; at least one.
    """
    found = assess(median_evidence(frames), strict=True)
    if found.verdict is Verdict.GOOD:
        return replace(found, reason="The images support the calibration.")
    reason = found.reason.replace("The image contradicts the fit", "The images contradict the calibration")
    reason = reason.replace("The image supports the fit only", "The images support the calibration only")
    return replace(found, reason=reason, remedy=found.remedy if found.nothing_there else _CALIBRATION_REMEDY)


def without_knowledge(found: Assessment, known: Sequence[Familiarity]) -> Assessment:
    """The verdict on a calibration by a network that may not know the robot: what is doubtful then has failed.

    Args:
        found: the verdict from the images.
        known: how well the network knows the arms, in some of the frames.
    """
    recognized = [one.recognized for one in known if one.recognized is not None]
    if found.verdict is not Verdict.DOUBTFUL or not recognized or float(np.median(recognized)) >= RECOGNIZED:
        return found
    reason = (
        f"{found.reason.rstrip('.')}, and the network recognizes a rendering of these arms with "
        f"{overlap_below_usual(float(np.median(recognized)))}."
    )
    return replace(found, verdict=Verdict.FAILED, reason=reason, remedy=UNKNOWN_ROBOT_REMEDY)


def median_evidence(frames: Sequence[Evidence]) -> Evidence:
    """Median over frames, so that a few broken ones decide nothing; what one of them does not know is left out."""
    values = {}
    for field in fields(Evidence):
        known = [value for frame in frames if (value := getattr(frame, field.name)) is not None]
        values[field.name] = float(np.median(known)) if len(known) == len(frames) else None
    return Evidence(**values | {"masked": all(frame.masked for frame in frames)})


def worse_in(before: Sequence[Evidence], after: Sequence[Evidence]) -> list[str]:
    """Names of the measures that say that frames fit worse than before, beyond chance.

    One-sided moderated t-tests (Smyth, Linear models and empirical Bayes methods for assessing differential expression,
    2004) with Holm's correction for several tests (A simple sequentially rejective multiple test procedure, 1979).

    Args:
        before, after: of the same frames, in the same order.
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
    """Probability of a mean rise that large where there is none [1]."""
    freedom = len(rises) - 1 + _SCATTER_FREEDOM
    squares = ((rises - rises.mean()) ** 2).sum() + _SCATTER_FREEDOM * _SCATTER**2
    return float(stdtr(freedom, -rises.mean() / np.sqrt(squares / freedom / len(rises))))
