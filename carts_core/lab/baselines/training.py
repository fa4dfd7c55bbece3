"""Training of a baseline on shared synthetic frames.

The loss is that of the paper. Augmentations are those of CaRTS and SegSTRONG-C.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn import functional

from ...errors import SettingsError, WeightsError
from ...files import OutputPath, holds_file, locked_folder, output_path, write_bytes
from ...files.reading import WEIGHTS, check_regular
from ...model.parts import COVERAGE, NORMALS
from ...model.robot import Robot
from ...networks.network import channels_last
from ...networks.weights import tensor_bytes
from ...resources import shipped_robot
from ...settings import ImageSettings
from ...settings.training import Augmentation, BaselineNetwork, BaselineTraining
from ..randomization import SURFACE_UNIT, SurfaceGenerator
from ..training.digests import start_digest
from ..training.loop import TrainingLoop
from ..training.tasks import dice
from .networks import Baseline, save_baseline, segmentation_models, start_from

Change = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Augmentation of an image [3, h, w], uint8, and its maps [7, h, w]: the mask and the given surface map."""

SMOKE_SHARE, SMOKE_STRENGTH = 0.2, 0.3
"""Share of images with smoke, and maximum opacity of the smoke: `p` and `smoke_aug` in the released configuration of
the paper."""
_SMOKE_WHITE = 255.0
_NORMALS = slice(1 + NORMALS.start, 1 + NORMALS.stop)
"""Channels of normals in the maps of `Change`. Their directions are those before a shear or warp."""
_GEOMETRIC = {"ShearX", "ShearY", "TranslateX", "TranslateY", "Rotate"}


def augmentation(name: Augmentation, rng: np.random.Generator) -> Change:
    """Create an augmentation by name; augmentations of torchvision use torch's global random numbers."""
    match name:
        case "none":
            return lambda image, maps: (image, maps)
        case "smoke":
            return lambda image, maps: (smoked(image, rng), maps)
        case "autoaugment":
            return _AutoAugment()
        case "elastic" | "projective":
            return _warped(name)


def smoked(image: UInt8[Tensor, "3 h w"], rng: np.random.Generator) -> UInt8[Tensor, "3 h w"]:
    """Add a layer of diamond-square smoke to the image, with the probability `SMOKE_SHARE`."""
    if rng.random() >= SMOKE_SHARE:
        return image
    height, width = image.shape[1:]
    side = 2 ** int(np.ceil(np.log2(max(height, width)))) + 1
    opacity = SMOKE_STRENGTH * torch.from_numpy(diamond_square(side, rng)[:height, :width])
    return ((1 - opacity) * image + opacity * _SMOKE_WHITE).round().to(torch.uint8)


def diamond_square(side: int, rng: np.random.Generator, roughness: float = 0.6) -> Float[np.ndarray, "side side"]:
    """Plasma fractal in [0, 1]; `side` is a power of two plus one, `roughness` the ratio of amplitudes per level."""
    field = np.zeros((side, side), np.float32)
    step, amplitude = side - 1, 1.0
    field[::step, ::step] = rng.normal(size=(2, 2))
    while step > 1:
        half = step // 2
        corners = field[::step, ::step]
        squares = (corners[:-1, :-1] + corners[1:, :-1] + corners[:-1, 1:] + corners[1:, 1:]) / 4
        field[half::step, half::step] = squares + amplitude * rng.normal(size=squares.shape)
        # The centre of each diamond is the mean of its neighbours at half a step, of which there are only three at the
        # border.
        padded = np.pad(field, half, constant_values=np.nan)
        for rows, columns in (
            (slice(0, None, step), slice(half, None, step)),
            (slice(half, None, step), slice(0, None, step)),
        ):
            target = field[rows, columns]
            top, left = rows.start, columns.start
            around = [
                padded[top + half + dy :: step, left + half + dx :: step][: target.shape[0], : target.shape[1]]
                for dy, dx in ((-half, 0), (half, 0), (0, -half), (0, half))
            ]
            field[rows, columns] = np.nanmean(around, axis=0) + amplitude * rng.normal(size=target.shape)
        step, amplitude = half, amplitude * roughness
    low, high = float(field.min()), float(field.max())
    return (field - low) / max(high - low, 1e-6)


