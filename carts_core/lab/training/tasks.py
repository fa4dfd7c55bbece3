"""Training tasks: samples, loss and validation metrics of each network."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from ...model.parts import COVERAGE, NORMALS, PARTS
from ...model.robot import Robot
from ...networks.network import FeatureNetwork
from ...networks.surface import AnySurfaceNetwork, SurfaceNetwork
from ...settings import NetworkName, TrainingConfig
from ..randomization import SURFACE_UNIT, PairGenerator, SurfaceGenerator, SurfaceSample, TrainingPair

Batch = tuple[Tensor, ...]
"""Byte tensors, each with a leading batch dimension."""


def flips(array: np.ndarray, horizontally: bool, vertically: bool) -> np.ndarray:
    """Mirror an image [h, w, ...]."""
    return array[:: -1 if vertically else 1, :: -1 if horizontally else 1]


def byte_tensor(array: np.ndarray) -> Tensor:
    """Convert an image [h, w, channels] to a tensor [channels, h, w]."""
    return torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1)))


def dice(predicted: Tensor, truth: Tensor) -> Tensor:
    """Dice of boolean masks [..., h, w]; 1 if both are empty."""
    overlap = (predicted & truth).sum((-2, -1))
    return (2 * overlap + 1e-9) / (predicted.sum((-2, -1)) + truth.sum((-2, -1)) + 1e-9)


def pooled_dice(predicted: Bool[Tensor, "n h w"], truth: Bool[Tensor, "n h w"]) -> float:
    """Dice over the pixels of all images together; 1 if both masks are empty.

    A mean over images would be dominated by images without an arm, whose Dice is 1, or 0 if a single pixel is wrong.
    """
    return float(dice(predicted.flatten(0, 1), truth.flatten(0, 1)))


_NEIGHBOURHOOD = 21
_TINY = 1e-8
_OTHER_PART = 0.6


def soft_dice_loss(
    probability: Float[Tensor, "batch *parts h w"], target: Float[Tensor, "batch *parts h w"]
) -> Float[Tensor, ""]:
    """One minus the Dice score of probabilities, averaged over images and parts."""
    overlap, total = (probability * target).sum((-2, -1)), probability.sum((-2, -1)) + target.sum((-2, -1))
    return 1 - ((2 * overlap + 1) / (total + 1)).mean()


def consistency_loss(
    features_a: Float[Tensor, "batch channels h w"],
    features_b: Float[Tensor, "batch channels h w"],
    classes_a: Int[Tensor, "batch h w"],
    classes_b: Int[Tensor, "batch h w"],
) -> Float[Tensor, ""]:
    """Loss on the cosine similarity of features near the instruments, where ACS compares them.

    Targets of the cosine are 1 for pixels with the same class in both images, at most 0 for background and instrument,
    and at most 0.6 for shaft and head. The terms are averaged separately, since background would otherwise outweigh
    instruments.
    """
    overlap = (features_a * features_b).sum(1)
    similarity = overlap * torch.rsqrt(features_a.square().sum(1) * features_b.square().sum(1) + _TINY)
    instrument = ((classes_a > 0) | (classes_b > 0)).to(similarity.dtype)
    near = dilated(instrument)
    same = (classes_a == classes_b).to(similarity.dtype)
    moved = ((classes_a > 0) != (classes_b > 0)).to(similarity.dtype)
    other_part = instrument * (classes_a != classes_b) * (1 - moved)
    return (
        weighted_mean(1 - similarity, same * instrument)
        + weighted_mean(1 - similarity, same * near * (1 - instrument))
        + weighted_mean(similarity.clamp(min=0), moved)
        + weighted_mean((similarity - _OTHER_PART).clamp(min=0), other_part)
    )


def dilated(mask: Float[Tensor, "batch h w"]) -> Float[Tensor, "batch h w"]:
    """Mask dilated by a square."""
    # The square structuring element is separable.
    rows = functional.max_pool2d(mask[:, None], (_NEIGHBOURHOOD, 1), 1, (_NEIGHBOURHOOD // 2, 0))
    return functional.max_pool2d(rows, (1, _NEIGHBOURHOOD), 1, (0, _NEIGHBOURHOOD // 2))[:, 0]


def _weighted(terms: dict[str, Tensor], weights: object) -> Tensor:
    """Sum of terms, weighted by the fields of the same names in `weights`."""
    return torch.stack([getattr(weights, name) * term for name, term in terms.items()]).sum()


def weighted_mean(values: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean; approximately zero if all weights are zero."""
    return (values * weights).sum() / (weights.sum() + 1)


