"""A controller at work without threads or a page, with the real optimizer."""

from pathlib import Path
from typing import Any

from carts_core.optimization import DescentSolver, FreeParameters
from carts_core.project import Project, ProjectState
from carts_core.recording import Sequence
from carts_core.settings import SolverName
from carts_core.settings.stages import FirstOrder
from carts_viewer.actions import intents
from carts_viewer.controller import Controller, JobRunner
from carts_viewer.editing import People, Person
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.session import Session
from carts_viewer.state import ViewState


class Desk:
    """A controller and its outputs."""

    def __init__(self, sequence: Sequence, project: Project, factory: OptimizerFactory) -> None:
        people = People(project)
        self.session, self.renderer = Session(sequence, people), OverlayRenderer(sequence)
        self.delivered: list[tuple[int, str, bytes]] = []
        self.factory = factory
        domain, camera = sequence.domains[0], sequence.scene.cameras[0].name
        frame = self.session.frame(0, domain, camera)
        state = ViewState(
            index=0,
            frame=frame,
            domain=domain,
            camera=camera,
            pose=self.session.pose(frame),
            layer=Layer.MASK,
            opacity=0.5,
            settings=DescentSolver(
                stages=(FirstOrder(attention=8, blur=1.6), FirstOrder(attention=4)), iterations=4, working_width=96
            ),
            solver=SolverName.ACS,
            free=FreeParameters(),
            project=self.session.editor.view,
        )
        own = Session(sequence, people, Person(0, present=False))

        def deliver(*file: Any) -> None:
            self.delivered.append(file)

        self.job_runner = JobRunner(state, own, self.renderer, factory)
        self.controller = Controller(state, self.session, self.renderer, factory, self.job_runner, deliver)

    @classmethod
    def open(cls, sequence: Path, *, project: Path | None = None, **networks: Any) -> "Desk":
        """The desk of a sequence file, by options of the networks; without any, they are the shipped ones."""
        opened = Sequence.open(sequence)
        return cls(opened, Project.open(opened, project), OptimizerFactory(report=lambda line: None, **networks))

    def reopened(self, *, read_only: bool = False) -> "Desk":
        """Another desk for the same project, after this one is closed."""
        project = self.session.editor.project
        self.session.close()
        project.close()
        sequence = self.session.sequence
        return Desk(sequence, Project.open(sequence, project.path, read_only=read_only), self.factory)

    @property
    def state(self) -> ViewState:
        """What the page would show."""
        return self.controller.state

    def do(self, *asked: intents.Intent) -> ViewState:
        """Handle intents in order."""
        for intent in asked:
            self.controller.handle(intent)
        return self.state

    def finish(self) -> ViewState:
        """Advance until nothing is going on."""
        while self.wait_time() == 0.0:
            self.advance()
        return self.state

    def wait_time(self) -> float | None:
        """How long nothing needs to be done, here and in the background."""
        waits = (self.controller.wait_time(), self.job_runner.wait_time())
        return min((wait for wait in waits if wait is not None), default=None)

    def advance(self) -> None:
        """Do one step of the work in the foreground, and one in the background."""
        try:
            self.controller.advance()
            self.job_runner.advance()
        finally:
            self.controller.follow()

    def fail(self, error: Exception) -> None:
        """Pass an error to the controller, as the worker does."""
        self.controller.fail(error, stop=True)
        self.job_runner.fail(str(error))
        self.controller.follow()

    def close(self) -> None:
        """Save all unfinished work."""
        self.job_runner.close()
        self.controller.close()

    @property
    def saved(self) -> ProjectState:
        """What is in the project, without the draft."""
        return self.session.editor.project.state

    def joint(self, index: int = 0) -> float:
        """A joint of the shown pose [rad, m]."""
        return float(self.session.joints(self.state.pose.scene)["PSM1"][index])
