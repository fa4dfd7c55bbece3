"""Settings for training networks, including the paper's baselines."""

import json
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from ..errors import SettingsError
from ..files.reading import parse_json
from ..resources import shipped_robot
from .ranges import Count, NotNegative, Positive, Range, Ranged, Share


@dataclass(frozen=True)
class ObjectiveWeights(Ranged):
    """Weights of the terms of the training loss; zero omits a term."""

    cross_entropy: NotNegative = 1.0
    """Binary cross-entropy of the instrument's probability, as in the paper."""
    dice: NotNegative = 0.5
    """One minus soft Dice per image, so that small instruments have the same weight as large instruments."""
    consistency: NotNegative = 1.0
    """Cosine similarity of features of an observed and a hybrid image, with the target 1 for equal classes, at most 0
    for background and instrument, and at most 0.6 for shaft and head."""


@dataclass(frozen=True)
class SurfaceWeights(Ranged):
    """Weights of the terms of the surface network's loss; zero omits a term."""

    everywhere: NotNegative = 1.0
    """Cross-entropy of coverage over all pixels."""
    near: NotNegative = 1.0
    """Cross-entropy of coverage near instruments, where the optimizer compares maps."""
    dice: NotNegative = 0.5
    """One minus soft Dice per image and part, so that small parts have the same weight as large parts."""
    normals: NotNegative = 1.0
    """Smooth L1 of normals near instruments."""


_MAX_LEVELS, _MAX_CHANNELS, _MAX_CONVOLUTIONS = 8, 1024, 16


@dataclass(frozen=True)
class Architecture:
    """Architecture of a network, stored in the weights file."""

    widths: tuple[int, ...] = (12, 24, 48, 64, 96)
    """Channels per level, from full resolution down; each level halves the resolution."""
    encoder_convolutions: tuple[int, ...] = (1, 2, 2, 2, 2)
    """3x3 convolutions per level of the encoder. Full resolution is the most expensive level and has one
    convolution."""
    decoder_convolutions: tuple[int, ...] = (1, 1, 1, 1)
    """3x3 convolutions per level of the decoder, from full resolution down."""
    local_mean: bool = True
    """Subtract the local instead of the global image mean, which reduces the effect of smooth haze."""
    local_contrast: float = 0.0
    """Weight of local versus global contrast normalization, from 0 (global) to 1 (local); requires `local_mean`. Local
    normalization reduces the effect of local loss of contrast."""

    def __post_init__(self) -> None:
        levels = len(self.widths)
        if not 2 <= levels <= _MAX_LEVELS or any(not 1 <= width <= _MAX_CHANNELS for width in self.widths):
            raise SettingsError(
                f"widths are {self.widths}; give 2 to {_MAX_LEVELS} channel counts of 1 to {_MAX_CHANNELS}."
            )
        for name, count in (("encoder_convolutions", levels), ("decoder_convolutions", levels - 1)):
            values = getattr(self, name)
            if len(values) != count or any(not 1 <= n <= _MAX_CONVOLUTIONS for n in values):
                raise SettingsError(f"{name} are {values}; give {count} counts of 1 to {_MAX_CONVOLUTIONS}.")
        if not 0 <= self.local_contrast <= float(self.local_mean):
            raise SettingsError(
                f"local_contrast is {self.local_contrast} and local_mean is {self.local_mean}; give a local_contrast "
                "of 0 to 1, or 0 without local_mean."
            )

    @property
    def stride(self) -> int:
        """Width and height of an input must be multiples of this [px]."""
        return 2 ** (len(self.widths) - 1)

    def to_json(self) -> str:
        """Encode as one line of JSON; the inverse of `from_json`."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> "Architecture":
        """Decode the result of `to_json`.

        Raises:
            ValueError, TypeError, KeyError, AttributeError: the text is not an architecture.
            SettingsError: the architecture is invalid.
        """
        values = parse_json(text)
        local_mean, local_contrast = bool(values.pop("local_mean")), float(values.pop("local_contrast", 0.0))
        return Architecture(
            **{name: tuple(int(n) for n in counts) for name, counts in values.items()},
            local_mean=local_mean,
            local_contrast=local_contrast,
        )


@dataclass(frozen=True)
class SurfaceArchitecture:
    """Architecture of the surface network, stored in the weights file: widths of the decoder and conditioning of the
    pretrained encoder.

    Multiples of 16 are fastest in ONNX Runtime.
    """

    decoder: tuple[int, ...] = (32, 32, 48, 64)
    """Channels of the decoder at strides 2, 4, 8 and 16."""
    convolutions: tuple[int, ...] = (1, 1, 1, 1)
    """3x3 convolutions of the decoder at strides 2, 4, 8 and 16."""
    conditioning: tuple[int, ...] = (24, 48)
    """Channels of the prior surface map at strides 4 and 8."""

    stride: ClassVar[int] = 16
    """Width and height of an input must be multiples of this [px]."""

    def __post_init__(self) -> None:
        widths = (*self.decoder, *self.conditioning)
        if (len(self.decoder), len(self.convolutions), len(self.conditioning)) != (4, 4, 2) or any(
            not 1 <= width <= _MAX_CHANNELS for width in widths
        ):
            raise SettingsError(
                f"decoder is {self.decoder} and conditioning {self.conditioning}; give four and two channel counts "
                f"of 1 to {_MAX_CHANNELS}."
            )
        if any(not 1 <= count <= _MAX_CONVOLUTIONS for count in self.convolutions):
            raise SettingsError(f"convolutions are {self.convolutions}; give four counts of 1 to {_MAX_CONVOLUTIONS}.")

    def to_json(self) -> str:
        """Encode as one line of JSON; the inverse of `from_json`."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> "SurfaceArchitecture":
        """Decode the result of `to_json`. Errors as in `Architecture.from_json`."""
        values = parse_json(text)
        return SurfaceArchitecture(**{name: tuple(int(n) for n in counts) for name, counts in values.items()})


