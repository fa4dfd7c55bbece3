"""Growing a trained network into a larger one."""

from dataclasses import replace

import pytest
import torch

from carts_core.errors import SettingsError
from carts_core.lab.training.training import grow
from carts_core.networks.network import SurfaceNetwork
from carts_core.settings import Architecture

SMALL = Architecture(widths=(4, 6, 8), encoder_convolutions=(1, 1, 2), decoder_convolutions=(1, 1))


@pytest.fixture
def trained() -> SurfaceNetwork:
    """A network whose batch norms have seen some images."""
    torch.manual_seed(0)
    network = SurfaceNetwork(SMALL)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        for _ in range(5):
            network(torch.rand(4, 3, 32, 32), torch.rand(4, 6, 32, 32))
    return network.eval()


@pytest.mark.parametrize(
    "larger",
    [
        SMALL,
        replace(SMALL, widths=(4, 9, 16)),
        replace(SMALL, encoder_convolutions=(2, 3, 2), decoder_convolutions=(1, 3)),
        replace(SMALL, widths=(5, 7, 9), encoder_convolutions=(1, 2, 3), decoder_convolutions=(2, 2)),
    ],
)
def test_a_grown_network_says_the_same_and_can_learn_everywhere(trained: SurfaceNetwork, larger: Architecture):
    images, given = torch.rand(2, 3, 32, 48), torch.rand(2, 6, 32, 48)
    grown = grow(SurfaceNetwork(larger), trained).eval()
    torch.testing.assert_close(grown(images, given).map(), trained(images, given).map(), atol=1e-5, rtol=1e-4)
    optimizer = torch.optim.SGD(grown.parameters(), 1e-3)
    for _ in range(2):  # weights from new to old channels start at zero and move first
        grown(images, given).map().square().sum().backward()
        optimizer.step()
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in grown.parameters())


@pytest.mark.parametrize(
    ("smaller", "message"),
    [
        (replace(SMALL, widths=(4, 5, 8)), "cannot be embedded in"),
        (replace(SMALL, encoder_convolutions=(1, 1, 1)), "at least as many convolutions"),
    ],
)
def test_a_network_does_not_grow_into_a_smaller_one(trained: SurfaceNetwork, smaller: Architecture, message: str):
    with pytest.raises(SettingsError, match=message):
        grow(SurfaceNetwork(smaller), trained)
