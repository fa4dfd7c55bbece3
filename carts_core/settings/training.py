"""Settings of a training run."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ..errors import SettingsError
from ..resources import shipped_robot
from .loss_weights import ObjectiveWeights, SurfaceWeights
from .network import Architecture
from .training_images import ImageSettings

NetworkName = Literal["feature", "surface"]
"""Which network is trained."""


@dataclass(frozen=True)
class TrainingConfig:
    """Everything that a training run depends on."""

    network: NetworkName = "feature"
    """Which network is trained: `feature` for the paper's loss, `surface` for Gauss-Newton."""
    robots: tuple[Path, ...] = field(default_factory=lambda: (shipped_robot(),))
    """URDF files of the robots whose images are made, or `builtin:NAME`."""
    start: Path | None = None
    """Weights file to start from, for fine-tuning; random weights without it. The network is as large as these,
    unless another architecture is asked for, into which it then grows."""
    steps: int = 4000
    """Optimizer steps."""
    minutes: float | None = None
    """Time for training [min]; a run that would take longer has fewer steps."""
    batch_size: int = 8
    """Samples per step: a pair of an observed and a hybrid image, or one observed image."""
    reuse: int = 2
    """How often a sample is used, mirrored by chance after the first time: making one takes as long as learning it."""
    learning_rate: float = 3e-3
    """Peak learning rate of AdamW; it rises for `warmup` steps and then falls along a cosine to a hundredth."""
    weight_decay: float = 1e-4
    """Weight decay of AdamW."""
    warmup: int = 100
    """Steps until the learning rate is at its peak."""
    average: float = 0.995
    """Decay per step of the running average of the weights, which is what is saved."""
    validation_every: int = 250
    """Steps between validations."""
    validation_minutes: float | None = None
    """Time between validations [min], in place of `validation_every`."""
    patience: int | None = None
    """Validations in a row without a gain after which a run ends, and whose weights are not kept."""
    validation_samples: int = 32
    """Samples of the fixed validation set."""
    checkpoint_every: int = 100
    """Steps between checkpoints."""
    workers: int = 2
    """Processes that make images."""
    threads: int = 2
    """Threads of the training process itself."""
    seed: int = 0
    """Seed of everything random."""
    device: str = "cpu"
    """Where the network is trained."""
    images: ImageSettings = field(default_factory=ImageSettings)
    """What training images look like."""
    objective: ObjectiveWeights = field(default_factory=ObjectiveWeights)
    """Weights of the feature network's loss terms."""
    surface_objective: SurfaceWeights = field(default_factory=SurfaceWeights)
    """Weights of the surface network's loss terms."""
    architecture: Architecture = field(default_factory=Architecture)
    """The network."""

    def __post_init__(self) -> None:
        for name in (
            "steps",
            "batch_size",
            "reuse",
            "validation_every",
            "validation_samples",
            "checkpoint_every",
            "threads",
        ):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} is {getattr(self, name)}; give 1 or more.")
        for name in ("warmup", "workers", "seed"):
            if getattr(self, name) < 0:
                raise SettingsError(f"{name} is {getattr(self, name)}; give 0 or more.")
        if not self.learning_rate > 0 or not self.weight_decay >= 0:
            raise SettingsError(
                f"learning_rate is {self.learning_rate} and weight_decay {self.weight_decay}; give a positive rate and "
                "a decay of 0 or more."
            )
        if self.minutes is not None and not self.minutes > 0:
            raise SettingsError(f"minutes is {self.minutes}; give a positive time, or leave it out.")
        if self.validation_minutes is not None and not self.validation_minutes > 0:
            raise SettingsError(
                f"validation_minutes is {self.validation_minutes}; give a positive time, or leave it out."
            )
        if self.patience is not None and self.patience < 1:
            raise SettingsError(f"patience is {self.patience}; give 1 or more, or leave it out.")
        if not 0 <= self.average < 1:
            raise SettingsError(f"average is {self.average}; give a decay from 0 (no average) to below 1.")
        if not self.robots:
            raise SettingsError("no robot to train on; give at least one URDF file.")
        stride = self.architecture.stride
        if self.images.width % stride or self.images.height % stride:
            raise SettingsError(
                f"training images of {self.images.width}x{self.images.height} px do not fit the network; give "
                f"multiples of {stride}."
            )
