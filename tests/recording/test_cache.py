"""ByteCache: bounded in bytes, least recently used first, made once."""

import threading

import numpy as np
import pytest

from carts_core.recording.sequence import ByteCache


def make(size: int):
    return lambda: np.zeros(size, np.uint8)


def never() -> np.ndarray:
    raise AssertionError("this array should have been kept")


def test_what_fits_is_made_once():
    cache = ByteCache(100)
    first = cache.get("a", make(60))
    assert cache.get("b", make(40)).nbytes == 40
    assert cache.get("a", never) is first
    assert "b" in cache


def test_the_array_that_was_not_used_for_longest_goes_first():
    cache = ByteCache(100)
    for key in "abc":
        cache.get(key, make(30))
    cache.get("a", never)
    cache.get("d", make(30))
    assert [key for key in "abcd" if key in cache] == ["a", "c", "d"]
    cache.get("e", make(90))
    assert [key for key in "abcde" if key in cache] == ["e"]


def test_one_array_may_be_larger_than_the_limit():
    cache = ByteCache(10)
    cache.get("a", make(1000))
    cache.get("a", never)
    cache.get("b", make(5))
    assert "a" not in cache and "b" in cache


def test_threads_that_ask_for_one_array_share_it():
    cache, started, go_on = ByteCache(100), threading.Event(), threading.Event()
    got: list[np.ndarray] = []

    def slow() -> np.ndarray:
        started.set()
        assert go_on.wait(30)
        return np.ones(4)

    first = threading.Thread(target=lambda: got.append(cache.get("a", slow)))
    second = threading.Thread(target=lambda: got.append(cache.get("a", never)))
    first.start()
    assert started.wait(30)
    second.start()
    assert cache.get("b", make(1)).size == 1  # Others are not held up.
    go_on.set()
    first.join(30)
    second.join(30)
    assert len(got) == 2 and got[0] is got[1]


def test_an_error_goes_to_its_maker_and_the_next_one_tries_again():
    cache, started, go_on = ByteCache(100), threading.Event(), threading.Event()
    caught: list[Exception] = []
    got: list[np.ndarray] = []

    def broken() -> np.ndarray:
        started.set()
        assert go_on.wait(30)
        raise ValueError("no disk")

    def first() -> None:
        with pytest.raises(ValueError, match="no disk") as error:
            cache.get("a", broken)
        caught.append(error.value)

    threads = [threading.Thread(target=first), threading.Thread(target=lambda: got.append(cache.get("a", make(3))))]
    threads[0].start()
    assert started.wait(30)
    threads[1].start()
    go_on.set()
    for thread in threads:
        thread.join(30)
    assert len(caught) == 1 and got[0].size == 3
