"""`carts export`, `evaluate`, `render` and `batch` beside a project: its corrections are what counts."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from carts_core.batch.engines import Pool
from carts_core.cli.command_line import main
from carts_core.project import JointCorrection, Key, MaskCorrection, Project, Provenance, Review, ReviewState, Source
from carts_core.recording import Sequence
from carts_core.recording.images import read_mask

BY_HAND = Provenance(Source.HAND)


@pytest.fixture
def corrected(tiny_sequence: Callable[..., Path]) -> Path:
    """Two frames with a project of their true joint positions; the first is accepted, and painted on."""
    path = tiny_sequence(frames=2, width=160, height=128)
    sequence = Sequence.open(path)
    assert sequence.truth is not None
    edits = {
        Key.joints(index, "PSM1"): JointCorrection(tuple(sequence.truth["PSM1"][index].tolist()), BY_HAND)
        for index in range(2)
    }
    with Project.open(sequence) as project:
        project.apply("Correct", edits)
        added = np.zeros((128, 160), bool)
        added[:5, :5] = True
        painted = MaskCorrection.of(added, np.zeros_like(added))
        project.apply("Paint", {Key.mask_correction(0, "left"): painted, Key.review(0): Review(ReviewState.ACCEPTED)})
    return path


def true_mask(sequence: Path, frame: str) -> np.ndarray:
    return read_mask(sequence.parent / "masks" / "left" / f"{frame}.png")


def agreement(a: np.ndarray, b: np.ndarray) -> float:
    return 2 * (a & b).sum() / (a.sum() + b.sum())


def test_the_project_beside_a_recording_is_what_is_exported(
    corrected: Path, tmp_path: Path, said: Callable[[], str]
) -> None:
    main(["export", str(corrected), str(tmp_path / "out"), "--format", "masks"])
    text = said()
    assert "sequence.carts: 1 accepted, 1 untouched of 2 frames; --project none uses the measured joints" in text
    wanted = true_mask(corrected, "001")
    wanted[:5, :5] = True
    assert agreement(read_mask(tmp_path / "out" / "binary" / "left_001.png"), wanted) > 0.999
    assert agreement(read_mask(tmp_path / "out" / "binary" / "left_002.png"), true_mask(corrected, "002")) > 0.999
    views = json.loads((tmp_path / "out" / "export.json").read_text())["views"]
    assert [(view["source"], view["review"]) for view in views] == [("edited", "accepted"), ("edited", "untouched")]

    main(["export", str(corrected), str(tmp_path / "as_measured"), "--format", "masks", "--project", "none"])
    assert "corrections of" not in said()
    assert (
        agreement(read_mask(tmp_path / "as_measured" / "binary" / "left_002.png"), true_mask(corrected, "002")) < 0.95
    )


def test_kinematics_that_are_given_are_exported_and_the_project_is_named_as_left_out(
    corrected: Path, tmp_path: Path, said: Callable[[], str]
) -> None:
    main(["export", str(corrected), str(tmp_path / "table"), "--format", "csv", "--project", "none"])
    command = ["export", str(corrected), str(tmp_path / "again"), "--format", "csv"]
    main([*command, "--kinematics", str(tmp_path / "table.csv")])
    assert "sequence.carts is not used, since --kinematics is given" in said()
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "table.csv").read_bytes()


@pytest.mark.parametrize(("options", "right"), [([], True), (["--project", "none"], False)])
def test_the_project_is_where_an_evaluation_starts_and_what_is_rendered(
    corrected: Path, tmp_path: Path, said: Callable[[], str], options: list[str], right: bool
) -> None:
    scores = tmp_path / "scores.json"
    main(["evaluate", str(corrected), "--solver", "none", "--json", str(scores), *options])
    assert ("1 accepted, 1 untouched" in said()) == right
    found = json.loads(scores.read_text())
    assert (found["mean"]["dice_before"] > 0.999) == right and ("project" in found) == right
    main(["render", str(corrected), "--style", "mask", "--output", str(tmp_path / "out"), *options])
    assert ("1 accepted, 1 untouched" in said()) == right
    mask = read_mask(tmp_path / "out" / "regular" / "left" / "002.png")
    assert (agreement(mask, true_mask(corrected, "002")) > 0.999) == right


@pytest.mark.parametrize(
    ("steps", "options", "right"),
    [("export", [], True), ("export", ["--project", "none"], False), ("calibrate export", [], False)],
)
def test_a_batch_exports_the_project_beside_a_recording_that_it_does_not_correct_itself(
    corrected: Path,
    tmp_path: Path,
    said: Callable[[], str],
    monkeypatch: pytest.MonkeyPatch,
    steps: str,
    options: list[str],
    right: bool,
) -> None:
    # In this process, which has imported what the jobs need.
    monkeypatch.setattr(Pool, "run", lambda pool, jobs: map(pool._work, jobs))
    named = ", ".join(f'"{step}"' for step in steps.split())
    calibrate = '\ncalibrate = ["--settings", "iterations=1"]' if "calibrate" in steps else ""
    manifest = tmp_path / "manifest.toml"
    manifest.write_text(
        f'format = "carts-batch/1"\n[[jobs]]\nrecordings = ["sequence.toml"]\nsteps = [{named}]\n'
        f'[jobs.options]\nexport = ["--format", "csv"]{calibrate}\n'
    )
    batch = tmp_path / "batch"
    main(["batch", str(manifest), "--output", str(batch), "--workers", "1", *options])
    (table,) = batch.glob("jobs/*/export.csv")
    assert ("edited" in table.read_text()) == right
    assert ("1 of 1 job" in said()) == right


def test_a_project_that_cannot_be_used_is_named(
    corrected: Path, tmp_path: Path, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("other.carts").write_bytes(b"no project")
    export = "export", corrected, "out", "--format", "csv"
    assert "gone.carts is missing" in refused(*export, "--project", "gone.carts")
    assert "To ignore the project: --project none." in refused("render", corrected, "--project", "other.carts")
