"""Smooth random fields: the raw material of tissue, blood and smoke."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


def smooth_noise(
    shape: Sequence[int], wavelength: float, rng: np.random.Generator, *, octaves: int = 1, gain: float = 0.5
) -> Float[np.ndarray, "..."]:
    """Periodic noise of zero mean and unit variance in any number of dimensions, filtered in the Fourier domain.

    Args:
        shape: size of the field, in samples per dimension.
        wavelength: typical distance between neighbouring crests of the first octave [samples].
        rng: source of randomness.
        octaves: how many bands are added, each of half the wavelength of the one before.
        gain: amplitude of each band relative to the one before.
    """
    spectrum = np.fft.rfftn(rng.standard_normal(shape).astype(np.float32))
    axes = [np.fft.fftfreq(n) for n in shape[:-1]] + [np.fft.rfftfreq(shape[-1])]
    frequency = np.sqrt(sum(axis**2 for axis in np.meshgrid(*axes, indexing="ij", sparse=True)))
    response = np.zeros_like(frequency)
    for octave in range(octaves):
        # Each band has the same energy whatever its wavelength: the number of modes in it grows as f^dimensions.
        center = 2.0**octave / wavelength
        band = np.exp(-0.5 * ((frequency - center) / (0.35 * center)) ** 2)
        energy = np.sqrt((band**2).sum())
        if energy > 0:
            response += gain**octave * band / energy
    response.flat[0] = 0.0
    field = np.fft.irfftn(spectrum * response, s=tuple(shape), axes=tuple(range(len(shape)))).astype(np.float32)
    deviation = float(field.std())
    return field / deviation if deviation > 0 else field


def smoothstep(value: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 below `low`, 1 above `high`, and a curve without corners between them."""
    x = np.clip((value - low) / (high - low), 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)
