import pytest
import torch

from carts_core.errors import SettingsError
from carts_core.networks.network import FeatureNetwork, standardize
from carts_core.settings import Architecture


def test_any_multiple_of_the_stride_is_a_valid_size():
    network = FeatureNetwork().eval()
    assert network.architecture.stride == 16
    for height, width in ((16, 16), (48, 112), (240, 320)):
        assert network.features(torch.rand(1, 3, height, width)).shape[-2:] == (height, width)


def test_a_size_that_does_not_fit_is_refused_with_the_stride(small_network: FeatureNetwork):
    with pytest.raises(SettingsError, match=r"\(1, 3, 30, 48\).*multiples of 4"):
        small_network.features(torch.rand(1, 3, 30, 48))


def test_folding_batch_norms_changes_nothing_but_the_speed(small_network: FeatureNetwork):
    images = torch.rand(2, 3, 32, 48)
    folded = small_network.folded()
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in folded.modules())
    torch.testing.assert_close(folded.features(images), small_network.features(images), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("block", [None, 4])
def test_exposure_and_a_uniform_veil_do_not_reach_the_first_convolution(block: int | None):
    image = torch.rand(1, 3, 16, 16)
    veiled = 0.5 * image + torch.tensor([0.3, 0.2, 0.1])[None, :, None, None]
    torch.testing.assert_close(standardize(veiled, block), standardize(image, block), atol=2e-2, rtol=2e-2)


def test_a_slope_of_brightness_disappears_with_the_local_mean_only():
    texture = torch.rand(1, 3, 64, 64)
    sloping = 0.5 * texture + torch.linspace(0, 0.5, 64)
    middle = (..., slice(16, 48), slice(16, 48))

    def change(block: int | None) -> float:
        return float((standardize(sloping, block) - standardize(texture, block))[middle].abs().mean())

    assert change(4) < 0.1 * change(None)


def test_a_loss_of_contrast_in_a_part_disappears_with_the_local_contrast_only():
    texture = torch.rand(1, 3, 96, 96, generator=torch.Generator().manual_seed(0)) - 0.5
    dull = texture * torch.linspace(0.2, 1.0, 96)
    middle = (..., slice(16, 80), slice(16, 80))

    def change(local_contrast: float) -> float:
        return float(
            (standardize(dull, 4, local_contrast) - standardize(texture, 4, local_contrast))[middle].abs().mean()
        )

    assert change(1.0) < 0.5 * change(0.7) < 0.5 * change(0.0)


def test_an_empty_image_is_not_amplified_to_noise():
    flat = torch.full((1, 3, 16, 16), 0.4) + 1e-4 * torch.randn(1, 3, 16, 16)
    assert standardize(flat, 4).abs().max() < 0.05
    assert standardize(flat, 4, 1.0).abs().max() < 0.05


def test_weights_from_before_local_contrast_have_none():
    older = Architecture().to_json().replace(', "local_contrast": 0.0', "")
    assert "local_contrast" not in older
    assert Architecture.from_json(older) == Architecture()


@pytest.mark.parametrize(
    "arguments",
    [
        {"widths": (8,)},
        {"widths": (8, 0)},
        {"encoder_convolutions": (1,)},
        {"decoder_convolutions": (1, 1, 1, 0)},
        {"local_contrast": 1.5},
        {"local_contrast": 0.5, "local_mean": False},
    ],
)
def test_an_impossible_architecture_is_refused(arguments: dict):
    with pytest.raises(SettingsError, match="give"):
        Architecture(**arguments)
