"""What is said of how well unknowns are known."""

import numpy as np
import pytest
import torch
from tiny import tiny_scene

from carts_core.model.robot import Robot
from carts_core.optimization import FreeParameters
from carts_core.optimization.factors import Prior
from carts_core.optimization.observability import Uncertainty, expected_scale, uncertainty_after
from carts_core.optimization.variables import Variables


@pytest.fixture(scope="module")
def variables(shipped_psm: Robot) -> Variables:
    """Those of two arms' joints."""
    scene = tiny_scene(shipped_psm, 2, ("left",), 96, 72).scene
    q = np.array([0.1, 0.2, 0.15, 0.0, 0.1, -0.1, 0.3])
    return Variables(scene, scene.state({arm.name: q for arm in scene.arms}), FreeParameters(), 0.15)


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


def test_errors_lie_within_the_deviations_however_far_off_the_start_was(variables: Variables) -> None:
    generator = torch.Generator().manual_seed(7)
    joints, expected, start_share = len(variables.names), 0.04, 0.1
    precision = torch.eye(joints, dtype=torch.float64) / expected**2
    prior = Prior(torch.zeros(joints), precision.float())

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    sizes, errors, deviations = [], [], []
    for _ in range(1500):
        # Some directions are shown well, some no better than they are expected.
        J = torch.logspace(0, 2, joints, dtype=torch.float64)[:, None] * random(joints, joints) / expected
        information = J.T @ J
        size = float((0.5 * (random() - 0.5)).exp())
        away, noise = size * expected * random(joints), J.T @ random(joints)
        moved = torch.linalg.solve(information + precision, (1 - start_share) * information @ -away + noise)
        curvature = (information + precision).float()
        known = uncertainty_after(variables, prior, curvature, torch.zeros(joints), moved.float(), start_share)
        sizes.append(size)
        errors.append((moved + away).abs() * variables.scales)
        deviations.append(torch.tensor(known.std))
    reported, size = torch.stack(deviations), torch.tensor(sizes)
    share, wide = torch.stack(errors) / reported, reported[:, 0] > reported[:, 0].median()
    assert size[wide].mean() > 1.2 * size[~wide].mean(), "starts that are further off have wider deviations"
    for frames in (wide, ~wide):
        assert 0.64 < (share[frames] < 1).double().mean() < 0.73
        assert 0.93 < (share[frames] < 2).double().mean() < 0.97


def test_a_joint_that_the_image_determines_stays_determined_where_all_errors_turn_out_small() -> None:
    before = Uncertainty(("PSM1/yaw", "PSM1/jaw"), (0.01, 0.039), (0.04, 0.04))
    after = before.rescaled(Uncertainty(before.names, (0.008, 0.0149), (0.015, 0.015)))
    assert after.std == (0.008, 0.0149)
    assert [after.observability(name) for name in after.names] == ["determined", "not visible"]
    assert [after.doubted(0.5).observability(name) for name in after.names] == ["weak", "not visible"]
