"""Ablation of the frame solver: leave out one stage or constant at a time, and measure the effect.

    python tools/ablate.py run RESULTS.jsonl --synthetic FOLDER ... --real tests/sequences/dvrk_stereo.toml
    python tools/ablate.py report RESULTS.jsonl

Rerun `run` to resume. Several processes can share the work with `--share 0/2` and `--share 1/2`, each with its own
file. Times are processor time [s]. `report` prints mean differences from the default solver.
"""

import argparse
import json
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from carts_core.evaluation.scores import Estimate, frame_score, start_positions
from carts_core.networks.extractor import FeatureExtractor
from carts_core.optimization import Backgrounds, FrameOptimizer
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.settings import SurfaceSolver
from carts_core.settings.stages import AlignEdges, Descend, Given, Observe, PreferStart, RandomRestart, Stage

AS_IS = SurfaceSolver()
"""Settings that variants are compared with."""


@dataclass(frozen=True)
class Variant:
    """Solver with one stage omitted, or one setting changed."""

    name: str
    change: Callable[[SurfaceSolver], SurfaceSolver] = lambda solver: solver
    """Changed fields of the settings."""
    constants: Mapping[str, Any] = field(default_factory=dict)
    """Changed module constants: name below `carts_core` -> value."""


def _without(*places: int) -> Callable[[SurfaceSolver], SurfaceSolver]:
    """Settings without the stages at these indices."""
    return lambda solver: replace(solver, stages=tuple(s for i, s in enumerate(solver.stages) if i not in places))


def _at(place: int, **fields: Any) -> Callable[[SurfaceSolver], SurfaceSolver]:
    """Settings with changed fields of the stage at an index."""

    def change(solver: SurfaceSolver) -> SurfaceSolver:
        stages = list(solver.stages)
        stages[place] = replace(stages[place], **fields)
        return replace(solver, stages=tuple(stages))

    return change


def _every(kind: type[Stage], **fields: Any) -> Callable[[SurfaceSolver], SurfaceSolver]:
    """Settings with changed fields of all stages of a kind."""
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
    Variant("_LEFT 0", constants={"optimization.observation.MIN_AREA_RATIO": 0.0}),
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
    Variant("no weight for haze at edges", constants={"optimization.image_factors.certainty": _clear}),
    Variant("dehaze 0", _settings(dehaze=0.0)),
    Variant("dehaze 1", _settings(dehaze=1.0)),
    Variant("parts_weight 0", _settings(parts_weight=0.0)),
    Variant("normals_weight 0", _settings(normals_weight=0.0)),
    Variant("parts_weight and normals_weight 0", _settings(parts_weight=0.0, normals_weight=0.0)),
    Variant("normals_weight 0.1", _settings(normals_weight=0.1)),
    Variant("noise 2.66", _settings(noise=2.66)),
    Variant("noise 1", _settings(noise=1.0)),
    Variant("prior_deg 3.75", _settings(prior_deg=3.75)),
    Variant("_SHARE 1", constants={"optimization.image_factors._SHARE": (1.0, 1.0, 1.0)}),
    Variant("_LIKELY off", constants={"optimization.image_factors._LIKELY": math.inf}),
    Variant("_BLUR 0", constants={"optimization.image_factors._BLUR": 0.0}),
    Variant("_RENDERED_ANEW off", constants={"optimization.image_factors._RENDERED_ANEW": math.inf}),
    Variant("_ROBUST of edges off", constants={"optimization.image_factors._ROBUST": math.inf}),
    Variant("_STILL 0", constants={"optimization.image_factors._STILL": 0.0}),
    Variant("longest step of descents off", constants={"optimization.factors._MAX_STEP": math.inf}),
    Variant("damping off", constants={"optimization.factors._FIRST_DAMPING": 1e-4}),
    Variant("_LEAST transmission 0.1", constants={"imaging.working_image._LEAST": 0.1}),
    Variant("haze at full size", constants={"imaging.working_image._COARSER": 1}),
    Variant("coarsest comparison 4", constants={"optimization.image_factors._REDUCTIONS": (1, 2, 4)}),
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
"""Domain and initial joint error [deg]."""


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
        """Key of the conditions over which results are averaged."""
        return f"{self.domain} {self.degrees:g}°" if self.degrees else f"real {self.camera}"


def run_one(job: Job, variant: Variant, sequence: Sequence, extractor: FeatureExtractor) -> dict:
    """One variant on one frame."""
    scene = sequence.scene.with_cameras([job.camera])
    frame = sequence.frame(job.frame, job.domain, [job.camera])
    backgrounds = Backgrounds.of(sequence, (job.camera,), job.domain)
    start = start_positions(sequence, frame, job.degrees, 0)
    with ExitStack() as stack:
        for name, value in variant.constants.items():
            stack.enter_context(patch(f"carts_core.{name}", value))
        began = time.process_time()
        optimizer = FrameOptimizer(
            scene, frame, backgrounds, extractor, start=start, settings=variant.change(AS_IS), live=False
        )
        for _ in optimizer:
            pass
        seconds = time.process_time() - began
    renderer = Renderer(scene, cameras=[job.camera])
    score = frame_score(sequence, frame, job.camera, renderer, start, Estimate.best(optimizer, seconds))
    return {"variant": variant.name, "condition": job.condition, **asdict(job), **asdict(score), "frame": job.frame}


def jobs(args: argparse.Namespace) -> Iterator[Job]:
    """All jobs, ordered so that an unfinished run covers every condition."""
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
    """Measure the jobs that are missing in the file."""
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
                run_one(job, missing[0], _open(job.recording), extractor)  # Compiles kernels, loads meshes.
            began = time.perf_counter()
            for variant in missing:
                row = run_one(job, variant, _open(job.recording), extractor)
                file.write(json.dumps(row) + "\n")
            file.flush()
            print(f"{job.condition}, {Path(job.recording).stem} {job.frame}: {time.perf_counter() - began:.0f} s")


def report(args: argparse.Namespace) -> None:
    """Markdown table of the mean Dice of the default solver, and of its change by each variant."""
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
    """Parse the arguments and run the command."""
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
