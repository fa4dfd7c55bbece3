"""Manifests: unique job names, and errors that are reported before any job runs."""

from pathlib import Path

import pytest

from carts_core.batch.folder import JobState, known_jobs, write_state
from carts_core.batch.manifest import Job, read_manifest, shard
from carts_core.cli.batch_job import check_options
from carts_core.errors import SettingsError
from carts_core.files import output_path

JOBS = '[[jobs]]\nrecordings = ["*/sequence.toml"]\nsteps = ["sequence", "export"]\n'


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    for name in ("b", "a", "c"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "sequence.toml").write_text("")
    return tmp_path


def manifest(archive: Path, text: str) -> Path:
    path = archive / "archive.toml"
    path.write_text(f'format = "carts-batch/1"\n{text}')
    return path


def test_every_recording_camera_and_domain_is_a_job(archive: Path) -> None:
    jobs = read_manifest(manifest(archive, JOBS + 'cameras = ["left", "right"]\ndomains = ["regular", "smoke"]'))
    assert len(jobs) == 3 * 2 * 2 and len({job.name for job in jobs}) == len(jobs)
    assert [job.name for job in jobs[:4]] == ["a-regular-left", "a-regular-right", "a-smoke-left", "a-smoke-right"]
    assert {job.recording for job in jobs} == {archive / name / "sequence.toml" for name in "abc"}


def test_the_folder_of_a_manifest_may_have_any_name(tmp_path: Path) -> None:
    folder = tmp_path / "[2024] *"
    (folder / "a").mkdir(parents=True)
    (folder / "a" / "sequence.toml").write_text("")
    assert [job.recording for job in read_manifest(manifest(folder, JOBS))] == [folder / "a" / "sequence.toml"]


def test_what_a_batch_has_made_is_no_new_recording(archive: Path) -> None:
    made = archive / "runs" / "calibration"
    made.mkdir(parents=True)
    (made / "sequence.toml").write_text("")
    everything = 'recordings = ["**/sequence.toml"]\nsteps = ["optimize"]\n'
    path = manifest(archive, "[[jobs]]\n" + everything)
    assert len(read_manifest(path)) == 4
    assert [job.name for job in read_manifest(path, archive / "runs")] == ["a", "b", "c"]
    with pytest.raises(SettingsError, match="matches no file"):
        read_manifest(manifest(archive, "[[jobs]]\n" + everything.replace("**", "runs/*")), archive / "runs")


def test_jobs_of_the_same_name_get_folders_of_their_own(archive: Path) -> None:
    names = [job.name for job in read_manifest(manifest(archive, JOBS + JOBS))]
    assert len(set(names)) == 6


def test_shards_have_every_job_once_and_impossible_ones_are_refused(archive: Path) -> None:
    jobs = read_manifest(manifest(archive, JOBS))
    for count in (1, 2, 5):
        parts = [shard(jobs, f"{number}/{count}") for number in range(1, count + 1)]
        assert sorted(job.name for part in parts for job in part) == sorted(job.name for job in jobs)
    for text in ("0/2", "3/2", "1", "a/b", "1/0", "-1/2", ""):
        with pytest.raises(SettingsError, match="Give I/N with 1 <= I <= N"):
            shard(jobs, text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"has no \[\[jobs\]\]"),
        ("jobs = 3", r"has no \[\[jobs\]\]"),
        ("stuff = 1\n" + JOBS, "contains stuff; allowed: format"),
        (JOBS + "camera = 'left'", "contains camera; allowed: cameras, domains"),
        (JOBS + "cameras = 'left'", "cameras is 'left'; give a list"),
        (JOBS + "cameras = []", r"cameras is \[\]; give a list"),
        (JOBS.replace("export", "train"), "step 'train' is unknown; allowed: import, calibrate"),
        (JOBS.replace('"sequence", "export"', '"export", "sequence"'), "in which they run: sequence, export"),
        (JOBS.replace("*/", "missing/"), "matches no file"),
        (JOBS + "[jobs.options]\noptimize = ['--together']", "options are given for 'optimize', but the steps are"),
        (JOBS + "options = 1", "options is 1; give a table"),
    ],
)
def test_what_is_wrong_with_a_manifest_is_said(archive: Path, text: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        read_manifest(manifest(archive, text))


@pytest.mark.parametrize("content", ["format = 1", "format = ", 'format = "carts-batch/2"\n' + JOBS])
def test_a_file_that_is_no_manifest_is_refused(archive: Path, content: str) -> None:
    path = archive / "archive.toml"
    path.write_text(content)
    with pytest.raises(SettingsError, match="manifest"):
        read_manifest(path)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--output", "is set by the batch"),
        ("--camera=left", "is set by the batch"),
        ("--wrong", "Unrecognized"),
        ("--free", "is not a valid command"),
    ],
)
def test_an_option_that_its_command_does_not_have_is_refused_before_anything_runs(
    archive: Path, option: str, message: str
) -> None:
    text = JOBS.replace(', "export"', "") + f'[jobs.options]\nsequence = ["{option}"]'
    with pytest.raises(SettingsError, match=message):
        check_options(read_manifest(manifest(archive, text)))


def test_unchanged_jobs_are_not_read_again(tmp_path: Path) -> None:
    batch, jobs = output_path(tmp_path), [Job("a", tmp_path / "a.bag", "all", "", ("import",))]
    write_state(batch / "jobs" / "a", JobState("done"))
    known = known_jobs(batch, jobs)
    assert known_jobs(batch, jobs, known)[0] is known[0]
    write_state(batch / "jobs" / "a", JobState("failed", error="No space left."))
    assert known_jobs(batch, jobs, known)[0].error == "No space left."
