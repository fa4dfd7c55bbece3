"""Small settings, small tissues and one small synthetic sequence for the tests of this folder."""

from pathlib import Path

import numpy as np
import pytest

from carts_core.lab.synthesis import (
    EndoscopeConfig,
    MotionConfig,
    RenderConfig,
    SensorConfig,
    SynthesisConfig,
    synthesize,
)
from carts_core.lab.synthesis.scene import Tissue


@pytest.fixture(scope="session")
def small_config() -> SynthesisConfig:
    """Two frames of 96x72 pixels, both cameras."""
    return SynthesisConfig(
        seed=3,
        endoscope=EndoscopeConfig(width=96, height=72, stereo=True),
        motion=MotionConfig(frames=2, frame_rate=2.0),
        render=RenderConfig(samples=2, tissue_resolution=96, texture_resolution=256),
        sensor=SensorConfig(jpeg_quality=95),
    )


@pytest.fixture(scope="session")
def small_sequence(small_config: SynthesisConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sequence file of `small_config`, all domains."""
    return synthesize(small_config, tmp_path_factory.mktemp("synthetic") / "sequence")


@pytest.fixture(scope="session")
def flat_tissue() -> Tissue:
    """A grey plane at z = 0."""
    return Tissue(
        heights=np.zeros((32, 32), np.float32),
        albedo=np.full((64, 64, 3), 0.4, np.float32),
        roughness=np.full((64, 64), 0.6, np.float32),
    )
