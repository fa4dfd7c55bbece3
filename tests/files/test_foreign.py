"""Texts of a recording in tables: shown, not run."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from carts_core.files import csv_cell, text_of_cell


@pytest.mark.parametrize("text", ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\tx", "\rx", "-", "'quoted"])
def test_a_cell_is_no_formula(text: str) -> None:
    assert csv_cell(text) == f"'{text}"


@pytest.mark.parametrize("text", ["001", "-0.5", "+3", "1e-9", "PSM1.yaw", "ü", ""])
def test_numbers_and_plain_texts_stay_as_they_are(text: str) -> None:
    assert csv_cell(text) == text


@given(st.text())
def test_a_cell_gives_its_text_back(text: str) -> None:
    assert text_of_cell(csv_cell(text)) == text
    assert not csv_cell(text).startswith(("=", "@", "\t", "\r"))