Interval = Annotated[tuple[float, float], Range(0)]
"""Lower and upper bound."""

DARKEST_BRIGHTNESS = 0.65
"""Minimum brightness factor of training images, since low light is an evaluation domain."""


@dataclass(frozen=True)
class AppearanceRanges(Ranged):
    """Ranges of the random image appearance of observed training images.

    Smoke, blood and low light are deliberately excluded, since robustness to these conditions is evaluated instead of
    trained: nothing red is drawn over an instrument (unless `ImageSettings.blood` is positive), no part of the image is
    hidden, and `brightness` has a lower bound.
    """

    brightness: Interval = (0.65, 1.35)
    """Factor for the whole image [1]; at least `DARKEST_BRIGHTNESS`."""
    contrast: Interval = (0.6, 1.3)
    """Factor for the difference from the mean of the image [1]."""
    gamma: Interval = (0.8, 1.25)
    """Exponent of the tone curve [1]."""
    white_balance: Interval = (0.82, 1.2)
    """Factor per colour channel [1]."""
    blur: Interval = (0.0, 1.1)
    """Standard deviation of the lens blur [px at the working size]."""
    noise: Interval = (0.0, 0.03)
    """Standard deviation of the sensor noise [1]."""
    jpeg_quality: Interval = (45.0, 98.0)
    """JPEG quality; 100 is best."""
    vignette: Interval = (0.0, 0.45)
    """Darkening in the image corners [1]."""
    unevenness: Share = 0.4
    """Maximum standard deviation of the logarithm of the illumination over the image [1]; the mean illumination is
    unchanged."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in vars(self).items():
            if name != "unevenness" and not value[0] <= value[1]:
                raise SettingsError(f"{name} is {value}; give two values with 0 <= lower <= upper.")
        if self.brightness[0] < DARKEST_BRIGHTNESS:
            raise SettingsError(
                f"brightness starts at {self.brightness[0]}, below {DARKEST_BRIGHTNESS}. Low light is an evaluation "
                "domain and must not be trained on; increase the lower value."
            )
        if self.gamma[0] == 0 or self.jpeg_quality[1] > 100:
            raise SettingsError("gamma must be positive and jpeg_quality at most 100; correct the range.")


MAX_SIDE = 4096
"""Maximum width and height of images for which a network is trained [px]."""
Side = Annotated[int, Range(16, MAX_SIDE, unit="px")]
"""Width or height of an image."""


@dataclass(frozen=True)
class ImageSettings(Ranged):
    """Settings of training images."""

    width: Side = 192
    """Width of a training image [px]."""
    height: Side = 160
    """Height of a training image [px]."""
    field_width: Side = 320
    """Width of the camera image from which a training image is cropped [px]; focal lengths refer to it."""
    two_arms: Share = 0.4
    """Share of pairs with two arms."""
    same_kinematics: Share = 0.5
    """Share of pairs whose hybrid image has exactly the kinematics of the observed image."""
    same_background: Share = 0.7
    """Share of pairs whose mean background is the background of the observed image."""
    occluded: Share = 0.4
    """Share of observed images with occluded arms; the occluded surface remains the label."""
    blood: Share = 0.0
    """Share of observed images with blood on background and arms."""
    crossing: Share = 0.5
    """Share of pairs of arms that cross in the image."""
    chains: Share = 0.0
    """Share of scenes with a random serial robot instead of `robots`, 0.3 to 2 m from the camera."""
    enlarged: Share = 0.0
    """Share of images at up to twice the working size, as in the final observation of a frame."""
    things: Share = 0.35
    """Share of observed images with objects (rods, plates, cables) behind the arms."""
    absent: Share = 0.1
    """Share of observed images in which one or all arms of the prior are absent."""
    photographs: Path | None = None
    """Folder of photographs; `from_photographs` sets the share of backgrounds cropped from them."""
    from_photographs: Share = 0.2
    """Share of backgrounds cropped from photographs, if `photographs` is given."""
    recording: Path | None = None
    """Sequence file; arms are placed near its recorded poses instead of 5 to 25 cm from the camera."""
    coverage: tuple[float, float] = (0.004, 0.5)
    """Allowed share of the image that shows arms."""
    appearance: AppearanceRanges = field(default_factory=AppearanceRanges)
    """Ranges of the random image appearance."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.chains and self.recording is not None:
            raise SettingsError(
                f"chains is {self.chains}, but random robots have no poses in the recording {self.recording}. "
                "Leave out `chains`."
            )
        if self.width % 16 or self.height % 16:
            raise SettingsError(
                f"training images have {self.width}x{self.height} px; both lengths must be positive multiples of 16."
            )
        if self.field_width < self.width:
            raise SettingsError(f"field_width is {self.field_width}; give at least the width, {self.width}.")
        if not 0 <= self.coverage[0] < self.coverage[1] <= 1:
            raise SettingsError(f"coverage is {self.coverage}; give two fractions, the lower one first.")