class _AutoAugment:
    """AutoAugment of torchvision with the policy for ImageNet; geometric transforms are applied to image and maps."""

    def __init__(self) -> None:
        segmentation_models()
        from torchvision.transforms import autoaugment  # noqa: PLC0415

        self._module, self._policy = autoaugment, autoaugment.AutoAugment()

    def __call__(self, image: Tensor, maps: Tensor) -> tuple[Tensor, Tensor]:
        policy = self._policy
        chosen, chances, signs = policy.get_params(len(policy.policies))
        space = policy._augmentation_space(10, (image.shape[1], image.shape[2]))
        for place, (name, chance, level) in enumerate(policy.policies[chosen]):
            if float(chances[place]) > chance:
                continue
            values, signed = space[name]
            magnitude = float(values[level]) if level is not None else 0.0
            if signed and int(signs[place]) == 0:
                magnitude = -magnitude
            image = self._applied(image, name, magnitude)
            if name in _GEOMETRIC:
                maps = self._applied(maps, name, magnitude)
            if name == "Rotate":
                x, y, _ = maps[_NORMALS].clone()
                cos, sin = np.cos(np.deg2rad(magnitude)), np.sin(np.deg2rad(magnitude))
                # torchvision's angle is counterclockwise; y points down.
                maps[_NORMALS.start], maps[_NORMALS.start + 1] = cos * x + sin * y, cos * y - sin * x
        return image, maps

    def _applied(self, picture: Tensor, name: str, magnitude: float) -> Tensor:
        return self._module._apply_op(picture, name, magnitude, self._policy.interpolation, None)


def _warped(name: Augmentation) -> Change:
    segmentation_models()
    from torchvision import tv_tensors  # noqa: PLC0415
    from torchvision.transforms import v2  # noqa: PLC0415

    transform = v2.ElasticTransform() if name == "elastic" else v2.RandomPerspective()

    def change(image: Tensor, maps: Tensor) -> tuple[Tensor, Tensor]:
        image, maps = transform(tv_tensors.Image(image), tv_tensors.Mask(maps))
        return image.as_subclass(Tensor), maps.as_subclass(Tensor)

    return change


SIZE = (256, 192)
"""Width and height of a training frame [px], which is a whole image."""
IMAGES = ImageSettings(width=SIZE[0], height=SIZE[1], field_width=SIZE[0], occluded=0.0, things=0.0, absent=0.0)
"""Settings of regular images, without smoke, blood, low light, occluders, solid distractors or absent arms."""
_SETTINGS = json.dumps(asdict(IMAGES))
CHUNK = 250
"""Number of frames per file."""


class TrainingFrames:
    """Training frames: images, surface maps of erroneous kinematics, and masks.

    Args:
        parts: tensors of each file of `make_chunk`.
    """

    def __init__(self, parts: Iterable[list[Tensor]]) -> None:
        self._images, self._given, self._masks = (torch.cat(part) for part in zip(*parts, strict=True))

    def __len__(self) -> int:
        return len(self._images)

    def batch(
        self, numbers: Iterable[int]
    ) -> tuple[UInt8[Tensor, "batch 3 h w"], Float[Tensor, "batch 6 h w"], Float[Tensor, "batch 1 h w"]]:
        """Images, surface maps of the given kinematics, and masks of the frames with these numbers."""
        chosen = list(numbers)
        return (self._images[chosen], self._given[chosen].float() / SURFACE_UNIT, self._masks[chosen].float()[:, None])


