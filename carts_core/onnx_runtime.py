"""Sessions of ONNX Runtime, loaded on first use and without its telemetry.

ONNX Runtime reports machine and models to Microsoft by default from 1.29 on.
"""

import os
from typing import TYPE_CHECKING

from .process import memory_kept

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


def inference_session(graph: bytes, threads: int | None = None, *, fold: bool = True) -> "InferenceSession":
    """A session of an ONNX graph on the CPU.

    Args:
        threads: for one operator; None lets ONNX Runtime choose.
        fold: compute constants when the graph is loaded; those of a foreign graph may take any amount of memory.

    Raises:
        ImportError: ONNX Runtime is not installed.
        RuntimeError: it cannot load the graph.
    """
    # The library reads it when it is loaded.
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime  # noqa: PLC0415  slow to load, and not needed by torch

    onnxruntime.disable_telemetry_events()
    options = onnxruntime.SessionOptions()
    if threads is not None:
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        # Waiting threads that spin take the cores from other work, such as torch's.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Its own pool has a block for every size of image and returns none.
    options.enable_cpu_mem_arena = options.enable_mem_pattern = not memory_kept()
    options.log_severity_level = 3
    left_out = [] if fold else ["ConstantFolding"]
    try:
        return onnxruntime.InferenceSession(graph, options, ["CPUExecutionProvider"], disabled_optimizers=left_out)
    except Exception as error:  # Its errors have no more specific base class.
        raise RuntimeError(str(error)) from error
