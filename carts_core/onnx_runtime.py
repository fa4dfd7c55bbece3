"""ONNX Runtime sessions; the library is loaded on first use, with telemetry disabled.

From version 1.29, ONNX Runtime by default sends telemetry on the machine and its models to Microsoft.
"""

import os
from typing import TYPE_CHECKING

import numpy as np

from .process import memory_kept

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


def inference_session(graph: bytes, threads: int | None = None, *, fold: bool = True) -> "InferenceSession":
    """Create a CPU session for an ONNX graph.

    Args:
        threads: number of threads per operator; None lets ONNX Runtime choose.
        fold: fold constants on loading; for an untrusted graph, this may require unlimited memory.

    Raises:
        ImportError: ONNX Runtime is not installed.
        RuntimeError: ONNX Runtime cannot load the graph.
    """
    # The library reads this variable when it is loaded.
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime  # noqa: PLC0415  slow to load, and not needed by torch

    onnxruntime.disable_telemetry_events()
    options = onnxruntime.SessionOptions()
    if threads is not None:
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        # Spinning threads would compete for the cores with other work, such as torch's.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # The memory pool keeps a block for every image size and never frees it. It is not needed if malloc keeps memory.
    options.enable_cpu_mem_arena = options.enable_mem_pattern = not memory_kept()
    options.log_severity_level = 3
    left_out = [] if fold else ["ConstantFolding"]
    try:
        return onnxruntime.InferenceSession(graph, options, ["CPUExecutionProvider"], disabled_optimizers=left_out)
    except Exception as error:  # Exceptions of ONNX Runtime have no more specific base class.
        raise RuntimeError(str(error)) from error


def exact_int8() -> bool:
    """Whether products of 8-bit integers are exact; on x86 processors without VNNI instructions, their sums saturate.

    Raises:
        ImportError: ONNX or ONNX Runtime is not installed.
        RuntimeError: ONNX Runtime cannot multiply 8-bit integers.
    """
    from onnx import TensorProto, helper  # noqa: PLC0415

    side, largest = 64, (255, 127)
    kinds = {"a": TensorProto.UINT8, "b": TensorProto.INT8, "product": TensorProto.INT32}
    *inputs, output = (helper.make_tensor_value_info(name, kind, [side, side]) for name, kind in kinds.items())
    product = helper.make_node("MatMulInteger", ["a", "b"], ["product"])
    graph = helper.make_graph([product], "product", inputs, [output])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    session = inference_session(model.SerializeToString(), 1)
    factors = (np.full((side, side), value, kind) for value, kind in zip(largest, (np.uint8, np.int8), strict=True))
    (found,) = session.run(["product"], dict(zip("ab", factors, strict=True)))
    return bool((np.asarray(found) == side * largest[0] * largest[1]).all())
