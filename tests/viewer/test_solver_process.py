"""The solver in a process of its own: the same results as in this process, and what survives its end."""

import os
import random
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from viewer_desk import Desk
from waiting import eventually

from carts_core.errors import CartsError, WeightsError
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
