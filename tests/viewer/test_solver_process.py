"""The solver in a separate process: results equal to those of this process, and recovery after its end."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from viewer_desk import Desk
from waiting import eventually

from carts_core.errors import WeightsError
from carts_core.project import Project
from carts_core.recording import Sequence
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.jobs.solver_process import Requests, SolverInProcess, SolverProcess, SolverStopped
from carts_viewer.picture.layers import Layer
from carts_viewer.state import Phase


def _settled(desk: Desk) -> None:
    while (wait := desk.wait_time()) is not None:
        time.sleep(min(wait, 0.002))
        desk.advance()


def _results(path: Path, requests: Requests, project: Path) -> list[object]:
    """Whatever the solver returns for a sequence of two cameras."""
    sequence = Sequence.open(path)
    factory = OptimizerFactory(report=lambda text: None, requests=requests, inference="torch")
    desk = Desk(sequence, Project.open(sequence, project), factory)
    with closing(desk):
        desk.do(intents.SetSetting("solver", "surface"), intents.Perturb(2.0, 0), intents.Run())
        _settled(desk)
        state = desk.state
        assert state.run.phase is Phase.IDLE and state.verdict is not None and len(state.run.curves.loss) > 2
        found: list[object] = [
            [values.tolist() for values in state.pose.scene.joint_positions],
            state.run.curves.loss,
            state.run.curves.stages,
            state.run.base_frame_gain,
            state.verdict,
            state.unfamiliar,
            desk.saved.joints(0),
        ]
        desk.do(intents.ShowLayer(Layer.REFINED))
        desk.controller.map()
        _settled(desk)
        refined = desk.state.refined
        assert refined is not None
        found += [np.packbits(mask).tobytes() for _, mask in sorted(refined.masks.items())]
        desk.do(intents.ShowFrame(1), intents.ShowLayer(Layer.SIMILARITY))
        desk.controller.map()
        _settled(desk)
        assert desk.state.maps is not None
        found.append(desk.state.maps.iterate.similarity.tobytes())
        desk.do(intents.Assess())
        _settled(desk)
        found.append(desk.state.verdict)
        for intent in (intents.OptimizeFrames("all"), intents.Solve(whole=True), intents.Calibrate(2)):
            desk.do(intent)
            _settled(desk)
            assert desk.state.jobs[-1].state.value == "done"
            found += [desk.state.jobs[-1].text, [desk.saved.joints(index) for index in range(2)]]
            found += [desk.saved.verdict(index) for index in range(2)]
    return found


def test_results_equal_those_of_the_solver_in_this_process(
    tiny_sequence: Callable[..., Path], solver: SolverProcess, tmp_path: Path
) -> None:
    path = tiny_sequence(frames=2, cameras=("left", "right"))
    here = _results(path, SolverInProcess(), tmp_path / "here.carts")
    there = _results(path, solver, tmp_path / "there.carts")
    assert len(here) == len(there)
    for one, other in zip(here, there, strict=True):
        assert one == other


@pytest.mark.parametrize("intent", [intents.Solve(whole=True), intents.OptimizeFrames("all")])
def test_the_worker_rests_while_the_solver_works_on_a_job(
    tiny_sequence: Callable[..., Path], solver: SolverProcess, tmp_path: Path, intent: intents.Intent
) -> None:
    sequence = Sequence.open(tiny_sequence(frames=2))
    factory = OptimizerFactory(report=lambda text: None, requests=solver, inference="torch")
    with closing(Desk(sequence, Project.open(sequence, tmp_path / "project.carts"), factory)) as desk:
        desk.do(intents.SetSetting("solver", "surface"), intent)
        waits = []
        while (wait := desk.wait_time()) is not None:
            waits.append(wait)
            time.sleep(min(wait, 0.002))
            desk.advance()
        assert desk.state.jobs[-1].state.value == "done" and max(waits) > 0


def test_a_run_whose_process_is_killed_ends_at_its_last_iterate_and_can_be_started_again(
    tiny_sequence: Callable[..., Path], untrained_weights: Path
) -> None:
    with (
        closing(SolverProcess()) as process,
        ViewerApp.open(tiny_sequence(), port=0, weights=(untrained_weights,), solver=process) as app,
    ):
        for intent in (
            intents.SetSetting("solver", "acs"),
            intents.SetSetting("iterations", 2000),
            intents.Perturb(2.0, 0),
        ):
            app.queue.put(intent)
        app.queue.put(intents.Run())
        eventually(lambda: len(app.state.run.curves.loss), lambda count: count > 2, timeout=60)
        _kill(process)
        state = app.wait_until_shown()
        assert state.error is not None and "SIGKILL" in state.error and "was started again" in state.error
        assert (state.run.phase, state.run.reason) == (Phase.IDLE, "Stopped: the solver process has ended")
        assert [step.name for step in state.project.steps] == ["Perturb by 2°, frame 001", "Optimize, frame 001"]
        assert not state.unsaved
        reached = state.pose.scene.joint_positions[0]
        saved = app.project.state.joints(0)["PSM1"].joint_positions
        assert np.array_equal(np.array(saved, np.float32), reached)
        app.queue.put(intents.SetSetting("iterations", 3))
        app.queue.put(intents.Run())
        state = app.wait_until_shown()
        assert state.error is None and len(state.run.curves.loss) == 4
        app.queue.put(intents.Undo())
        app.queue.put(intents.Undo())
        app.queue.put(intents.Undo())
        assert not app.wait_until_shown().project.joints(0)


def _kill(process: SolverProcess) -> int:
    pid = process.pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    eventually(lambda: process.pid, lambda now: now not in (None, pid), timeout=60)
    return pid


def _niceness(pid: int) -> set[int]:
    return {os.getpriority(os.PRIO_PROCESS, int(task.name)) for task in Path(f"/proc/{pid}/task").iterdir()}


def test_all_threads_of_the_solver_have_low_priority_after_its_first_reply(untrained_weights: Path) -> None:
    with closing(SolverProcess()) as process:
        factory = OptimizerFactory(report=lambda text: None, requests=process, weights=(untrained_weights,))
        for _ in range(2):
            assert factory.prepare().result() and process.pid is not None
            eventually(lambda: _niceness(process.pid or 0), lambda found: found == {os.nice(0) + 5})
            _kill(process)


def test_a_process_that_never_replies_is_started_again_only_by_a_request(untrained_weights: Path) -> None:
    with closing(SolverProcess()) as process:
        factory = OptimizerFactory(report=lambda text: None, requests=process, weights=(untrained_weights,))
        process.start()
        eventually(lambda: process.pid, lambda pid: pid is not None, timeout=60)
        for _ in range(2):
            _kill(process)
        waiting, pid = factory.prepare(), process.pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(SolverStopped, match="cannot be started"):
            waiting.result()
        assert process.pid is None
        assert factory.prepare().result()


def test_an_error_of_a_task_is_the_error_of_its_reply(solver: SolverProcess, tmp_path: Path) -> None:
    factory = OptimizerFactory(report=lambda text: None, requests=solver, weights=(tmp_path / "none.safetensors",))
    with pytest.raises(WeightsError, match=r"none\.safetensors is missing"):
        factory.prepare().result()


def test_requests_of_a_closed_process_fail() -> None:
    process = SolverProcess()
    factory = OptimizerFactory(report=lambda text: None, requests=process)
    waiting = factory.prepare()
    process.close()
    for reply in (waiting, factory.prepare()):
        with pytest.raises(SolverStopped, match="closed"):
            reply.result()


_PAGE = """
import sys, time
from pathlib import Path
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.solver_process import SolverProcess

