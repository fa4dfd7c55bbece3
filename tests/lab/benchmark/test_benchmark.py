"""Complete small benchmark: runs, interruption, resumption and report."""

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from carts_core.cli.command_line import BAD_INPUT, main
from carts_core.files import output_path
from carts_core.lab.benchmark import Benchmark, Facts, Measurement, Run, write_report
from carts_core.lab.benchmark.conditions import NO_ARM, OTHER_INSTRUMENT, WRONG
from carts_core.lab.benchmark.frame import SourceBench

QUIET = Console(quiet=True)
RUNS = 40
"""10 of the main table, 2 of the surface network alone, 2 with an error at the start, 4 with something wrong, 6 with
occluders, 4 with both cameras, 2 with masks as the target, 4 in sequence mode, 4 of TC-CaRTS."""


@pytest.fixture
def count_runs(monkeypatch: pytest.MonkeyPatch) -> list[Measurement]:
    """List of the runs that were measured."""
    measured: list[Measurement] = []
    measure = SourceBench.measure

    def counting(self: SourceBench, *arguments) -> list[Measurement]:
        found = measure(self, *arguments)
        measured.extend(found)
        return found

    monkeypatch.setattr(SourceBench, "measure", counting)
    return measured


def test_every_method_is_scored_in_every_domain_although_stopped_once_and_a_further_run_measures_nothing(
    tiny_benchmark: Callable[..., Benchmark],
    count_runs: list[Measurement],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    measure, log = SourceBench.measure, io.StringIO()

    def stop_at_five(self: SourceBench, *arguments) -> list[Measurement]:
        assert log.getvalue().count("\n") == len(count_runs), "each measurement has its line at once"
        if len(count_runs) == 5:
            raise KeyboardInterrupt
        return measure(self, *arguments)

    monkeypatch.setattr(SourceBench, "measure", stop_at_five)
    with pytest.raises(KeyboardInterrupt):
        tiny_benchmark().run(Console(file=log))
    assert log.getvalue().startswith(f"1 of {RUNS}: synthetic, regular, frame 0: ")
    kept = tiny_benchmark().measurements()
    assert [entry.run for entry in kept] == [entry.run for entry in count_runs] and len(kept) == 5
    monkeypatch.setattr(SourceBench, "measure", measure)
    benchmark = tiny_benchmark()
    benchmark.run(QUIET)
    measurements = benchmark.measurements()
    assert len(measurements) == len(benchmark.runs) == len(count_runs) == RUNS and measurements[:5] == kept
    by_method = {measurement.run.method: measurement for measurement in measurements}
    assert by_method["paper"].iterations == 2 and by_method["start"].iterations == 0
    assert 1 <= by_method["ours"].iterations <= 2
    best = by_method["paper"].best_of(2)
    assert best is not None and best.nsd_wide is not None and 0.0 <= best.nsd <= best.nsd_wide <= 1.0
    held, posed = by_method["stereo"], by_method["stereo_posed"]
    assert replace(posed.run, method="stereo") == held.run and posed.final.dice != held.final.dice
    for measurement in measurements:
        assert 0.0 <= measurement.final.nsd <= 1.0
        assert measurement.run.domain in WRONG or 0.3 < measurement.final.dice <= 1.0
        assert measurement.final.seconds > 0
        if measurement.run.error_deg and measurement.start:
            assert measurement.start.joint_mae_deg == pytest.approx(2.0, abs=1e-3)
    rendered = {m.run: m for m in measurements}
    for refined in (m for m in measurements if m.run.method == "ours_refined"):
        ours = rendered[replace(refined.run, method="ours")]
        assert refined.verdict == ours.verdict
        # A refined mask belongs to no kinematics.
        assert (refined.final.joint_mae_deg is None) is (refined.verdict == "good")
        assert refined.verdict == "good" or refined.final.dice == ours.final.dice
    temporal = [m.stopped for m in measurements if m.run.method == "temporal"]
    assert temporal == 2 * ["cold", "warm"], "the second frame starts at the first's correction"
    judged = [m for m in measurements if m.run.method in ("ours", "masks", "sequence")]
    assert all(m.verdict in ("good", "doubtful", "failed") and m.probability is not None for m in judged)
    known, other = ([m for m in judged if (m.run.domain == OTHER_INSTRUMENT) is kind] for kind in (False, True))
    assert all(m.within and 0 <= m.within[1] <= m.within[2] <= m.within[0] == 7 for m in known)
    assert len(other) == 1 and other[0].within is None
    (nothing,) = [m for m in measurements if m.run.domain == NO_ARM]
    assert nothing.final.dice == 0.0 and nothing.verdict == "failed"
    tiny_benchmark().run(QUIET)
    assert len(count_runs) == RUNS
    facts = Facts("quick", RUNS, {"synthetic": "tiny"}, "w", "c", "0")
    page = write_report(output_path(tmp_path, "bench"), measurements, facts, {}, [])
    assert f"{RUNS} of {RUNS}" in page.read_text() and "TC-CaRTS" in page.read_text()


def test_sequence_mode_is_resumed(tiny_benchmark: Callable[..., Benchmark], count_runs: list[Measurement]) -> None:
    runs = [Run("synthetic", "regular", frame, "sequence", 1.0) for frame in (0, 1)]
    benchmark = tiny_benchmark(runs=runs)
    benchmark.run(QUIET)
    first = benchmark.measurements()
    assert [entry.stopped for entry in first] == ["cold", "warm"]
    path = benchmark.results.path.path
    path.write_bytes(path.read_bytes().splitlines(keepends=True)[0])
    again = tiny_benchmark(runs=runs)
    again.run(QUIET)
    assert len(count_runs) == 4
    assert [entry.final.dice for entry in again.measurements()] == [entry.final.dice for entry in first]


def test_stale_measurements_are_not_used(
    tiny_benchmark: Callable[..., Benchmark], monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = tiny_benchmark()
    keys = set(reference.runs.values())
    assert set(tiny_benchmark().runs.values()) == keys
    assert not keys & set(tiny_benchmark("other images").runs.values())
    with monkeypatch.context() as patch:
        patch.setattr(reference.extractor, "sha256", "0" * 64)
        assert not keys & set(tiny_benchmark().runs.values())
    monkeypatch.setattr("carts_core.lab.benchmark.measurement.code_fingerprint", lambda: "edited")
    assert not keys & set(tiny_benchmark().runs.values())


def test_a_report_of_nothing_says_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["bench", str(tmp_path), "--quick", "--report-only"])
    assert stop.value.code == BAD_INPUT
    assert "holds no measurement" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_the_shipped_sequences_seed_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["bench", "--quick", "--seed", "7", "--report-only"])
    assert stop.value.code == BAD_INPUT and "--seed 7 is the seed of the shipped sequence" in capsys.readouterr().err
