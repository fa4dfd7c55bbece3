"""What is measured: every frame, domain, method and start of a benchmark, in the order in which it is done."""

from dataclasses import dataclass, replace

from ..errors import SettingsError
from ..synthesis.config import DOMAINS

SYNTHETIC = "synthetic"
REAL = "real"


@dataclass(frozen=True)
class Run:
    """One method on one frame from one start."""

    source: str
    """`synthetic` or `real`."""
    domain: str
    frame: int
    """Position in the sequence."""
    method: str
    """A name in `methods.METHODS`."""
    error_deg: float | None = None
    """How far every joint is off at the start [deg, mm for prismatic ones], from the true joint positions where they
    are known; None starts at the measured ones."""


@dataclass(frozen=True)
class Scope:
    """How much is measured."""

    frames: int
    """Evaluated frames of each sequence, evenly spread."""
    sequence_frames: int
    """Frames of the synthetic sequence that is made; all of them serve the estimate of the background."""
    samples: int
    """Paths per pixel of the synthetic sequence."""
    paper_iterations: int
    """Steps in the paper's setting. Its schedule does not depend on their number, so one run holds all shorter ones."""
    error_domains: tuple[str, ...]
    """Synthetic domains in which the start is put off on purpose."""
    errors_deg: tuple[float, ...]
    """Sizes of that error for the default solver [deg]."""
    paper_errors_deg: tuple[float, ...]
    """The same for the paper's setting, in the regular domain [deg]."""
    real_errors_deg: tuple[float, ...]
    """The same on real frames, both methods, in the regular domain, from the measured joint positions [deg]."""

    def with_frames(self, frames: int) -> "Scope":
        """The same with another number of evaluated frames.

        Raises:
            SettingsError: it is less than one, or more than the synthetic sequence has.
        """
        if not 1 <= frames <= self.sequence_frames:
            raise SettingsError(
                f"--frames is {frames}; the synthetic sequence has {self.sequence_frames}. Give 1 to "
                f"{self.sequence_frames}."
            )
        return replace(self, frames=frames)


QUICK = Scope(
    frames=3,
    sequence_frames=3,
    samples=4,
    paper_iterations=50,
    error_domains=("regular",),
    errors_deg=(0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
    paper_errors_deg=(2.0,),
    real_errors_deg=(),
)
FULL = Scope(
    frames=12,
    sequence_frames=24,
    samples=8,
    paper_iterations=100,
    error_domains=DOMAINS,
    errors_deg=QUICK.errors_deg,
    paper_errors_deg=QUICK.errors_deg,
    real_errors_deg=(1.0, 2.0, 3.0),
)


def plan(scope: Scope, frames: dict[str, list[int]], methods: tuple[str, ...]) -> list[Run]:
    """All runs, frame after frame, so that a benchmark that was stopped has measured some of everything.

    Args:
        scope: how much is measured.
        frames: source -> positions of the evaluated frames.
        methods: rows of the main table.
    """
    runs: list[Run] = []
    for turn in range(max(map(len, frames.values()))):
        for source, positions in frames.items():
            if turn < len(positions):
                runs += _runs_of_frame(scope, source, positions[turn], methods)
    return runs


def _runs_of_frame(scope: Scope, source: str, frame: int, methods: tuple[str, ...]) -> list[Run]:
    runs = [Run(source, domain, frame, method) for domain in DOMAINS for method in methods]
    ours, papers = scope.errors_deg, scope.paper_errors_deg
    domains = scope.error_domains
    if source == REAL:
        ours = papers = scope.real_errors_deg
        domains = ("regular",)
    runs += [Run(source, domain, frame, "ours", error) for error in ours for domain in domains]
    runs += [Run(source, "regular", frame, "paper", error) for error in papers]
    return runs
