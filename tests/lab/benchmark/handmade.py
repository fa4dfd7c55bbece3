"""Measurements made by hand."""

from carts_core.lab.benchmark import Measurement, Run, Score, Target, targets
from carts_core.lab.benchmark.statistics import Measurements


def make_measurement(
    dice: tuple[float, ...],
    *,
    method: str = "ours",
    source: str = "synthetic",
    domain: str = "regular",
    frame: int = 0,
    error_deg: float | None = None,
    seconds: float = 1.0,
    stopped: str = "converged",
) -> Measurement:
    """Run whose loss falls as its Dice rises, with `seconds` per step; the last Dice is the result."""
    trace = tuple(
        Score(
            loss=round(1.0 - value, 6),
            dice=value,
            nsd=value,
            joint_mae_deg=0.5,
            visible_joint_mae_deg=None,
            tip_depth_mm=None,
            seconds=place,
        )
        for place, value in ((seconds * (step + 1), value) for step, value in enumerate(dice))
    )
    best = tuple(max(range(place + 1), key=lambda i: dice[i]) for place in range(len(dice)))
    return Measurement(Run(source, domain, frame, method, error_deg), trace[-1], stopped, "a machine", trace, best)


def target_of(start: str, *measurements: Measurement) -> Target:
    """The one target of measurements whose label starts so."""
    (found,) = [target for target in targets(Measurements(measurements)) if target.what.startswith(start)]
    return found
