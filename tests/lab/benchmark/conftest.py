"""A benchmark over a tiny sequence with few steps."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from carts_core.files import output_path
from carts_core.lab.benchmark import QUICK, Benchmark, ResultsFile, Run, Source, plan, runner
from carts_core.lab.benchmark.scope import METHODS
from carts_core.networks import FeatureExtractor
from carts_core.optimization import SolverSettings
from carts_core.recording import Sequence

TINY = replace(
    QUICK,
    frames=1,
    sequence_frames=1,
    samples=1,
    paper_iterations=2,
    errors_deg=(2.0,),
    crossing_errors_deg=(),
    consecutive=2,
    calibration_frames=2,
    room_consecutive=2,
    room_share=16,
    family_frames=0,
    hand_eye_starts=0,
)


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Sequence:
    """Three frames with masks."""
    return Sequence.open(tiny_sequence(frames=3, width=160, height=120))


@pytest.fixture(scope="session")
def extractor() -> FeatureExtractor:
    return FeatureExtractor.load()


@pytest.fixture
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two steps for every iterative method."""
    for name, method in list(METHODS.items()):
        if method.settings is not None:
            make = method.settings

            def short(steps: int, make: Callable[[int], SolverSettings] = make) -> SolverSettings:
                return replace(make(steps), iterations=2)

            monkeypatch.setitem(METHODS, name, replace(method, settings=short))


@pytest.fixture
def tiny_benchmark(
    tiny_sequence: Callable[..., Path],
    tmp_path: Path,
    few_steps: None,
    monkeypatch: pytest.MonkeyPatch,
    extractor: FeatureExtractor,
) -> Callable[..., Benchmark]:
    """Factory of the same benchmark over one frame of a tiny sequence in two domains, and two in sequence mode, on the
    same results file."""
    domains = "regular", "smoke"
    monkeypatch.setattr(runner, "DOMAINS", domains)
    path = tiny_sequence(frames=2, domains=domains, cameras=("left", "right"), width=160, height=128)

    def make(fingerprint: str = "tiny", name: str = "synthetic", runs: list[Run] | None = None) -> Benchmark:
        source = Source(
            name,
            "tiny",
            "left",
            [0],
            fingerprint,
            lambda progress: Sequence.open(path),
            cameras=("left", "right"),
            consecutive=[0, 1],
            length=2,
        )
        results = ResultsFile(output_path(tmp_path, "bench", "measurements.jsonl"))
        return Benchmark(TINY, [source], extractor, results, runs or plan(TINY, [source]))

    return make
