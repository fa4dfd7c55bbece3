"""Foreign recordings changed at random: imported, or refused in words with nothing written."""

import random
import shutil
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from fuzz.mutations import mutated_bytes, mutated_text
from recordings import BagKind, write_bag
from test_carts_layouts import ambf, cts, segstrong
from test_datasets import endovis, jigsaws, surgpose
from test_dvrk_recorder import session
from test_folder import lab
from test_lerobot import dataset
from test_surgsync import clip, episode

from carts_core.errors import CartsError
from carts_core.recording import Sequence
from carts_core.recording.importing.importer import import_recording

MAKERS: dict[str, Callable[[Path], Path]] = {
    "ROS 1 bag": lambda folder: _bag(folder, "rec.bag", BagKind(ros=1, frames=3, endoscope="measured_cp")),
    "ROS 2 bag, sqlite3": lambda folder: _bag(folder, "bag", BagKind(frames=3, endoscope="measured_js")),
    "ROS 2 bag, MCAP": lambda folder: _bag(folder, "bag", BagKind(storage="mcap", frames=3)),
    "dVRK recorder": session,
    "LeRobot v2.1": partial(dataset, version="v2.1"),
    "LeRobot v3.0": partial(dataset, version="v3.0"),
    "SurgSync clip": clip,
    "SurgSync episode": episode,
    "CTS": cts,
    "AMBF": ambf,
    "SegSTRONG-C": segstrong,
    "SurgPose": surgpose,
    "EndoVis": endovis,
    "JIGSAWS": jigsaws,
    "folder": lab,
}
TEXTS = (".json", ".jsonl", ".yaml", ".yml", ".csv", ".txt", ".ini")
SAMPLED, WHOLE = 2, 60


def _bag(folder: Path, name: str, kind: BagKind) -> Path:
    folder.mkdir(parents=True)
    return write_bag(folder / name, kind)


def mutate(folder: Path, rng: random.Random) -> str:
    """Change one file of a recording, or take it away; gives what was done."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    # Tables and descriptions more often than the many images.
    others = [path for path in files if path.suffix not in (".png", ".jpg")]
    file = rng.choice(others if others and rng.random() < 0.8 else files)
    what = rng.choice(("bytes", "bytes", "text", "text", "text", "missing", "empty", "folder", "swapped"))
    content = file.read_bytes()
    if what == "missing":
        file.unlink()
    elif what == "folder":
        file.unlink()
        file.mkdir()
    elif what == "empty":
        file.write_bytes(b"")
    elif what == "swapped":
        file.write_bytes(rng.choice(files).read_bytes())
    elif what == "text" and file.suffix in TEXTS:
        file.write_bytes(mutated_text(content, rng))
    else:
        file.write_bytes(mutated_bytes(content, rng))
    return f"{what} {file.relative_to(folder)}"


def campaign(name: str, count: int, sandbox: Path) -> tuple[int, int]:
    """Import mutated recordings of one kind; how many were imported and how many refused."""
    right = sandbox / "right"
    source = MAKERS[name](right / "source")
    imported = refused = 0
    for seed in range(count):
        work = sandbox / f"{seed}"
        shutil.copytree(right, work)
        done = mutate(work, random.Random(f"{name} {seed}"))
        before = sorted(work.rglob("*"))
        try:
            path, _ = import_recording(work / source.relative_to(right), work / "out")
        except CartsError as error:
            refused += 1
            assert len(str(error)) > 20, (name, seed, done)
            assert sorted(work.rglob("*")) == before, f"{name}, {seed} ({done}): something was written"
        except Exception as error:
            raise AssertionError(f"{name}, {seed} ({done}): {error!r}\n{traceback.format_exc()}") from error
        else:
            imported += 1
            assert len(Sequence.open(path)) > 0
        shutil.rmtree(work)
    print(f"{name}: {count} mutated, {imported} imported, {refused} refused in words")
    return imported, refused


@pytest.mark.parametrize("name", MAKERS)
def test_a_sample_of_mutated_recordings_is_imported_or_refused_in_words(name: str, tmp_path: Path) -> None:
    assert sum(campaign(name, SAMPLED, tmp_path)) == SAMPLED


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", MAKERS)
def test_60_mutated_recordings_of_each_source_are_imported_or_refused_in_words(name: str, tmp_path: Path) -> None:
    imported, refused = campaign(name, WHOLE, tmp_path)
    assert imported + refused == WHOLE and refused > 0
