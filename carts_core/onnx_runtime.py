"""ONNX Runtime without its telemetry: from 1.29 on it reports machine and models to Microsoft by default.

Whoever needs `onnxruntime` imports it from here, since the library looks at the environment when it is loaded.
"""

import os

os.environ["ORT_DISABLE_TELEMETRY"] = "1"

import onnxruntime

onnxruntime.disable_telemetry_events()

__all__ = ["onnxruntime"]
