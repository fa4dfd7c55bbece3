"""Frozen networks of the optimizer, and hybrid images (the rendering over the mean background)."""

import hashlib
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import WeightsError
from ..resources import shipped_weights
from ..settings.optimization import Inference
from .inference import full_precision, surface_engine
from .network import FeatureNetwork, SurfaceNetwork, UNet
from .weights import Weights, read_weights


def hybrid(
    rendering_image: Float[Tensor, "*batch 3 h w"],
    silhouette: Float[Tensor, "*batch h w"],
    background: Float[Tensor, "*#batch 3 h w"],
) -> Float[Tensor, "*batch 3 h w"]:
    """BG_m + Î of the paper: the rendering where the silhouette is, the mean background elsewhere.

    At a silhouette between 0 and 1 (blurred, or in a gradient) both are mixed as by a lens.

    Args:
        rendering_image: rendered arms, RGB in [0, 1], black where the silhouette is 0.
        silhouette: Ŝ in [0, 1].
        background: mean background BG_m, RGB in [0, 1]; it may lack the leading dimensions.
    """
    return background * (1.0 - silhouette.unsqueeze(-3)) + rendering_image


class FeatureExtractor:
    """The trained feature and surface networks, frozen and folded. Made by `FeatureExtractor.load`.

    Gradients flow to images, never to weights.

    Attributes:
        weights: what was read, "feature" and "surface" network.
        sha256: fingerprint of both.
        working_size: width and height [px] of the images that the networks were trained for.
        stride: width and height of an input must be multiples of this [px].
        channels: number of feature channels.
        device: where the networks live.
        engine: who runs the surface network: "torch" or "onnx".
    """

    def __init__(
        self, features: Weights, surface: Weights, device: str | torch.device, inference: Inference = "torch"
    ) -> None:
        self.device = torch.device(device)
        self.weights = {"feature": features, "surface": surface}
        feature_network, surface_network = features.network, surface.network
        assert isinstance(feature_network, FeatureNetwork) and isinstance(surface_network, SurfaceNetwork)
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
        """Fingerprint of the networks and the inference engine, as engines differ by round-off."""
        return self.sha256 if self.engine == "torch" else f"{self.sha256} {self.engine}"

    @staticmethod
    def load(
        *weights: Path | str, device: str | torch.device = "cpu", inference: Inference = "torch"
    ) -> "FeatureExtractor":
        """Read weights files; a network without one has the shipped weights.

        Args:
            inference: who runs the surface network; `auto` measures once on each machine who is faster.

        Raises:
            SettingsError: `onnx` was asked for and is not possible.
            WeightsError: a file is missing, is not safetensors, or holds no network, or two hold the same kind.
        """
        read: dict[str, tuple[Path, Weights]] = {}
        for path in map(Path, weights):
            found = read_weights(path)
            if found.network.kind in read:
                raise WeightsError(
                    f"weights files {read[found.network.kind][0]} and {path} both hold a {found.network.kind} network; "
                    "give one of each kind at most."
                )
            read[found.network.kind] = (path, found)
        kinds: tuple[type[UNet], ...] = (FeatureNetwork, SurfaceNetwork)
        for network, path in zip(kinds, shipped_weights(), strict=True):
            if network.kind not in read:
                read[network.kind] = (path, read_weights(path))
        return FeatureExtractor(read["feature"][1], read["surface"][1], device, inference)

    def features(self, images: Float[Tensor, "batch 3 h w"]) -> Float[Tensor, "batch channels h w"]:
        """Features of the last layer before the head (F_I and F_Î of the paper), not negative.

        Args:
            images: RGB in [0, 1]; h and w are multiples of `stride`.

        Raises:
            SettingsError: another number of channels or another size.
        """
        return self._features.features(images.contiguous(memory_format=torch.channels_last))

    def probability(self, images: Float[Tensor, "batch 3 h w"]) -> Float[Tensor, "batch 1 h w"]:
        """Probability that a pixel shows an instrument. Arguments and errors as `features`."""
        return self._features.logits(images.contiguous(memory_format=torch.channels_last)).sigmoid()

    @torch.no_grad()
    def surface(
        self, images: Float[Tensor, "batch 3 h w"], given: Float[Tensor, "batch 6 h w"]
    ) -> Float[Tensor, "batch 6 h w"]:
        """Predict surface maps of images, given those of the prior poses.

        They are where the images are, wherever the network runs. Arguments and errors as `SurfaceNetwork.forward`.
        """
        if self._faster is not None:
            self._surface.check_input(images, 3)
            return self._faster(images, given)
        there = images.to(self.device, memory_format=torch.channels_last)
        with full_precision(self.device):
            return self._surface(there, given.to(self.device)).map().to(images.device)
