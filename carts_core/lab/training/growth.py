"""Growing a trained network: a larger one that starts out saying exactly what the smaller one says."""

import math

import torch
from torch import Tensor, nn

from ...errors import SettingsError
from ...networks.network import Network


def grow(larger: Network, trained: nn.Module) -> Network:
    """Put the weights of a trained network into a larger one of the same kind, so that it gives the same output.

    New channels keep their random weights, but no trained channel reads them yet; new convolutions at the end of a
    block pass trained channels on unchanged.

    Args:
        larger: a fresh network; changed in place and returned.
        trained: a network with as many channels or fewer, and as many convolutions per block or fewer.

    Raises:
        SettingsError: some layer of `trained` is larger than that of `larger`, or has no counterpart in it.
    """
    old_layers, new_layers = dict(trained.named_modules()), dict(larger.named_modules())
    for name in old_layers:
        if name not in new_layers:
            raise SettingsError(
                f"layer {name} of the weights has no counterpart; ask for as many convolutions or more."
            )
    before: nn.BatchNorm2d | None = None
    with torch.no_grad():
        for name, layer in new_layers.items():
            old = old_layers.get(name)
            if isinstance(layer, nn.Conv2d):
                assert old is None or isinstance(old, nn.Conv2d)
                _embed_convolution(name, layer, old, before)
            elif isinstance(layer, nn.BatchNorm2d):
                if old is None:
                    assert before is not None
                    _pass_through(layer, before)
                else:
                    assert isinstance(old, nn.BatchNorm2d)
                    for own, theirs in zip(layer.state_dict().values(), old.state_dict().values(), strict=True):
                        _put(name, own, theirs)
                    before = old
    return larger


def _embed_convolution(name: str, layer: nn.Conv2d, old: nn.Conv2d | None, before: nn.BatchNorm2d | None) -> None:
    if old is None:
        assert before is not None
        kept = before.num_features
        layer.weight[:kept] = 0
        middle = layer.kernel_size[0] // 2
        layer.weight[range(kept), range(kept), middle, middle] = 1
        return
    layer.weight[: old.out_channels] = 0
    _put(name, layer.weight, old.weight)
    if layer.bias is not None and old.bias is not None:
        _put(name, layer.bias, old.bias)


def _pass_through(layer: nn.BatchNorm2d, before: nn.BatchNorm2d) -> None:
    """Undo the normalisation of what the ReLU after `before` lets through, taken to be normally distributed."""
    kept = before.num_features
    shift, scale = before.bias, before.weight.abs().clamp(min=1e-6)
    ratio = shift / scale
    share, density = (
        0.5 * (1 + torch.erf(ratio / math.sqrt(2))),
        torch.exp(-ratio.square() / 2) / math.sqrt(2 * math.pi),
    )
    mean = shift * share + scale * density
    variance = ((shift.square() + scale.square()) * share + shift * scale * density - mean.square()).clamp(min=1e-4)
    assert layer.running_mean is not None and layer.running_var is not None
    layer.running_mean[:kept], layer.running_var[:kept] = mean, variance
    layer.bias[:kept], layer.weight[:kept] = mean, (variance + layer.eps).sqrt()


def _put(name: str, own: Tensor, theirs: Tensor) -> None:
    if own.ndim != theirs.ndim or any(size < needed for size, needed in zip(own.shape, theirs.shape, strict=True)):
        raise SettingsError(
            f"layer {name} of the weights has shape {tuple(theirs.shape)} and does not fit into {tuple(own.shape)}. "
            "Ask for an architecture that is as large or larger everywhere."
        )
    own[tuple(slice(size) for size in theirs.shape)] = theirs
