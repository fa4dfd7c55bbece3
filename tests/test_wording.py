"""Words of messages."""

import pytest

from carts_core.wording import closest, counted


def test_one_thing_is_not_called_by_its_plural() -> None:
    assert [counted(number, "frame") for number in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]


@pytest.mark.parametrize(
    ("name", "meant"),
    [("psm1", "PSM1"), ("lef", "left"), ("7", "007"), ("0007", "007"), ("0", None), ("zebra", None), ("", None)],
)
def test_the_name_that_is_meant_is_suggested(name: str, meant: str | None) -> None:
    assert closest(name, ["PSM1", "left", "007", "070"]) == ("" if meant is None else f" Did you mean {meant!r}?")
