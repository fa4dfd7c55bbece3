"""The results file through crashes and changed settings."""

from pathlib import Path

from handmade import make_measurement

from carts_core.files import output_path
from carts_core.lab.benchmark import ResultsFile


def test_what_was_appended_is_found_again_under_its_fingerprint_only(tmp_path: Path) -> None:
    measurement = make_measurement((0.5, 0.7))
    ResultsFile(output_path(tmp_path, "new", "lines.jsonl")).append(measurement, "settings A", weights="w")
    again = ResultsFile(output_path(tmp_path, "new", "lines.jsonl"))
    assert again.find(measurement.run, "settings A") == measurement
    assert again.find(measurement.run, "settings B") is None
    assert again.unreadable == 0


def test_a_torn_last_line_is_left_out_and_does_not_swallow_the_next(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    first, second, third = (make_measurement((0.5, 0.7), frame=frame) for frame in range(3))
    results = ResultsFile(output_path(path))
    results.append(first, "A")
    results.append(second, "A")
    path.write_bytes(path.read_bytes()[:-20])
    resumed = ResultsFile(output_path(path))
    assert resumed.unreadable == 1
    assert resumed.find(first.run, "A") == first and resumed.find(second.run, "A") is None
    resumed.append(third, "A")
    last = ResultsFile(output_path(path))
    assert last.find(first.run, "A") == first and last.find(third.run, "A") == third
    assert last.unreadable == 1


def test_lines_of_another_kind_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    path.write_text('{"fingerprint": "A"}\n[1, 2]\n\xff\n{"run": 3, "fingerprint": "A"}\n', encoding="latin-1")
    assert ResultsFile(output_path(path)).unreadable == 4
