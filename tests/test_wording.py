"""Words of messages."""

from carts_core.wording import counted


def test_one_thing_is_not_called_by_its_plural() -> None:
    assert [counted(number, "frame") for number in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]