def _chunk(path: Path, seed: int) -> list[Tensor]:
    """Images, surface maps and masks of a file of `make_chunk`."""
    try:
        check_regular(path, WEIGHTS)
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("settings") != _SETTINGS:
                raise ValueError("its frames were generated with other settings")
            if metadata.get("seed") != str(seed):
                raise ValueError(f"its frames were generated with seed {metadata.get('seed')}, but the seed is {seed}")
            return [file.get_tensor(name) for name in ("images", "given", "masks")]
    except (SafetensorError, OSError, ValueError) as error:
        raise WeightsError(
            f"training frames {path} cannot be read ({error}). Delete the file to regenerate them, or give another "
            "folder of frames."
        ) from error


def make_chunk(folder: OutputPath, chunk: int, seed: int) -> None:
    """Write one file of frames, which depends only on the seed and the number of the file.

    Raises:
        OutputError: the file cannot be written.
    """
    generator = SurfaceGenerator([Robot.load(shipped_robot())], IMAGES, (seed, chunk))
    images, given, masks = [], [], []
    for number in range(CHUNK):
        sample = generator(number)
        images.append(sample.observed.transpose(2, 0, 1))
        given.append(sample.given.transpose(2, 0, 1))
        covered = sample.surface[..., COVERAGE].sum(-1, dtype=np.int16)
        masks.append((2 * covered > SURFACE_UNIT).astype(np.uint8))
    arrays = {"images": images, "given": given, "masks": masks}
    tensors = {name: torch.from_numpy(np.stack(values)).contiguous() for name, values in arrays.items()}
    write_bytes(_file(folder, chunk), tensor_bytes(tensors, {"settings": _SETTINGS, "seed": str(seed)}))


def _file(folder: OutputPath, chunk: int) -> OutputPath:
    return folder / f"frames_{chunk:03d}.safetensors"


WEIGHTS_FILE = "baseline.safetensors"
VALIDATION = 100
"""Number of frames, at the end, that are used for validation."""
_MAY_CHANGE = ("steps", "minutes", "checkpoint_every", "threads", "device")
_LOG_EVERY = 20


@dataclass(frozen=True)
class BaselineResult:
    """Files and metrics of a finished run."""

    weights: Path
    steps: int
    dice: float
    """Mean Dice of the validation frames, without augmentation."""
    processor_seconds: float
    """CPU time of the training process, including all resumed parts [s]."""


