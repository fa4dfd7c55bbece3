"""Weights files: safetensors with the architecture and the training settings as metadata.

Files with equal tensors and metadata are byte-identical.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from ..errors import SettingsError, WeightsError
from ..files import write_bytes
from ..files.reading import WEIGHTS, parse_json, read_bytes
from ..settings import Architecture, SurfaceArchitecture
from ..settings.training import MAX_SIDE
from ..wording import shortened
from .header import REMEDY, read_header, unreadable
from .network import FeatureNetwork, ImageNetwork
from .surface import SurfaceNetwork, UNetSurface

_LENGTH = 8
"""Size of the header's length field and alignment of the tensors [bytes]."""


def tensor_bytes(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> bytes:
    """Reproducible content of a safetensors file, unlike that of the library, in which the order of metadata varies.

    Args:
        tensors: tensors by name.
        metadata: strings for the header, in this order.
    """
    content = save(dict(tensors))
    end = _LENGTH + int.from_bytes(content[:_LENGTH], "little")
    header = {"__metadata__": dict(metadata), **json.loads(content[_LENGTH:end])}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _LENGTH)
    return len(text).to_bytes(_LENGTH, "little") + text + content[end:]


_NETWORKS: dict[tuple[str, str], tuple[type[Architecture | SurfaceArchitecture], Callable[[Any], ImageNetwork]]] = {
    ("carts-feature-network", "1"): (Architecture, FeatureNetwork),
    ("carts-surface-network", "1"): (Architecture, UNetSurface),
    ("carts-surface-network", "2"): (SurfaceArchitecture, SurfaceNetwork),
}
"""Format and version -> architecture and network."""
_TYPES = (torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64)


@dataclass(frozen=True)
class Weights:
    """Content of a weights file."""

    network: ImageNetwork
    """Trained network in evaluation mode, not folded."""
    working_size: tuple[int, int]
    """Width and height [px] of the images for which the network was trained."""
    training: dict
    """Settings and metrics of the training run, as written by `carts train`."""
    sha256: str
    """Fingerprint of the file."""


def save_weights(network: ImageNetwork, path: Path, training: dict, working_size: tuple[int, ...]) -> None:
    """Write a weights file atomically.

    Args:
        network: network whose state is written, including batch norms, so that training can be resumed.
        path: path of the file, by convention `*.safetensors`; its folder is created.
        working_size: width and height [px] of the images for which the network was trained.
    """
    metadata = {
        "format": f"carts-{network.kind}-network",
        "version": "2" if isinstance(network, SurfaceNetwork) else "1",
        "architecture": network.architecture.to_json(),
        "working_size": json.dumps(working_size),
        "training": json.dumps(training),
    }
    tensors = {name: value.contiguous() for name, value in network.state_dict().items()}
    write_bytes(path, tensor_bytes(tensors, metadata))


def read_weights(path: Path) -> Weights:
    """Read and check a weights file.

    Raises:
        WeightsError: the file is missing, is not safetensors, was not written by `carts train`, or its tensors do not
            fit its architecture.
    """
    metadata, shapes = read_header(path)
    kind, make_network = _NETWORKS[metadata["format"], metadata["version"]]
    architecture, working_size, training = _described(path, metadata, kind)
    network = _filled(path, make_network, architecture, shapes)
    if len(working_size) != 2 or any(not 0 < n <= MAX_SIDE or n % architecture.stride for n in working_size):
        raise WeightsError(
            f"weights file {path} has the working size {working_size}; allowed: two positive multiples of "
            f"{architecture.stride} up to {MAX_SIDE}. {REMEDY}"
        )
    return Weights(network.eval(), working_size, training, hashlib.sha256(read_bytes(path, WEIGHTS)).hexdigest())


def _described(
    path: Path, metadata: Mapping[str, str], kind: type[Architecture | SurfaceArchitecture]
) -> tuple[Architecture | SurfaceArchitecture, tuple[int, ...], dict]:
    """Parse architecture, working size [px] and training settings from the metadata."""
    try:
        architecture = kind.from_json(metadata["architecture"])
        working_size = tuple(int(n) for n in parse_json(metadata["working_size"]))
        training = parse_json(metadata["training"], finite=False)
        if not isinstance(training, dict):
            raise TypeError("the training settings are not a table")
    except (KeyError, ValueError, TypeError, AttributeError, OverflowError, SettingsError) as error:
        raise WeightsError(
            f"weights file {path} has unreadable metadata ({shortened(str(error))}). Required: an architecture "
            f"(widths and numbers of convolutions), a working size and the training settings. {REMEDY}"
        ) from error
    return architecture, working_size, training


def _filled(
    path: Path,
    make_network: Callable[[Any], ImageNetwork],
    architecture: Architecture | SurfaceArchitecture,
    shapes: Mapping[str, tuple[int, ...]],
) -> ImageNetwork:
    """Create the network with the tensors of the file."""
    differing = misfit(lambda: make_network(architecture), shapes)
    if differing is not None:
        raise WeightsError(f"weights file {path} does not fit its architecture {architecture}: {differing}. {REMEDY}")
    try:
        with safe_open(path, framework="pt") as file:
            state = {name: file.get_tensor(name) for name in shapes}
        network = make_network(architecture)
        network.load_state_dict(state)
    except (SafetensorError, OSError, RuntimeError, ValueError) as error:
        raise unreadable(path, error) from error
    if any(value.dtype not in _TYPES for value in state.values()):
        raise WeightsError(f"weights file {path} holds tensors of an unknown type. {REMEDY}")
    if not all(bool(value.isfinite().all()) for value in state.values()):
        raise WeightsError(f"weights file {path} holds values that are not finite. {REMEDY}")
    return network


def misfit(make_network: Callable[[], nn.Module], shapes: Mapping[str, tuple[int, ...]]) -> str | None:
    """First tensor of a file that does not fit a network, as a clause; None if names and shapes of all tensors fit.

    The network is created without memory, so that nothing is allocated for an architecture that does not fit the file.
    """
    with torch.device("meta"):
        wanted = {name: tuple(value.shape) for name, value in make_network().state_dict().items()}
    differing = [name for name in sorted(wanted.keys() | shapes.keys()) if wanted.get(name) != shapes.get(name)]
    if not differing:
        return None
    first = differing[0]
    return f"{shortened(first)} is {shapes.get(first, 'missing')}, but should be {wanted.get(first, 'absent')}"
