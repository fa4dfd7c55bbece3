"""Ctrl-C, SIGTERM and SIGHUP end a command in the same way, between two steps."""

import os
import signal
import subprocess
import sys

import pytest

from carts_core.stopping import Stopped, exit_status, finished_first, message, stopped_by_signals, when_stopped

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


@pytest.mark.parametrize("number", SIGNALS)
def test_each_signal_stops_with_the_status_that_shells_have_for_it(number: signal.Signals) -> None:
    with pytest.raises(Stopped) as stop, stopped_by_signals(), when_stopped("2 of 3 frames are kept"):
        os.kill(os.getpid(), number)
    assert exit_status(stop.value) == 128 + number
    by = "interrupted" if number == signal.SIGINT else f"stopped by {number.name}"
    assert message(stop.value) == f"{by}; 2 of 3 frames are kept"


def test_what_was_begun_is_finished_before_the_stop() -> None:
    done = []
    with pytest.raises(Stopped), stopped_by_signals():
        with finished_first():
            with finished_first():
                os.kill(os.getpid(), signal.SIGTERM)
                done.append("inner")
            done.append("outer")
        done.append("never")
    assert done == ["inner", "outer"]


def test_handlers_are_those_of_before_when_the_command_has_ended() -> None:
    before = [signal.getsignal(number) for number in SIGNALS]
    with stopped_by_signals():
        assert [signal.getsignal(number) for number in SIGNALS] != before
    assert [signal.getsignal(number) for number in SIGNALS] == before


def test_a_signal_that_is_ignored_stays_ignored_as_under_nohup() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stopped_by_signals():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_forked_child_ends_by_the_signal_itself() -> None:
    code = """
import os, signal, time
from carts_core.stopping import stopped_by_signals
with stopped_by_signals():
    ready, begun = os.pipe()
    if not (child := os.fork()):
        os.write(begun, b"!")
        time.sleep(60)
    os.read(ready, 1)
    os.kill(child, signal.SIGTERM)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=30)
    assert (ran.stdout.strip(), ran.stderr) == ("-15", "")
