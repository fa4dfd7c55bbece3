"""One run on many frames, as the viewer drives it."""

from carts_core.optimization import FrameEstimate, SequenceAssessment, SequenceOptimizer
from carts_core.project import Provenance
from carts_core.wording import spoken_time


class SequenceRun:
    """One run on many frames: the optimizer, and what a project keeps about it."""

    def __init__(self, optimizer: SequenceOptimizer, provenance: Provenance) -> None:
        self.provenance = provenance
        self.cancelled = False
        self._optimizer = optimizer

    @property
    def done(self) -> int:
        """Frames that were visited."""
        return self._optimizer.progress[0]

    def step(self) -> bool:
        """Visit the next frame; False when there are no more."""
        return self._optimizer.step() is not None

    def cancel(self) -> None:
        """Stop; what was reached stays in `estimates`."""
        self.cancelled = True
        self._optimizer.cancel()

    def estimates(self) -> dict[int, FrameEstimate]:
        """Of every frame that was visited, in the light of all of them."""
        return self._optimizer.estimates

    @property
    def assessment(self) -> SequenceAssessment | None:
        """At the end, how far all frames together can be relied on; None before, and of a run that was stopped."""
        return self._optimizer.assessment

    def base_frame_gain(self) -> float | None:
        """At the end, what free base frames would explain of what is left [1]; None where it is not known."""
        return self._optimizer.base_frame_gain()

    def status(self) -> str:
        """How it goes, for people."""
        done, total = self._optimizer.progress
        if done == 0:
            return "Solving a few frames alone, for a first estimate of the error of all"
        if done == total:
            return f"All {total} frames estimated, revising those that disagree and judging the fit"
        if done < 2 < total:
            return f"Frame {done} of {total}"  # The first takes longer than others.
        return f"Frame {done} of {total}, about {spoken_time(self._optimizer.seconds_left)} left"
