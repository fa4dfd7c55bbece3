"""Names that lead elsewhere, links and special files: the viewer writes its project and its exports, nothing else."""

import random
import shutil
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest
from hostile_recording import WHERE, hostile_names, with_name
from planted import PLANTED, contents, plant, treasure
from tracing import places, traced
from viewer_desk import Desk

from carts_core.errors import CartsError
from carts_core.recording import Sequence
from carts_viewer.actions import intents
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.session import open_storage

OUTPUTS = ("sequence.carts", "sequence.carts.lock", "sequence_exports", "sequence_jobs.json")


def view(path: Path, meanwhile: Callable[[], None] = lambda: None) -> bool:
    """Open a project, edit, export and close, as `carts view` does; whether it could be opened."""
    try:
        sequence = Sequence.open(path)
        storage = open_storage(sequence)
    except CartsError:
        return False
    try:
        desk = Desk(sequence, storage.project, OptimizerFactory(report=lambda line: None))
        arm = sequence.scene.arms[0].name
        for number, step in enumerate(
            (
                (intents.SetJoint(arm, 0, 0.1), intents.Released()),
                (intents.SetJoint(arm, 0, 0.2), intents.Released()),
                *((intents.Export(name, "All"),) for name in ("csv", "masks", "coco")),
            )
        ):
            with suppress(CartsError):
                desk.do(*step)
                desk.finish()
            if not number:
                meanwhile()
        with suppress(CartsError):
            desk.session.close()
    finally:
        with suppress(CartsError):
            storage.close()
    return True


def _is_output(name: str) -> bool:
    parts = Path(name).parts
    return len(parts) > 1 and parts[0] == "work" and parts[1].startswith(OUTPUTS)


def view_hostile_names(recording: Path, sandbox: Path, count: int) -> int:
    """View recordings with hostile names; returns the number of opened recordings."""
    treasure(sandbox / "home")
    work, accepted = sandbox / "work", 0
    for number, name in enumerate(hostile_names(count, sandbox)):
        shutil.copytree(recording, work)
        file, where = work / "sequence.toml", WHERE[number % len(WHERE)]
        file.write_text(with_name(file.read_text(), where, name), encoding="utf-8", errors="surrogatepass")
        if where == "frame":
            header, row = (recording / "kinematics.csv").read_text().splitlines()
            quoted = '"' + name.replace('"', '""') + '"'
            (work / "kinematics.csv").write_text(f"{header}\n{quoted},{row.split(',', 1)[1]}\n", encoding="utf-8")
        before = contents(sandbox)
        accepted += view(file)
        after = {name: what for name, what in contents(sandbox).items() if not _is_output(name)}
        assert after == {name: what for name, what in before.items() if not _is_output(name)}, (where, name)
        shutil.rmtree(work)
    print(f"{count} names, {accepted} recordings opened; 0 writes outside")
    return accepted


def attack(recording: Path, folder: Path, sample: int | None) -> int:
    """Plant each kind at each place that is written, before and while the viewer runs; the number of runs."""
    shutil.copytree(recording, folder / "trace" / "work")
    with traced() as trace:
        view(folder / "trace" / "work" / "sequence.toml")
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
        lay = partial(plant, kind, here / place, home)
        if not running:
            lay()
        view(here / "sequence.toml", lay if running else lambda: None)
        assert contents(home) == before, (place, kind, running)
        assert contents(here / "regular") == images, (place, kind, running)
        shutil.rmtree(folder / str(number))
    print(f"view: {len(found)} places, {len(attacks)} runs: {', '.join(map(str, found))}")
    return len(attacks)


@pytest.fixture
def recording(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=1, masks=False, truth=False).parent


@pytest.fixture
def sandbox(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sandbox")


def test_hostile_names_and_planted_files_lead_nowhere_from_the_viewer(recording: Path, sandbox: Path) -> None:
    assert view_hostile_names(recording, sandbox / "names", 8) > 0
    assert attack(recording, sandbox / "attacks", sample=4) == 4


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_500_hostile_names_lead_nowhere_from_the_viewer(recording: Path, sandbox: Path) -> None:
    assert view_hostile_names(recording, sandbox, 500) > 50


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_nothing_planted_anywhere_is_followed_by_the_viewer(recording: Path, sandbox: Path) -> None:
    assert attack(recording, sandbox, sample=None) > 50
