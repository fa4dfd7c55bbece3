"""The chart of all frames."""

from viewer_desk import Desk

from carts_core.project import Figures, Project
from carts_viewer.panels.timeline import badness


def _figures(project: Project, *figures: Figures) -> dict[int, float]:
    project.record_figures(dict(enumerate(figures)), project.state)
    return badness(project.state)


def test_badness_is_the_loss_over_the_largest_until_any_frame_has_dice(desk: Desk) -> None:
    project = desk.session.editor.project
    assert badness(project.state) == {}
    assert _figures(project, Figures(loss=0.2), Figures(loss=0.4)) == {0: 0.5, 1: 1.0}
    assert _figures(project, Figures(loss=0.2), Figures(loss=0.4, dice=0.75)) == {1: 0.25}
