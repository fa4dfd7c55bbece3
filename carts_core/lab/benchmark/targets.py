"""What the default solver is meant to reach, and what these measurements say. Every verdict is computed."""

from .accuracy_targets import accuracy_targets
from .image_alone import image_alone_targets
from .speed_targets import speed_targets
from .statistics import Measurements
from .target import Target
from .verdicts import verdict_targets


def targets(data: Measurements) -> list[Target]:
    """All targets, also those that could not be computed from what is there."""
    return [*speed_targets(data), *accuracy_targets(data), *image_alone_targets(data), *verdict_targets(data)]
