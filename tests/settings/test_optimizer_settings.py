"""Settings of the optimizer."""

import pytest

from carts_core.errors import SettingsError
from carts_core.settings import OptimizerSettings


def test_gauss_newton_refuses_a_loss_without_residuals() -> None:
    with pytest.raises(SettingsError, match="solver is 'gauss_newton'; allowed is auto, adam, gradient_descent or"):
        OptimizerSettings(loss="acs", solver="gauss_newton")


def test_a_solver_that_is_not_chosen_follows_the_loss() -> None:
    assert OptimizerSettings().chosen_solver == "gauss_newton"
    assert OptimizerSettings(loss="l1").chosen_solver == "adam"
    assert OptimizerSettings(loss="l1", solver="gradient_descent").chosen_solver == "gradient_descent"
    chosen = OptimizerSettings(solver="gauss_newton").with_loss("acs")
    assert chosen.chosen_solver == "adam" and chosen.with_loss("surface").chosen_solver == "gauss_newton"
    assert OptimizerSettings(solver="none").with_loss("acs").chosen_solver == "none"
    assert OptimizerSettings().resolved() == OptimizerSettings(solver="gauss_newton"), "what is kept of a run"
