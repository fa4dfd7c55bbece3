"""Compare surface networks by the fits they give on synthetic sequences of the built-in instruments and on recordings.

    python -m tools.compare_weights run RESULTS.jsonl --weights runs/new/surface.safetensors --robots cautery_hook
    python -m tools.compare_weights run RESULTS.jsonl --weights runs/new/surface.safetensors --robots \
        --recordings sample_data/sequence/sequence.toml
    python -m tools.compare_weights report RESULTS.jsonl
    python -m tools.compare_weights time runs/new/surface.safetensors

Weights are compared with the shipped weights, named `shipped`, all in single precision. `run` renders missing sequences
and resumes where it was stopped; of recordings, frames with a mask are fitted in the first camera and in all domains.
`time` measures the inference time of one image with one thread of ONNX Runtime, all networks in turn.
"""

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import asdict
from itertools import product
from pathlib import Path

import numpy as np
import torch

from carts_core.evaluation.scores import evaluate
from carts_core.files import append_line, output_path
from carts_core.lab.synthesis import synthesize
from carts_core.model.instruments.builtin import SCHEME, builtin_names
from carts_core.model.instruments.catalogue import SI_SUFFIX
from carts_core.networks.engines import OnnxSurface
from carts_core.networks.extractor import FeatureExtractor
from carts_core.networks.weights import read_weights
from carts_core.optimization import FreeParameters
from carts_core.recording import Sequence, evenly_spaced
from carts_core.resources import shipped_weights
from carts_core.settings import SurfaceSolver
from carts_core.settings.synthesis import MotionConfig, RenderConfig, SynthesisConfig

DOMAINS = ("regular", "smoke")
_SHIPPED = "shipped"
_SEED = 43
_SAMPLES = 4
_MOTION_SECONDS = 8.0
_SIZE, _ROUNDS = (240, 320), 40


def _sequence(folder: Path, robot: str, frames: int) -> Sequence:
    """Open the sequence of a robot; render it if it is missing."""
    target = output_path(folder, f"{robot}_{frames}")
    if not (target.path / "sequence.toml").is_file():
        motion = MotionConfig(frames=frames, frame_rate=frames / _MOTION_SECONDS)
        render, path = RenderConfig(samples=_SAMPLES), Path(SCHEME + robot)
        config = SynthesisConfig(_SEED, robot, path, domains=DOMAINS, motion=motion, render=render)
        synthesize(config, target)
    return Sequence.open(target.path / "sequence.toml")


def _key(row: dict) -> tuple:
    return row["weights"], row["name"], row["domain"], row["degrees"], row["index"]


def _compared(args: argparse.Namespace) -> Iterator[tuple[str, Sequence, tuple[str, ...], list[int]]]:
    """Name, sequence, domains and frames of each fitted sequence."""
    for robot in args.robots:
        yield robot, _sequence(args.sequences, robot, args.frames), DOMAINS, list(range(args.frames))
    for path in args.recordings:
        sequence = Sequence.open(path)
        camera = sequence.scene.cameras[0].name
        masked = [index for index in range(len(sequence)) if sequence.frame(index, cameras=[camera]).masks]
        frames = [masked[place] for place in evenly_spaced(len(masked), min(args.frames, len(masked)))]
        yield sequence.name, sequence, sequence.domains, frames


def run(args: argparse.Namespace) -> None:
    """Append the missing scores to the results."""
    torch.set_num_threads(1)
    done = {_key(row) for row in _rows(args.results)} if args.results.exists() else set()
    loaded = {str(path): FeatureExtractor.load(path, inference="onnx") for path in args.weights}
    extractors = {_SHIPPED: FeatureExtractor.load(inference="onnx"), **loaded}
    for sequence_name, sequence, domains, frames in _compared(args):
        for degrees, domain, (name, extractor) in product(args.degrees, domains, extractors.items()):
            wanted = [index for index in frames if (name, sequence_name, domain, degrees, index) not in done]
            scores = evaluate(
                sequence,
                extractor,
                frames=wanted,
                cameras=[sequence.scene.cameras[0].name],
                domains=[domain],
                settings=SurfaceSolver(),
                free=FreeParameters(),
                perturb_deg=degrees,
            )
            for index, score in zip(wanted, scores, strict=True):
                row = {"weights": name, "name": sequence_name, "degrees": degrees, "index": index, **asdict(score)}
                append_line(args.results, json.dumps(row).encode())


