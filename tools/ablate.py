"""Ablation of the frame solver: leave out one stage or constant at a time, and measure the effect.

    python tools/ablate.py run RESULTS.jsonl --synthetic FOLDER ... --real tests/sequences/dvrk_stereo.toml
    python tools/ablate.py report RESULTS.jsonl

`run` resumes where it stopped. Several processes share the work with `--share 0/2` and `--share 1/2`, each with a file
of its own. Stages that two variants share are computed once and charged to both, so times are those of separate runs
[s of one core]. `report` prints mean differences from the default solver.
"""

import argparse
import json
import math
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from carts_core.evaluation.evaluate import frame_score, start_positions
from carts_core.networks.extractor import FeatureExtractor
from carts_core.optimization import Backgrounds, FrameOptimizer
from carts_core.optimization.frame_problem import FrameProblem
from carts_core.optimization.observability import Evaluation
from carts_core.optimization.observation import observe
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.settings import SurfaceSolver
from carts_core.settings.stages import AlignEdges, Descend, Given, Observe, PreferStart, RandomRestart, Stage

AS_IS = SurfaceSolver()
"""What variants are compared with."""

_PARTS = {
    "images": ("imaging.haze.", "optimization.observation.", "optimization.backgrounds."),
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


_SYNTHETIC = (
    ("smoke", 5.0),
    ("regular", 2.0),
    ("bleeding", 5.0),
    ("smoke", 1.0),
    ("regular", 5.0),
    ("simulated_smoke", 2.0),
    ("smoke", 2.0),
    ("low_brightness", 2.0),
    ("bleeding", 2.0),
    ("simulated_smoke", 5.0),
    ("regular", 1.0),
)
"""Domain, and how far off a run starts [deg]."""


@dataclass(frozen=True)
class Job:
    """One frame under one condition."""

    recording: str
    frame: int
    camera: str
    domain: str
    degrees: float

    @property
    def condition(self) -> str:
        """What results are averaged over."""
        return f"{self.domain} {self.degrees:g}°" if self.degrees else f"real {self.camera}"


class Shared:
    """Results that runs of one frame have in common, with what they cost."""

    def __init__(self) -> None:
        self._kept: dict[Hashable, tuple[Any, float]] = {}
        self._saved = 0.0

    def clock(self) -> float:
        """Processor time, as if nothing had been shared [s]."""
        return time.process_time() + self._saved

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """What was made for a key before, or made now."""
        if key in self._kept:
            found, seconds = self._kept[key]
            self._saved += seconds
        else:
            began = self.clock()
            found = make()
            self._kept[key] = found, self.clock() - began
        return found


def shared_problem(shared: Shared, variant: Variant) -> type[FrameProblem]:
    """A `FrameProblem` that shares what another variant computed from the same inputs."""
    images_of, surface_of, edges_of = (variant.constants_of(part) for part in ("images", "surface", "edges"))

    class SharedProblem(FrameProblem):
        def images(self, scale: float):
            key = "images", scale, self.settings.dehaze, images_of
            return shared.get(key, lambda: FrameProblem.images(self, scale))

        def observe(self, stage, offsets, *, whole: bool = False) -> None:
            given = self.start if stage.given is Given.START else offsets
            what = replace(stage, given=Given.ESTIMATE), given.numpy().tobytes(), whole
            self.observation = shared.get(
                ("observe", *what, self.settings.dehaze, images_of),
                lambda: observe(
                    self.images(stage.scale), self.predictor, self.variables.state(given), stage, whole=whole
                ),
            )

        def _key(self, offsets) -> tuple[Hashable, ...]:
            weights = replace(self.settings, stages=AS_IS.stages)
            return id(self.observation), offsets.numpy().tobytes(), weights, images_of, surface_of

        def costs(self, offsets, stage):
            key = "costs", stage.blur, stage.robust, *self._key(offsets)
            return shared.get(key, lambda: FrameProblem.costs(self, offsets, stage))

        def evaluate(self, offsets, stage, *, gradient: bool = True) -> Evaluation:
            def make() -> Evaluation:
                found = FrameProblem.evaluate(self, offsets, stage, gradient=gradient)
                none = torch.zeros(1, 3, 1, 1)
                return replace(found, image=none, silhouette=none[0], similarity=none[0], attention=none[0])

            return shared.get(("evaluate", stage.blur, stage.robust, gradient, *self._key(offsets)), make)

        def aligned(self, stage, offsets, known):
            key = "aligned", stage, id(known), edges_of, *self._key(offsets)
            return shared.get(key, lambda: FrameProblem.aligned(self, stage, offsets, known))

    return SharedProblem


def run_one(job: Job, variant: Variant, shared: Shared, sequence: Sequence, extractor: FeatureExtractor) -> dict:
    """One variant on one frame."""
    scene = sequence.scene.with_cameras([job.camera])
    frame = sequence.frame(job.frame, job.domain, [job.camera])
    backgrounds = Backgrounds.of(sequence, (job.camera,), job.domain)
    start = start_positions(sequence, frame, job.degrees, 0)
    with ExitStack() as stack:
        stack.enter_context(patch("carts_core.optimization.frame.FrameProblem", shared_problem(shared, variant)))
        for name, value in variant.constants.items():
            stack.enter_context(patch(f"carts_core.{name}", value))
        began = shared.clock()
        optimizer = FrameOptimizer(
            scene, frame, backgrounds, extractor, start=start, settings=variant.change(AS_IS), live=False
        )
        for _ in optimizer:
            pass
        seconds = shared.clock() - began
    best = optimizer.best
    assert best is not None and optimizer.stop_reason is not None
    steps, renderer = len(optimizer.history) - 1, Renderer(scene, cameras=[job.camera])
    positions, deviations = best.joint_positions(), best.joint_std()
    score = frame_score(
        sequence, frame, job.camera, renderer, start, best.state, positions, deviations, steps, seconds,
        optimizer.stop_reason,
    )  # fmt: skip
    return {"variant": variant.name, "condition": job.condition, **asdict(job), **asdict(score), "frame": job.frame}


def jobs(args: argparse.Namespace) -> Iterator[Job]:
    """All jobs; every condition early, so that an unfinished run says something of each."""
    lengths = {str(folder): len(_open(folder)) for folder in args.synthetic}
    real = len(_open(args.real)) if args.real else 0
    for index in range(max([*lengths.values(), real], default=0)):
        for folder, length in lengths.items():
            if index < length:
                for domain, degrees in _SYNTHETIC[: args.conditions]:
                    yield Job(folder, index, "left", domain, degrees)
        for frame in range(4 * index, min(4 * index + 4, real), args.every):
            for camera in ("left", "right"):
                yield Job(str(args.real), frame, camera, _open(args.real).domains[0], 0.0)


_OPENED: dict[str, Sequence] = {}


def _open(path: str | Path) -> Sequence:
    path = Path(path) / "sequence.toml" if Path(path).is_dir() else Path(path)
    return _OPENED.setdefault(str(path), Sequence.open(path))


def run(args: argparse.Namespace) -> None:
    """Measure what is not in the file yet."""
    torch.set_num_threads(1)
    share, shares = map(int, args.share.split("/"))
    wanted = {VARIANTS[0].name, *(args.variants or (variant.name for variant in VARIANTS))} - set(args.skip)
    chosen = [variant for variant in VARIANTS if variant.name in wanted]
    rows = _read([args.results]) if args.results.exists() else []
    done = {(row["variant"], Job(*(row[name] for name in Job.__dataclass_fields__))) for row in rows}
    extractor = FeatureExtractor.load()
    with args.results.open("a") as file:
        for number, job in enumerate(jobs(args)):
            missing = [variant for variant in chosen if (variant.name, job) not in done]
            if number % shares != share or not missing:
                continue
            if not number // shares:
                run_one(job, missing[0], Shared(), _open(job.recording), extractor)  # Compiles kernels, loads meshes.
            shared, began = Shared(), time.perf_counter()
            for variant in missing:
                row = run_one(job, variant, shared, _open(job.recording), extractor)
                file.write(json.dumps(row) + "\n")
            file.flush()
            print(f"{job.condition}, {Path(job.recording).stem} {job.frame}: {time.perf_counter() - began:.0f} s")


def report(args: argparse.Namespace) -> None:
    """A Markdown table: the mean Dice of the solver as it is, and what each variant adds to it."""
    found: dict[str, dict[str, dict[tuple, dict]]] = defaultdict(lambda: defaultdict(dict))
    for row in _read(args.results):
        found[row["variant"]][row["condition"]][row["recording"], row["frame"], row["camera"]] = row
    plain = found.pop(VARIANTS[0].name)
    conditions = sorted(plain, key=lambda c: (c.startswith("real"), c.split()[-1], c))
    print("| | " + " | ".join([*conditions, "s", "steps"]) + " |\n|---|" + (len(conditions) + 2) * "---|")
    print("| frames | " + " | ".join(str(len(plain[c])) for c in conditions) + " | | |")
    everything = [row for c in conditions for row in plain[c].values()]
    cells = [f"{_mean(list(plain[c].values()), 'dice_after'):.4f}" for c in conditions]
    ends = [f"{_mean(everything, 'seconds'):.2f}", f"{_mean(everything, 'iterations'):.1f}"]
    print("| " + " | ".join([VARIANTS[0].name, *cells, *ends]) + " |")
    for name in (v.name for v in VARIANTS[1:] if v.name in found):
        pairs = {c: [(plain[c][k], row) for k, row in found[name][c].items() if k in plain[c]] for c in conditions}
        cells = [f"{_gain(pairs[c], 'dice_after'):+.4f}" if pairs[c] else "" for c in conditions]
        together = [pair for c in conditions for pair in pairs[c]]
        ends = [f"{_gain(together, 'seconds'):+.2f}", f"{_gain(together, 'iterations'):+.1f}"]
        print("| " + " | ".join([name, *cells, *ends]) + " |")


def _mean(rows: list[dict], what: str) -> float:
    return float(np.mean([row[what] for row in rows]))


def _gain(pairs: list[tuple[dict, dict]], what: str) -> float:
    return float(np.mean([other[what] - plain[what] for plain, other in pairs]))


def _read(paths: list[Path]) -> list[dict]:
    return [json.loads(line) for path in paths for line in path.read_text().splitlines()]


def main() -> None:
    """Parse the arguments, and do it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    measure = commands.add_parser("run", help="measure")
    measure.add_argument("results", type=Path, help="JSON lines")
    measure.add_argument("--synthetic", type=Path, nargs="*", default=[], help="what `carts synthesize` made")
    measure.add_argument("--real", type=Path, help="a recording with masks, started as measured")
    measure.add_argument("--every", type=int, default=2, help="use every so-manieth real frame")
    measure.add_argument("--conditions", type=int, default=len(_SYNTHETIC), help="so many of the synthetic ones")
    measure.add_argument("--skip", nargs="*", default=[], help="variants to leave out")
    measure.add_argument("--variants", nargs="*", default=[], help="names; all by default")
    measure.add_argument("--share", default="0/1", help="which part of the jobs")
    measure.set_defaults(command=run)
    show = commands.add_parser("report", help="print the table")
    show.add_argument("results", type=Path, nargs="+")
    show.set_defaults(command=report)
    args = parser.parse_args()
    args.command(args)


if __name__ == "__main__":
    main()