NetworkName = Literal["feature", "surface"]
"""Network to train."""


@dataclass(frozen=True)
class TrainingConfig(Ranged):
    """Settings of a training run."""

    network: NetworkName = "feature"
    """Network to train: `feature` for losses of image features, `surface` for `SurfaceSolver`."""
    robots: tuple[Path, ...] = field(default_factory=lambda: (shipped_robot(),))
    """URDF files of the robots in the training images, or `builtin:NAME`."""
    start: Path | None = None
    """Weights file to start from, for fine-tuning; by default random weights. The architecture of these weights is
    used."""
    steps: Count = 4000
    """Optimizer steps."""
    minutes: Annotated[float | None, Range(0, unit="min", above=True)] = None
    """Processor time for training, per thread of the training process [min]; a run that would take longer has fewer
    steps. Machine load does not affect the number of steps."""
    batch_size: Count = 8
    """Samples per step: a pair of an observed and a hybrid image, or one observed image."""
    reuse: Count = 2
    """Number of uses of each sample; repeats are mirrored at random. Generating a sample costs about as much as a
    training step."""
    cache: Path | None = None
    """Folder of training images of the surface network; missing images are generated before the first step. By default,
    images are generated during training."""
    cached: Count = 60_000
    """Number of images in `cache`, rounded up to a multiple of 250."""
    crop: tuple[int, int] | None = None
    """Width and height of random crops of the images in `cache` [px]; by default, images are not cropped."""
    learning_rate: Positive = 3e-3
    """Peak learning rate of AdamW; it rises for `warmup` steps and then falls along a cosine to a hundredth."""
    encoder_rate: Share = 0.3
    """Learning rate of the surface network's pretrained encoder, relative to `learning_rate` [1]."""
    frozen: Annotated[int, Range(0, 5)] = 0
    """Number of stages of this encoder, from the image, whose weights are not trained, with the stem; 0 trains all.
    With two, a step takes about four fifths of the time."""
    weight_decay: NotNegative = 1e-4
    """Weight decay of AdamW."""
    warmup: Annotated[int, Range(0)] = 100
    """Steps until the learning rate is at its peak."""
    average: Annotated[float, Range(0, 1, below=True)] = 0.995
    """Decay per step of the running average of the weights; the average is saved."""
    validation_every: Count = 250
    """Steps between validations."""
    patience: Annotated[int | None, Range(1)] = None
    """Early stopping: number of validations without improvement after which training stops; the weights of these
    validations are discarded."""
    validation_samples: Count = 32
    """Samples of the fixed validation set."""
    checkpoint_every: Count = 100
    """Steps between checkpoints."""
    workers: Annotated[int, Range(0)] = 2
    """Number of processes that generate images."""
    threads: Count = 2
    """Threads of the training process itself."""
    seed: Annotated[int, Range(0)] = 0
    """Random seed."""
    device: str = "cpu"
    """Device of the training."""
    images: ImageSettings = field(default_factory=ImageSettings)
    """Settings of training images."""
    objective: ObjectiveWeights = field(default_factory=ObjectiveWeights)
    """Weights of the feature network's loss terms."""
    surface_objective: SurfaceWeights = field(default_factory=SurfaceWeights)
    """Weights of the surface network's loss terms."""
    architecture: Architecture = field(default_factory=Architecture)
    """Architecture of the feature network."""
    surface_architecture: SurfaceArchitecture = field(default_factory=SurfaceArchitecture)
    """Architecture of the surface network."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.robots:
            raise SettingsError("no robot was given; give at least one URDF file.")
        if self.cache is not None and self.network != "surface":
            raise SettingsError("an image cache is only supported for the surface network; leave out `cache`.")
        stride = (self.architecture if self.network == "feature" else self.surface_architecture).stride
        if self.crop is not None and self.cache is None:
            raise SettingsError("crop requires cached images; give `cache`, or leave out `crop`.")
        if self.crop is not None and (
            self.crop[0] not in range(stride, self.images.width + 1, stride)
            or self.crop[1] not in range(stride, self.images.height + 1, stride)
        ):
            raise SettingsError(
                f"crop is {self.crop}; give multiples of {stride} up to {self.images.width} and {self.images.height}."
            )
        if self.images.width % stride or self.images.height % stride:
            raise SettingsError(
                f"training images of {self.images.width}x{self.images.height} px do not fit the network; give "
                f"multiples of {stride}."
            )


ADAPTATION_SETTINGS = TrainingConfig(
    network="surface",
    steps=10**6,
    learning_rate=6e-4,
    warmup=15,
    average=0.97,
    validation_every=40,
    validation_samples=48,
    patience=5,
    images=ImageSettings(from_photographs=0.5),
)
"""Default settings of an adaptation to a recording. `steps` is no limit; without `minutes`, the limit is lower."""


BaselineName = Literal["unet", "hrnet", "swin", "efficientnet", "colleoni"]
"""Baseline network. Colleoni's network also uses a rendering of the kinematics, the others only the image."""
Augmentation = Literal["none", "smoke", "autoaugment", "elastic", "projective"]
"""Augmentation of training images in addition to mirroring: simulated smoke (as in the paper), or an augmentation
compared by SegSTRONG-C."""

