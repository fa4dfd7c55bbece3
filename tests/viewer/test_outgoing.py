"""Messages to tabs that several threads queue at once."""

import asyncio
import threading

import pytest
from viser._messages import GuiUpdateMessage
from viser.infra import _infra
from viser.infra._async_message_buffer import AsyncMessageBuffer

from carts_viewer.transport.viser_private import LoopEvent, MessageBuffer, queue_safely


@pytest.fixture
def event_loop_in_a_thread():
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    yield loop
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    loop.close()


def test_an_event_is_set_by_its_loop_only(event_loop_in_a_thread: asyncio.AbstractEventLoop) -> None:
    event = LoopEvent(event_loop_in_a_thread)
    waiting = asyncio.run_coroutine_threadsafe(event.wait(), event_loop_in_a_thread)
    event.set()

    async def set_on_another_loop() -> None:
        event.set()

    other = threading.Thread(target=lambda: asyncio.run(set_on_another_loop()))
    other.start()
    other.join()
    assert not event.is_set()
    event_loop_in_a_thread.call_soon_threadsafe(event.set)
    assert waiting.result(10) and event.is_set()


def test_every_tab_gets_what_threads_queue_at_the_same_time(event_loop_in_a_thread: asyncio.AbstractEventLoop) -> None:
    loop, tabs, threads, messages = event_loop_in_a_thread, 8, 3, 1000
    buffer = MessageBuffer(loop, persistent_messages=True, window_duration_sec=0.0)
    failures: list[BaseException] = []

    async def receive(tab: int) -> set[str]:
        seen: set[str] = set()
        async for window in buffer.window_generator(tab):
            seen |= {message.uuid for message in window if isinstance(message, GuiUpdateMessage)}
            if len(seen) == threads * messages:
                break
        return seen

    def send(thread: int) -> None:
        try:
            for number in range(messages):
                buffer.push(GuiUpdateMessage(f"{thread}-{number}", {"value": number}))
        except BaseException as error:
            failures.append(error)

    received = [asyncio.run_coroutine_threadsafe(receive(tab), loop) for tab in range(tabs)]
    senders = [threading.Thread(target=send, args=(thread,)) for thread in range(threads)]
    for sender in senders:
        sender.start()
    for sender in senders:
        sender.join()
    assert not failures
    expected = {f"{thread}-{number}" for thread in range(threads) for number in range(messages)}
    assert all(future.result(60) == expected for future in received)


def test_servers_and_tabs_use_safe_queues(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_infra, "AsyncMessageBuffer", AsyncMessageBuffer)
    queue_safely()
    assert _infra.AsyncMessageBuffer is MessageBuffer  # pyright: ignore[reportPrivateImportUsage]
