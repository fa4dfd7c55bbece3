"""Settings of a baseline: a network of others, how large it is, and how it is trained."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ..errors import SettingsError
from .training import Architecture

BaselineName = Literal["unet", "hrnet", "swin", "colleoni"]
"""Which network: three look at the image alone, Colleoni's at what is rendered of the kinematics, too."""
Augmentation = Literal["none", "smoke", "autoaugment", "elastic", "projective"]
"""What is done to training images besides mirroring them: simulated smoke (the paper), or what SegSTRONG-C compares."""

_ENCODERS: dict[BaselineName, str] = {
    "hrnet": "hrnet_w18_small",
    "swin": "swin_tiny_patch4_window7_224",
    "colleoni": "resnet10t",
}
_ENCODER = re.compile(r"[a-z0-9_]{1,80}")
_LARGEST = 1024


@dataclass(frozen=True)
class BaselineNetwork:
    """What distinguishes one baseline network from another; it travels in the weights file."""

    name: BaselineName = "hrnet"
    """Which network."""
    encoder: str = ""
    """timm's name of the encoder; empty for a small one of the kind, `hrnet_w18_small`, `swin_tiny_patch4_window7_224`
    or `resnet10t` (twice, for Colleoni's). The paper has `hrnet_w48`. The U-Net has none."""
    width: int | None = None
    """Channels of the first stage of a Swin transformer, if not the encoder's own (96 for tiny)."""
    decoder: tuple[int, ...] = (64, 48, 32, 24, 16)
    """Channels of the decoder's five levels, from the coarsest up."""
    unet: Architecture = field(default_factory=lambda: Architecture(local_mean=False))
    """The U-Net."""
    size: tuple[int, int] = (256, 192)
    """Width and height [px] of the images that it gets: multiples of 32."""

    def __post_init__(self) -> None:
        if self.encoder and not _ENCODER.fullmatch(self.encoder):
            raise SettingsError(f"encoder is {self.encoder!r}; give a name of timm's list, such as hrnet_w48.")
        if self.width is not None and (self.name != "swin" or not 12 <= self.width <= _LARGEST or self.width % 12):
            raise SettingsError(f"width is {self.width}; give a multiple of 12 up to {_LARGEST}, and for swin only.")
        if len(self.decoder) != 5 or any(not 1 <= channels <= _LARGEST for channels in self.decoder):
            raise SettingsError(f"decoder is {self.decoder}; give five channel counts of 1 to {_LARGEST}.")
        if len(self.size) != 2 or any(not 32 <= side <= 4096 or side % 32 for side in self.size):
            raise SettingsError(f"size is {self.size}; give a width and a height, multiples of 32 up to 4096.")

    @property
    def timm_encoder(self) -> str:
        """timm's name of the encoder; empty for the U-Net."""
        return self.encoder or _ENCODERS.get(self.name, "")

    @property
    def looks_at_kinematics(self) -> bool:
        """Whether it is given what is rendered of the measured kinematics."""
        return self.name == "colleoni"


@dataclass(frozen=True)
class BaselineTraining:
    """Everything that a training run of a baseline depends on."""

    augmentation: Augmentation = "smoke"
    """What is done to training images."""
    start: Path | None = None
    """Safetensors file with timm's weights of the encoder, such as pretrained ones; for a U-Net one with a feature
    network. Random weights without it."""
    frames: int = 3000
    """Synthetic training frames; the last 100 validate."""
    steps: int = 20_000
    """Optimizer steps."""
    minutes: float | None = None
    """Time for training [min]; a run that would take longer has fewer steps."""
    batch_size: int = 4
    """Frames per step."""
    learning_rate: float = 1e-3
    """Peak learning rate of AdamW; it rises for `warmup` steps and then falls along a cosine to a hundredth."""
    weight_decay: float = 1e-4
    """Weight decay of AdamW."""
    warmup: int = 50
    """Steps until the learning rate is at its peak."""
    bfloat16: bool | None = None
    """Compute in bfloat16; weights stay float32. Without it, on a GPU alone: a processor that has no instructions for
    bfloat16 takes ten times as long with it."""
    checkpoint_every: int = 100
    """Steps between checkpoints."""
    threads: int = 2
    """Threads of torch."""
    seed: int = 0
    """Seed of everything random, the frames included."""
    device: str = "cpu"
    """Where the network is trained."""

    def __post_init__(self) -> None:
        for name, least in (("frames", 101), ("steps", 1), ("batch_size", 1), ("checkpoint_every", 1), ("threads", 1)):
            if getattr(self, name) < least:
                raise SettingsError(f"{name} is {getattr(self, name)}; give {least} or more.")
        for name in ("warmup", "seed"):
            if getattr(self, name) < 0:
                raise SettingsError(f"{name} is {getattr(self, name)}; give 0 or more.")
        if not self.learning_rate > 0 or not self.weight_decay >= 0:
            raise SettingsError(
                f"learning_rate is {self.learning_rate} and weight_decay {self.weight_decay}; give a positive rate and "
                "a decay of 0 or more."
            )
        if self.minutes is not None and not self.minutes > 0:
            raise SettingsError(f"minutes is {self.minutes}; give a positive time, or leave it out.")
