"""The variants of the frame solver that `tools/ablate.py` measures."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from carts_core.settings import SurfaceSolver
from carts_core.settings.stages import (
    AlignEdges,
    Descend,
    Given,
    Observe,
    PreferStart,
    RandomRestart,
    Stage,
)

AS_IS = SurfaceSolver()
"""What variants are compared with."""

_PARTS = {
    "images": ("imaging.haze.", "optimization.observation.", "optimization.counterfactual."),
    "surface": ("optimization.factors.surface.",),
    "edges": ("imaging.haze.", "optimization.factors.edges."),
}
"""Which modules' constants what is shared depends on."""


@dataclass(frozen=True)
class Variant:
    """The solver with one thing left out or changed."""

    name: str
    change: Callable[[SurfaceSolver], SurfaceSolver] = lambda solver: solver
    """Of the settings."""
    constants: Mapping[str, Any] = field(default_factory=dict)
    """Names below `carts_core` -> values."""

    def constants_of(self, part: str) -> str:
        """Those that a part of the computation depends on, as a key."""
        known = {name: value for name, value in self.constants.items() if name.startswith(_PARTS[part])}
        return f"{self.name}: {known}" if known else ""


def _without(*places: int) -> Callable[[SurfaceSolver], SurfaceSolver]:
    """Without the stages at these places."""
    return lambda solver: replace(solver, stages=tuple(s for i, s in enumerate(solver.stages) if i not in places))


def _at(place: int, **fields: Any) -> Callable[[SurfaceSolver], SurfaceSolver]:
    """With other fields of the stage at one place."""

    def change(solver: SurfaceSolver) -> SurfaceSolver:
        stages = list(solver.stages)
        stages[place] = replace(stages[place], **fields)
        return replace(solver, stages=tuple(stages))

    return change


def _every(kind: type[Stage], **fields: Any) -> Callable[[SurfaceSolver], SurfaceSolver]:
    """With other fields of all stages of a kind."""
    return lambda solver: replace(
        solver, stages=tuple(replace(s, **fields) if isinstance(s, kind) else s for s in solver.stages)
    )


def _settings(**fields: Any) -> Callable[[SurfaceSolver], SurfaceSolver]:
    return lambda solver: replace(solver, **fields)


def _places(kind: type[Stage]) -> list[int]:
    return [i for i, stage in enumerate(AS_IS.stages) if isinstance(stage, kind)]


_OBSERVE, _DESCEND, _EDGES = _places(Observe), _places(Descend), _places(AlignEdges)
(_RESTART,), (_START,) = _places(RandomRestart), _places(PreferStart)


def _tolerance(solver: SurfaceSolver) -> SurfaceSolver:
    return _every(Descend, tolerance=Descend.tolerance)(solver)


def _clear(through: torch.Tensor) -> torch.Tensor:
    return torch.ones_like(through)


VARIANTS = (
    Variant("as it is"),
    Variant("no small first image", _without(_OBSERVE[0], _DESCEND[0])),
    Variant("first image at 1.5", _at(_OBSERVE[0], scale=1.5)),
    Variant("second image conditioned on the estimate", _at(_OBSERVE[1], given=Given.ESTIMATE)),
    Variant("no second image", _without(_OBSERVE[1], _DESCEND[1])),
    Variant("tolerance 0.01 everywhere", _tolerance),
    Variant("no Descend(3) on the third image", _without(_DESCEND[2])),
    Variant("no Descend(1.6) on the third image", _without(_DESCEND[3])),
    Variant("no third image", _without(_OBSERVE[2], *_DESCEND[2:4])),
    Variant("Descend.steps 12", _every(Descend, steps=12)),
    Variant("no RandomRestart", _without(_RESTART)),
    Variant("RandomRestart.candidates 32", _at(_RESTART, candidates=32)),
    Variant("RandomRestart.deviation 1", _at(_RESTART, deviation=1.0)),
    Variant("RandomRestart.if_loss 0.03", _at(_RESTART, if_loss=0.03)),
    Variant("arms are never lost", constants={"optimization.stages.arm_is_lost": lambda *_: False}),
    Variant("_SUPPORT 0", constants={"optimization.stages._SUPPORT": 0.0}),
    Variant("_LEFT 0", constants={"optimization.observation.HAS_LEFT": 0.0}),
    Variant("no AlignEdges between", _without(_EDGES[0])),
    Variant("no AlignEdges at the end", _without(_EDGES[1])),
    Variant("no AlignEdges", _without(*_EDGES)),
    Variant("no fourth image", _without(_OBSERVE[3], _EDGES[0])),
    Variant("no PreferStart", _without(_START)),
    Variant("PreferStart.ratio off", _at(_START, ratio=100.0)),
    Variant("PreferStart.overlap off", _at(_START, overlap=0.0)),
    Variant("no weight for haze", _every(Observe, haze=False)),
    Variant("no weight for haze but at the end", _at(_OBSERVE[2], haze=False)),
    Variant("weight for haze at first, too", _every(Observe, haze=True)),
    Variant("transmission squared", constants={"optimization.observation.certainty": lambda through: through}),
    Variant("no weight for haze at edges", constants={"optimization.factors.edges.certainty": _clear}),
    Variant("dehaze 0", _settings(dehaze=0.0)),
    Variant("dehaze 1", _settings(dehaze=1.0)),
    Variant("parts_weight 0", _settings(parts_weight=0.0)),
    Variant("normals_weight 0", _settings(normals_weight=0.0)),
    Variant("parts_weight and normals_weight 0", _settings(parts_weight=0.0, normals_weight=0.0)),
    Variant("normals_weight 0.1", _settings(normals_weight=0.1)),
    Variant("noise 2.66", _settings(noise=2.66)),
    Variant("noise 1", _settings(noise=1.0)),
    Variant("prior_deg 3.75", _settings(prior_deg=3.75)),
    Variant("_SHARE 1", constants={"optimization.factors.edges._SHARE": (1.0, 1.0, 1.0)}),
    Variant("_LIKELY off", constants={"optimization.factors.edges._LIKELY": math.inf}),
    Variant("_BLUR 0", constants={"optimization.factors.edges._BLUR": 0.0}),
    Variant("_RENDERED_ANEW off", constants={"optimization.factors.edges._RENDERED_ANEW": math.inf}),
    Variant("_ROBUST of edges off", constants={"optimization.factors.edges._ROBUST": math.inf}),
    Variant("_STILL 0", constants={"optimization.factors.edges._STILL": 0.0}),
    Variant("longest step of descents off", constants={"optimization.solvers._LONGEST_STEP": math.inf}),
    Variant("damping off", constants={"optimization.solvers._FIRST_DAMPING": 1e-4}),
    Variant("_LEAST transmission 0.1", constants={"imaging.haze._LEAST": 0.1}),
    Variant("haze at full size", constants={"imaging.haze._COARSER": 1}),
    Variant("coarsest comparison 4", constants={"optimization.factors.surface._REDUCTIONS": (1, 2, 4)}),
)
