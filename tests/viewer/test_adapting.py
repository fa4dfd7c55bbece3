"""The network adapted to the recording, as a job of the page, and which network runs."""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import expect
from viewer_canvas import eventually
from viewer_desk import Desk
from viewer_tab import Tab

from carts_core.errors import CartsError
from carts_core.project import Project
from carts_core.recording import Sequence
from carts_core.resources import shipped_weights
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.jobs import work as adapting
from carts_viewer.jobs.companions import Decisions
from carts_viewer.jobs.job_list import AdaptOptions, Job, JobState
from carts_viewer.jobs.networks import STARTED, Networks
from carts_viewer.jobs.optimizers import OptimizerFactory

SMALL = (
    "--steps 2 --batch-size 1 --workers 1 --threads 1 --validation-samples 2 --images.width 64 --images.height 48 "
    "--images.field-width 64 --fits 1"
).split()
OVER = 240.0
"""Time for a small run on a busy machine [s]."""


@pytest.fixture
def small_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Training of two steps on small images."""
    monkeypatch.setattr(adapting, "OPTIONS", tuple(SMALL))


@pytest.fixture
def at_desk(tiny_sequence: Callable[..., Path]) -> Desk:
    """A desk with the shipped networks."""
    sequence = Sequence.open(tiny_sequence(frames=2))
    return Desk(sequence, Project.open(sequence), OptimizerFactory(inference="torch", report=lambda line: None))


def networks(project: Path, factory: OptimizerFactory | None = None, *, kept: bool = True) -> Networks:
    """The networks of a project, as a new viewer finds them."""
    factory = factory or OptimizerFactory(inference="torch", report=lambda line: None)
    return Networks(project, kept=kept, optimizers=factory, decisions=Decisions())


def ended(desk: Desk) -> Job:
    """The newest job, once it is over."""
    until = time.monotonic() + OVER
    while not desk.state.jobs[-1].over:
        assert time.monotonic() < until, desk.state.jobs[-1]
        time.sleep(desk.wait_time() or 0.0)
        desk.advance()
    return desk.state.jobs[-1]


@pytest.mark.slow
@pytest.mark.usefixtures("small_run")
def test_a_job_adapts_the_network_and_what_it_made_is_used_and_remembered(at_desk: Desk) -> None:
    at_desk.do(intents.Adapt(1))
    assert at_desk.wait_time() == 0.0
    # The page stays usable meanwhile.
    assert at_desk.do(intents.ShowFrame(1)).index == 1
    job = ended(at_desk)
    assert job.state is JobState.DONE and "Dice" in job.text and "of the error is left" in job.text
    assert any("step 0: made images of this recording" in line for line in job.log)
    folder = at_desk.session.editor.project.path.with_name("sequence_adapted_1")
    assert (folder / "surface.safetensors").is_file()
    # It is offered, and nothing is changed before somebody wants it.
    assert at_desk.state.networks == (STARTED, "Adapted 1") and at_desk.state.network == STARTED
    before = at_desk.factory.prepare().sha256
    assert at_desk.do(intents.UseNetwork("Adapted 1")).network == "Adapted 1"
    after = at_desk.factory.prepare().sha256
    assert before != after
    project = at_desk.session.editor.project.path
    again = OptimizerFactory(inference="torch", report=lambda line: None)
    assert networks(project, again).used == "Adapted 1" and again.prepare().sha256 == after
    # Weights of the command line count more, and weights that are damaged are not used.
    given = OptimizerFactory(weights=(shipped_weights()[1],), inference="torch", report=lambda line: None)
    assert networks(project, given).used == STARTED
    (folder / "surface.safetensors").write_bytes(b"nothing")
    assert networks(project, again).used == STARTED
    at_desk.do(intents.UseNetwork("Adapted 1"))
    with pytest.raises(CartsError, match=r"surface\.safetensors"):
        at_desk.do(intents.AnswerNetwork(True))
    assert at_desk.do(intents.UseNetwork(STARTED)).network == STARTED
    assert at_desk.factory.prepare().sha256 == before
    with pytest.raises(CartsError, match=r"no network '\.\./\.\./else'"):
        at_desk.do(intents.UseNetwork("../../else"))


@pytest.fixture
def planted(tmp_path: Path) -> Path:
    """A project with a network that another user has made and chosen."""
    folder = tmp_path / "work_adapted_1"
    folder.mkdir()
    (folder / "surface.safetensors").write_bytes(shipped_weights()[1].read_bytes())
    (tmp_path / "work_network.json").write_text('{"network": "Adapted 1"}')
    return tmp_path / "work.carts"


@pytest.mark.parametrize("kept", [True, False])
def test_weights_of_another_user_are_asked_for_once_a_file(
    planted: Path, kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = networks(planted, kept=kept)
    assert (first.used, first.asked) == (STARTED, "Adapted 1")
    first.answer(True)
    assert (first.used, first.asked) == ("Adapted 1", "")
    with pytest.raises(CartsError, match="No network waits"):
        first.answer(True)
    again = networks(planted, kept=kept)
    assert (again.used, again.asked) == ("Adapted 1", "")
    monkeypatch.setenv("CARTS_DATA", str(tmp_path / "other user"))
    other = networks(planted, kept=kept)
    assert (other.used, other.asked) == (STARTED, "Adapted 1")
    other.answer(False)
    refused = networks(planted, kept=kept)
    assert (refused.used, refused.asked) == (STARTED, "")
    refused.use("Adapted 1")
    assert (refused.used, refused.asked) == (STARTED, "Adapted 1")


def test_weights_that_were_replaced_are_asked_for_again(planted: Path) -> None:
    first = networks(planted)
    first.answer(True)
    planted.with_name("work_adapted_1").joinpath("surface.safetensors").write_bytes(b"others")
    again = networks(planted)
    assert (again.used, again.asked) == (STARTED, "Adapted 1")


@pytest.mark.parametrize("content", ["", "[]", '{"network": 1}', '{"network": null}', "{}", "[" * 100])
def test_a_damaged_choice_is_kept_and_the_first_network_runs(planted: Path, content: str) -> None:
    file = planted.with_name("work_network.json")
    file.write_text(content)
    found = networks(planted)
    assert (found.used, found.asked) == (STARTED, "") and "choice of a network work_network.json" in found.problem
    assert file.with_name("work_network.json.damaged-1").read_text() == content and not file.exists()


def test_training_that_is_cancelled_ends_and_goes_on_in_its_folder(
    at_desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapting, "OPTIONS", ("--steps", "100000", "--checkpoint-every", "1", *SMALL[2:]))
    trainings: list[subprocess.Popen] = []
    popen = subprocess.Popen

    def watched(*arguments: Any, **options: Any) -> subprocess.Popen:
        trainings.append(popen(*arguments, **options))
        return trainings[-1]

    monkeypatch.setattr(subprocess, "Popen", watched)
    at_desk.do(intents.Adapt(1))
    until, folder = time.monotonic() + OVER, at_desk.session.editor.project.path.with_name("sequence_adapted_1")
    while not (folder / "checkpoint.safetensors").is_file():
        assert time.monotonic() < until
        time.sleep(0.1)
        at_desk.advance()
    at_desk.do(intents.CancelJob(1))
    assert at_desk.state.jobs[0].state is JobState.CANCELLED and at_desk.wait_time() is None
    assert trainings[0].wait(OVER) != 0
    assert any("step 0" in line for line in at_desk.state.jobs[0].log)
    assert (folder / "checkpoint.safetensors").is_file()
    monkeypatch.setattr(adapting, "OPTIONS", tuple(SMALL))
    at_desk.do(intents.RepeatJob(1))
    job = ended(at_desk)
    assert job.state is JobState.DONE and job.options == AdaptOptions(1, 1)
    at_desk.do(intents.RepeatJob(2))
    assert at_desk.state.jobs[-1].options == AdaptOptions(1, 2)
    at_desk.do(intents.CancelJob(3))


def test_a_program_that_ends_while_it_trains_does_not_hang(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    program = (
        "import pathlib, sys; from carts_viewer.jobs.work import adapt\n"
        "training = adapt(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), 1.0); next(training)"
    )
    subprocess.run([sys.executable, "-c", program, tiny_sequence(frames=2), tmp_path / "run"], check=True, timeout=OVER)


def test_training_that_fails_says_why(at_desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapting, "OPTIONS", ("--steps", "0"))
    at_desk.do(intents.Adapt(1))
    with pytest.raises(CartsError, match="steps is 0; allowed is 1 or more"):
        ended(at_desk)
    assert at_desk.state.jobs[0].state is JobState.FAILED and at_desk.state.networks == (STARTED,)


def test_a_run_says_what_the_network_does_not_know_once_and_what_helps(
    at_desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_desk.do(intents.SetSetting("solver", "surface"), intents.SetSetting("iterations", 1))
    state = at_desk.do(intents.Step())
    assert all("Fit masks (Fit to), or adapt the network" in line for line in state.unfamiliar)
    monkeypatch.setattr(sys.modules["carts_core.optimization.verdict"], "RECOGNIZED", 1.01)
    at_desk.factory.use(None)
    at_desk.factory._unfamiliar.clear()
    state = at_desk.do(intents.Reset(), intents.Step())
    assert "may not know this robot" in state.unfamiliar[0]
    assert at_desk.do(intents.Reset(), intents.SetObserved("masks", "recording"), intents.Step()).unfamiliar == ()


@pytest.mark.browser
@pytest.mark.usefixtures("small_run")
def test_the_network_is_adapted_in_the_page_and_used(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=2)
    tab = open_tab(app)
    tab.page.get_by_text("Jobs", exact=True).first.click()
    expect(tab.page.get_by_role("button", name="Use the newest network", exact=True)).to_have_count(0)
    tab.button("Adapt the network")
    offered = tab.page.get_by_role("button", name="Use the newest network", exact=True)
    expect(offered).to_be_visible(timeout=1000 * OVER)
    tab.button("Use the newest network")
    eventually(lambda: tab.state.network, lambda network: network == "Adapted 1")
    kept = app.project.path.with_name(f"{app.project.path.stem}_network.json")
    assert json.loads(kept.read_text()) == {"network": "Adapted 1"}
    with ViewerApp.open(app.sequence.path, port=0) as second:
        assert second.wait_until_shown(60).network == "Adapted 1"
