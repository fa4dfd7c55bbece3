"""The mailbox between people and the worker."""

import threading
import time

from carts_viewer.intents import MoveFrame, SetJoint, SetOpacity, ShowFrame
from carts_viewer.mailbox import Mailbox


def test_of_a_burst_for_one_joint_only_the_last_value_is_left() -> None:
    mailbox = Mailbox()
    for value in range(100):
        mailbox.put(SetJoint("PSM1", 0, float(value)))
    assert mailbox.take(0) == [SetJoint("PSM1", 0, 99.0)]


def test_two_joints_moved_at_once_both_arrive() -> None:
    mailbox = Mailbox()
    mailbox.put(SetJoint("PSM1", 0, 1.0))
    mailbox.put(SetJoint("PSM1", 1, 2.0))
    mailbox.put(SetJoint("PSM2", 0, 3.0))
    assert len(mailbox.take(0)) == 3


def test_presses_of_a_button_are_never_merged() -> None:
    mailbox = Mailbox()
    for _ in range(3):
        mailbox.put(MoveFrame(1))
    assert mailbox.take(0) == [MoveFrame(1)] * 3


def test_intents_come_in_the_order_of_their_newest_version() -> None:
    mailbox = Mailbox()
    mailbox.put(SetJoint("PSM1", 0, 1.0))
    mailbox.put(ShowFrame(4))
    mailbox.put(SetJoint("PSM1", 0, 2.0))
    assert mailbox.take(0) == [ShowFrame(4), SetJoint("PSM1", 0, 2.0)]


def test_taking_empties_the_mailbox() -> None:
    mailbox = Mailbox()
    mailbox.put(SetOpacity(0.5))
    assert mailbox.waits(SetOpacity) and not mailbox.empty()
    mailbox.take(0)
    assert mailbox.take(0) == [] and mailbox.empty() and not mailbox.waits(SetOpacity)


def test_a_put_from_another_thread_wakes_whoever_waits() -> None:
    mailbox = Mailbox()
    threading.Thread(target=lambda: (time.sleep(0.05), mailbox.put(ShowFrame(1)))).start()
    assert mailbox.take(20) == [ShowFrame(1)]


def test_a_wait_can_be_ended_with_nothing() -> None:
    mailbox = Mailbox()
    threading.Thread(target=lambda: (time.sleep(0.05), mailbox.wake())).start()
    assert mailbox.take(20) == []
