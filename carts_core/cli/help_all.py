"""All settings of the solvers, as text."""

from typing import get_args

from ..settings import DescentSolver, SequenceSettings, SurfaceSolver
from ..settings.serialization import described
from ..settings.stages import Stage


def settings_reference() -> str:
    """What a settings file can hold, with defaults and meanings."""
    parts = [
        "Settings of `--settings FILE`, in the tables [solver] and [sequence]; --print-settings writes them all.",
        *(described(kind) for kind in (SurfaceSolver, DescentSolver, SequenceSettings)),
        "Stages, each a table of [[solver.stages]] with its name under `stage`:",
        *(described(kind) for kind in get_args(Stage)),
    ]
    return "\n\n".join(parts)
