"""Jobs: what takes long, one after the other."""

from dataclasses import dataclass
from typing import Literal

from carts_viewer.intents.base import Intent

Frames = Literal["found", "unreviewed", "range", "all"]


@dataclass(frozen=True)
class Jobs(Intent):
    """An intent about what takes long."""


@dataclass(frozen=True)
class OptimizeFrames(Jobs):
    """Run the optimizer on many frames, each alone, from where it is."""

    frames: Frames = "unreviewed"
    """Those that the filter finds, those that nobody has judged, those in the chosen range, or all."""


@dataclass(frozen=True)
class Calibrate(Jobs):
    """Fit base frames, and cameras if somebody frees them, to some frames of the sequence together."""

    frames: int = 20
    """How many, spread evenly."""


@dataclass(frozen=True)
class Adapt(Jobs):
    """Adapt the network to the recording."""

    minutes: int = 15
    """At most."""


@dataclass(frozen=True)
class UseNetwork(Jobs):
    """Have another network run, for everybody."""

    name: str
    """One of `ViewState.networks`."""


@dataclass(frozen=True)
class AnswerNetwork(Jobs):
    """Accept or refuse the weights that are asked for (`ViewState.asked_network`)."""

    accepted: bool


@dataclass(frozen=True)
class AnswerJobs(Jobs):
    """Run or discard all jobs that are asked for (`JobState.ASKED`)."""

    accepted: bool


@dataclass(frozen=True)
class CancelJob(Jobs):
    """Stop a job, or take it out of the queue."""

    number: int


@dataclass(frozen=True)
class RepeatJob(Jobs):
    """Queue a job once more; one on many frames goes on where it was stopped."""

    number: int


@dataclass(frozen=True)
class ForgetJobs(Jobs):
    """Take all jobs that have ended off the list."""
