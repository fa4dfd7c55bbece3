"""Files beside a recording, of a batch and of the user, each field replaced by wrong types and extreme values.

Every case is opened through the server by a tab: the page opens, says what is wrong, and nothing starts.
"""

import json
import logging
import os
import random
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from carts_core.batch.folder import write_jobs
from carts_core.batch.manifest import read_manifest
from carts_core.cli.batch_job import BatchWork
from carts_core.files import output_path
from carts_core.optimization.hand_eye import ImagePoint
from carts_core.project.identity import data_dir
from carts_core.settings import FreeParameters, SolverName, solver
from carts_core.settings.interchange import ImportOptions
from carts_core.settings.serialization import to_plain
from carts_viewer.jobs.choices import Choices, Observed
from carts_viewer.jobs.job_list import Job, JobState
from carts_viewer.jobs.networks import STARTED
from carts_viewer.start.site import Site
from carts_viewer.start.start_page import RecentProject
from carts_viewer.transport.events import Chosen
from carts_viewer.wizard.draft import Draft, Step
from tools.raw_tab import RawTab

DEEP: Any = []
for _ in range(100):
    DEEP = [DEEP]
VALUES: dict[str, Any] = {
    "null": None,
    "true": True,
    "minus one": -1,
    "half": 0.5,
    "1e308": 1e308,
    "10**30": 10**30,
    "empty text": "",
    "text": "x",
    "markup": "<img src=x onerror=alert(1)>",
    "path": "../../../../etc/passwd",
    "half a character": "\ud800",
    "huge text": "x" * 300_000,
    "empty list": [],
    "list": ["x", 1],
    "nested": DEEP,
    "table": {"x": {}},
    "huge list": [1] * 100_000,
}
CONTENTS: dict[str, bytes | None] = {
    "empty": b"",
    "text": b"x",
    "brackets": b"[" * 100_000,
    "not a number": b"[NaN, Infinity]",
    "zeros": bytes(1_000_000),
    "no text": bytes(range(256)),
    "a folder": None,
    "a pipe": None,
    "a link to nothing": None,
    "a link to /dev/zero": None,
}
"""Contents of whole files; None for a special file."""
REMOVED = "removed"
Steps = tuple[str | int, ...]


@dataclass(frozen=True)
class Case:
    """A companion file with one thing wrong."""

    companion: str
    place: Steps | None
    """Way to the field; None for the whole file."""
    wrong: str
    """Key of `VALUES` or `CONTENTS`, or `REMOVED`."""

    def __str__(self) -> str:
        return f"{self.companion} {'' if self.place is None else list(self.place)}: {self.wrong}"


def places(content: Any, way: Steps = ()) -> Iterator[Steps]:
    """Every field, and the first entry of every list."""
    yield way
    inner = content.items() if isinstance(content, dict) else []
    for key, value in list(enumerate(content))[:1] if isinstance(content, list) else inner:
        yield from places(value, (*way, key))


def with_wrong(content: Any, case: Case) -> str:
    """The content as text, with the wrong value in its place."""
    if not case.place:
        return json.dumps(VALUES[case.wrong])
    copy = json.loads(json.dumps(content))
    parent = copy
    for key in case.place[:-1]:
        parent = parent[key]
    if case.wrong == REMOVED:
        del parent[case.place[-1]]
    else:
        parent[case.place[-1]] = VALUES[case.wrong]
    return json.dumps(copy)


