"""A short sequence whose truth is seen, rendered once."""

from collections.abc import Callable
from pathlib import Path

import pytest
from short_sequence import FRAMES, Truths

from carts_core.recording import Sequence


@pytest.fixture(scope="module")
def made_truths(shared_sequence: Callable[..., Path]) -> Truths:
    return Truths(Sequence.open(shared_sequence(frames=FRAMES, width=320, height=240)))


@pytest.fixture
def truths(made_truths: Truths) -> Truths:
    return made_truths.fresh()
