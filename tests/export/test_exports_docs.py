"""Statements of docs/reference/exports.md."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from pycocotools.coco import COCO

from carts_core.export import FORMATS

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "exports.md").read_text(encoding="utf-8")


def test_the_page_lists_every_format() -> None:
    (table, *_) = PAGE.split("## Details")
    assert re.findall(r"^\| `(\w[\w.-]*)` \|", table, flags=re.MULTILINE) == list(FORMATS)


def test_the_example_runs(tiny_sequence: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tiny_sequence().parent
    monkeypatch.chdir(folder)
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    exec(example, {})
    assert len(COCO(str(folder / "exported" / "annotations" / "instances_default.json")).imgs) == 3