_ENCODERS: dict[BaselineName, str] = {
    "hrnet": "hrnet_w18_small",
    "swin": "swin_tiny_patch4_window7_224",
    "efficientnet": "tf_efficientnet_lite0",
    "colleoni": "resnet10t",
}
_ENCODER = re.compile(r"[a-z0-9_]{1,80}")
_LARGEST = 1024


@dataclass(frozen=True)
class BaselineNetwork:
    """Architecture of a baseline network, stored in the weights file."""

    name: BaselineName = "hrnet"
    """Baseline network."""
    encoder: str = ""
    """Encoder name in timm; by default a small encoder of the architecture: `hrnet_w18_small`,
    `swin_tiny_patch4_window7_224`, `tf_efficientnet_lite0` or `resnet10t` (two encoders, for Colleoni's). The paper
    uses `hrnet_w48`; the U-Net takes no encoder."""
    width: int | None = None
    """Channels of the first stage of a Swin transformer; by default as in the encoder (96 for tiny)."""
    decoder: tuple[int, ...] = (64, 48, 32, 24, 16)
    """Channels of the decoder's five levels, starting with the coarsest."""
    unet: Architecture = field(default_factory=lambda: Architecture(local_mean=False))
    """Architecture of the U-Net."""
    size: tuple[int, int] = (256, 192)
    """Network input width and height [px], multiples of 32."""

    def __post_init__(self) -> None:
        if self.encoder and not _ENCODER.fullmatch(self.encoder):
            raise SettingsError(f"encoder is {self.encoder!r}; give the name of a timm model, such as hrnet_w48.")
        if self.width is not None and (self.name != "swin" or not 12 <= self.width <= _LARGEST or self.width % 12):
            raise SettingsError(
                f"width is {self.width}; give a multiple of 12 up to {_LARGEST}; only swin has a width."
            )
        if len(self.decoder) != 5 or any(not 1 <= channels <= _LARGEST for channels in self.decoder):
            raise SettingsError(f"decoder is {self.decoder}; give five channel counts of 1 to {_LARGEST}.")
        if len(self.size) != 2 or any(not 32 <= side <= 4096 or side % 32 for side in self.size):
            raise SettingsError(f"size is {self.size}; give a width and a height, multiples of 32 up to 4096.")

    @property
    def timm_encoder(self) -> str:
        """Encoder name in timm; empty for the U-Net."""
        return self.encoder or _ENCODERS.get(self.name, "")

    @property
    def uses_kinematics(self) -> bool:
        """Whether a rendering of the measured kinematics is an input."""
        return self.name == "colleoni"


