"""Frozen networks of the optimizer, hybrid images (the rendering over the mean background), and inference engines.

The surface network runs in torch or ONNX Runtime; `auto` selects the faster engine on this machine and stores the
timing.
"""

import hashlib
import io
import json
import logging
import platform
import time
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..errors import OutputError, SettingsError, WeightsError
from ..files import output_path, write_bytes, write_new
from ..files.reading import VALUES, WEIGHTS, parse_json, read_bytes
from ..model.mesh_cache import cache_dir
from ..model.parts import SURFACE_CHANNELS
from ..onnx_runtime import inference_session
from ..process import inference_threads
from ..provenance import fingerprint
from ..resources import shipped_weights
from ..settings.optimization import Engine, Inference
from .network import FeatureNetwork
from .surface import AnySurfaceNetwork, SurfaceNetwork, UNetSurface
from .weights import Weights, read_weights

_VERSION = 3
"""Version of the exported graph, part of its file name."""
_OPSET = 17
_AXES = {0: "cameras", 2: "height", 3: "width"}


class _Maps(nn.Module):
    """Module to export: predicts a surface map from an image and a prior surface map."""

    def __init__(self, network: AnySurfaceNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor, given: Tensor) -> Tensor:
        """Predicted surface maps."""
        logits = self.network(images, given)
        # ONNX Runtime's softmax over channels takes four times as long.
        odds = (logits.coverage - logits.coverage.amax(1, keepdim=True)).exp()
        return torch.cat([odds[:, 1:] / odds.sum(1, keepdim=True), logits.normals], 1)


class OnnxSurface:
    """Surface network in ONNX Runtime, with the number of threads that `inference_threads` returns at creation.

    The graph is exported once and stored in the cache, under the fingerprint of the weights.

    Raises:
        RuntimeError: torch cannot export the network, or ONNX Runtime cannot load it.
    """

    def __init__(self, network: AnySurfaceNetwork, sha256: str) -> None:
        path = cache_dir() / f"surface-{sha256[:32]}-{_VERSION}.onnx"
        try:
            self._session = inference_session(read_bytes(path, WEIGHTS), inference_threads())
        except (OSError, RuntimeError, ValueError):
            # The file is missing or damaged.
            graph = _exported(network)
            self._session = inference_session(graph, inference_threads())
            with suppress(OutputError):
                write_bytes(output_path(path.parent, path.name), graph)

    def __call__(
        self, images: Float[Tensor, "batch 3 h w"], given: Float[Tensor, "batch 6 h w"]
    ) -> Float[Tensor, "batch 6 h w"]:
        """Predict surface maps; equal to `SurfaceNetwork.forward(images, given).map()` up to rounding.

        Raises:
            RuntimeError: ONNX Runtime cannot run the graph.
        """
        inputs = {"images": images.contiguous().numpy(), "given": given.contiguous().numpy()}
        try:
            (maps,) = self._session.run(["maps"], inputs)
        except Exception as error:  # ONNX Runtime's errors have no narrower base class.
            raise RuntimeError(f"ONNX Runtime cannot run the graph: {error}") from error
        assert isinstance(maps, np.ndarray)
        return torch.from_numpy(maps)


def _exported(network: AnySurfaceNetwork) -> bytes:
    """Export the network as an ONNX graph for images of any size."""
    side = 2 * network.architecture.stride
    example = torch.rand(1, 3, side, side), torch.rand(1, SURFACE_CHANNELS, side, side)
    stream, names = io.BytesIO(), ["images", "given", "maps"]
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Sizes are checked in Python, so the graph requires no checks.
        torch.onnx.export(
            _Maps(network).eval(),
            example,
            stream,  # pyright: ignore[reportArgumentType]  files are taken where `dynamo` is false
            input_names=names[:2],
            output_names=names[2:],
            dynamic_axes={name: _AXES for name in names},
            opset_version=_OPSET,
            dynamo=False,
        )
    return stream.getvalue()


TOLERANCE = 1e-4
"""Maximum difference between equivalent surface maps [1]."""
_GAIN = 0.9
"""Ratio to torch's time below which another engine is preferred [1]."""
_ROUNDS = 7
_MEASUREMENT = 2
"""Version of the timing procedure, part of its file name."""
_PROBE = 7, 13
"""Height and width of the timed image, in strides of the network; typical of a window around an arm."""

Surface = Callable[[Tensor, Tensor], Tensor]


