"""Names in a recording that try to lead elsewhere: the viewer writes its project and its exports, nothing else."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from hostile_recording import WHERE, hostile_names, with_name
from planted import contents, treasure
from viewer_desk import Desk

from carts_core.errors import CartsError
from carts_core.recording import Sequence
from carts_viewer.actions import intents
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.session import open_storage

OUTPUTS = ("sequence.carts", "sequence.carts.lock", "sequence_exports", "sequence_jobs.json")


def view(path: Path) -> bool:
    """Open, edit, export and close; False if the recording is refused."""
    try:
        sequence = Sequence.open(path)
        storage = open_storage(sequence)
    except CartsError:
        return False
    try:
        desk = Desk(sequence, storage.project, OptimizerFactory(report=lambda line: None))
        arm = sequence.scene.arms[0].name
        for intent in (
            intents.SetJoint(arm, 0, 0.1),
            intents.Released(),
            intents.Export("csv", "All"),
            intents.Export("masks", "All"),
            intents.Export("coco", "All"),
        ):
            desk.do(intent)
            desk.finish()
        desk.session.close()
    finally:
        storage.close()
    return True


def campaign(recording: Path, sandbox: Path, count: int) -> int:
    """View recordings with hostile names; how many could be opened."""
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


def _is_output(name: str) -> bool:
    parts = Path(name).parts
    return len(parts) > 1 and parts[0] == "work" and parts[1].startswith(OUTPUTS)


@pytest.fixture
def recording(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=1, masks=False, truth=False).parent


def test_hostile_names_lead_nowhere_from_the_viewer(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert campaign(recording, tmp_path_factory.mktemp("sandbox"), 10) > 0


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_500_hostile_names_lead_nowhere_from_the_viewer(
    recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    assert campaign(recording, tmp_path_factory.mktemp("sandbox"), 500) > 50