@dataclass(frozen=True)
class BaselineTraining(Ranged):
    """Settings of a training run of a baseline."""

    augmentation: Augmentation = "smoke"
    """Augmentation of training images."""
    start: Path | None = None
    """Safetensors file with encoder weights from timm, such as pretrained weights; for a U-Net, a file with a feature
    network. By default random weights."""
    frames: Annotated[int, Range(101)] = 3000
    """Number of synthetic frames, rounded up to a multiple of 250; the last 100 are used for validation."""
    steps: Count = 20_000
    """Optimizer steps."""
    minutes: Annotated[float | None, Range(0, unit="min", above=True)] = None
    """Processor time for training, per thread [min]; a run that would take longer has fewer steps."""
    batch_size: Count = 4
    """Frames per step."""
    learning_rate: Positive = 1e-3
    """Peak learning rate of AdamW; it rises for `warmup` steps and then falls along a cosine to a hundredth."""
    weight_decay: NotNegative = 1e-4
    """Weight decay of AdamW."""
    warmup: Annotated[int, Range(0)] = 50
    """Steps until the learning rate is at its peak."""
    bfloat16: bool | None = None
    """Compute in bfloat16 with float32 weights. By default only on a GPU; on CPUs without bfloat16 instructions it is
    ten times slower."""
    checkpoint_every: Count = 100
    """Steps between checkpoints."""
    threads: Count = 2
    """Number of torch threads."""
    seed: Annotated[int, Range(0)] = 0
    """Random seed, also of the frames."""
    device: str = "cpu"
    """Device of the training."""
