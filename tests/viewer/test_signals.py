"""`carts view` is asked to end, or killed, at any moment: what the page has called saved is there, and a draft, too."""

import multiprocessing
import os
import random
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import viewer_victim
from viewer_client import Client

from carts_core.project import Project
from carts_core.recording import Sequence
from carts_viewer.app import ViewerApp
from carts_viewer.serving import opened_in_browser, serve, webbrowser
from tools.raw_tab import RawTab

FRAMES = 6


def _serve_until_signal(sequence: Path, weights: Path, tell) -> None:
    """`carts view` as it is, but for a page that a test can find its way in."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    opened = ViewerApp.open

    def once(*arguments, **options):
        ViewerApp.open = opened
        return viewer_victim.open_and_tell(sequence, weights, tell)

    ViewerApp.open = once  # pyright: ignore[reportAttributeAccessIssue]
    serve(sequence, port=0)


def _live(sequence_path: Path, weights: Path, number: int, seed: int, least: int = 0) -> int:
    """Work in a new process until a signal ends it, when so many edits at least were acknowledged; how many were."""
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["carts_viewer.app"])
    ours, theirs = processes.Pipe(duplex=False)
    # A daemon, so that a test that fails before the signal does not keep pytest from ending.
    victim = processes.Process(target=_serve_until_signal, args=(sequence_path, weights, theirs), daemon=True)
    victim.start()
    theirs.close()
    assert ours.poll(120), "the app did not start"
    url = ours.recv()
    dice = random.Random(seed)
    before = _names(sequence_path)
    with RawTab(url, keep=1) as tab:
        ids = ours.recv()
        pixels = iter([(row, column) for row in range(72) for column in range(96)])
        client = Client(tab, ids, FRAMES, dice, iter(range(seed * 10**6 + 1, 10**9)), pixels)
        assert victim.pid is not None
        pid, delay = victim.pid, 0.3 + 2.0 * dice.random()

        def end() -> None:
            """A while after the least that is asked for, which a busy machine takes long for."""
            patience = time.monotonic() + 60
            while len(client.seen) < least and time.monotonic() < patience:
                time.sleep(0.05)
            time.sleep(delay)
            os.kill(pid, number)

        killer = threading.Thread(target=end)
        killer.start()
        client.work()
        killer.join()
    victim.join(60)
    assert victim.exitcode == (-9 if number == signal.SIGKILL else 0), victim.exitcode
    with Project.open(Sequence.open(sequence_path)) as project:
        assert project.writable
        steps = [step.name for step in project.state.steps]
        assert steps[: len(before)] == before
        for edit in client.seen:
            assert steps[edit.number - 1 : edit.number] == [edit.name], edit
            project.go_to(edit.number)
            assert edit.holds(project.state), edit
        project.go_to(len(steps))
    return len(client.seen)


def _names(sequence_path: Path) -> list[str]:
    if not sequence_path.with_suffix(".carts").exists():
        return []
    with Project.open(Sequence.open(sequence_path), read_only=True) as project:
        return [step.name for step in project.state.steps]


def test_nothing_acknowledged_is_lost_to_any_signal(
    tiny_sequence: Callable[..., Path], untrained_weights: Path
) -> None:
    path = tiny_sequence(frames=FRAMES, width=96, height=72)
    acknowledged = sum(
        _live(path, untrained_weights, number, seed, least=1)
        for seed, number in enumerate((signal.SIGTERM, signal.SIGHUP, signal.SIGKILL))
    )
    assert acknowledged >= 3


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_nothing_acknowledged_is_lost_to_60_signals(
    tiny_sequence: Callable[..., Path], untrained_weights: Path
) -> None:
    path = tiny_sequence(frames=FRAMES, width=96, height=72)
    numbers = (signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)
    counts = [_live(path, untrained_weights, numbers[seed % 3], seed) for seed in range(60)]
    print(f"{sum(counts)} edits acknowledged in 60 lives")


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.slow), signal.SIGINT])
def test_a_note_that_nobody_has_left_yet_is_saved(
    tiny_sequence: Callable[..., Path], untrained_weights: Path, number: signal.Signals
) -> None:
    path = tiny_sequence(frames=2)
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["carts_viewer.app"])
    ours, theirs = processes.Pipe(duplex=False)
    # A daemon, so that a test that fails before the signal does not keep pytest from ending.
    victim = processes.Process(target=_serve_until_signal, args=(path, untrained_weights, theirs), daemon=True)
    victim.start()
    assert ours.poll(120), "the app did not start"
    url = ours.recv()
    with RawTab(url, keep=1) as tab:
        ids = ours.recv()
        time.sleep(1.0)
        tab.set(ids.note, "half a th")
        time.sleep(1.0)
        assert victim.pid is not None
        os.kill(victim.pid, number)
        victim.join(60)
    assert victim.exitcode == 0
    with Project.open(Sequence.open(path), read_only=True) as project:
        assert project.state.review(0).note == "half a th"


def test_a_token_is_not_on_the_command_line_of_the_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    url = "http://192.168.0.7:8080/?token=secret&more"
    with opened_in_browser(url):
        (given,) = opened
        page = Path(given.removeprefix("file://"))
        assert "secret" not in given and "url=http://192.168.0.7:8080/?token=secret&amp;more" in page.read_text()
        assert page.stat().st_mode & 0o777 == 0o600 and page.parent.stat().st_mode & 0o777 == 0o700
    assert not page.parent.exists()
    with opened_in_browser("http://127.0.0.1:8080"):
        assert opened[1:] == ["http://127.0.0.1:8080"]