def _rows(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def report(args: argparse.Namespace) -> None:
    """Print a Markdown table of mean Dice, over the frames that all networks have fitted."""
    scores = {_key(row): row["dice_after"] for row in _rows(args.results)}
    networks = sorted({key[0] for key in scores}, key=lambda name: name != _SHIPPED)
    rows: dict[tuple, list[list[float]]] = {}
    for _, *rest in sorted(key for key in scores if key[0] == _SHIPPED):
        keys = [(name, *rest) for name in networks]
        if all(key in scores for key in keys):
            rows.setdefault((rest[0], rest[1], rest[2]), []).append([scores[key] for key in keys])
    print("| sequence, domain, initial error | frames | " + " | ".join(networks) + " |")
    print("|---|---|" + len(networks) * "---|")
    for (name, domain, degrees), found in rows.items():
        print(f"| {name}, {domain}, {degrees:g}° | {len(found)} | {_cells(found)} |")
    everything = [values for found in rows.values() for values in found]
    print(f"| all | {len(everything)} | {_cells(everything)} |")


def _cells(values: list[list[float]]) -> str:
    return " | ".join(f"{mean:.4f}" for mean in np.mean(values, axis=0))


@torch.no_grad()
def measure_time(args: argparse.Namespace) -> None:
    """Print the median and minimum time of a prediction by each network [ms]."""
    torch.set_num_threads(1)
    networks = {}
    for path in (shipped_weights()[1], *args.weights):
        weights = read_weights(path)
        networks[str(path)] = OnnxSurface.float32(weights.network.folded(), weights.sha256)  # pyright: ignore[reportArgumentType]
    images, given = torch.rand(1, 3, *_SIZE), torch.rand(1, 6, *_SIZE)
    seconds: dict[str, list[float]] = {name: [] for name in networks}
    for _ in range(_ROUNDS):
        for name, network in networks.items():
            began = time.perf_counter()
            network(images, given)
            seconds[name].append(time.perf_counter() - began)
    for name, values in seconds.items():
        print(f"{name}: median {1e3 * np.median(values):.1f} ms, minimum {1e3 * min(values):.1f} ms")


def main() -> None:
    """Parse the arguments and run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    fits = commands.add_parser("run", help="fit frames")
    fits.add_argument("results", type=Path, help="JSON lines")
    fits.add_argument("--weights", type=Path, nargs="*", default=[], help="weights files of surface networks")
    robots = [name for name in builtin_names() if not name.endswith(SI_SUFFIX)]
    fits.add_argument(
        "--robots", nargs="*", default=robots, help="built-in instruments; by default all on a classic arm"
    )
    fits.add_argument("--recordings", type=Path, nargs="*", default=[], help="sequence files with masks")
    fits.add_argument("--sequences", type=Path, default=Path("runs/sequences"), help="folder of rendered sequences")
    fits.add_argument("--frames", type=int, default=8, help="frames of each sequence")
    fits.add_argument("--degrees", type=float, nargs="*", default=[2.0, 5.0], help="initial errors [deg]")
    fits.set_defaults(command=run)
    table = commands.add_parser("report", help="print mean Dice")
    table.add_argument("results", type=Path)
    table.set_defaults(command=report)
    clock = commands.add_parser("time", help="measure inference times")
    clock.add_argument("weights", type=Path, nargs="*")
    clock.set_defaults(command=measure_time)
    args = parser.parse_args()
    args.command(args)


if __name__ == "__main__":
    main()
