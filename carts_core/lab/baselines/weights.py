"""Weights files of baselines: safetensors, with the network and its training as metadata."""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from ...errors import SettingsError, WeightsError
from ...files import OutputPath, write_bytes
from ...files.reading import WEIGHTS, check_regular, parse_json, read_bytes
from ...networks.network import FeatureNetwork
from ...networks.tensor_bytes import tensor_bytes
from ...networks.weights import read_weights
from ...settings import Architecture
from ...settings.baseline import BaselineNetwork
from ...wording import shortened
from .networks import Baseline

FORMAT = "carts-baseline"
_VERSION = "1"
_REMEDY = "Train one with `carts baseline`."


@dataclass(frozen=True)
class TrainedBaseline:
    """What a weights file holds."""

    network: Baseline
    """In evaluation mode."""
    training: dict[str, Any]
    """Settings and figures of the run, as `carts baseline` wrote them."""
    sha256: str

    @property
    def row(self) -> str:
        """Its row in the benchmark: network and augmentation."""
        return f"{self.network.settings.name}_{self.training['augmentation']}"


def save_baseline(network: Baseline, path: OutputPath, training: dict[str, Any]) -> None:
    """Write a weights file; a reader never sees half of it."""
    metadata = {
        "format": FORMAT,
        "version": _VERSION,
        "network": json.dumps({**asdict(network.settings), "unet": network.settings.unet.to_json()}),
        "training": json.dumps(training),
    }
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    write_bytes(path, tensor_bytes(tensors, metadata))


def read_baseline(path: Path) -> TrainedBaseline:
    """Read and check a weights file.

    Raises:
        CartsError: the extra is not installed.
        WeightsError: the file is missing, is not what `carts baseline` writes, or its tensors do not fit.
    """
    try:
        check_regular(path, WEIGHTS)
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if (metadata.get("format"), metadata.get("version")) != (FORMAT, _VERSION):
                raise ValueError(f"it says format {metadata.get('format')!r}; wanted is {FORMAT!r}")
            settings, training = _described(metadata)
            network = Baseline(settings)
            _fill(network, {name: file.get_tensor(name) for name in file.keys()})
    except (FileNotFoundError, IsADirectoryError) as error:
        raise WeightsError(f"weights file {path} is missing. {_REMEDY}") from error
    except (SafetensorError, SettingsError, OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise WeightsError(f"weights file {path} holds no baseline ({shortened(str(error))}). {_REMEDY}") from error
    digest = hashlib.sha256(read_bytes(path, WEIGHTS)).hexdigest()
    return TrainedBaseline(network.eval().requires_grad_(False), training, digest)


def start_from(network: Baseline, path: Path) -> int:
    """Put timm's weights, such as pretrained ones, into the encoder of the image; returns how many tensors fit.

    Raises:
        WeightsError: the file is missing, is not safetensors, or nothing in it fits; a U-Net's is no feature network of
            the same architecture.
    """
    if isinstance(network.body, FeatureNetwork):
        trained = read_weights(path).network
        if not isinstance(trained, FeatureNetwork) or trained.architecture != network.body.architecture:
            raise WeightsError(
                f"weights file {path} holds a {trained.kind} network of {trained.architecture}. Give a feature network "
                f"of {network.body.architecture}, or ask for a U-Net like that."
            )
        network.body.load_state_dict(trained.state_dict())
        return len(trained.state_dict())
    try:
        check_regular(path, WEIGHTS)
        with safe_open(path, framework="pt") as file:
            given = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError, ValueError) as error:
        raise WeightsError(
            f"weights file {path} cannot be read ({shortened(str(error))}). Give timm's weights of the encoder as "
            "safetensors; pickles are not read."
        ) from error
    own = network.state_dict()
    # smp wraps timm's model, and features of HRNet and Swin are wrapped once more: names differ in what comes before.
    ends = {name.split("model.", 1)[-1]: name for name in own if "rendering." not in name}
    fitting = {
        ends[name]: value for name, value in given.items() if name in ends and own[ends[name]].shape == value.shape
    }
    if not fitting:
        raise WeightsError(
            f"weights file {path} has no tensor of the encoder {network.settings.timm_encoder!r}. Give timm's "
            "weights of exactly this model."
        )
    network.load_state_dict({**own, **fitting})
    return len(fitting)


def _described(metadata: dict[str, str]) -> tuple[BaselineNetwork, dict[str, Any]]:
    values = parse_json(metadata["network"])
    training = parse_json(metadata["training"], finite=False)
    if not isinstance(values, dict) or not isinstance(training, dict) or not isinstance(training["augmentation"], str):
        raise TypeError("its description is no table")
    unet = Architecture.from_json(values.pop("unet"))
    width, height = values.pop("size")
    decoder = tuple(int(n) for n in values.pop("decoder"))
    return BaselineNetwork(**values, decoder=decoder, size=(int(width), int(height)), unet=unet), training


def _fill(network: Baseline, tensors: dict[str, Tensor]) -> None:
    if not all(bool(torch.isfinite(value).all()) for value in tensors.values()):
        raise ValueError("some of its values are not finite")
    network.load_state_dict(tensors)
