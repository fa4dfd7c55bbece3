"""Optimizers of the viewer: requests to the solver, and runs on single frames and on many frames."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from jaxtyping import UInt8

from carts_core import optimization
from carts_core.errors import WeightsError
from carts_core.networks.header import is_surface
from carts_core.optimization import FreeParameters, Iterate, SolverSettings
from carts_core.project import Provenance, Source
from carts_core.recording import Sequence as Recording
from carts_core.segmentation import Prompt, Segmenter
from carts_core.settings.optimization import Inference
from carts_core.settings.serialization import to_plain
from carts_viewer.jobs.live_stream import LiveEnded, LiveStep, LiveTask
from carts_viewer.jobs.solver import (
    Calibrated,
    CalibrationStep,
    CalibrationTask,
    Estimate,
    Fit,
    FrameTask,
    Masks,
    NetworkChoice,
    RefineTask,
    RunResult,
    SequenceStep,
    SequenceTask,
    Smoothed,
    Started,
    result_state,
)
from carts_viewer.jobs.solver_process import Reply, Requests, Run, SolverInProcess
from carts_viewer.picture.strokes import Mask
from carts_viewer.state import NETWORK, Pose, Target

REPLY_WAIT = 1.0
"""Maximum time between checks for a reply, which wakes the worker [s]."""


def wait_for(reply: Reply[Any] | None) -> float:
    """Time until work that waits for a reply is due [s]."""
    return 0.0 if reply is None or reply.done else REPLY_WAIT


class ActiveRun:
    """One run on one frame.

    Attributes:
        provenance: provenance of its results; known after `Started`.
        due: number of iterations to perform while the run is paused.
        reply: the next result, if it was requested.
    """

    def __init__(self, steps: Run[RunResult], task: FrameTask) -> None:
        self.steps, self.task, self.cameras = steps, task, task.cameras
        self.provenance: Provenance | None = None
        self.reply: Reply[RunResult | None] | None = None
        self.due = 0

    def request(self) -> Reply[RunResult | None]:
        """The requested result; the next one is requested if there is none."""
        self.reply = self.reply or self.steps.next()
        return self.reply

    def pose(self, iterate: Iterate) -> Pose:
        """Pose of the whole scene at an iterate."""
        return Pose(result_state(self.task, iterate), Source.OPTIMIZER)


class SequenceRun:
    """One run on many frames.

    Attributes:
        provenance: provenance of its results; known after `Started`.
        estimates: frame -> newest estimate of each visited frame.
        done: number of visited frames.
        cancelled: whether the run was stopped; its results are kept.
    """

    def __init__(self, steps: "Run[Started | SequenceStep | Smoothed | float]") -> None:
        self.steps = steps
        self.provenance = Provenance(Source.PROPAGATED)
        self.estimates: dict[int, Estimate] = {}
        self.done, self.cancelled = 0, False


class NetworkOptions(TypedDict, total=False):
    """Options of the networks."""

    weights: tuple[Path, ...]
    """Weights files; networks without a file have the shipped weights."""
    device: str
    """PyTorch device of the networks, such as `cuda`; `cpu` by default."""
    inference: Inference
    """Runtime of the surface network; `auto` by default."""
    segmenter: Segmenter | tuple[Path, Path] | None
    """Segmenter of the *Prompt* tool, or its encoder and decoder as ONNX files; the shipped network by default."""


class OptimizerFactory:
    """Sends tasks to the solver, with the chosen networks. Errors are raised by the replies."""

    def __init__(
        self, *, report: Callable[[str], None], requests: Requests | None = None, **options: Unpack[NetworkOptions]
    ) -> None:
        """`requests`: the solver; None for the solver in this process."""
        segmenter = options.get("segmenter")
        files = segmenter if isinstance(segmenter, tuple) else None
        self._segmenter = None if isinstance(segmenter, tuple) else segmenter
        self._choice = NetworkChoice(
            options.get("weights", ()), None, options.get("device", "cpu"), options.get("inference", "auto"), files
        )
        self._requests: Requests = requests or SolverInProcess()
        self.report = report

    def given_surface(self) -> bool:
        """Whether the weights options include a surface network.

        Raises:
            WeightsError: weights cannot be read.
        """
        return any(is_surface(path) for path in self._choice.weights)

    def use(self, surface: Path | None) -> None:
        """Use another surface network from now on; None for the initial network.

        Raises:
            WeightsError: the weights cannot be read, or are not those of a surface network.
        """
        if surface is not None and not is_surface(surface):
            raise WeightsError(f"{surface} contains no surface network. Adapt the network again.")
        self._choice = replace(self._choice, surface=surface)

    @property
    def warm_up(self) -> tuple[Any, ...]:
        """The request that loads the networks."""
        return "call", self._choice, "prepare"

    def prepare(self) -> Reply[str]:
        """Load the networks; the result is their fingerprint."""
        return self._requests.ask(*self.warm_up)

    def forget_images(self, sequence: Recording) -> None:
        """Drop values computed from the images of a recording."""
        # No such values exist before this module is imported.
        if "carts_core.optimization.observation" in sys.modules:
            optimization.Backgrounds.forget(sequence)
        self._call("forget_images", sequence)

    def segment(self, image: UInt8[np.ndarray, "height width 3"], prompt: Prompt) -> Reply[Mask]:
        """Mask of the object of a prompt."""
        own = self._segmenter
        if own is not None:
            return Reply.of(lambda: own.segment(image, prompt))
        return self._call("segment", image, prompt)

    def run(self, task: FrameTask) -> ActiveRun:
        """A run on a frame."""
        return ActiveRun(Run(self._requests, self._choice, "run", task), task)

    def compare(self, task: FrameTask) -> Reply[Iterate | None]:
        """The iterate at the pose of a task, with its maps."""
        return self._call("compare", task)

    def fit(self, task: FrameTask) -> Reply[Fit]:
        """The fit of the pose of a task."""
        return self._call("fit", task)

    def refine(self, task: RefineTask) -> Reply[Masks]:
        """Refined masks."""
        return self._call("refine", task)

    def sequence(self, task: SequenceTask) -> SequenceRun:
        """A run on many frames."""
        return SequenceRun(Run(self._requests, self._choice, "sequence", task))

    def calibration(self, task: CalibrationTask) -> Run[Started | CalibrationStep | Calibrated]:
        """A calibration on many frames."""
        return Run(self._requests, self._choice, "calibration", task)

    def live(self, task: LiveTask) -> Run[LiveStep | LiveEnded]:
        """A tracked stream."""
        return Run(self._requests, self._choice, "live", task)

    def _call(self, method: str, *arguments: Any) -> Reply[Any]:
        return self._requests.ask("call", self._choice, method, *arguments)


def provenance(
    started: Started,
    cameras: Sequence[str],
    settings: SolverSettings,
    free: FreeParameters,
    target: Target = NETWORK,
    source: Source = Source.OPTIMIZER,
    **more: Any,
) -> Provenance:
    """Provenance of a run with these settings, and with `more` settings."""
    used = {**to_plain(settings), "free": asdict(free), "cameras": list(cameras), **more}
    if target.observed.what != "network":
        used |= {"observe": target.observed.what, "masks": target.observed.masks}
    return Provenance.made_by_optimizer(used, started.weights_sha256, source)
