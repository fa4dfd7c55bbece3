"""Functions for NumPy arrays, PyTorch tensors and poses. PyTorch is imported only if tensors are used."""

from typing import Any

import numpy as np
from jaxtyping import Float

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


def array_if_faster(values: Array) -> Array:
    """Convert a CPU tensor that requires no gradient to an array with the same memory, since small operations are
    faster in NumPy. Other tensors, and arrays, are returned unchanged."""
    if isinstance(values, np.ndarray) or values.requires_grad or values.device.type != "cpu":
        return values
    return values.numpy()


def converted(values: Array, like: Array) -> Array:
    """Convert an array to the library, device and data type of `like`; tensors are unchanged."""
    if not isinstance(values, np.ndarray):
        return values
    if isinstance(like, np.ndarray):
        return values.astype(like.dtype, copy=False)
    return library(like).from_numpy(values).to(like)


def pose_distance(
    before: Float[np.ndarray, "*batch 4 4"], after: Float[np.ndarray, "*batch 4 4"]
) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
    """Rotation angles [deg] and translation distances [mm] between poses."""
    turned = after[..., :3, :3] @ np.swapaxes(before[..., :3, :3], -1, -2)
    # The chord length is accurate for small angles, unlike the arc cosine of the trace.
    chord = np.linalg.norm(turned - np.eye(3), axis=(-2, -1))
    angle = 2.0 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0))
    return np.rad2deg(angle), 1000.0 * np.linalg.norm(after[..., :3, 3] - before[..., :3, 3], axis=-1)
