"""The viewer's code, scripts and page use words of the field, not private ones."""

import re
from pathlib import Path

import pytest

import carts_viewer
from carts_core.resources import static_dir

PRIVATE = re.compile(
    r"(?<![a-z])(?<!hand[-_])(glance|told|believe|opinion|veil|eye|sight|news|slid|mailbox|patience)(s|d|ed)?(?![a-z])",
    re.IGNORECASE,
)
"""Hand-eye calibration is the field's own word."""
FOLDERS = (Path(carts_viewer.__file__).parent, static_dir())


def test_the_viewer_uses_no_private_words() -> None:
    paths = [path for folder in FOLDERS for path in folder.rglob("*") if path.suffix in (".py", ".js", ".css", ".md")]
    assert len(paths) > 50
    found = [
        f"{path.name}:{number}: {match[0]}"
        for path in paths
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        for match in PRIVATE.finditer(line)
    ]
    assert found == []


@pytest.mark.parametrize(
    "line", ["self._told = 1", "def look_at(eye):", "a second opinion", "from .mailbox import Mailbox"]
)
def test_a_private_word_is_found(line: str) -> None:
    assert PRIVATE.search(line)


@pytest.mark.parametrize(
    "line", ["slider", "insight", "unveiled", "newest", "the hand-eye calibration", "Step.HAND_EYE"]
)
def test_words_that_only_contain_one_are_left_alone(line: str) -> None:
    assert not PRIVATE.search(line)
