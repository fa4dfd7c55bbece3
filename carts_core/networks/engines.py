"""Inference engines of the surface network: torch, ONNX Runtime, and ONNX Runtime with 8-bit integers.

`auto` selects the fastest engine on this machine and stores the timing.
"""

import hashlib
import io
import json
import logging
import platform
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..errors import OutputError, SettingsError
from ..files import output_path, write_bytes, write_new
from ..files.reading import VALUES, WEIGHTS, parse_json, read_bytes
from ..model.mesh_cache import cache_dir
from ..model.parts import COVERAGE, NORMALS, SURFACE_CHANNELS
from ..onnx_runtime import exact_int8, inference_session
from ..process import inference_threads
from ..provenance import fingerprint
from ..resources import shipped_int8
from ..settings.optimization import Engine, Inference
from .surface import AnySurfaceNetwork

_VERSION = 3
"""Version of the exported graph, part of its file name."""
_OPSET = 17
_AXES = {0: "cameras", 2: "height", 3: "width"}
WEIGHTS_KEY = "weights"
"""Metadata key of a quantized graph: SHA-256 of its weights."""


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

    Raises:
        ImportError: ONNX Runtime is not installed.
        RuntimeError: ONNX Runtime cannot load the graph.
    """

    def __init__(self, graph: bytes) -> None:
        self._session = inference_session(graph, inference_threads())
        self.digest = hashlib.sha256(graph).hexdigest()
        """SHA-256 of the graph."""

    @staticmethod
    def float32(network: AnySurfaceNetwork, sha256: str) -> "OnnxSurface":
        """The network in single precision. The graph is exported once and stored in the cache, under the fingerprint of
        the weights; `RuntimeError` if torch cannot export it."""
        path = cache_dir() / f"surface-{sha256[:32]}-{_VERSION}.onnx"
        try:
            return OnnxSurface(read_bytes(path, WEIGHTS))
        except (OSError, RuntimeError, ValueError):
            # The file is missing or damaged.
            graph = exported(network)
            found = OnnxSurface(graph)
            with suppress(OutputError):
                write_bytes(output_path(path.parent, path.name), graph)
            return found

    @staticmethod
    def int8(network: AnySurfaceNetwork, sha256: str) -> "OnnxSurface":
        """The quantized network; `RuntimeError` unless the weights are those of the shipped graph."""
        try:
            found = OnnxSurface(read_bytes(shipped_int8(), WEIGHTS))
        except OSError as error:
            raise RuntimeError(str(error)) from error
        if found._session.get_modelmeta().custom_metadata_map.get(WEIGHTS_KEY) != sha256:
            raise RuntimeError("only the shipped weights have a quantized graph")
        return found

    def __call__(
        self, images: Float[Tensor, "batch 3 h w"], given: Float[Tensor, "batch 6 h w"]
    ) -> Float[Tensor, "batch 6 h w"]:
        """Predict surface maps; equal to `SurfaceNetwork.forward(images, given).map()` up to rounding or quantization.

        Raises:
            RuntimeError: ONNX Runtime cannot run the graph.
        """
        inputs = {"images": images.detach().contiguous().numpy(), "given": given.detach().contiguous().numpy()}
        try:
            (maps,) = self._session.run(["maps"], inputs)
        except Exception as error:  # ONNX Runtime's errors have no narrower base class.
            raise RuntimeError(f"ONNX Runtime cannot run the graph: {error}") from error
        assert isinstance(maps, np.ndarray)
        return torch.from_numpy(maps)


def exported(network: AnySurfaceNetwork) -> bytes:
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
INT8_TOLERANCE = 0.03
"""Maximum root mean square difference between the coverage of the quantized network and of the network [1]."""
_GAIN = 0.9
"""Ratio to the time of the next engine in the order of `Engine` below which a later engine is preferred [1]."""
_ROUNDS = 7
_MEASUREMENT = 3
"""Version of the timing procedure, part of its file name."""
_PROBE = 7, 13
"""Height and width of the timed image, in strides of the network; typical of a window around an arm."""

_PACKAGES: dict[Engine, tuple[str, ...]] = dict.fromkeys(("onnx", "int8"), ("onnxruntime", "onnx"))


def surface_engine(
    network: AnySurfaceNetwork, sha256: str, device: torch.device, wanted: Inference
) -> "tuple[Engine, OnnxSurface | None]":
    """Select the inference engine of the surface network.

    Raises:
        SettingsError: another engine than torch was requested but cannot be used.
    """
    if wanted == "auto":
        return _fastest(network, sha256, device)
    if wanted == "torch":
        return "torch", None
    try:
        return wanted, _checked(wanted, network, sha256, device)
    except (RuntimeError, ImportError) as error:
        raise SettingsError(
            f"ONNX Runtime cannot be used: {error}. Use --device cpu or cpu:torch; in Python inference='auto' or "
            "'torch'."
        ) from error


def _checked(name: Engine, network: AnySurfaceNetwork, sha256: str, device: torch.device) -> OnnxSurface:
    """An engine that predicts what torch predicts; `RuntimeError` or `ImportError` otherwise."""
    if absent := [package for package in _PACKAGES[name] if find_spec(package) is None]:
        raise RuntimeError(f"{' and '.join(absent)} {'is' if len(absent) == 1 else 'are'} not installed")
    if device.type != "cpu":
        raise RuntimeError(f"it requires the device cpu; given: {device}")
    if name == "int8" and not exact_int8():
        raise RuntimeError("sums of 8-bit products saturate on this processor")
    make = OnnxSurface.int8 if name == "int8" else OnnxSurface.float32
    found = make(network, sha256)
    difference = _deviation(network, found) if name == "int8" else _difference(network, found)
    allowed = INT8_TOLERANCE if name == "int8" else TOLERANCE
    if not difference <= allowed:
        raise RuntimeError(f"its surface maps differ by {difference:.1e}, more than {allowed:.0e}")
    return found


def _fastest(network: AnySurfaceNetwork, sha256: str, device: torch.device) -> tuple[Engine, OnnxSurface | None]:
    """Fastest engine, according to a timing stored on this machine."""
    versions = [version(name) for name in ("torch", "onnxruntime") if find_spec(name) is not None]
    machine = platform.node(), platform.processor(), torch.get_num_threads(), inference_threads()
    key = fingerprint(_MEASUREMENT, sha256, versions, str(device), machine)[:32]
    path = cache_dir() / f"inference-{key}.json"
    known = _read(path)
    engines: dict[Engine, OnnxSurface] = {}
    for name in _PACKAGES if known is None else (known,):
        if name != "torch":
            with suppress(RuntimeError, ImportError):
                engines[name] = _checked(name, network, sha256, device)
    if known is None and engines:
        seconds = _times(network, engines)
        known = min(seconds, key=lambda name: seconds[name] / _GAIN ** get_args(Engine).index(name))
        with suppress(OutputError):
            # Concurrent processes use the result of the first process.
            write_new(output_path(path.parent, path.name), json.dumps({"engine": known, "seconds": seconds}).encode())
            known = _read(path) or known
    if known is None or known not in engines:
        return "torch", None
    return known, engines[known]


def _probe(network: AnySurfaceNetwork) -> tuple[Tensor, Tensor]:
    """Fixed test image and prior surface map."""
    height, width = (strides * network.architecture.stride for strides in _PROBE)
    chance = torch.Generator().manual_seed(0)
    images = torch.rand(1, 3, height, width, generator=chance)
    return images, torch.rand(1, SURFACE_CHANNELS, height, width, generator=chance)


@torch.no_grad()
def _difference(network: AnySurfaceNetwork, other: OnnxSurface) -> float:
    """Maximum difference of surface maps."""
    images, given = _probe(network)
    return float((network(images, given).map() - other(images, given)).abs().max())


@torch.no_grad()
def _deviation(network: AnySurfaceNetwork, other: OnnxSurface) -> float:
    """Root mean square difference of coverage, for a dark shaft on tissue; quantization is inaccurate in noise."""
    images, given = (torch.zeros_like(values) for values in _probe(network))
    images += torch.tensor([0.7, 0.4, 0.3]).view(3, 1, 1)
    shaft = slice(images.shape[3] // 3, images.shape[3] // 2)
    images[..., shaft] = 0.2
    given[:, COVERAGE.start, :, shaft], given[:, NORMALS.stop - 1, :, shaft] = 1.0, -1.0
    difference = (network(images, given).map() - other(images, given))[:, COVERAGE]
    return float(difference.square().mean().sqrt())


def _read(path: Path) -> Engine | None:
    try:
        engine = parse_json(read_bytes(path, VALUES))["engine"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return engine if engine in get_args(Engine) else None


@torch.no_grad()
def _times(network: AnySurfaceNetwork, engines: dict[Engine, OnnxSurface]) -> dict[Engine, float]:
    """Minimum of several alternating timings of each engine [s]."""
    images, given = _probe(network)
    runs: dict[Engine, Callable[[], Tensor]] = {
        "torch": lambda: network(images.contiguous(memory_format=torch.channels_last), given).map(),
        **{name: partial(engine, images, given) for name, engine in engines.items()},
    }
    seconds: dict[Engine, list[float]] = {name: [] for name in runs}
    for _ in range(_ROUNDS):
        for name, run in runs.items():
            began = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - began)
    return {name: min(values) for name, values in seconds.items()}
