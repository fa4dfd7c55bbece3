"""The queue of intents, and their handlers."""

import inspect
import pkgutil
import threading
import time
from importlib import import_module

from carts_viewer import actions, controller
from carts_viewer.actions import intents
from carts_viewer.actions.context import Handler
from carts_viewer.actions.intents import Intent, MoveFrame, SetJoint, SetOpacity, ShowFrame
from carts_viewer.tabs import IntentQueue

TAB = "one"


def _taken(queue: IntentQueue[str], timeout: float) -> list[Intent]:
    return [asked.intent for asked in queue.take(timeout)]


def test_of_a_burst_for_one_joint_only_the_last_value_is_left() -> None:
    queue = IntentQueue[str]()
    for value in range(100):
        queue.put(TAB, SetJoint("PSM1", 0, float(value)))
    assert _taken(queue, 0) == [SetJoint("PSM1", 0, 99.0)]


def test_two_joints_moved_at_once_both_arrive() -> None:
    queue = IntentQueue[str]()
    queue.put(TAB, SetJoint("PSM1", 0, 1.0))
    queue.put(TAB, SetJoint("PSM1", 1, 2.0))
    queue.put(TAB, SetJoint("PSM2", 0, 3.0))
    assert len(_taken(queue, 0)) == 3


def test_presses_of_a_button_are_never_merged() -> None:
    queue = IntentQueue[str]()
    for _ in range(3):
        queue.put(TAB, MoveFrame(1))
    assert _taken(queue, 0) == [MoveFrame(1)] * 3


def test_intents_come_in_the_order_of_their_newest_version() -> None:
    queue = IntentQueue[str]()
    queue.put(TAB, SetJoint("PSM1", 0, 1.0))
    queue.put(TAB, ShowFrame(4))
    queue.put(TAB, SetJoint("PSM1", 0, 2.0))
    assert _taken(queue, 0) == [ShowFrame(4), SetJoint("PSM1", 0, 2.0)]


def test_taking_empties_the_queue() -> None:
    queue = IntentQueue[str]()
    queue.put(TAB, SetOpacity(0.5))
    assert queue.waits(TAB, SetOpacity) and not queue.empty()
    queue.take(0)
    assert _taken(queue, 0) == [] and queue.empty() and not queue.waits(TAB, SetOpacity)


def test_a_put_from_another_thread_wakes_whoever_waits() -> None:
    queue = IntentQueue[str]()
    threading.Thread(target=lambda: (time.sleep(0.05), queue.put(TAB, ShowFrame(1)))).start()
    assert _taken(queue, 20) == [ShowFrame(1)]


def test_a_wait_can_be_ended_with_nothing() -> None:
    queue = IntentQueue[str]()
    threading.Thread(target=lambda: (time.sleep(0.05), queue.wake())).start()
    assert _taken(queue, 20) == []


def test_every_intent_has_a_handler() -> None:
    modules = [
        controller,
        *(import_module(f"carts_viewer.actions.{each.name}") for each in pkgutil.iter_modules(actions.__path__)),
    ]
    handlers = {
        one for module in modules for one in vars(module).values() if inspect.isclass(one) and issubclass(one, Handler)
    }
    handled = {name.removeprefix("_on_") for handler in handlers for name in vars(handler) if name.startswith("_on_")}
    kinds = {kind for kind in vars(intents).values() if inspect.isclass(kind) and issubclass(kind, Intent)}
    assert handled == {kind.__name__ for kind in kinds if not any(base in kind.__subclasses__() for base in kinds)}
