"""Baseline networks and their weights files.

The networks are a U-Net, encoders of timm (HRNet, Swin, EfficientNet) with a U-Net decoder, and Colleoni's network with
two encoders.
"""

import hashlib
import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from ...errors import SettingsError, WeightsError
from ...files import OutputPath, write_bytes
from ...files.reading import WEIGHTS, check_regular, parse_json, read_bytes
from ...model.parts import SURFACE_CHANNELS
from ...networks.network import FeatureNetwork
from ...networks.weights import misfit, read_weights, tensor_bytes
from ...package_imports import require_package
from ...settings import Architecture
from ...settings.training import BaselineNetwork
from ...wording import shortened

EXTRA = "baselines"
_DECLARED = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"
_held: list[torch.library.Library] = []


def segmentation_models() -> ModuleType:
    """Import segmentation-models-pytorch, which requires timm and torchvision.

    Raises:
        CartsError: the optional dependencies are not installed.
    """
    for module in ("segmentation_models_pytorch", "timm", "torchvision"):
        require_package(module, EXTRA)
    _import_torchvision()
    import segmentation_models_pytorch  # noqa: PLC0415

    return segmentation_models_pytorch


def _import_torchvision() -> None:
    """Import torchvision, even if it does not match the build of torch.

    PyPI provides torchvision only for CUDA. With a CPU build of torch, its compiled operators are not loaded, and the
    import fails for operators that it registers immediately. The names of these operators are therefore declared; none
    of them is used.
    """
    while True:
        try:
            import torchvision  # noqa: F401, PLC0415
        except RuntimeError as error:
            missing = re.search(r"operator torchvision::(\w+) does not exist", str(error))
            if missing is None or len(_held) > 8:
                raise
            library = torch.library.Library("torchvision", "FRAGMENT")
            library.define(missing[1] + _DECLARED)
            # The declaration is valid as long as the library object exists.
            _held.append(library)
        else:
            return


_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Channel mean and standard deviation of ImageNet, as expected by timm's weights."""
_HEADS = (1, 2, 4, 8)
"""Attention heads per stage of a Swin transformer of width 24; the number is proportional to the width."""


class Baseline(nn.Module):
    """Baseline segmentation network.

    Raises:
        CartsError: the optional dependencies are not installed.
        SettingsError: timm does not provide the encoder, or the encoder does not work in the baseline.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, settings: BaselineNetwork) -> None:
        super().__init__()
        self.settings = settings
        if settings.name == "unet":
            self.body: nn.Module = FeatureNetwork(settings.unet)
        elif settings.name == "colleoni":
            self.body = _TwoEncoders(settings)
        else:
            models, options = segmentation_models(), dict[str, Any]()
            if settings.name == "swin":
                options["img_size"] = settings.size[::-1]
                if settings.width is not None:
                    heads = tuple((settings.width // 24 or 1) * factor for factor in _HEADS)
                    options |= {"embed_dim": settings.width, "num_heads": heads}
            options |= {"encoder_weights": None, "decoder_channels": settings.decoder}
            self.body = _made(settings, lambda: models.Unet(f"tu-{settings.timm_encoder}", **options))
        self.register_buffer("mean", torch.tensor(_MEAN)[:, None, None], persistent=False)
        self.register_buffer("deviation", torch.tensor(_DEVIATION)[:, None, None], persistent=False)

    def forward(
        self, images: Float[Tensor, "batch 3 h w"], given: Float[Tensor, "batch 6 h w"] | None = None
    ) -> Float[Tensor, "batch 1 h w"]:
        """Predict logits of the instrument mask.

        Args:
            images: RGB in [0, 1], of the width and height in the settings.
            given: surface maps of the measured kinematics, for Colleoni's network.
        """
        if self.settings.name == "unet":
            return self.body(images)
        images = (images - self.mean) / self.deviation
        if self.settings.uses_kinematics:
            return self.body(images, given)
        return self.body(images)


class _TwoEncoders(nn.Module):
    """Network with encoders of image and rendering, fused at every level, and a decoder, after Colleoni et al., arXiv
    2007.09107.

    The code of Colleoni et al. is not public, so the layer sizes may differ.
    """

    def __init__(self, settings: BaselineNetwork) -> None:
        super().__init__()
        models = segmentation_models()
        from segmentation_models_pytorch.base import SegmentationHead  # noqa: PLC0415
        from segmentation_models_pytorch.decoders.unet.decoder import UnetDecoder  # noqa: PLC0415

        def encoder(channels: int) -> Any:
            return models.encoders.get_encoder(f"tu-{settings.timm_encoder}", in_channels=channels, weights=None)

        self.image = _made(settings, lambda: encoder(3))
        self.rendering = _made(settings, lambda: encoder(SURFACE_CHANNELS))
        joined = [a + b for a, b in zip(self.image.out_channels, self.rendering.out_channels, strict=True)]
        self.decoder = UnetDecoder(joined, settings.decoder, len(settings.decoder))
        self.head = SegmentationHead(settings.decoder[-1], 1)

    def forward(self, images: Tensor, given: Tensor) -> Tensor:
        levels = zip(self.image(images), self.rendering(given), strict=True)
        return self.head(self.decoder([torch.cat(level, 1) for level in levels]))


def _made(settings: BaselineNetwork, make: Any) -> Any:
    """Result of `make`; raises `SettingsError` if timm lacks the encoder or it does not work in the baseline."""
    import timm  # noqa: PLC0415

    if not timm.is_model(settings.timm_encoder):
        raise SettingsError(
            f"timm {timm.__version__} has no encoder {settings.timm_encoder!r}. Give the name of a timm model, such as "
            "hrnet_w18_small, hrnet_w48, swin_tiny_patch4_window7_224 or resnet34."
        )
    try:
        return make()
    except (ValueError, RuntimeError, TypeError, KeyError, AssertionError) as error:
        raise SettingsError(
            f"the encoder {settings.timm_encoder!r} does not work in the {settings.name} baseline with {settings.size} "
            f"px ({error}). Choose an encoder of the {settings.name} family."
        ) from error


FORMAT = "carts-baseline"
_VERSION = "1"
_REMEDY = "Train a baseline with `carts baseline`."


@dataclass(frozen=True)
class TrainedBaseline:
    """Content of a weights file."""

    network: Baseline
    """Network in evaluation mode."""
    training: dict[str, Any]
    """Settings and metrics of the training run, as written by `carts baseline`."""
    sha256: str

    @property
    def row(self) -> str:
        """Name of the benchmark's row: network and augmentation."""
        return f"{self.network.settings.name}_{self.training['augmentation']}"


