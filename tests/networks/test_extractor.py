"""Feature extractor, weights files and hybrid images."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from carts_core.errors import WeightsError
from carts_core.networks import FeatureExtractor, hybrid
from carts_core.networks.network import FeatureNetwork
from carts_core.networks.surface import UNetSurface
from carts_core.networks.weights import read_weights, save_weights
from carts_core.settings import Architecture

FORMAT = "carts-feature-network"


def test_what_was_saved_is_what_is_loaded(small_weights: Path, small_network: FeatureNetwork):
    extractor = FeatureExtractor.load(small_weights)
    images = torch.rand(1, 3, 32, 48)
    torch.testing.assert_close(extractor.features(images), small_network.features(images), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(
        extractor.probability(images), small_network.logits(images).sigmoid(), atol=1e-5, rtol=1e-4
    )
    assert extractor.working_size == (320, 240)
    assert extractor.weights["feature"].training == {"step": 3}
    assert (extractor.channels, extractor.stride) == (4, 16)
    assert len(extractor.sha256) == 64


def test_gradients_reach_the_image_and_no_weight(small_weights: Path):
    extractor = FeatureExtractor.load(small_weights)
    images = torch.rand(1, 3, 32, 48, requires_grad=True)
    extractor.features(images).square().sum().backward()
    assert images.grad is not None and images.grad.abs().sum() > 0
    assert all(not parameter.requires_grad for parameter in extractor._features.parameters())


def test_the_gradient_agrees_with_finite_differences(small_weights: Path):
    extractor = FeatureExtractor.load(small_weights)
    extractor._features.double()
    images = torch.rand(1, 3, 16, 16, dtype=torch.float64, requires_grad=True)
    direction = torch.randn_like(images)
    weights = torch.randn(1, 4, 16, 16, dtype=torch.float64)

    def value(image: torch.Tensor) -> torch.Tensor:
        return (extractor.features(image) * weights).sum()

    (gradient,) = torch.autograd.grad(value(images), images)
    step = 1e-6
    numeric = (value(images + step * direction) - value(images - step * direction)) / (2 * step)
    torch.testing.assert_close((gradient * direction).sum(), numeric, rtol=1e-3, atol=1e-6)


def test_missing_weights_name_the_file_and_the_remedy(tmp_path: Path):
    with pytest.raises(WeightsError, match=r"none\.safetensors is missing.*carts train.*reinstall"):
        FeatureExtractor.load(tmp_path / "none.safetensors")


def test_a_file_of_another_kind_is_refused_by_name(tmp_path: Path):
    path = tmp_path / "notes.safetensors"
    path.write_text("these are not weights")
    with pytest.raises(WeightsError, match=r"notes\.safetensors is not a readable safetensors file"):
        FeatureExtractor.load(path)


def test_truncated_weights_are_refused(small_weights: Path):
    small_weights.write_bytes(small_weights.read_bytes()[:-100])
    with pytest.raises(WeightsError, match="not a readable safetensors file"):
        FeatureExtractor.load(small_weights)


def test_safetensors_of_another_program_are_refused_with_what_is_allowed(tmp_path: Path):
    path = tmp_path / "other.safetensors"
    save_file({"x": torch.zeros(3)}, path)
    with pytest.raises(WeightsError, match=f"format None.*allowed: '{FORMAT}', version '1' or "):
        FeatureExtractor.load(path)


def _save(path: Path, network: FeatureNetwork, **metadata: str) -> None:
    known = {
        "format": FORMAT,
        "version": "1",
        "architecture": network.architecture.to_json(),
        "working_size": "[320, 240]",
        "training": "{}",
    }
    save_file(network.state_dict(), path, known | metadata)


def test_weights_of_another_shape_say_which_tensor_differs(small_network: FeatureNetwork, tmp_path: Path):
    path = tmp_path / "wide.safetensors"
    _save(path, small_network, architecture=Architecture().to_json())
    with pytest.raises(WeightsError, match=r"wide\.safetensors does not fit its .*widths=\(12, 24"):
        FeatureExtractor.load(path)


@pytest.mark.parametrize("architecture", ["{}{", '{"depth": [3]}', "[1, 2]", '{"widths": [1]}', '{"widths": ["a"]}'])
def test_unreadable_metadata_is_refused(architecture: str, small_network: FeatureNetwork, tmp_path: Path):
    path = tmp_path / "odd.safetensors"
    _save(path, small_network, architecture=architecture)
    with pytest.raises(WeightsError, match="unreadable metadata"):
        FeatureExtractor.load(path)


def test_a_working_size_that_does_not_fit_is_refused(small_network: FeatureNetwork, tmp_path: Path):
    path = tmp_path / "size.safetensors"
    _save(path, small_network, working_size="[321, 240]")
    with pytest.raises(WeightsError, match=r"\(321, 240\).*multiples of 4"):
        FeatureExtractor.load(path)


def test_weights_that_are_not_finite_are_refused(small_network: FeatureNetwork, tmp_path: Path):
    with torch.no_grad():
        small_network.head.weight.fill_(float("nan"))
    path = tmp_path / "nan.safetensors"
    _save(path, small_network)
    with pytest.raises(WeightsError, match="not finite"):
        read_weights(path)


def test_a_surface_network_takes_the_place_of_the_shipped_one(tmp_path: Path, small_architecture: Architecture):
    torch.manual_seed(2)
    network = UNetSurface(small_architecture).eval()
    save_weights(network, tmp_path / "surface.safetensors", {}, (320, 240))
    extractor = FeatureExtractor.load(tmp_path / "surface.safetensors")
    images, given = torch.rand(1, 3, 32, 48), torch.rand(1, 6, 32, 48)
    torch.testing.assert_close(extractor.surface(images, given), network(images, given).map(), atol=1e-5, rtol=1e-4)
    assert extractor.sha256 != FeatureExtractor.load().sha256


def test_two_files_of_one_kind_are_refused_by_name(small_weights: Path):
    with pytest.raises(WeightsError, match=r"small\.safetensors and .*small\.safetensors both hold a feature network"):
        FeatureExtractor.load(small_weights, small_weights)


def test_a_hybrid_shows_the_rendering_inside_the_silhouette_and_the_background_outside():
    rendering, background = torch.rand(3, 4, 6), torch.rand(3, 4, 6)
    silhouette = torch.zeros(4, 6)
    silhouette[1:3, 2:5] = 1
    rendering = rendering * silhouette
    image = hybrid(rendering, silhouette, background)
    inside = silhouette.bool()
    torch.testing.assert_close(image[:, inside], rendering[:, inside])
    torch.testing.assert_close(image[:, ~inside], background[:, ~inside])


def test_a_point_that_moves_outwards_takes_the_backgrounds_place():
    """Where the silhouette grows by a share, so does the rendering, and the background gives way by that share."""
    silhouette = torch.zeros(1, 1, requires_grad=True)
    tool = 0.9 * torch.ones(3, 1, 1)
    hybrid(tool * silhouette, silhouette, torch.full((3, 1, 1), 0.25)).sum().backward()
    assert silhouette.grad is not None
    torch.testing.assert_close(silhouette.grad, torch.full((1, 1), 3 * (0.9 - 0.25)))
