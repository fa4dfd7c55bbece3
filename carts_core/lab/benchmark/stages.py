"""Milliseconds of the stages of an iteration, measured on the shipped sequence."""

import json

import torch

from ...files import OutputPath, write_text
from ...files.reading import VALUES, parse_json, read_bytes
from ...model.scene import Scene
from ...networks.extractor import FeatureExtractor
from ...optimization.inputs import working_size
from ...recording import Sequence
from ...resources import sample_sequence
from ...settings import SurfaceSolver
from ...settings.stages import Observe
from .fingerprints import code_fingerprint
from .machine import machine
from .timing import milliseconds, optimizer_figures, render_figures

_RUNS = 10


def known_stages(path: OutputPath, extractor: FeatureExtractor) -> dict[str, float]:
    """Figures that this machine and this code have written to `path`; none if there are no such."""
    try:
        stored = parse_json(read_bytes(path.path, VALUES))
        return stored["ms"] if stored["of"] == _of(extractor) else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def measure_stages(path: OutputPath, extractor: FeatureExtractor) -> None:
    """Measure all stages, on the CPU, and write them to `path`, unless they are there."""
    if known_stages(path, extractor):
        return
    sequence = Sequence.open(sample_sequence())
    figures = {
        **render_figures(sequence, _RUNS),
        **network_figures(sequence.scene, extractor),
        **optimizer_figures(sequence, _RUNS),
    }
    write_text(path, json.dumps({"of": _of(extractor), "ms": figures}, indent=1))


def network_figures(scene: Scene, extractor: FeatureExtractor) -> dict[str, float]:
    """Times of the networks on whole images of the sizes that the optimizer compares by default [ms]."""
    settings = SurfaceSolver()
    scale = max(stage.scale for stage in settings.stages if isinstance(stage, Observe))
    width, height = working_size(scene, settings.working_width, extractor.stride)
    wide, high = working_size(scene, round(settings.working_width * scale), extractor.stride)
    image = torch.rand(1, 3, height, width, device=extractor.device)

    def forward() -> None:
        with torch.no_grad():
            extractor.features(image)

    def both() -> None:
        extractor.features(image.requires_grad_()).sum().backward()

    large = torch.rand(1, 3, high, wide, device=extractor.device)
    given = torch.rand(1, 6, high, wide, device=extractor.device)

    return {
        f"surface network forward, {wide}x{high}": milliseconds(lambda: extractor.surface(large, given), _RUNS),
        f"feature network forward, {width}x{height}": milliseconds(forward, _RUNS),
        f"feature network forward and backward, {width}x{height}": milliseconds(both, _RUNS),
    }


def _of(extractor: FeatureExtractor) -> list[str]:
    return [machine(extractor.device), extractor.fingerprint, code_fingerprint()]
