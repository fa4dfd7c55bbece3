"""Small network for tests."""

from pathlib import Path

import pytest
import torch

from carts_core.networks.network import FeatureNetwork
from carts_core.networks.weights import save_weights
from carts_core.settings import Architecture


@pytest.fixture(scope="session")
def small_architecture() -> Architecture:
    return Architecture(widths=(4, 6, 8), encoder_convolutions=(1, 1, 1), decoder_convolutions=(1, 1))


@pytest.fixture
def small_network(small_architecture: Architecture) -> FeatureNetwork:
    """Random weights, and batch norms with nontrivial statistics, so that folding has an effect."""
    torch.manual_seed(1)
    network = FeatureNetwork(small_architecture)
    with torch.no_grad():
        for _ in range(5):
            network(torch.rand(4, 3, 32, 48))
    return network.eval()


@pytest.fixture
def small_weights(small_network: FeatureNetwork, tmp_path: Path) -> Path:
    path = tmp_path / "small.safetensors"
    save_weights(small_network, path, {"step": 3}, (320, 240))
    return path
