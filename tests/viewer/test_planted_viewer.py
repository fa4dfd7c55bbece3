"""Links and special files wherever the viewer writes, laid before it opens or while it runs: none is followed."""

import random
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from planted import PLANTED, contents, plant, treasure
from tracing import places, traced
from viewer_desk import Desk

from carts_core.errors import CartsError
from carts_core.recording import Sequence
from carts_viewer.actions import intents
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.session import open_storage


def work(sequence_path: Path, meanwhile: Callable[[], None] = lambda: None) -> None:
    """Open the project, edit, export twice and close, as `carts view` does; errors in words may end each of these."""
    factory = OptimizerFactory(report=lambda line: None)
    sequence = Sequence.open(sequence_path)
    with suppress(CartsError):
        storage = open_storage(sequence)
        try:
            desk = Desk(sequence, storage.project, factory)
            desk.do(intents.SetJoint("PSM1", 0, 0.1), intents.Released())
            meanwhile()
            for intent in (
                intents.SetJoint("PSM1", 0, 0.2),
                intents.Released(),
                intents.Export("csv", "All"),
                intents.Export("masks", "All"),
            ):
                with suppress(CartsError):
                    desk.do(intent)
                    desk.finish()
            desk.session.close()
        finally:
            storage.close()


def attack(recording: Path, folder: Path, sample: int | None) -> int:
    """Plant each kind at each place that is written, before and while the viewer runs; the number of runs."""
    shutil.copytree(recording, folder / "trace" / "work")
    with traced() as trace:
        work(folder / "trace" / "work" / "sequence.toml")
    found = places(trace.written, folder / "trace" / "work")
    # SQLite opens these by itself, unseen.
    found += [Path(f"sequence.carts{suffix}") for suffix in ("-wal", "-shm", "-journal", ".lock")]
    attacks = [(place, kind, running) for place in found for kind in PLANTED for running in (False, True)]
    if sample is not None:
        attacks = random.Random(3).sample(attacks, sample)
    for number, (place, kind, running) in enumerate(attacks):
        here, home = folder / str(number) / "work", treasure(folder / str(number) / "home")
        shutil.copytree(recording, here)
        before, images = contents(home), contents(here / "regular")

        def lay(place: Path = place, kind: str = kind, here: Path = here, home: Path = home) -> None:
            plant(kind, here / place, home)

        if not running:
            lay()
        work(here / "sequence.toml", lay if running else lambda: None)
        assert contents(home) == before, (place, kind, running)
        assert contents(here / "regular") == images, (place, kind, running)
        shutil.rmtree(folder / str(number))
    print(f"view: {len(found)} places, {len(attacks)} runs: {', '.join(map(str, found))}")
    return len(attacks)


@pytest.fixture
def recording(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=1).parent


def test_nothing_planted_is_followed_by_the_viewer(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert attack(recording, tmp_path_factory.mktemp("attacks"), sample=4) == 4


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_nothing_planted_anywhere_is_followed_by_the_viewer(
    recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    assert attack(recording, tmp_path_factory.mktemp("attacks"), sample=None) > 50