def plant(path: Path, content: Any, case: Case) -> None:
    """Put the wrong file in its place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    if case.place is not None:
        path.write_text(with_wrong(content, case))
    elif (whole := CONTENTS[case.wrong]) is not None:
        path.write_bytes(whole)
    elif case.wrong == "a folder":
        path.mkdir()
    elif case.wrong == "a pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero" if "zero" in case.wrong else "nowhere")


def job(number: int, kind: str, **options: Any) -> dict[str, Any]:
    row = asdict(Job(number, kind, "Harmless", {}, log=("12:00:00 begun",)))  # pyright: ignore[reportArgumentType]
    return row | {"options": options, "state": "waiting", "token": "0" * 32}


CHOICES = Choices(
    *("regular", "left", True, SolverName.ACS),
    *(solver("acs"), FreeParameters(arms=("PSM1",)), Observed(), "forward"),
)
JOBS = [
    job(1, "adapt", minutes=15, folder=1, first=0),
    job(2, "solve", whole=True, at=0, range=[0, 1]),
    job(3, "export", format="csv", frames="All", parts="arms", images=True, shown_camera=False, range=[0, 1]),
    job(4, "optimize", frames=[0, 1], first=0),
    job(5, "calibrate", frames=20) | {"choices": to_plain(CHOICES)},
]
"""Of another user; all of them wait."""
JOB_PLACES = [
    *places(JOBS),
    *((row, "options", *way) for row in range(1, 5) for way in places(JOBS[row]["options"])),
    *((4, "choices", *way) for way in places(JOBS[4]["choices"])),
]
POINT = asdict(ImagePoint(0, "left", "PSM1", "wrist", (10.0, 20.0)))
OPTIONS = asdict(
    ImportOptions(
        source="folder",
        images={"left": "images"},
        calibration={"left": "camera.yaml"},  # pyright: ignore[reportArgumentType]
        kinematics="kinematics.csv",  # pyright: ignore[reportArgumentType]
        columns={"time": "time"},
        flip=("yaw",),
        time_offset=0.1,
        frame_rate=30.0,
        arms={"PSM1": "PSM1"},
        robot={"PSM1": "builtin:psm_lnd"},
        wrist_length=0.0091,
        base={"PSM1": "base.json"},  # pyright: ignore[reportArgumentType]
    )
)
POSE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.1], [0.0, 0.0, 0.0, 1.0]]
CALIBRATION = {"arms": {"PSM1": POSE}, "cameras": {"left": POSE}, "intrinsics": {"left": [100.0, 100.0, 48.0, 36.0]}}


class World:
    """A server, a recording and a batch, and the companion files of both and of the user."""

    def __init__(self, folder: Path, weights: Path, recording: Path) -> None:
        self.folder, self._recording, self._batch = folder, recording, recording.parent.with_name("batch")
        self._count = 0
        folder.mkdir()
        self.site = Site([folder.parent], port=0, weights=(weights,))
        self.site.wait()

    def opened(self, case: Case) -> str:
        """Why a case is not as it must be; empty if it is."""
        self._count += 1
        place = self.folder / f"case{self._count}"
        try:
            return CHECKS[case.companion.partition(" ")[0]](self, case, place) or self.serves()
        finally:
            self.do(self.site.show_start)
            shutil.rmtree(place, ignore_errors=True)

    def do(self, work: Callable[[], None]) -> None:
        """Do something on the site's thread, and wait for it."""
        self.site.post(work)
        self.site.wait()

    def serves(self) -> str:
        """Why a tab gets no page; empty if it gets one."""
        app = self.site.app
        if app is None and not self.site.document.content:
            return "there is no document"
        with RawTab(self.site.url, hello=app is not None):
            pass
        if app is not None:
            app.wait_until_shown()
        return ""

    # ---- Beside a recording -----------------------------------------------------------------------------------------

    def recording(self, place: Path) -> Path:
        shutil.copytree(self._recording.parent, place)
        return place / self._recording.name

    def open_recording(self, case: Case, place: Path, name: str, content: Any) -> str:
        sequence = self.recording(place)
        (place / "sequence_adapted_1").mkdir()
        plant(place / name, content, case)
        self.do(lambda: self.site.open_sequence(sequence))
        app = self.site.app
        if app is None:
            return "" if 'class="problem"' in self.site.document.content else "the recording does not open"
        if problem := self.serves():
            return problem
        state = app.state
        if any(not (job.over or job.state is JobState.ASKED) for job in state.jobs):
            return "a job starts"
        if state.network != STARTED or len(app.project.state.steps):
            return "something has changed"
        kept = list(place.glob("*.damaged-*"))
        asked = any(job.state is JobState.ASKED for job in state.jobs) or bool(state.asked_network)
        read = name in ("sequence_jobs.json", "sequence_network.json")
        if read and not (state.problems and (kept or "no longer exists" in state.problems[0])) and not asked:
            return "" if case.wrong in ("empty list", "a link to nothing") else f"nothing is said: {state.jobs}"
        return ""

    # ---- Of the user ------------------------------------------------------------------------------------------------

    def open_start(self, case: Case, place: Path) -> str:
        sequence = self.recording(place)
        shutil.rmtree(data_dir() / "recent", ignore_errors=True)
        entry = asdict(RecentProject(str(sequence), "tiny", str(sequence.with_suffix(".carts")), 3, 1, 1, 1.7e9))
        file = data_dir() / "recent" / "recent.json"
        plant(file, [entry], case)
        self.do(self.site.show_start)
        shown = self.site.document.content
        said = "list of recent recordings" in shown or str(sequence) in shown
        none = case.wrong in ("empty list", REMOVED, "a link to nothing") or case.place == (0, "sequence")
        return "" if said or none else "nothing is said"

    def open_thumbnail(self, case: Case, place: Path) -> str:
        sequence = self.recording(place)
        entry = RecentProject(str(sequence), "tiny", "", 3, 1, 1, 1.7e9)
        shutil.rmtree(data_dir() / "recent", ignore_errors=True)
        plant(entry.thumbnail, None, case)
        (data_dir() / "recent" / "recent.json").write_text(json.dumps([asdict(entry)]))
        self.do(self.site.show_start)
        return "" if str(sequence) in self.site.document.content else "the recording is not listed"

    def open_draft(self, case: Case, place: Path) -> str:
        sequence = self.recording(place)
        shutil.rmtree(data_dir() / "drafts", ignore_errors=True)
        draft = asdict(Draft(Step.CHECK, str(sequence.parent), "tiny")) | {"options": OPTIONS, "points": [POINT]}
        draft |= {"format": "carts-draft/1", "calibration": CALIBRATION}
        if case.companion == "draft hand-eye":
            draft |= {"step": Step.HAND_EYE, "options": {}}
        plant(data_dir() / "drafts" / "0123.json", draft, case)
        self.do(self.site.show_start)
        if "Unfinished imports" not in self.site.document.content:
            return "the draft is not listed"
        if problem := self.serves():
            return problem
        for _ in range(2):
            self.do(lambda: self.site.show_recording("0123"))
            if problem := self.serves():
                return problem
            self.do(lambda: self.site._dispatch(Chosen("continue", "")))
        return self.serves()

    def open_decision(self, case: Case, place: Path) -> str:
        """A decision is named by a digest; a damaged one is none."""
        sequence = self.recording(place)
        weights = place / "sequence_adapted_1" / "surface.safetensors"
        weights.parent.mkdir()
        weights.write_bytes(b"weights")
        (place / "sequence_network.json").write_text('{"network": "Adapted 1"}')
        shutil.rmtree(data_dir() / "decisions", ignore_errors=True)
        plant(data_dir() / "decisions" / sha256(b"weights").hexdigest(), None, case)
        self.do(lambda: self.site.open_sequence(sequence))
        app = self.site.app
        if app is None or self.serves():
            return "the recording does not open"
        return "" if app.state.asked_network == "Adapted 1" and app.state.network == STARTED else "it is not asked for"

    # ---- Of a batch -------------------------------------------------------------------------------------------------

    def batch(self, place: Path) -> tuple[Path, Path]:
        """A copy of the batch, and its job's folder."""
        if not self._batch.exists():
            self._run_batch()
        shutil.copytree(self._batch, place)
        content = json.loads((place / "batch.json").read_text())
        (job,) = (place / "jobs").iterdir()
        assert job.name == content["jobs"][0]["name"]
        return place, job

    def _run_batch(self) -> None:
        manifest = self._recording.with_name("archive.toml")
        manifest.write_text(
            f'format = "carts-batch/1"\n[[jobs]]\nrecordings = ["{self._recording.name}"]\nsteps = ["optimize"]\n'
            '[jobs.options]\noptimize = ["--settings", "iterations=2"]\n'
        )
        jobs = read_manifest(manifest)
        write_jobs(output_path(self._batch), jobs)
        work = BatchWork(output_path(self._batch), inference="torch")
        assert [outcome.status for outcome in map(work, jobs)] == ["done"]

    def open_batch(self, case: Case, place: Path) -> str:
        batch, job = self.batch(place)
        name = case.companion.partition(" ")[2]
        file = next((path for path in (batch / name, job / name) if path.exists()), None) or next(job.rglob(name))
        content = json.loads(file.read_text()) if file.suffix == ".json" else None
        plant(file, content, case)
        self.do(lambda: self.site.show_batch(batch))
        if problem := self.serves():
            return problem
        shown = self.site.document.content
        said = "cannot be read" in shown or 'class="problem"' in shown
        if name == "batch.json" and "Batch case" not in shown and not said:
            return "nothing is said"
        if name in ("job.json", "findings.json") and case.wrong in NEVER and not said:
            return "nothing is said"
        self.do(lambda: self.site._dispatch(Chosen("review", job.name)))
        app = self.site.app
        if app is not None and any(not one.over for one in app.state.jobs):
            return "a job starts"
        return self.serves()


