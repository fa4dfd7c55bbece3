"""What the engines have in common: they take jobs and yield what came of each."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from .manifest import Job

ATTEMPTS = 5
"""How often a job is begun whose worker dies, before it counts as failed."""


@dataclass(frozen=True)
class Outcome:
    """What came of a job."""

    job: str
    status: Literal["done", "known", "busy", "failed", "stopped"]
    """`known`: it was done before; `busy`: another process runs it."""
    error: str = ""
    seconds: float = 0.0


Work = Callable[[Job], Outcome]
"""Does a job; what people should know of a failure is in the outcome."""


def lost(job: Job) -> Outcome:
    """Of a job whose worker died every time, with no word."""
    return Outcome(job.name, "failed", f"its worker died {ATTEMPTS} times; the machine may lack memory (see its log)")
