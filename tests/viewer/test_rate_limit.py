"""When the next picture may be sent."""

import pytest

from carts_viewer.picture.display import LONGEST_WAIT, RateLimit


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_the_first_picture_may_go_at_once(clock: Clock) -> None:
    assert RateLimit(clock).ready_in() == 0.0


def test_a_tab_that_draws_nothing_gets_pictures_at_a_steady_rate(clock: Clock) -> None:
    limit = RateLimit(clock)
    limit.sent()
    assert limit.ready_in() == pytest.approx(LONGEST_WAIT)
    clock.now += LONGEST_WAIT
    assert limit.ready_in() == 0.0


def test_a_tab_that_has_drawn_gets_the_next_picture_at_once(clock: Clock) -> None:
    limit = RateLimit(clock)
    limit.sent()
    clock.now += 0.02
    limit.drawn()
    assert limit.ready_in() == 0.0
