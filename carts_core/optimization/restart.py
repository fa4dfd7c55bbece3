"""Where a look says that it began at a bad place: another one, from elsewhere."""

from jaxtyping import Float
from torch import Tensor

from ..settings import OptimizerSettings
from .evaluation import Objective, Solver
from .gauss_newton import GaussNewton
from .surface_objective import SurfaceObjective

_DOUBTFUL = 0.03
"""Loss from which the end of a later look is in doubt [1]."""


class Restart:
    """Goes on from better offsets: after a first look (a glance is none) that ended badly or lost an arm, and before
    the last look where those before it ended doubtfully and an arm fits better further along its shaft. Each once at
    most.

    For Gauss-Newton on the surface objective; any other descent goes on as it was.

    Attributes:
        number: of restarts so far.
    """

    def __init__(self, settings: OptimizerSettings, objective: Objective, solver: Solver) -> None:
        self.number = 0
        self._settings = settings
        self._objective = objective if isinstance(objective, SurfaceObjective) else None
        self._solver = solver if isinstance(solver, GaussNewton) else None
        self._searched = self._slid = settings.candidates == 0

    def __call__(self, stage: int, offsets: Float[Tensor, " n"], loss: float) -> Float[Tensor, " n"]:
        """The offsets to go on from.

        Args:
            stage: that was just evaluated; the solver has moved on.
            offsets: where the solver wants to go on.
            loss: that the stage has reached.
        """
        objective, solver = self._objective, self._solver
        if objective is None or solver is None or solver.finished is not None:
            return offsets
        look, first = objective.look(stage), objective.first_look
        if look == objective.look(solver.stage):
            return offsets
        if look == first and not self._searched and (loss >= self._settings.bad_loss or objective.lost(offsets)):
            self._searched = True
            return self._from(0, objective.better_start(offsets, self._settings.candidates), solver)
        if look > first and solver.stage == objective.stages - 1 and not self._slid and loss >= _DOUBTFUL:
            self._slid = True
            slid = objective.slid(offsets)
            if slid is not offsets:
                second = next(index for index in range(objective.stages) if objective.look(index) > first)
                return self._from(second, slid, solver)
        return offsets

    def _from(self, stage: int, offsets: Tensor, solver: GaussNewton) -> Tensor:
        self.number += 1
        solver.restart(stage)
        return offsets