def wrong_cases(companion: str, ways: Iterable[Steps] = ()) -> list[Case]:
    """Every wrong value in each of these places, each place without its field, and a whole file replaced."""
    values = [Case(companion, way, name) for way in ways for name in (*VALUES, REMOVED) if way or name != REMOVED]
    return [*values, *(Case(companion, None, name) for name in CONTENTS)]


def cases(world: World, group: str) -> list[Case]:
    """All cases of one of `GROUPS`."""
    recent = asdict(RecentProject("", "", "", 0, 0, 0, 0.0))
    draft = asdict(Draft(Step.CHECK, "x", "tiny")) | {"options": OPTIONS, "points": [POINT], "calibration": CALIBRATION}
    known = {
        "jobs": JOB_PLACES,
        "network": places({"network": ""}),
        "recent": places([recent]),
        "draft": places({**draft, "format": ""}),
        "draft hand-eye": [way for way in places(draft) if way[:1] in (("points",), ("calibration",))],
    }
    if group == "beside":
        return [case for name in BESIDE for case in wrong_cases(f"beside {name}")]
    if not group.startswith("batch"):
        return wrong_cases(group, known.get(group, ()))
    name = group.partition(" ")[2]
    batch, job = world.batch(world.folder / "example")
    file = batch / name if name == "batch.json" else next(job.rglob(name))
    ways = list(places(json.loads(file.read_text()))) if file.suffix == ".json" else []
    shutil.rmtree(batch)
    if name == "results.json":
        first = next((way[1] for way in ways if len(way) == 2 and way[0] == "frames"), "")
        ways = [way for way in ways if way[:1] != ("frames",) or way[1:2] in ((), (first,))]
    elif name == "findings.json":
        ways = [way for way in ways if way[:1] not in (("corrections",), ("deviations",)) or len(way) < 3]
    return wrong_cases(f"batch {file.name}", ways)


