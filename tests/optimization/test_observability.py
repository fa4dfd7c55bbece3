"""What is said of how well unknowns are known."""

import numpy as np
import torch

from carts_core.optimization.observability import Uncertainty, expected_scale


def test_errors_turn_out_as_large_as_what_the_image_has_corrected() -> None:
    generator = np.random.default_rng(3)
    expected, count = 0.04, 400
    prior = torch.eye(count) / expected**2
    # The image determines two of three unknowns, each as well as it likes, and says nothing of the others.
    information = torch.diag(torch.tensor(([1e6, 2e4, 0.0] * count)[:count]))
    for size in (0.3, 1.0, 2.0):
        truth = size * expected * generator.standard_normal(count)
        noise = generator.standard_normal(count) * information.diagonal().clamp(min=1.0).rsqrt().numpy()
        pull = information @ torch.from_numpy(truth + noise * (information.diagonal() > 0).numpy()).float()
        moved = torch.linalg.solve(information + prior, pull)
        assert abs(expected_scale(moved, information, prior) - size) < 0.2 * size


def test_an_image_that_determines_nothing_leaves_errors_as_large_as_expected() -> None:
    nothing, prior = torch.zeros(7), torch.eye(7) / 0.04**2
    assert expected_scale(nothing, torch.zeros(7, 7), prior) == 1.0


def test_a_joint_that_the_image_determines_stays_determined_where_all_errors_turn_out_small() -> None:
    before = Uncertainty(("PSM1/yaw", "PSM1/jaw"), (0.01, 0.039), (0.04, 0.04))
    after = before.scaled(Uncertainty(before.names, (0.008, 0.0149), (0.015, 0.015)))
    assert after.std == (0.008, 0.0149)
    assert [after.observability(name) for name in after.names] == ["determined", "not visible"]
    assert [after.doubted(0.5).observability(name) for name in after.names] == ["weak", "not visible"]
