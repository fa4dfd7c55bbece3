"""Dice against the severity of each corruption, five strengths, on real frames: `run RESULTS.jsonl SEQUENCE`, `draw`.

The third strength is the benchmark's. Rerun the command to resume.
"""

import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from carts_core.console import Bar
from carts_core.files import append_line, output_path, output_stream
from carts_core.lab.baselines.networks import read_baseline
from carts_core.lab.benchmark import TEST_SEED, Run
from carts_core.lab.benchmark.counterfactual import Counterfactual
from carts_core.lab.benchmark.frame import SourceBench
from carts_core.lab.benchmark.scope import FULL, METHODS
from carts_core.lab.benchmark.sources import Source
from carts_core.networks.extractor import FeatureExtractor
from carts_core.recording import Sequence
from carts_core.recording.background import evenly_spaced
from carts_core.settings import DomainConfig

SEVERITIES: dict[str, tuple[DomainConfig, ...]] = {
    "low_brightness": tuple(DomainConfig(low_brightness=share) for share in (0.6, 0.4, 0.22, 0.12, 0.06)),
    "bleeding": tuple(
        DomainConfig(blood_coverage=share, blood_on_tools=0.75 * share) for share in (0.1, 0.25, 0.4, 0.6, 0.8)
    ),
    "smoke": tuple(DomainConfig(smoke_density=density) for density in (2.0, 4.0, 8.0, 16.0, 32.0)),
    "simulated_smoke": tuple(DomainConfig(overlay_opacity=opacity) for opacity in (0.2, 0.35, 0.5, 0.65, 0.8)),
}
"""Domain -> its strengths, from weak to strong."""
METHODS_DRAWN = ("unet", "surface", "start", "ours")
_COLORS = ("#9aa0a6", "#c9a227", "#d0d3d6", "#1f5fa8", "#b3541e", "#5b8c5a", "#7d5ba6", "#333333")
_FRAMES = 2


def run(results: Path, path: Path, baselines: list[Path]) -> None:
    """Measure the missing runs."""
    networks = {trained.row: trained for trained in map(read_baseline, baselines)}
    sequence, extractor = Sequence.open(path), FeatureExtractor.load()
    camera = sequence.scene.cameras[0]
    masked = [index for index in range(len(sequence)) if camera.name in (sequence.frame(index).masks or {})]
    frames = [masked[place] for place in evenly_spaced(len(masked), _FRAMES)]
    done = {tuple(entry["of"]) for entry in _read(results)}
    nothing = np.zeros((camera.height, camera.width, 3), np.uint8)
    output = output_path(results.parent, results.name)
    for level in (2, 4, 3, 1, 0):
        for domain, strengths in SEVERITIES.items():
            altered = Counterfactual(sequence, camera.name, nothing, TEST_SEED, strengths[level])
            source = Source("real", "", camera.name, frames, "", lambda progress, found=altered: found)
            bench = SourceBench(source, Bar(disable=True), FULL, extractor, networks)
            for frame in frames:
                for method in (*METHODS_DRAWN, *networks):
                    if (domain, level, frame, method) in done:
                        continue
                    began = time.process_time()
                    (found,) = bench.measure([Run("real", domain, frame, method)])
                    entry = {"of": (domain, level, frame, method), "strength": asdict(strengths[level])}
                    entry |= {"dice": found.final.dice, "processor_seconds": time.process_time() - began}
                    append_line(output, json.dumps(entry).encode())


def draw(results: Path, picture: Path) -> None:
    """A panel for each corruption."""
    entries = _read(results)
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    methods = list(dict.fromkeys(entry["of"][3] for entry in entries))
    for axes, domain in zip(figure.subplots(1, len(SEVERITIES), sharey=True), SEVERITIES, strict=True):
        for method, color in zip(methods, _COLORS, strict=False):
            found = {
                level: [e["dice"] for e in entries if e["of"][:2] == [domain, level] and e["of"][3] == method]
                for level in range(5)
            }
            levels = [level for level, values in found.items() if values]
            means = [float(np.mean(found[level])) for level in levels]
            axes.plot([level + 1 for level in levels], means, ".-", color=color, label=METHODS[method].label)
        axes.set(
            title=domain.replace("_", " "), xlabel="severity (3: the benchmark's)", xticks=range(1, 6), ylim=(0, 1)
        )
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("Dice")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    with output_stream(output_path(picture.parent, picture.name)) as stream:
        figure.savefig(stream, format="png", dpi=110)


def _read(results: Path) -> list[dict]:
    return [json.loads(line) for line in results.read_text().splitlines()] if results.exists() else []


if __name__ == "__main__":
    if len(sys.argv) >= 4 and sys.argv[1] == "run":
        run(Path(sys.argv[2]), Path(sys.argv[3]), list(map(Path, sys.argv[4:])))
    elif len(sys.argv) == 4 and sys.argv[1] == "draw":
        draw(Path(sys.argv[2]), Path(sys.argv[3]))
    else:
        sys.exit("usage: severity.py run RESULTS.jsonl SEQUENCE [BASELINE ...] | draw RESULTS.jsonl PICTURE.png")
