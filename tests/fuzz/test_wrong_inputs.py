"""Inputs changed at random: read or refused with a message, in bounded time and memory, and always finite."""

import pytest

from fuzz.campaign import GOOD, run
from fuzz.kinds import KINDS


def check(count: int, seed: int) -> None:
    outcomes = list(run(count, seed))
    assert [outcome for outcome in outcomes if outcome.result not in GOOD] == []
    assert {outcome.kind for outcome in outcomes} == set(KINDS) and len(outcomes) == count
    assert {outcome.result for outcome in outcomes} == set(GOOD)


def test_a_sample_of_wrong_inputs_is_read_or_refused_in_words():
    check(3 * len(KINDS), seed=1)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_five_thousand_wrong_inputs_are_read_or_refused_in_words():
    check(5000, seed=1000)
