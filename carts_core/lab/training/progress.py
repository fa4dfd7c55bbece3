"""What a training run says while it goes on, and at its end."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TrainingProgress:
    """Where a run stands; one per logged step."""

    step: int
    """Steps done."""
    steps: int
    """Steps in all; an estimate in a run of limited time."""
    loss: float
    """Loss, averaged over the last steps."""
    seconds_per_step: float
    """Wall time per step [s]."""
    validation: dict[str, float] | None
    """The newest validation."""
    first: dict[str, float] | None
    """The first one of the run, wherever that was interrupted since."""


@dataclass(frozen=True)
class TrainingResult:
    """What a finished run leaves behind."""

    weights: Path
    """Weights file, ready for `FeatureExtractor.load`."""
    report: Path
    """The training report."""
    validation: dict[str, float]
    """Figures of the saved weights."""
    first: dict[str, float] | None
    """Figures of the run's first validation; None of a run that had none."""
    seconds: float
    """Wall time spent in training steps, over all resumed parts [s]."""
