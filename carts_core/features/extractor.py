"""The frozen feature network that the optimizer uses."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ..resources import shipped_weights
from .network import FeatureNetwork
from .weights import read_weights


class FeatureExtractor:
    """A trained feature network, frozen, folded and in channels-last order. Made by `FeatureExtractor.load`.

    Gradients flow to the images, never to the weights.

    Attributes:
        path: the weights file.
        sha256: its fingerprint.
        working_size: width and height [px] of the images that the network was trained for.
        stride: width and height of an input must be multiples of this [px].
        channels: number of feature channels.
        training: settings and figures of the training run.
        device: where the network lives.
    """

    def __init__(
        self,
        network: FeatureNetwork,
        path: Path,
        sha256: str,
        working_size: tuple[int, int],
        training: dict,
        device: str,
    ) -> None:
        self._network = network.to(device).folded()
        self.path = path
        self.sha256 = sha256
        self.working_size = working_size
        self.stride = network.architecture.stride
        self.channels = network.architecture.widths[0]
        self.training = training
        self.device = torch.device(device)

    def __repr__(self) -> str:
        return f"FeatureExtractor({self.path.name!r}, {self.channels} channels, {self.sha256[:8]})"

    @staticmethod
    def load(weights: Path | str | None = None, device: str | torch.device = "cpu") -> "FeatureExtractor":
        """Read a weights file, the shipped one by default.

        Raises:
            WeightsError: the file is missing, is not safetensors, or holds another network.
        """
        path = Path(weights) if weights is not None else shipped_weights()
        read = read_weights(path)
        return FeatureExtractor(read.network, path, read.sha256, read.working_size, read.training, str(device))

    def features(self, images: Float[Tensor, "batch 3 h w"]) -> Float[Tensor, "batch channels h w"]:
        """Features of the last layer before the head (F_I and F_Î of the paper), not negative.

        Args:
            images: RGB in [0, 1]; h and w are multiples of `stride`.

        Raises:
            SettingsError: another number of channels or another size.
        """
        return self._network.features(images.contiguous(memory_format=torch.channels_last))

    def probability(self, images: Float[Tensor, "batch 3 h w"]) -> Float[Tensor, "batch 1 h w"]:
        """Probability that a pixel shows an instrument. Arguments and errors as `features`."""
        return self._network.logits(images.contiguous(memory_format=torch.channels_last)).sigmoid()
