"""A second first look, where the first one says that the start was bad."""

from jaxtyping import Float
from torch import Tensor

from .evaluation import Objective, Solver
from .gauss_newton import GaussNewton
from .settings import OptimizerSettings
from .surface_objective import SurfaceObjective


class Restart:
    """Starts a descent again from better offsets, once at most, after a first look that ended badly or lost an arm.

    For Gauss-Newton on the surface objective; any other descent goes on as it was.
    """

    def __init__(self, settings: OptimizerSettings, objective: Objective, solver: Solver) -> None:
        self._settings = settings
        self._objective = objective if isinstance(objective, SurfaceObjective) else None
        self._solver = solver if isinstance(solver, GaussNewton) else None
        self.done = settings.candidates == 0

    def __call__(self, stage: int, offsets: Float[Tensor, " n"], loss: float) -> Float[Tensor, " n"]:
        """The offsets to go on from.

        Args:
            stage: that was just evaluated; the solver has moved on.
            offsets: where the solver wants to go on.
            loss: lowest of the stage.
        """
        objective, solver = self._objective, self._solver
        if self.done or objective is None or solver is None or solver.finished is not None:
            return offsets
        if objective.look(stage) > 0 or objective.look(solver.stage) == 0:
            return offsets
        if loss < self._settings.bad_loss and not objective.lost(offsets):
            return offsets
        self.done = True
        solver.restart()
        return objective.better_start(offsets, self._settings.candidates)