def surface_engine(
    network: AnySurfaceNetwork, sha256: str, device: torch.device, wanted: Inference
) -> "tuple[Engine, OnnxSurface | None]":
    """Select the inference engine of the surface network.

    Raises:
        SettingsError: `onnx` was requested but cannot be used.
    """
    if wanted == "torch":
        return "torch", None
    absent = [name for name in ("onnxruntime", "onnx") if find_spec(name) is None]
    if device.type != "cpu" or absent:
        fault = (
            f"{' and '.join(absent)} {'is' if len(absent) == 1 else 'are'} not installed"
            if absent
            else f"it requires the device cpu; given: {device}"
        )
        return _without(wanted, fault)
    try:
        found = OnnxSurface(network, sha256)
        difference = _difference(network, found)
    except (RuntimeError, ImportError) as error:
        return _without(wanted, f"it cannot run the network: {error}")
    if not difference <= TOLERANCE:
        return _without(wanted, f"its surface maps differ by {difference:.1e}, more than {TOLERANCE:.0e}")
    if wanted == "auto" and _remembered(network, sha256, found) == "torch":
        return "torch", None
    return "onnx", found


def full_precision(device: torch.device) -> AbstractContextManager[None]:
    """Context manager that disables TF32 (10-bit mantissa), PyTorch's default for convolutions on a GPU."""
    if device.type != "cuda":
        return nullcontext()
    return torch.backends.cudnn.flags(enabled=True, allow_tf32=False)


def _without(wanted: Inference, fault: str) -> tuple[Engine, None]:
    if wanted == "onnx":
        raise SettingsError(
            f"ONNX Runtime cannot be used: {fault}. Use --device cpu or cpu:torch; in Python inference='auto' or "
            "'torch'."
        )
    return "torch", None


def _probe(network: AnySurfaceNetwork) -> tuple[Tensor, Tensor]:
    """Fixed test image and prior surface map."""
    height, width = (strides * network.architecture.stride for strides in _PROBE)
    chance = torch.Generator().manual_seed(0)
    images = torch.rand(1, 3, height, width, generator=chance)
    return images, torch.rand(1, SURFACE_CHANNELS, height, width, generator=chance)


@torch.no_grad()
def _difference(network: AnySurfaceNetwork, other: Surface) -> float:
    images, given = _probe(network)
    return float((network(images, given).map() - other(images, given)).abs().max())


def _remembered(network: AnySurfaceNetwork, sha256: str, other: Surface) -> Engine:
    """Faster engine, according to a timing stored on this machine."""
    versions = [version(name) for name in ("torch", "onnxruntime")]
    machine = platform.node(), platform.processor(), torch.get_num_threads(), inference_threads()
    key = fingerprint(_MEASUREMENT, sha256, versions, machine)[:32]
    path = cache_dir() / f"inference-{key}.json"
    if (known := _read(path)) is not None:
        return known
    seconds = _times(network, other)
    engine: Engine = "onnx" if seconds["onnx"] < _GAIN * seconds["torch"] else "torch"
    try:
        # Concurrent processes use the result of the first process.
        write_new(output_path(path.parent, path.name), json.dumps({"engine": engine, "seconds": seconds}).encode())
    except OutputError:
        return engine
    return _read(path) or engine


def _read(path: Path) -> Engine | None:
    try:
        engine = parse_json(read_bytes(path, VALUES))["engine"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return engine if engine in ("torch", "onnx") else None


@torch.no_grad()
def _times(network: AnySurfaceNetwork, other: Surface) -> dict[Engine, float]:
    """Minimum of several alternating timings of each engine [s]."""
    images, given = _probe(network)
    engines: dict[Engine, Callable[[], Tensor]] = {
        "torch": lambda: network(images.contiguous(memory_format=torch.channels_last), given).map(),
        "onnx": lambda: other(images, given),
    }
    seconds: dict[Engine, list[float]] = {"torch": [], "onnx": []}
    for _ in range(_ROUNDS):
        for name, run in engines.items():
            began = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - began)
    return {name: min(values) for name, values in seconds.items()}


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
        working_size: width and height [px] of the images for which the networks were trained.
        stride: width and height of an input must be multiples of this [px].
        channels: number of feature channels.
        device: device of the networks.
        engine: inference engine of the surface network, "torch" or "onnx".
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
        """Fingerprint of the networks and of the inference engine, because engines differ by round-off."""
        return self.sha256 if self.engine == "torch" else f"{self.sha256} {self.engine}"

    @staticmethod
    def load(
        *weights: Path | str, device: str | torch.device = "cpu", inference: Inference = "torch"
    ) -> "FeatureExtractor":
        """Load networks from weights files; the shipped weights are used for a network without a file.

        Args:
            inference: engine of the surface network; `auto` selects the faster engine, timed once on each machine.

        Raises:
            SettingsError: `onnx` was requested but cannot be used.
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
