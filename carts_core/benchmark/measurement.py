"""What a run measured, and its line in the results file."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from .plan import Run


@dataclass(frozen=True)
class Score:
    """How good one estimate is."""

    loss: float | None
    """None for a method without one."""
    dice: float
    nsd: float
    """Normalized surface distance within `frame.TOLERANCE`."""
    joint_mae_deg: float | None
    """Over measured revolute joints; None without true joint positions."""
    visible_joint_mae_deg: float | None
    """The same over those that the image determines; None where the optimizer does not report which."""
    seconds: float
    """Wall time from the frame's arrival until this estimate was known [s]; scoring does not count."""


@dataclass(frozen=True)
class Measurement:
    """One run's result."""

    run: Run
    final: Score
    """Of what the method returns."""
    trace: tuple[Score, ...]
    """Of every iterate, the start first; empty for a method without iterates."""
    stopped: str
    """Why the optimization ended."""
    machine: str
    """What it ran on, for people."""

    @property
    def start(self) -> Score | None:
        """The score before anything is corrected; None where the method has no start."""
        return self.trace[0] if self.trace else None

    @property
    def iterations(self) -> int:
        """Number of steps."""
        return max(len(self.trace) - 1, 0)

    @property
    def made_worse(self) -> bool:
        """Whether Dice fell by more than 0.01."""
        return self.start is not None and self.final.dice < self.start.dice - 0.01

    def best_of(self, iterations: int) -> Score | None:
        """The iterate of the lowest loss among the first so many steps; None where the run was cut before them.

        Its `seconds` are those of all these steps, since the lowest loss is only known after them.
        """
        if not self.trace or (iterations > self.iterations and self.stopped == "iterations"):
            return None
        within = self.trace[: iterations + 1]
        best = min(within, key=lambda score: float("inf") if score.loss is None else score.loss)
        return Score(**{**asdict(best), "seconds": within[-1].seconds})

    def best_so_far(self) -> list[Score]:
        """For each iterate, the one of the lowest loss until then."""
        best: list[Score] = []
        for score in self.trace:
            better = not best or (score.loss is not None and best[-1].loss is not None and score.loss < best[-1].loss)
            best.append(score if better else best[-1])
        return best

    def to_json(self) -> dict[str, Any]:
        """The measurement without what identifies its settings; lists by column keep the line short."""
        names = [field.name for field in fields(Score)]
        return {
            "run": asdict(self.run),
            "final": _rounded(asdict(self.final)),
            "trace": {name: [_round(getattr(score, name)) for score in self.trace] for name in names},
            "stopped": self.stopped,
            "machine": self.machine,
        }

    @staticmethod
    def from_json(line: Mapping[str, Any]) -> "Measurement":
        """The measurement that `to_json` wrote.

        Raises:
            KeyError, TypeError, ValueError: it is not one.
        """
        names = [field.name for field in fields(Score)]
        rows = zip(*(line["trace"][name] for name in names), strict=True)
        return Measurement(
            run=Run(**line["run"]),
            final=Score(**line["final"]),
            trace=tuple(Score(**dict(zip(names, row, strict=True))) for row in rows),
            stopped=line["stopped"],
            machine=line["machine"],
        )


def _round(value: float | None) -> float | None:
    return None if value is None else round(value, 6)


def _rounded(values: dict[str, float | None]) -> dict[str, float | None]:
    return {name: _round(value) for name, value in values.items()}