process = SolverProcess()
app = ViewerApp.open(Path(sys.argv[1]), port=0, solver=process)
app._optimizers.prepare().result()
print(process.pid, flush=True)
time.sleep(600)
"""


def test_the_process_ends_with_a_killed_page(tiny_sequence: Callable[..., Path]) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _PAGE, str(tiny_sequence())], stdout=subprocess.PIPE, text=True
    ) as page:
        assert page.stdout is not None
        solver = int(page.stdout.readline())
        os.kill(solver, 0)
        page.kill()
    eventually(lambda: _runs(solver), lambda runs: not runs, timeout=30)


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_nothing_is_lost_when_the_process_is_killed_while_the_page_is_used(
    tiny_sequence: Callable[..., Path], tmp_path: Path
) -> None:
    """`CARTS_KILLS` kills (5 by default) at random times during random work; prints the time of each restart."""
    kills, dice = int(os.environ.get("CARTS_KILLS", "5")), random.Random(7)
    path, project = tiny_sequence(frames=6, cameras=("left", "right")), tmp_path / "killed.carts"
    noted: dict[int, str] = {}
    seconds: list[float] = []
    with closing(SolverProcess()) as process, ViewerApp.open(path, port=0, project=project, solver=process) as app:
        put, tab = app.queue.put, app.tabs.first
        put(intents.SetSetting("solver", "surface"))
        for number in range(kills):
            frame = number % 6
            put(intents.ShowFrame(frame))
            put(intents.Perturb(1.0, number))
            work = dice.choice(
                [
                    [intents.Run()],
                    [intents.Assess()],
                    [intents.ShowLayer(Layer.REFINED)],
                    [intents.ShowLayer(Layer.SIMILARITY)],
                    [intents.OptimizeFrames("all")],
                    [intents.Solve(whole=True)],
                    [intents.Calibrate(3)],
                    [],
                ]
            )
            for intent in work:
                put(intent)
            time.sleep(dice.uniform(0.0, 2.0))
            eventually(lambda: process.pid, lambda pid: pid is not None, timeout=60)
            known = app.project.state
            began = time.monotonic()
            _kill(process)
            # The page is used while the process is started again.
            note = f"note {number}"
            noted[frame] = note
            put(intents.ShowFrame(frame))
            put(intents.SetNote(note))
            put(intents.Released())
            app._optimizers.prepare().result()
            seconds.append(time.monotonic() - began)
            said = eventually(lambda: app.state.error, lambda error: error is not None, timeout=60)
            assert said is not None and "solver process" in said, said
            put(intents.DismissError())
            put(intents.ShowLayer(Layer.MASK))
            state = app.wait_until_shown()
            assert state.run.phase is Phase.IDLE and not state.unsaved and not state.solving
            assert all(job.over for job in state.jobs)
            # The history has only grown.
            assert [step.name for step in state.project.steps][: len(known.steps)] == [s.name for s in known.steps]
            assert state.project.review(frame).note == note
        steps = [step.name for step in app.state.project.steps]
        assert tab in app.tabs
        put(intents.Run())
        state = app.wait_until_shown()
        assert state.error is None and state.verdict is not None
    print(f"{kills} kills; back after {np.median(seconds):.2f} s (median), {max(seconds):.2f} s (worst)")
    with closing(Project.open(Sequence.open(path), project)) as kept:
        assert [step.name for step in kept.state.steps][: len(steps)] == steps
        assert all(kept.state.review(frame).note == note for frame, note in noted.items())
