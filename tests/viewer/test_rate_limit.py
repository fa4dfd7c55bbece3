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


def test_with_nobody_watching_pictures_go_at_a_steady_rate(clock: Clock) -> None:
    limit = RateLimit(clock)
    limit.sent()
    assert limit.ready_in() == pytest.approx(LONGEST_WAIT)
    clock.now += LONGEST_WAIT
    assert limit.ready_in() == 0.0


def test_a_tab_that_has_drawn_gets_the_next_picture_at_once(clock: Clock) -> None:
    limit = RateLimit(clock)
    limit.sent()
    clock.now += 0.02
    limit.drawn(1)
    assert limit.ready_in() == 0.0


def test_the_slowest_of_two_tabs_sets_the_rate_limit(clock: Clock) -> None:
    limit = RateLimit(clock)
    limit.drawn(1)
    limit.drawn(2)
    clock.now += 0.01
    limit.sent()
    clock.now += 0.02
    limit.drawn(1)
    assert limit.ready_in() > 0.0
    clock.now += 0.02
    limit.drawn(2)
    assert limit.ready_in() == 0.0


def test_a_tab_that_stops_drawing_holds_nobody_up_for_long(clock: Clock) -> None:
    limit = RateLimit(clock)
    limit.drawn(1)
    limit.drawn(2)
    for _ in range(50):
        clock.now += 0.01
        limit.sent()
        clock.now += LONGEST_WAIT
        limit.drawn(1)
        assert limit.ready_in() == 0.0
    clock.now += 0.01
    limit.sent()
    limit.drawn(1)
    clock.now += 0.001
    limit.drawn(1)
    assert limit.ready_in() == 0.0
