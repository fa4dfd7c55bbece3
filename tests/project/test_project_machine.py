"""Random actions on a real project and on a model in plain Python, whose states must be equal."""

import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from many_actions import check_after_each_of_10000_actions
from project_model import FRAMES, IDENTITY, POSSIBLE_EDITS, ProjectModel, visible

from carts_core.project import Figures, Project

EDITS = st.lists(st.sampled_from(POSSIBLE_EDITS), min_size=1, max_size=6).map(dict)
FIGURES = st.dictionaries(st.sampled_from(FRAMES), st.builds(Figures, st.floats(0, 1), st.none() | st.floats(0, 1)))


class ProjectMachine(RuleBasedStateMachine):
    """What users do, in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="carts-project-"))
        self.model = ProjectModel()
        self.project = Project(IDENTITY, self.folder / "small.carts")

    def teardown(self) -> None:
        self.project.close()
        shutil.rmtree(self.folder)

    @rule(name=st.text(min_size=1, max_size=200).filter(str.strip), edits=EDITS, figures=st.none() | FIGURES)
    def apply(self, name: str, edits: dict, figures: dict | None) -> None:
        change = self.project.apply(name, edits, figures)
        before = self.model.snapshots[self.model.position]
        self.model.apply(" ".join(name.encode("utf-8", "replace").decode().split()), edits, figures)
        assert (change is None) == (self.model.snapshots[self.model.position] == before)

    @rule()
    def undo(self) -> None:
        self.project.undo()
        self.model.go_to(self.model.position - 1)

    @rule()
    def redo(self) -> None:
        self.project.redo()
        self.model.go_to(self.model.position + 1)

    @rule(edits=EDITS)
    def do_it_differently(self, edits: dict) -> None:
        """Take a step back and make another one in its place."""
        self.apply("first try", edits, {frame: Figures(0.5) for frame in FRAMES})
        self.undo()
        self.apply("second try", dict(list(edits.items())[:1]), None)

    @rule(share=st.floats(0, 1))
    def go_to(self, share: float) -> None:
        position = round(share * len(self.model.names))
        self.project.go_to(position)
        self.model.go_to(position)

    @rule(figures=FIGURES)
    def record_figures(self, figures: dict) -> None:
        self.project.record_figures(figures, self.project.state)
        self.model.record_figures(figures)

    @rule()
    def log_export(self) -> None:
        self.project.log_export("coco", Path("out"), 3, {})
        self.model.exports.append("out")

    @rule()
    def reopen(self) -> None:
        self.project.close()
        self.project = Project(IDENTITY, self.folder / "small.carts")

    @rule()
    def read_beside_the_writer(self) -> None:
        with Project(IDENTITY, self.folder / "small.carts", read_only=True) as reader:
            assert visible(reader.state) == self.model.visible()

    @invariant()
    def they_say_the_same(self) -> None:
        assert visible(self.project.state) == self.model.visible()


def test_a_project_says_what_the_model_says_after_every_action() -> None:
    run_state_machine_as_test(
        ProjectMachine, settings=settings(max_examples=20, stateful_step_count=30, deadline=None, derandomize=True)
    )


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_project_says_what_the_model_says_after_each_of_10000_actions() -> None:
    check_after_each_of_10000_actions(ProjectMachine)