def save_baseline(network: Baseline, path: OutputPath, training: dict[str, Any]) -> None:
    """Write a weights file atomically."""
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
        CartsError: the optional dependencies are not installed.
        WeightsError: the file is missing, was not written by `carts baseline`, or its tensors do not fit.
    """
    try:
        check_regular(path, WEIGHTS)
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if (metadata.get("format"), metadata.get("version")) != (FORMAT, _VERSION):
                raise ValueError(f"its format is {metadata.get('format')!r}; expected: {FORMAT!r}")
            values, training = parse_json(metadata["network"]), parse_json(metadata["training"], finite=False)
            tables = isinstance(values, dict) and isinstance(training, dict)
            if not tables or not isinstance(training["augmentation"], str):
                raise TypeError("its description is not a table")
            unet = Architecture.from_json(values.pop("unet"))
            width, height = values.pop("size")
            decoder = tuple(int(n) for n in values.pop("decoder"))
            settings = BaselineNetwork(**values, decoder=decoder, size=(int(width), int(height)), unet=unet)
            shapes = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}
            differing = misfit(lambda: Baseline(settings), shapes)
            if differing is not None:
                raise ValueError(differing)
            network = Baseline(settings)
            tensors = {name: file.get_tensor(name) for name in file.keys()}
            if not all(bool(torch.isfinite(value).all()) for value in tensors.values()):
                raise ValueError("it has values that are not finite")
            network.load_state_dict(tensors)
    except (FileNotFoundError, IsADirectoryError) as error:
        raise WeightsError(f"weights file {path} is missing. {_REMEDY}") from error
    except (SafetensorError, SettingsError, OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise WeightsError(f"weights file {path} is not a baseline ({shortened(str(error))}). {_REMEDY}") from error
    digest = hashlib.sha256(read_bytes(path, WEIGHTS)).hexdigest()
    return TrainedBaseline(network.eval().requires_grad_(False), training, digest)


def start_from(network: Baseline, path: Path) -> int:
    """Load timm's weights, such as pretrained weights, into the image encoder; returns the number of fitting tensors.

    Raises:
        WeightsError: the file is missing, is not safetensors, or contains no fitting tensor; for the U-Net, the file
            does not contain a feature network of the same architecture.
    """
    if isinstance(network.body, FeatureNetwork):
        trained = read_weights(path).network
        if not isinstance(trained, FeatureNetwork) or trained.architecture != network.body.architecture:
            raise WeightsError(
                f"weights file {path} holds a {trained.kind} network of {trained.architecture}. Give a feature network "
                f"of {network.body.architecture}, or choose a U-Net of that architecture."
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
            "safetensors; pickles are not supported."
        ) from error
    own = network.state_dict()
    # smp wraps the models of timm once, and the features of HRNet and Swin twice, so the prefixes of names differ.
    ends = {name.split("model.", 1)[-1]: name for name in own if "rendering." not in name}
    fitting = {
        ends[name]: value for name, value in given.items() if name in ends and own[ends[name]].shape == value.shape
    }
    if not fitting:
        raise WeightsError(
            f"weights file {path} has no tensors of the encoder {network.settings.timm_encoder!r}. Give timm's "
            "weights of this model."
        )
    network.load_state_dict({**own, **fitting})
    return len(fitting)
