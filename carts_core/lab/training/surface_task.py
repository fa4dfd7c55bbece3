"""Learning to see surfaces: what `SurfaceNetwork` is trained on, what it minimises, how well it does."""

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from ...model.parts import PARTS
from ...model.robot import Robot
from ...model.surface import COVERAGE, NORMALS
from ...networks.network import SurfaceNetwork
from ...settings import TrainingConfig
from ..randomization import SURFACE_UNIT, SurfaceGenerator, SurfaceSample
from .objective import dilated, weighted_mean
from .task import Batch, byte_tensor, flips
from .validation import pooled_dice

_PART_WORSE, _TIP_WORSE = 0.005, 0.2
"""What counts as worse: a part's Dice lower by this much [1], tips farther off by this much [px]."""
_LOST = 20.0
"""Error of a tip that is not predicted, and the most that one counts [px]."""
_SMOOTH = 0.2
_AT_ONCE = 8


class SurfaceTask:
    """See `Task`. A batch is images, given surface maps and true surface maps."""

    columns: ClassVar[dict[str, str]] = {
        "dice": "Dice of the arms",
        "dice_given": "Dice of the given kinematics",
        "part_accuracy": "pixels with the right part",
        **{f"dice_{part}": f"Dice of the part {part}" for part in PARTS},
        "tip_error": "error of tips [px]",
        "normal_error_deg": "error of normals [deg]",
    }
    score: ClassVar[str] = "dice"

    def network(self, config: TrainingConfig) -> SurfaceNetwork:
        """A network with random weights."""
        return SurfaceNetwork(config.architecture)

    def generator(self, config: TrainingConfig, stream: Sequence[int]) -> SurfaceGenerator:
        """An endless source of samples."""
        return SurfaceGenerator([Robot.load(path) for path in config.robots], config.images, stream)

    def flipped(self, sample: SurfaceSample, horizontally: bool, vertically: bool) -> SurfaceSample:
        """A sample mirrored; normals turn with it."""
        observed, given, surface = (
            flips(part, horizontally, vertically) for part in (sample.observed, sample.given, sample.surface)
        )
        turn = np.ones(surface.shape[2], np.int8)
        turn[NORMALS.start] = -1 if horizontally else 1
        turn[NORMALS.start + 1] = -1 if vertically else 1
        return SurfaceSample(observed, given * turn, surface * turn)

    def tensors(self, sample: SurfaceSample) -> Batch:
        """A sample as tensors of bytes."""
        return byte_tensor(sample.observed), byte_tensor(sample.given), byte_tensor(sample.surface)

    def loss(self, config: TrainingConfig, network: SurfaceNetwork, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted loss, and each term before weighting."""
        images, given, surface = _floats(batch)
        predicted = network(images, given)
        coverage = surface[:, COVERAGE]
        near = dilated((coverage.sum(1) > 0).float())
        background = (1 - coverage.sum(1, keepdim=True)).clamp(min=0)
        entropy = functional.cross_entropy(predicted.coverage, torch.cat([background, coverage], 1), reduction="none")
        difference = functional.smooth_l1_loss(predicted.normals, surface[:, NORMALS], reduction="none", beta=_SMOOTH)
        terms = {
            "everywhere": entropy.mean(),
            "near": weighted_mean(entropy, near),
            "dice": _part_dice_loss(predicted.map()[:, COVERAGE], coverage),
            "normals": weighted_mean(difference.sum(1), near),
        }
        weights = config.surface_objective
        return torch.stack([getattr(weights, name) * term for name, term in terms.items()]).sum(), terms

    @torch.no_grad()
    def validate(self, network: SurfaceNetwork, batch: Batch) -> dict[str, float]:
        """Figures of a folded network."""
        images, given, surface = _floats(batch)
        seen = _seen(network, images, given)
        true, guess = (maps[:, COVERAGE].sum(1) > 0.5 for maps in (surface, seen))
        known = given[:, COVERAGE].sum(1) > 0.5
        ours, theirs = seen.movedim(1, -1)[true], surface.movedim(1, -1)[true]
        cosine = functional.cosine_similarity(ours[:, NORMALS], theirs[:, NORMALS], dim=1)
        parts = {f"dice_{name}": _pooled_part(seen, surface, part) for part, name in enumerate(PARTS)}
        return {
            **parts,
            "tip_error": tip_error(seen, surface),
            "dice": pooled_dice(guess, true),
            "dice_given": pooled_dice(known, true),
            "part_accuracy": float((ours[:, COVERAGE].argmax(1) == theirs[:, COVERAGE].argmax(1)).float().mean()),
            "normal_error_deg": float(torch.rad2deg(cosine.clamp(-1, 1).arccos()).mean()),
        }

    def worse(self, now: dict[str, float], first: dict[str, float]) -> bool:
        """Whether a part is seen worse than at the start, or tips are farther off."""
        # Runs of earlier versions have no such figures.
        names = [name for name in (f"dice_{part}" for part in PARTS) if name in first]
        parts = any(now[name] < first[name] - _PART_WORSE for name in names)
        return parts or now["tip_error"] > first.get("tip_error", math.inf) + _TIP_WORSE

    @torch.no_grad()
    def panels(self, network: SurfaceNetwork, batch: Batch) -> list[list[tuple[str, np.ndarray]]]:
        """Example predictions of a folded network."""
        images, given, surface = _floats(batch)
        seen = _seen(network, images, given)
        rows = []
        for image, wrong, found, true in zip(images, given, seen, surface, strict=True):
            rows.append(
                [
                    ("observed", image.permute(1, 2, 0).numpy()),
                    ("given", _colors(wrong[COVERAGE])),
                    ("predicted parts", _colors(found[COVERAGE])),
                    ("true parts", _colors(true[COVERAGE])),
                    ("predicted normals", _colors(0.5 + 0.5 * found[NORMALS])),
                    ("true normals", _colors(0.5 + 0.5 * true[NORMALS])),
                ]
            )
        return rows


def _pooled_part(seen: Tensor, surface: Tensor, part: int) -> float:
    guess, true = (maps[:, COVERAGE][:, part] > 0.5 for maps in (seen, surface))
    return pooled_dice(guess, true)


def tip_error(seen: Float[Tensor, "n channels h w"], surface: Float[Tensor, "n channels h w"]) -> float:
    """Mean distance of predicted tips from true ones, over images that show the jaws [px].

    The tip is the pixel of the jaws that is farthest from the middle of the shaft, or of what is seen of the arm.
    """
    errors = []
    for ours, theirs in zip(seen[:, COVERAGE] > 0.5, surface[:, COVERAGE] > 0.5, strict=True):
        middle = _middle(theirs)
        if middle is None or (true := _farthest(theirs[-1], middle)) is None:
            continue
        found = _farthest(ours[-1], middle)
        errors.append(_LOST if found is None else min(float((found - true).norm()), _LOST))
    return float(np.mean(errors)) if errors else 0.0


def _middle(parts: Tensor) -> Tensor | None:
    """Middle of the shaft, or of the arm where no shaft is seen; None without any."""
    pixels = (parts[0] if parts[0].any() else parts.any(0)).nonzero()
    return pixels.float().mean(0) if len(pixels) else None


def _farthest(mask: Tensor, middle: Tensor) -> Tensor | None:
    pixels = mask.nonzero().float()
    return pixels[(pixels - middle).norm(dim=1).argmax()] if len(pixels) else None


def _floats(batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    images, given, surface = batch
    images = (images.float() / 255).contiguous(memory_format=torch.channels_last)
    return images, given.float() / SURFACE_UNIT, surface.float() / SURFACE_UNIT


def _seen(network: SurfaceNetwork, images: Tensor, given: Tensor) -> Tensor:
    """What the network sees in many images, where these are; it may be on another device."""
    device = next(network.parameters()).device
    parts = zip(images.split(_AT_ONCE), given.split(_AT_ONCE), strict=True)
    return torch.cat([network(image.to(device), known.to(device)).map().to(images.device) for image, known in parts])


def _part_dice_loss(
    predicted: Float[Tensor, "batch parts h w"], coverage: Float[Tensor, "batch parts h w"]
) -> Float[Tensor, ""]:
    assert predicted.shape[1] == len(PARTS)
    overlap = (predicted * coverage).sum((2, 3))
    return 1 - ((2 * overlap + 1) / (predicted.sum((2, 3)) + coverage.sum((2, 3)) + 1)).mean()


def _colors(channels: Float[Tensor, "3 h w"]) -> np.ndarray:
    return channels.clamp(0, 1).permute(1, 2, 0).cpu().numpy()
