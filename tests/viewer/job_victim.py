"""A viewer that queues jobs and works on them until it is killed, and says what it has promised."""

import random
import time
from multiprocessing.connection import Connection
from pathlib import Path

import torch

from carts_core.project import ReviewState
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.state import ViewState

FORMATS = ("masks", "coco", "csv")


def queue_jobs(sequence: Path, weights: Path, seed: int, more: bool, tell: Connection) -> None:
    """Open the viewer, queue jobs now and then while somebody edits, and tell the state of every job that changes.

    Args:
        sequence: the recording.
        weights: of a small network.
        seed: of what is done.
        more: whether to queue more; otherwise what waits is finished, and the viewer ends by itself.
        tell: gets lists of (number, kind, state) whenever they change.
    """
    torch.set_num_threads(1)
    dice = random.Random(seed)
    app = ViewerApp.open(sequence, port=0, weights=(weights,))
    app.queue.put(intents.SetSetting("solver", "surface"))
    said: list[tuple[int, str, str]] = []
    tell.send(said)
    end = time.monotonic() + 240
    while time.monotonic() < end:
        state = app.state
        now = [(job.number, job.kind, str(job.state)) for job in state.jobs]
        if now != said:
            said = now
            tell.send(now)
        if more:
            _work(app, state, dice)
        elif now and all(kind in ("done", "failed", "cancelled") for _, _, kind in now):
            break
        time.sleep(0.02)
    app.close()
    tell.send(None)


def _work(app: ViewerApp, state: ViewState, dice: random.Random) -> None:
    """Somebody at work: mostly looks and edits, and queues a job where fewer than four wait."""
    waiting = sum(not job.over for job in state.jobs)
    what = dice.random()
    if what < 0.5:
        app.queue.put(intents.ShowFrame(dice.randrange(len(app.sequence))))
    elif what < 0.7:
        app.queue.put(intents.Perturb(dice.uniform(0.1, 3.0), dice.randrange(1000)))
    elif what < 0.75:
        app.queue.put(intents.SetReview(dice.choice((ReviewState.ACCEPTED, ReviewState.UNTOUCHED))))
    elif waiting < 4:
        app.queue.put(
            dice.choice(
                (
                    intents.OptimizeFrames("all"),
                    intents.Solve(whole=True),
                    intents.Calibrate(2),
                    intents.Export(dice.choice(FORMATS), "All"),
                    intents.Export(dice.choice(FORMATS), "All"),
                )
            )
        )
