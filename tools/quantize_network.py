"""Quantize the shipped surface network to 8-bit integers for ONNX Runtime.

    python -m tools.quantize_network

Writes the graph `carts_core.resources.shipped_int8()` of the shipped weights, with static activation ranges from
generated training images. Needed after a change of the shipped weights.
"""

import tempfile
from pathlib import Path

import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

from carts_core.files import output_path, write_bytes
from carts_core.lab.randomization import SURFACE_UNIT, SurfaceGenerator
from carts_core.model.instruments.builtin import SCHEME, builtin_names
from carts_core.model.instruments.catalogue import SI_SUFFIX
from carts_core.model.robot import Robot
from carts_core.networks.engines import WEIGHTS_KEY, exported
from carts_core.networks.surface import UNetSurface
from carts_core.networks.weights import read_weights
from carts_core.resources import shipped_int8, shipped_weights
from carts_core.settings import ImageSettings

_IMAGES, _SEED = 64, 5
_OPERATIONS = ["Conv", "MaxPool", "Resize", "Concat", "Add", "Relu"]


class _Images(CalibrationDataReader):
    """Generated images with prior surface maps."""

    def __init__(self) -> None:
        robots = [Robot.load(Path(SCHEME + name)) for name in builtin_names() if not name.endswith(SI_SUFFIX)]
        settings = ImageSettings(width=320, height=240, field_width=320, blood=0.2, enlarged=0.3)
        self._generator, self._made = SurfaceGenerator(robots, settings, _SEED), 0

    def get_next(self) -> dict[str, np.ndarray] | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Inputs of the network; None after the last image."""
        if self._made == _IMAGES:
            return None
        self._made += 1
        sample = self._generator()
        inputs = {"images": sample.observed / 255, "given": sample.given / SURFACE_UNIT}
        return {name: values.astype(np.float32).transpose(2, 0, 1)[None] for name, values in inputs.items()}


def main() -> None:
    """Quantize the shipped weights."""
    weights = read_weights(shipped_weights()[1])
    assert isinstance(weights.network, UNetSurface)
    with tempfile.TemporaryDirectory() as folder:
        plain, prepared, quantized = (Path(folder, f"{name}.onnx") for name in ("plain", "prepared", "quantized"))
        plain.write_bytes(exported(weights.network.folded()))
        quant_pre_process(plain, prepared, skip_symbolic_shape=True)
        convolutions = [node.name for node in onnx.load(prepared).graph.node if node.op_type == "Conv"]
        quantize_static(
            prepared,
            quantized,
            _Images(),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=_OPERATIONS,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            # The last convolution predicts log odds and normals.
            nodes_to_exclude=convolutions[-1:],
        )
        model = onnx.load(quantized)
        onnx.helper.set_model_props(model, {WEIGHTS_KEY: weights.sha256})
        target = shipped_int8()
        write_bytes(output_path(target.parent, target.name), model.SerializeToString())


if __name__ == "__main__":
    main()
