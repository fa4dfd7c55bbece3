"""What the images of a frame say of a pose: in every camera alone, and of the frame."""

from dataclasses import dataclass, replace

from carts_core.optimization import Assessment, SolverSettings
from carts_core.project import FitVerdict
from carts_core.project.values import VERDICTS
from carts_viewer.observing import Target
from carts_viewer.running import OptimizerFactory
from carts_viewer.session import Session
from carts_viewer.state import Pose

_OUT_OF_VIEW = 5e-4
"""Share of an image below which no arm is in view of a camera [1]."""
_WORSE_LOSS, _WORSE_FAILURE, _WORSE_DICE = 1.1, 0.02, 0.005
"""What counts as worse: a loss by this factor, a probability or Dice by this much [1]."""


@dataclass(frozen=True)
class Fit:
    """How well a pose fits the images of its frame."""

    verdict: FitVerdict
    loss: float
    """Mean of the cameras that see an arm [1]."""
    dice: float | None = None
    """Overlap with the true mask; None where there is none."""

    def worse_than(self, other: "Fit") -> str | None:
        """By what this fit is worse than another one of the same frame, for people; None where it is not."""
        if other.dice is not None and self.dice is not None:
            # Where the truth is known, nothing else counts.
            return f"Dice {self.dice:.3f}, was {other.dice:.3f}" if self.dice < other.dice - _WORSE_DICE else None
        if VERDICTS.index(self.verdict.verdict) > VERDICTS.index(other.verdict.verdict):
            return f"{self.verdict.verdict}, was {other.verdict.verdict}"
        if self.verdict.failure > other.verdict.failure + _WORSE_FAILURE:
            return f"probably wrong by {self.verdict.failure:.0%}, was {other.verdict.failure:.0%}"
        if self.loss > _WORSE_LOSS * other.loss:
            return f"loss {self.loss:.3g}, was {other.loss:.3g}"
        return None


class FitCheck:
    """Compares poses with images; nothing moves."""

    def __init__(self, session: Session, optimizers: OptimizerFactory) -> None:
        self._session = session
        self._optimizers = optimizers

    def fit(self, index: int, domain: str, pose: Pose, settings: SolverSettings, target: Target) -> Fit:
        """The fit of a pose in all cameras that can be compared with the target.

        Raises:
            CartsError: an image, a mask or the weights are not usable.
        """
        sequence, cameras = self._session.sequence, [camera.name for camera in self._session.scene.cameras]
        found: dict[str, tuple[Assessment, float]] = {}
        for name in target.seen(sequence, index, domain, cameras) or cameras:
            ignore = self._session.ignored(index, [name], target)
            found[name] = self._optimizers.assess(sequence, index, domain, [name], pose, settings, target, ignore)
        # A camera that sees no arm says nothing, unless none sees any.
        seeing = {name: one for name, one in found.items() if one[0].evidence.area >= _OUT_OF_VIEW} or found
        loss = sum(loss for _, loss in seeing.values()) / len(seeing)
        return Fit(of_cameras({name: assessment for name, (assessment, _) in seeing.items()}), loss)


def of_cameras(assessed: dict[str, Assessment]) -> FitVerdict:
    """The verdict on a frame: that of the camera that speaks most against it."""
    worst = max(assessed, key=lambda name: (VERDICTS.index(assessed[name].verdict.value), assessed[name].probability))
    found = assessed[worst]
    verdict = FitVerdict(found.verdict.value, found.reason, found.remedy, found.probability)
    if len(assessed) == 1:
        return verdict
    cameras = tuple((name, one.probability) for name, one in assessed.items())
    reason = found.reason if found.verdict.value == VERDICTS[0] else f"Camera {worst}: {found.reason}"
    return replace(verdict, reason=reason, cameras=cameras)
