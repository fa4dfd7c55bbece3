from pathlib import Path

import pytest
import torch

from carts_core.errors import SettingsError, WeightsError
from carts_core.networks import FeatureExtractor
from carts_core.networks.surface import SurfaceNetwork, UNetSurface
from carts_core.networks.weights import read_weights, save_weights
from carts_core.settings import SurfaceArchitecture

SMALL = SurfaceArchitecture(decoder=(4, 8, 8, 8), convolutions=(1, 2, 1, 1), conditioning=(4, 8))


@pytest.fixture(scope="module")
def network() -> SurfaceNetwork:
    torch.manual_seed(0)
    network = SurfaceNetwork(SMALL)
    for _ in range(3):  # running statistics of the batch norms
        network(torch.rand(2, 3, 32, 48), torch.rand(2, 6, 32, 48) / 6)
    return network.eval()


def test_a_size_that_does_not_fit_is_refused_with_the_stride(network: SurfaceNetwork):
    with pytest.raises(SettingsError, match=r"\(1, 3, 30, 48\).*multiples of 16"):
        network(torch.rand(1, 3, 30, 48), torch.rand(1, 6, 30, 48))


def test_a_network_starts_without_the_prior(network: SurfaceNetwork):
    images = torch.rand(1, 3, 32, 48)
    first = SurfaceNetwork(SMALL).eval()
    assert first(images, torch.rand(1, 6, 32, 48)).map().equal(first(images, torch.zeros(1, 6, 32, 48)).map())


def test_folding_batch_norms_changes_nothing_but_the_speed(network: SurfaceNetwork):
    images, prior = torch.rand(2, 3, 32, 48), torch.rand(2, 6, 32, 48) / 6
    folded = network.folded()
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in folded.modules())
    torch.testing.assert_close(folded(images, prior).map(), network(images, prior).map(), atol=1e-5, rtol=1e-4)


def test_weights_are_read_as_written_and_run_by_both_engines(network: SurfaceNetwork, tmp_path: Path):
    path = tmp_path / "surface.safetensors"
    save_weights(network, path, {"step": 3}, (320, 240))
    read = read_weights(path)
    assert (
        isinstance(read.network, SurfaceNetwork) and read.network.architecture == SMALL and read.training["step"] == 3
    )
    images, prior = torch.rand(1, 3, 48, 64), torch.rand(1, 6, 48, 64) / 6
    wanted = network(images, prior).map()
    for engine in ("torch", "onnx"):
        extractor = FeatureExtractor.load(path, inference=engine)
        assert extractor.engine == engine
        torch.testing.assert_close(extractor.surface(images, prior), wanted, atol=1e-4, rtol=1e-3)


def test_weights_of_earlier_versions_are_still_read(small_architecture, tmp_path: Path):
    save_weights(UNetSurface(small_architecture), tmp_path / "old.safetensors", {}, (320, 240))
    assert isinstance(read_weights(tmp_path / "old.safetensors").network, UNetSurface)


def test_an_impossible_architecture_is_refused(network: SurfaceNetwork, tmp_path: Path):
    with pytest.raises(SettingsError, match="four and two channel counts"):
        SurfaceArchitecture(decoder=(4, 4, 4))
    with pytest.raises(SettingsError, match="four counts of 1 to"):
        SurfaceArchitecture(convolutions=(0, 1, 1, 1))
    path = tmp_path / "other.safetensors"
    save_weights(network, path, {}, (320, 240))
    path.write_bytes(path.read_bytes().replace(b"[4, 8, 8, 8]", b"[4, 8, 8, 9]"))
    with pytest.raises(WeightsError, match="does not fit its architecture"):
        read_weights(path)