NEVER = ("nested", "half a character", "10**30", "brackets", "zeros", "no text")
"""Wrong in every place."""
CHECKS: dict[str, Callable[[World, Case, Path], str]] = {
    "jobs": lambda world, case, place: world.open_recording(case, place, "sequence_jobs.json", JOBS),
    "network": lambda world, case, place: world.open_recording(
        case, place, "sequence_network.json", {"network": "Adapted 1"}
    ),
    "beside": lambda world, case, place: world.open_recording(case, place, case.companion.partition(" ")[2], None),
    "recent": World.open_start,
    "thumbnail": World.open_thumbnail,
    "draft": World.open_draft,
    "decision": World.open_decision,
    "batch": World.open_batch,
}
BESIDE = (
    *(f"sequence.carts{suffix}" for suffix in ("", "-wal", "-journal", "-shm")),
    *("sequence.rescued-20260101-000000.carts", "sequence_adapted_1", "sequence_exports"),
    *(f"sequence_adapted_1/{name}.safetensors" for name in ("surface", "checkpoint")),
)
OF_A_BATCH = ("batch.json", "job.json", "findings.json", "results.json", "kinematics.csv", "*.jpg")
GROUPS = (
    *("jobs", "network", "beside", "decision", "recent", "thumbnail", "draft", "draft hand-eye"),
    *(f"batch {name}" for name in OF_A_BATCH),
)
SEEN = (
    Case("jobs", (0, "number"), "text"),
    Case("jobs", (0, "options", "minutes"), "text"),
    Case("batch job.json", ("status",), "text"),
    Case("batch job.json", ("error",), "minus one"),
    Case("draft hand-eye", ("calibration", "arms", "PSM1", 0), REMOVED),
    Case("batch kinematics.csv", None, "a folder"),
)
"""With these, no tab got a page, or the page met an unexpected error."""


@pytest.fixture
def world(shared_sequence: Callable[..., Path], tmp_path: Path, untrained_weights: Path) -> Iterator[World]:
    """A recording of two frames and a batch of one job, which is done."""
    original = shutil.copytree(shared_sequence(frames=2).parent, tmp_path / "original")
    world = World(tmp_path / "work", untrained_weights, original / "sequence.toml")
    with world.site:
        yield world


def wrong(world: World, chosen: Iterable[Case], caplog: pytest.LogCaptureFixture) -> list[str]:
    """What is not as it must be."""
    found = []
    for case in chosen:
        caplog.clear()
        try:
            problem = world.opened(case)
        except Exception as error:
            problem = repr(error)
        errors = [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]
        if problem or errors:
            found.append(f"{case}: {problem} {errors}")
            print(found[-1], flush=True)
    return found


@pytest.mark.timeout(600)
def test_a_tab_gets_its_page_whatever_a_companion_file_holds(world: World, caplog: pytest.LogCaptureFixture) -> None:
    dice = random.Random(1)
    others = [group for group in GROUPS if group not in {case.companion for case in SEEN}]
    assert wrong(world, [*SEEN, *(dice.choice(cases(world, group)) for group in others)], caplog) == []


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("group", GROUPS)
def test_a_tab_gets_its_page_with_any_field_of_a_companion_file_wrong(
    world: World, group: str, caplog: pytest.LogCaptureFixture
) -> None:
    chosen = cases(world, group)
    print(f"{group}: {len(chosen)} cases", flush=True)
    assert wrong(world, chosen, caplog) == []
