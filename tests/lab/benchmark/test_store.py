"""The results file through crashes and changed settings."""

from pathlib import Path

from handmade import make_measurement

from carts_core.files import output_path
from carts_core.lab.benchmark import ResultsFile


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
