"""Who runs the surface network."""

from typing import Literal

Inference = Literal["auto", "torch", "onnx"]
"""`torch`, `onnx` (ONNX Runtime, on a CPU), or whichever is faster here and gives the same."""
Engine = Literal["torch", "onnx"]
"""What it came to."""
