"""Random fields that textures are made of."""

import cv2
import numpy as np


def smooth_noise(rng: np.random.Generator, width: int, height: int, cells: float, octaves: int = 3) -> np.ndarray:
    """Multi-octave noise, zero mean, about unit deviation [height, width]; `cells` are the coarsest cells per width."""
    noise = np.zeros((height, width), np.float32)
    amplitude = 1.0
    for _ in range(octaves):
        columns = max(int(cells), 2)
        rows = max(int(cells * height / width), 2)
        grid = rng.standard_normal((rows, columns), np.float32)
        noise += amplitude * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        cells *= 2.1
        amplitude *= 0.55
    return (noise - noise.mean()) / (noise.std() + 1e-6)


def grain(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Fine texture of about unit deviation, some pixels wide [height, width, 1]."""
    texture = rng.standard_normal((height, width), np.float32)
    texture = cv2.GaussianBlur(texture, (0, 0), rng.uniform(0.5, 2.0))
    return (texture / (texture.std() + 1e-6))[..., None]
