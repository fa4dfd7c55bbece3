"""What the encoders report instead of the truth."""

import numpy as np
from jaxtyping import Float

from ...errors import SettingsError
from ...settings import MeasurementError


def measure(
    truth: Float[np.ndarray, "frames dofs"],
    times: Float[np.ndarray, " frames"],
    error: MeasurementError,
    rng: np.random.Generator,
) -> Float[np.ndarray, "frames dofs"]:
    """Measured joint positions T_m = T + bias + drift(t) + noise(t), [rad] or [m] per joint as in `truth`.

    Raises:
        SettingsError: the error does not have one value per joint, or one more: that of jaws, which some tools lack.
    """
    dofs = truth.shape[-1]
    if len(error.bias) not in (dofs, dofs + 1):
        raise SettingsError(f"MeasurementError has {len(error.bias)} values per kind, but the robot has {dofs} joints.")
    bias = np.asarray(error.bias[:dofs]) * rng.choice([-1.0, 1.0], dofs) * rng.uniform(0.6, 1.2, dofs)
    periods = error.drift_period * rng.uniform(0.6, 1.6, (2, dofs))
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, dofs))
    waves = np.sin(2.0 * np.pi * times[:, None, None] / periods + phases).mean(axis=1)
    noise = rng.standard_normal(truth.shape) * np.asarray(error.noise[:dofs])
    return truth + bias + np.asarray(error.drift[:dofs]) * waves + noise
