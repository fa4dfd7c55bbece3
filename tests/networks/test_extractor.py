"""Feature extractor, weights files and hybrid images."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from carts_core.errors import WeightsError
from carts_core.networks import FeatureExtractor, hybrid
from carts_core.networks.network import FeatureNetwork
from carts_core.networks.surface import UNetSurface
from carts_core.networks.weights import save_weights
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


def _saved(weight: float | None = None, **metadata: str) -> Callable[[Path, FeatureNetwork], object]:
    """Writes the network with other metadata, or with this weight in its head."""

    def write(path: Path, network: FeatureNetwork) -> None:
        architecture = network.architecture.to_json()
        known = {"format": FORMAT, "version": "1", "architecture": architecture, "working_size": "[320, 240]"}
        if weight is not None:
            torch.nn.init.constant_(network.head.weight, weight)
        save_file(network.state_dict(), path, {**known, "training": "{}", **metadata})

    return write


def _cut(path: Path, network: FeatureNetwork) -> None:
    save_weights(network, path, {}, (320, 240))
    path.write_bytes(path.read_bytes()[:-100])


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path, network: None, r"x\.safetensors is missing.*carts train.*reinstall"),
        (lambda path, network: path.write_text("no weights"), r"x\.safetensors is not a readable safetensors file"),
        (_cut, "not a readable safetensors file"),
        (lambda path, network: save_file({"x": torch.zeros(3)}, path), f"format None.*'{FORMAT}', version '1' or "),
        (_saved(architecture=Architecture().to_json()), r"x\.safetensors does not fit its .*widths=\(12, 24"),
        (_saved(architecture="{}{"), "unreadable metadata"),
        (_saved(architecture='{"widths": ["a"]}'), "unreadable metadata"),
        (_saved(working_size="[321, 240]"), r"\(321, 240\).*multiples of 4"),
        (_saved(weight=float("nan")), "not finite"),
    ],
)
def test_files_that_are_no_weights_are_refused_in_words(
    small_network: FeatureNetwork, tmp_path: Path, write: Callable[[Path, FeatureNetwork], object], message: str
):
    write(tmp_path / "x.safetensors", small_network)
    with pytest.raises(WeightsError, match=message):
        FeatureExtractor.load(tmp_path / "x.safetensors")


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
