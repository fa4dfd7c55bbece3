"""Small files that grow when they are read are refused, or read in bounded time and memory, without a traceback."""

import pytest

from fuzz.growing import measured, run
from fuzz.growing_files import CASES, right_folder

QUICK = [
    ("yaml", "aliases"),
    ("yaml", "tags"),
    ("ini", "blanks"),
    ("npy", "false length"),
    ("parquet", "dictionary of texts"),
    ("bag", "merge keys"),
    ("dae", "instances"),
    ("glb", "zeros"),
]


@pytest.mark.parametrize(("kind", "name"), QUICK)
def test_a_file_that_grows_costs_little(kind: str, name: str) -> None:
    right_folder()
    cost = measured(kind, name, CASES[kind][name])
    assert cost.result == "refused", cost


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_files_of_every_kind_that_grow_cost_little() -> None:
    assert [cost for cost in run(list(CASES)) if cost.result not in ("read", "refused")] == []
