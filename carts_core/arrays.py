"""Functions for both NumPy arrays and PyTorch tensors. PyTorch is imported only if tensors are used."""

from typing import Any

import numpy as np

Array = Any
"""A NumPy array or a PyTorch tensor."""


def library(values: Array) -> Any:
    """The module, `numpy` or `torch`, whose functions apply to an array or a tensor."""
    if isinstance(values, np.ndarray):
        return np
    import torch  # noqa: PLC0415

    return torch


def as_array(values: Array) -> np.ndarray:
    """Convert to a C-ordered NumPy array without gradients, copied only if necessary."""
    return np.ascontiguousarray(values if isinstance(values, np.ndarray) else values.detach().cpu().numpy())


def converted(values: np.ndarray, like: Array) -> Array:
    """Convert an array to the library, device and data type of `like`."""
    if isinstance(like, np.ndarray):
        return values.astype(like.dtype, copy=False)
    return library(like).from_numpy(values).to(like)
