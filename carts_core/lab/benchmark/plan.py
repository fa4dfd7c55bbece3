"""Every run of a benchmark, in the order in which it is done."""

from collections.abc import Sequence as Items
from itertools import product

from ...settings import DOMAINS
from .crossing import CROSSING
from .methods import MAIN, METHODS, RENDERING
from .occlusion import OCCLUSION
from .scope import FAMILY, REAL, ROOMS, SYNTHETIC, Run, Scope
from .sources import Source
from .wrong_inputs import wrong_inputs

_UNDER_OCCLUDERS = ("ours", "ours_given", "ours_proposed")


def plan(scope: Scope, sources: Items[Source], baselines: Items[str] = ()) -> list[Run]:
    """All runs, frame after frame, so that a benchmark that was stopped has measured some of everything.

    Frames on which not all methods are evaluated come after that, then frames that are corrected together, other rooms,
    and instruments that no training has last.

    Args:
        scope: how much is measured.
        sources: where frames come from.
        baselines: names in `methods.BASELINES` whose weights are given.
    """
    rooms, families = ([s for s in sources if s.name.startswith(kind)] for kind in (ROOMS, FAMILY))
    sources = [source for source in sources if source not in (*rooms, *families)]
    runs: list[Run] = []
    for turn in range(max((len(source.frames) for source in sources), default=0)):
        for source in sources:
            if turn < len(source.frames):
                runs += _runs_of_frame(scope, source, source.frames[turn], baselines)
    for source in sources:
        for frame in source.further:
            runs += _runs_of_further_frame(scope, source, frame)
    together = [name for name, method in METHODS.items() if method.together]
    runs += [
        Run(source.name, domain, frame, method, error)
        for source in sources
        for error in (None, *(scope.consecutive_errors_deg if source.name == SYNTHETIC else ()))
        for domain in scope.consecutive_domains
        for method in together
        for frame in source.consecutive
    ]
    runs += [run for source in rooms for run in _runs_in_rooms(source)]
    return runs + [
        Run(source.name, domain, frame, "ours", error)
        for source in families
        for frame in source.frames
        for domain in source.domains
        for error in scope.hard_errors_deg
    ]


def _runs_in_rooms(source: Source) -> list[Run]:
    return [
        Run(source.name, room, frame, method)
        for room in source.rooms
        for method, frames in (("ours", source.frames), ("acs", source.frames), ("sequence", source.consecutive))
        for frame in frames
    ]


def _runs_of_frame(scope: Scope, source: Source, frame: int, baselines: Items[str]) -> list[Run]:
    runs = [Run(source.name, domain, frame, method) for domain in DOMAINS for method in (*MAIN, RENDERING, *baselines)]
    if source.name == SYNTHETIC:
        domains, ours, papers, hard = (
            scope.error_domains,
            scope.errors_deg,
            scope.paper_errors_deg,
            scope.hard_errors_deg,
        )
    else:
        domains, ours, papers, hard = ("regular",), scope.real_errors_deg, scope.real_errors_deg, ()
    runs += [Run(source.name, domain, frame, "ours", error) for error in ours for domain in domains]
    runs += [Run(source.name, "regular", frame, "paper", error) for error in papers]
    if source.name == SYNTHETIC:
        crossing = product(scope.crossing_errors_deg, ("ours", "acs"))
        runs += [Run(source.name, CROSSING, frame, method, error) for error, method in crossing]
    wrong = wrong_inputs(source.length, len(source.cameras), built_in=source.name == SYNTHETIC)
    runs += [Run(source.name, kind, frame, "ours") for kind in wrong]
    for error in (None, *hard):
        runs += [Run(source.name, "regular", frame, "masks", error)]
        runs += [Run(source.name, OCCLUSION, frame, method, error) for method in _UNDER_OCCLUDERS]
        if len(source.cameras) > 1:
            runs += [Run(source.name, "regular", frame, method, error) for method in ("stereo", "stereo_posed")]
    if source.name == REAL:
        runs += [Run(source.name, "regular", frame, method) for method, entry in METHODS.items() if entry.calibrated]
    return runs


def _runs_of_further_frame(scope: Scope, source: Source, frame: int) -> list[Run]:
    if source.name == REAL:
        # One calibration serves the whole recording, and scoring it costs next to nothing.
        return [Run(source.name, "regular", frame, "calibrated")]
    return [
        Run(source.name, domain, frame, "ours", error)
        for error in scope.further_errors_deg
        for domain in scope.error_domains
    ]
