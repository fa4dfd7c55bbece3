"""The surface network in ONNX Runtime, which runs it faster than torch on many CPUs."""

import io
import logging
import warnings
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..errors import OutputError
from ..files import output_path, write_bytes
from ..files.reading import WEIGHTS, read_bytes
from ..model.mesh_cache import cache_dir
from ..onnx_runtime import onnxruntime
from ..process import inference_threads
from .surface_network import SurfaceNetwork

_VERSION = 1
"""Of the exported graph; part of its file's name."""
_OPSET = 17
_AXES = {0: "cameras", 2: "height", 3: "width"}


class _Maps(nn.Module):
    """From an image and a given surface map to a surface map, in one graph."""

    def __init__(self, network: SurfaceNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor, given: Tensor) -> Tensor:
        """The surface maps."""
        return self.network(images, given).map()


class OnnxSurface:
    """A surface network in ONNX Runtime, with `inference_threads` as they are when it is made.

    Its graph is exported once and kept in the cache, under the fingerprint of the weights.

    Args:
        network: folded, on the CPU.
        sha256: fingerprint of its weights.

    Raises:
        RuntimeError: torch cannot export the network, or ONNX Runtime cannot load it.
    """

    def __init__(self, network: SurfaceNetwork, sha256: str) -> None:
        path = cache_dir() / f"surface-{sha256[:32]}-{_VERSION}.onnx"
        try:
            self._session = _session(read_bytes(path, WEIGHTS))
        except (OSError, RuntimeError, ValueError):
            # It is not there yet, or was damaged.
            graph = _exported(network)
            self._session = _session(graph)
            _keep(path, graph)

    def __call__(
        self, images: Float[Tensor, "batch 3 h w"], given: Float[Tensor, "batch 6 h w"]
    ) -> Float[Tensor, "batch 6 h w"]:
        """The same as `SurfaceNetwork.forward(images, given).map()`, but for rounding.

        Raises:
            RuntimeError: ONNX Runtime cannot run the graph.
        """
        inputs = {"images": images.contiguous().numpy(), "given": given.contiguous().numpy()}
        try:
            (maps,) = self._session.run(["maps"], inputs)
        except Exception as error:  # Its errors have no base class but this.
            raise RuntimeError(f"ONNX Runtime cannot run the graph: {error}") from error
        assert isinstance(maps, np.ndarray)
        return torch.from_numpy(maps)


def _session(graph: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = inference_threads(), 1
    # Waiting threads that spin take the cores from whatever else runs, such as torch.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # Its errors have no base class but this.
        raise RuntimeError(f"ONNX Runtime cannot load the graph: {error}") from error


def _exported(network: SurfaceNetwork) -> bytes:
    """The network as an ONNX graph for images of any size."""
    side = 2 * network.architecture.stride
    example = torch.rand(1, 3, side, side), torch.rand(1, network.inputs - 3, side, side)
    stream, names = io.BytesIO(), ["images", "given", "maps"]
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Sizes are checked in Python, which the graph need not know of.
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


def _keep(path: Path, graph: bytes) -> None:
    """A cache that cannot be written is no error."""
    try:
        write_bytes(output_path(path.parent, path.name), graph)
    except OutputError:
        return
