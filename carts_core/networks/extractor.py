"""Frozen networks of the optimizer, and hybrid images (the rendering over the mean background)."""

import hashlib
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import WeightsError
from ..resources import shipped_weights
from ..settings.optimization import Inference
from .engines import surface_engine
from .network import FeatureNetwork
from .surface import SurfaceNetwork, UNetSurface
from .weights import Weights, read_weights


def full_precision(device: torch.device) -> AbstractContextManager[None]:
    """Context manager that disables TF32 (10-bit mantissa), PyTorch's default for convolutions on a GPU."""
    if device.type != "cuda":
        return nullcontext()
    return torch.backends.cudnn.flags(enabled=True, allow_tf32=False)


def hybrid(
    rendering_image: Float[Tensor, "*batch 3 h w"],
    silhouette: Float[Tensor, "*batch h w"],
    background: Float[Tensor, "*#batch 3 h w"],
) -> Float[Tensor, "*batch 3 h w"]:
    """Hybrid image (BG_m + Î in the paper): rendering inside the silhouette, mean background outside.

    At silhouette values between 0 and 1 (after a blur, or for gradients), both are blended linearly.

    Args:
        rendering_image: rendered arms, RGB in [0, 1], black where the silhouette is 0.
        silhouette: Ŝ in [0, 1].
        background: mean background BG_m, RGB in [0, 1]; leading dimensions are optional.
    """
    return background * (1.0 - silhouette.unsqueeze(-3)) + rendering_image


class FeatureExtractor:
    """Trained feature and surface networks, frozen and folded; created by `FeatureExtractor.load`.

    Gradients are computed for images, not for weights.

    Attributes:
        weights: weights read from the files, by kind: "feature" and "surface".
        sha256: fingerprint of both networks.
        working_size: width and height [px] of the images for which the feature network was trained.
        stride: width and height of an input must be multiples of this [px].
        channels: number of feature channels.
        device: device of the networks.
        engine: inference engine of the surface network: "torch", "onnx" or "int8".
    """

    def __init__(
        self, features: Weights, surface: Weights, device: str | torch.device, inference: Inference = "torch"
    ) -> None:
        self.device = torch.device(device)
        self.weights = {"feature": features, "surface": surface}
        feature_network, surface_network = features.network, surface.network
        assert isinstance(feature_network, FeatureNetwork) and isinstance(surface_network, SurfaceNetwork | UNetSurface)
        self._features = feature_network.to(self.device).folded()
        self._surface = surface_network.to(self.device).folded()
        self.sha256 = hashlib.sha256((features.sha256 + surface.sha256).encode()).hexdigest()
        self.engine, self._faster = surface_engine(self._surface, surface.sha256, self.device, inference)
        self.working_size = features.working_size
        self.stride = max(network.architecture.stride for network in (self._features, self._surface))
        self.channels = self._features.architecture.widths[0]

    def __repr__(self) -> str:
        return f"FeatureExtractor({self.channels} channels, {self.sha256[:8]})"

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the networks and of the inference engine, because the predictions of engines differ."""
        if self._faster is None:
            return self.sha256
        graph = f" {self._faster.digest[:16]}" if self.engine == "int8" else ""
        return f"{self.sha256} {self.engine}{graph}"

    @staticmethod
    def load(
        *weights: Path | str, device: str | torch.device = "cpu", inference: Inference = "torch"
    ) -> "FeatureExtractor":
        """Load networks from weights files; the shipped weights are used for a network without a file.

        Args:
            inference: engine of the surface network; `auto` selects the fastest engine, timed once on each machine.

        Raises:
            SettingsError: an engine was requested but cannot be used.
            WeightsError: a file is missing, is not safetensors or contains no network, or two files contain the same
                kind of network.
        """
        read: dict[str, tuple[Path, Weights]] = {}
        for path in map(Path, weights):
            found = read_weights(path)
            if found.network.kind in read:
                raise WeightsError(
                    f"weights files {read[found.network.kind][0]} and {path} both hold a {found.network.kind} network; "
                    "give at most one of each kind."
                )
            read[found.network.kind] = (path, found)
        for kind, path in zip((FeatureNetwork.kind, SurfaceNetwork.kind), shipped_weights(), strict=True):
            if kind not in read:
                read[kind] = (path, read_weights(path))
        return FeatureExtractor(read["feature"][1], read["surface"][1], device, inference)

    def features(self, images: Float[Tensor, "batch 3 h w"]) -> Float[Tensor, "batch channels h w"]:
        """Features of the last layer before the head (F_I and F_Î in the paper), which are non-negative.

        Args:
            images: RGB in [0, 1]; h and w are multiples of `stride`.

        Raises:
            SettingsError: the number of channels or the size is not allowed.
        """
        return self._features.features(images.contiguous(memory_format=torch.channels_last))

    def probability(self, images: Float[Tensor, "batch 3 h w"]) -> Float[Tensor, "batch 1 h w"]:
        """Probability of an instrument in each pixel. Arguments and errors are those of `features`."""
        return self._features.logits(images.contiguous(memory_format=torch.channels_last)).sigmoid()

    @torch.no_grad()
    def surface(
        self, images: Float[Tensor, "batch 3 h w"], given: Float[Tensor, "batch 6 h w"]
    ) -> Float[Tensor, "batch 6 h w"]:
        """Predict surface maps from images and the surface maps of prior poses.

        The result is on the device of the images. Arguments and errors are those of `SurfaceNetwork.forward`.
        """
        if self._faster is not None:
            self._surface.check_input(images, 3)
            return self._faster(images, given)
        there = images.to(self.device, memory_format=torch.channels_last)
        with full_precision(self.device):
            return self._surface(there, given.to(self.device)).map().to(images.device)