def prepare_frames(
    folder: OutputPath, training: BaselineTraining, say: Callable[[str], None] = lambda line: None
) -> TrainingFrames:
    """Open training frames in a folder, which baselines may share; missing frames are generated.

    Raises:
        OutputError: the folder cannot be written to.
        WeightsError: a file of frames cannot be read, or has other settings or another seed.
    """
    with locked_folder(folder.path):
        chunks = range(-(-training.frames // CHUNK))
        parts = []
        for chunk in chunks:
            if not holds_file(_file(folder, chunk)):
                say(f"training frames: part {chunk + 1} of {len(chunks)}")
                make_chunk(folder, chunk, training.seed)
            parts.append(_chunk(_file(folder, chunk).path, training.seed))
    return TrainingFrames(parts)


def train_baseline(
    network: BaselineNetwork,
    training: BaselineTraining,
    frames: TrainingFrames,
    output: Path,
    say: Callable[[str], None] = lambda line: None,
) -> BaselineResult:
    """Train a baseline, or resume the run in `output`.

    Args:
        network, training: settings of the network and of its training.
        frames: training and validation frames.
        output: folder of `checkpoint.safetensors` and, at the end, `baseline.safetensors`.
        say: called with lines of progress.

    Raises:
        CartsError: the optional dependencies are not installed.
        SettingsError: the network does not fit the frames, or `output` holds a run with other settings.
        WeightsError: the initial weights or the checkpoint cannot be read.
        OutputError: `output` cannot be written to, or another process trains there.
    """
    if network.size != SIZE:
        raise SettingsError(f"size is {network.size}, but training frames are {SIZE} px. Use the default size.")
    torch.set_num_threads(training.threads)
    with locked_folder(output):
        run = _Run(network, training, frames, output)
        try:
            return run.finish(say)
        except KeyboardInterrupt:
            run.loop.save()
            raise


class _Run:
    """Training run of a baseline."""

    def __init__(
        self, network: BaselineNetwork, training: BaselineTraining, frames: TrainingFrames, output: Path
    ) -> None:
        self.training, self.frames, self.output = training, frames, output
        torch.manual_seed(training.seed)
        self.network = Baseline(network)
        if training.start is not None:
            start_from(self.network, training.start)
        channels_last(self.network.to(training.device))
        start = {
            "start": training.start.name if training.start else None,
            "start_digest": start_digest(training.start),
        }
        self.config = json.dumps({"network": asdict(network), **asdict(training), **start})
        self.loop = TrainingLoop(output, self.network, training, self.config, _MAY_CHANGE)

    def finish(self, say: Callable[[str], None]) -> BaselineResult:
        """Run the remaining steps, validate, and write the weights."""
        loop = self.loop

        def logged(means: dict[str, float], _: float) -> None:
            say(f"step {loop.step} of {loop.planned}: loss {means['loss']:.4f}")

        if loop.step < loop.planned:
            loop.run((self._batch() for _ in count()), self._loss, _LOG_EVERY, logged)
        score, path = self.validate(), output_path(self.output, WEIGHTS_FILE)
        seconds = loop.history.processor_seconds * self.training.threads
        figures = {"steps": loop.step, "dice": score, "processor_seconds": round(seconds, 1)}
        save_baseline(self.network, path, {**json.loads(self.config), **figures})
        return BaselineResult(path.path, loop.step, score, seconds)

    @torch.no_grad()
    def validate(self) -> float:
        """Mean Dice of the validation frames."""
        self.network.eval()
        found = []
        frames = len(self.frames)
        for first in range(frames - VALIDATION, frames, 10):
            images, given, masks = self.frames.batch(range(first, min(first + 10, frames)))
            logits = self._logits(images.float() / 255, given)
            found.append(dice(logits[:, 0].cpu() > 0, masks[:, 0] > 0.5))
        return float(torch.cat(found).mean())

    def _loss(self, batch: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        images, given, masks = batch
        return functional.binary_cross_entropy_with_logits(self._logits(images, given), masks), {}

    def _batch(self) -> tuple[Tensor, Tensor, Tensor]:
        """Batch of the next step, which depends only on the seed and the step's number."""
        rng = np.random.default_rng((self.training.seed, self.loop.step))
        torch.manual_seed(int(rng.integers(2**63)))
        numbers = rng.integers(len(self.frames) - VALIDATION, size=self.training.batch_size)
        images, given, masks = self.frames.batch(map(int, numbers))
        change = augmentation(self.training.augmentation, rng)
        changed = [change(image, map_) for image, map_ in zip(images, torch.cat([masks, given], 1), strict=True)]
        images, maps = (torch.stack(part) for part in zip(*changed, strict=True))
        masks, given = maps[:, :1], maps[:, 1:]
        for dimension, normal in ((-1, NORMALS.start), (-2, NORMALS.start + 1)):
            if rng.integers(2):
                images, given, masks = (part.flip(dimension) for part in (images, given, masks))
                given[:, normal] *= -1
        device = self.training.device
        return images.to(device).float() / 255, given.to(device), masks.to(device)

    def _logits(self, images: Tensor, given: Tensor) -> Tensor:
        device, bfloat16 = self.training.device, self.training.bfloat16
        images = images.to(device).contiguous(memory_format=torch.channels_last)
        enabled = device != "cpu" if bfloat16 is None else bfloat16
        with torch.autocast(device.split(":")[0], torch.bfloat16, enabled=enabled):
            return self.network(images, given.to(device)).float()
