"""The one table of keys, and what is made from it."""

from pathlib import Path

import pytest

from carts_viewer.panels.help import key_table, shortcuts, with_keys

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "keys.md"


def test_no_two_shortcuts_share_a_key_and_none_flies_the_camera() -> None:
    keys = [(shortcut.hotkey, shortcut.modifier) for shortcut in shortcuts()]
    assert len(set(keys)) == len(keys)
    assert not {hotkey for hotkey, _ in keys} & set("WASDQE")


def test_the_page_of_keys_lists_them_as_they_are() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert with_keys(text) == text and key_table() in text


def test_a_text_without_a_place_for_the_table_is_refused() -> None:
    with pytest.raises(ValueError, match="no lines"):
        with_keys("# Nothing")
