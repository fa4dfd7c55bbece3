"""What an image said of a frame's fit when it was last assessed."""

from dataclasses import dataclass

from ..errors import ProjectError
from .values import JsonValue

VERDICTS = ("good", "doubtful", "failed")
"""As `carts_core.optimization.Verdict` has them."""
LONGEST_TEXT = 2_000
"""Characters."""


@dataclass(frozen=True)
class FitVerdict(JsonValue):
    """How far a frame's fit can be relied on; see `ProjectState.verdict` for how long it holds.

    Raises:
        ProjectError: there is no such verdict, a text is too long, or the probability is none.
    """

    verdict: str
    """One of `VERDICTS`."""
    reason: str = ""
    """For people."""
    remedy: str = ""
    """What to try, for people; empty where nothing has to be."""
    failure: float = 0.0
    """Probability that the mask is wrong (Dice below 0.9) [1]."""
    cameras: tuple[tuple[str, float], ...] = ()
    """The same in single cameras, by their names, where there are several."""

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise ProjectError(f"a verdict is {self.verdict!r}, but must be one of: {', '.join(VERDICTS)}.")
        for text in (self.reason, self.remedy):
            if not isinstance(text, str) or len(text) > LONGEST_TEXT:
                raise ProjectError(f"reason and remedy must be texts of at most {LONGEST_TEXT} characters. Shorten it.")
        object.__setattr__(self, "cameras", tuple((str(name), value) for name, value in self.cameras))
        for value in (self.failure, *(value for _, value in self.cameras)):
            if not (isinstance(value, float | int) and 0.0 <= value <= 1.0):
                raise ProjectError(f"the probability of a failure is {value!r}. Give a number from 0 to 1.")