class FeatureTask:
    """Training task of the feature network; stateless, so that each worker can create an instance.

    A batch consists of images [batch, 2, 3, h, w] and classes [batch, 2, h, w] of observed and hybrid images, as bytes.
    """

    columns: ClassVar[dict[str, str]] = {
        "dice_observed": "Dice, observed",
        "dice_hybrid": "Dice, hybrid",
        "similarity_aligned": "cosine, aligned",
        "similarity_misaligned": "cosine, misaligned",
    }
    """Validation metrics: name -> heading in the report."""
    score: ClassVar[str] = "dice_observed"
    """Name of the metric by which networks are compared; higher values are better."""

    def network(self, config: TrainingConfig) -> FeatureNetwork:
        """Network with random weights."""
        return FeatureNetwork(config.architecture)

    def generator(self, config: TrainingConfig, stream: Sequence[int]) -> PairGenerator:
        """Generator of pairs by number, counted from 0; different streams are independent."""
        return PairGenerator([Robot.load(path) for path in config.robots], config.images, stream)

    def flipped(self, sample: TrainingPair, horizontally: bool, vertically: bool) -> TrainingPair:
        """Mirror a pair; mirrored instruments remain valid samples."""
        parts = sample.observed, sample.observed_classes, sample.hybrid, sample.hybrid_classes
        return TrainingPair(*(flips(part, horizontally, vertically) for part in parts))

    def tensors(self, sample: Any) -> Batch:
        """Convert a pair to byte tensors."""
        images = np.stack([sample.observed, sample.hybrid]).transpose(0, 3, 1, 2)
        classes = np.stack([sample.observed_classes, sample.hybrid_classes])
        return torch.from_numpy(np.ascontiguousarray(images)), torch.from_numpy(np.ascontiguousarray(classes))

    def loss(self, config: TrainingConfig, network: Any, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Weighted loss, and each term before weighting."""
        images, classes = batch[0].float() / 255, batch[1]
        features = network.features(images.flatten(0, 1).contiguous(memory_format=torch.channels_last))
        logits = network.head(features)[:, 0]
        target = (classes > 0).flatten(0, 1).to(logits.dtype)
        of_pair = features.unflatten(0, images.shape[:2])
        terms = {
            "cross_entropy": functional.binary_cross_entropy_with_logits(logits, target),
            "dice": soft_dice_loss(logits.sigmoid(), target),
            "consistency": consistency_loss(of_pair[:, 0], of_pair[:, 1], classes[:, 0], classes[:, 1]),
        }
        return _weighted(terms, config.objective), terms

    @torch.no_grad()
    def validate(self, network: Any, batch: Batch) -> dict[str, float]:
        """Validation metrics of a folded network, by the names in `columns`.

        `dice_*`: Dice of the predicted mask. `similarity_aligned`: cosine similarity of the features of observed and
        hybrid image in pixels where both show an instrument; `similarity_misaligned`: in pixels where only one shows an
        instrument.
        """
        dices, aligned, misaligned = [], [], []
        device = next(network.parameters()).device
        for images, classes in zip(*(part.split(_PAIRS_AT_ONCE) for part in batch), strict=True):
            chunk, mask = (images.float() / 255).to(device), (classes > 0).to(device)
            features = network.features(chunk.flatten(0, 1).contiguous(memory_format=torch.channels_last))
            dices.append(dice((network.head(features)[:, 0] > 0).unflatten(0, chunk.shape[:2]), mask))
            of_pair = features.unflatten(0, chunk.shape[:2])
            similarity = functional.cosine_similarity(of_pair[:, 0], of_pair[:, 1], dim=1)
            aligned.append(similarity[mask[:, 0] & mask[:, 1]])
            misaligned.append(similarity[mask[:, 0] ^ mask[:, 1]])
        mean = torch.cat(dices).mean(0)
        return {
            "dice_observed": float(mean[0]),
            "dice_hybrid": float(mean[1]),
            "similarity_aligned": float(torch.cat(aligned).mean()),
            "similarity_misaligned": float(torch.cat(misaligned).mean()),
        }

    def worse(self, now: dict[str, float], first: dict[str, float]) -> bool:
        """Whether a metric other than `score` is worse than at the start, so that the weights are rejected."""
        return False

    @torch.no_grad()
    def panels(self, network: Any, batch: Batch) -> list[list[tuple[str, np.ndarray]]]:
        """Example predictions of a folded network: titled images per sample."""
        rows = []
        for pair, truth in zip(batch[0].float() / 255, batch[1].cpu().numpy() > 0, strict=True):
            features = network.features(pair.to(next(network.parameters()).device))
            predicted = (network.head(features)[:, 0] > 0).cpu().numpy()
            similarity = functional.cosine_similarity(features[:1], features[1:], dim=1)[0].cpu().numpy()
            shown = pair.permute(0, 2, 3, 1).cpu().numpy()
            rows.append(
                [
                    ("observed", shown[0]),
                    ("its prediction", _confusion(predicted[0], truth[0])),
                    ("hybrid", shown[1]),
                    ("its prediction", _confusion(predicted[1], truth[1])),
                    ("cosine similarity of features", similarity),
                ]
            )
        return rows


def _confusion(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Confusion image: true positives white, true negatives black, false positives orange, false negatives red."""
    image = np.zeros((*truth.shape, 3))
    image[predicted & truth] = 1, 1, 1
    image[predicted & ~truth] = 1, 0.6, 0.1
    image[~predicted & truth] = 0.9, 0.1, 0.1
    return image


_PART_WORSE, _TIP_WORSE = 0.005, 0.2
"""Thresholds of "worse": decrease of a part's Dice [1], increase of the tip error [px]."""
_LOST = 20.0
"""Upper bound of a tip error, also used for tips that are not predicted [px]."""
_SMOOTH = 0.2
_AT_ONCE, _PAIRS_AT_ONCE = 8, 4


class SurfaceTask:
    """Training task of the surface network. A batch consists of images, prior surface maps and true surface maps."""

    columns: ClassVar[dict[str, str]] = {
        "dice": "Dice of the arms",
        "dice_given": "Dice of the given kinematics",
        "part_accuracy": "pixel accuracy of parts",
        **{f"dice_{part}": f"Dice of the part {part}" for part in PARTS},
        "tip_error": "tip error [px]",
        "normal_error_deg": "normal error [deg]",
    }
    score: ClassVar[str] = "dice"

    def network(self, config: TrainingConfig) -> SurfaceNetwork:
        """Network with random weights."""
        return SurfaceNetwork(config.surface_architecture)

    def generator(self, config: TrainingConfig, stream: Sequence[int]) -> SurfaceGenerator:
        """Generator of samples by number, counted from 0."""
        return SurfaceGenerator([Robot.load(path) for path in config.robots], config.images, stream)

    def flipped(self, sample: SurfaceSample, horizontally: bool, vertically: bool) -> SurfaceSample:
        """Mirror a sample, including its normals."""
        observed, given, surface = (
            flips(part, horizontally, vertically) for part in (sample.observed, sample.given, sample.surface)
        )
        turn = np.ones(surface.shape[2], np.int8)
        turn[NORMALS.start] = -1 if horizontally else 1
        turn[NORMALS.start + 1] = -1 if vertically else 1
        return SurfaceSample(observed, given * turn, surface * turn)

    def tensors(self, sample: Any) -> Batch:
        """Convert a sample to byte tensors."""
        return byte_tensor(sample.observed), byte_tensor(sample.given), byte_tensor(sample.surface)

    def loss(self, config: TrainingConfig, network: Any, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Weighted loss, and each term before weighting."""
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
            "dice": soft_dice_loss(predicted.parts(), coverage),
            "normals": weighted_mean(difference.sum(1), near),
        }
        return _weighted(terms, config.surface_objective), terms

    @torch.no_grad()
    def validate(self, network: Any, batch: Batch) -> dict[str, float]:
        """Validation metrics of a folded network, by the names in `columns`."""
        images, given, surface = _floats(batch)
        seen = _seen(network, images, given)
        true, guess = (maps[:, COVERAGE].sum(1) > 0.5 for maps in (surface, seen))
        known = given[:, COVERAGE].sum(1) > 0.5
        ours, theirs = seen.movedim(1, -1)[true], surface.movedim(1, -1)[true]
        cosine = functional.cosine_similarity(ours[:, NORMALS], theirs[:, NORMALS], dim=1)
        ours_parts, true_parts = (maps[:, COVERAGE].movedim(1, 0) > 0.5 for maps in (seen, surface))
        parts = {f"dice_{name}": pooled_dice(*pair) for name, *pair in zip(PARTS, ours_parts, true_parts, strict=True)}
        return {
            **parts,
            "tip_error": tip_error(seen, surface),
            "dice": pooled_dice(guess, true),
            "dice_given": pooled_dice(known, true),
            "part_accuracy": float((ours[:, COVERAGE].argmax(1) == theirs[:, COVERAGE].argmax(1)).float().mean()),
            "normal_error_deg": float(torch.rad2deg(cosine.clamp(-1, 1).arccos()).mean()),
        }

    def worse(self, now: dict[str, float], first: dict[str, float]) -> bool:
        """Whether the Dice of a part or the tip error is worse than at the start."""
        # Runs of earlier versions do not have these metrics.
        names = [name for name in (f"dice_{part}" for part in PARTS) if name in first]
        parts = any(now[name] < first[name] - _PART_WORSE for name in names)
        return parts or now["tip_error"] > first.get("tip_error", math.inf) + _TIP_WORSE

    @torch.no_grad()
    def panels(self, network: Any, batch: Batch) -> list[list[tuple[str, np.ndarray]]]:
        """Example predictions of a folded network: titled images per sample."""
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


def tip_error(seen: Float[Tensor, "n channels h w"], surface: Float[Tensor, "n channels h w"]) -> float:
    """Mean distance between predicted and true tips, over images that show the jaws [px].

    The tip is the jaw pixel farthest from the centre of the visible shaft or, without a shaft, of the visible arm.
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
    """Centre of the visible shaft or, without a shaft, of the visible arm; None if neither is visible."""
    pixels = (parts[0] if parts[0].any() else parts.any(0)).nonzero()
    return pixels.float().mean(0) if len(pixels) else None


def _farthest(mask: Tensor, middle: Tensor) -> Tensor | None:
    pixels = mask.nonzero().float()
    return pixels[(pixels - middle).norm(dim=1).argmax()] if len(pixels) else None


def _floats(batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    images, given, surface = batch
    images = (images.float() / 255).contiguous(memory_format=torch.channels_last)
    return images, given.float() / SURFACE_UNIT, surface.float() / SURFACE_UNIT


def _seen(network: AnySurfaceNetwork, images: Tensor, given: Tensor) -> Tensor:
    """Predicted surface maps of many images, on the device of the images; the network may be on another device."""
    device = next(network.parameters()).device
    parts = zip(images.split(_AT_ONCE), given.split(_AT_ONCE), strict=True)
    return torch.cat([network(image.to(device), known.to(device)).map().to(images.device) for image, known in parts])


def _colors(channels: Float[Tensor, "3 h w"]) -> np.ndarray:
    return channels.clamp(0, 1).permute(1, 2, 0).cpu().numpy()


Task = FeatureTask | SurfaceTask


def task_of(network: NetworkName) -> Task:
    """Create the training task of a network."""
    return FeatureTask() if network == "feature" else SurfaceTask()
