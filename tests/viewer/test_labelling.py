"""How many keys and clicks it takes to label a real recording, from as measured to accepted."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from statistics import median

import pytest
from playwright.sync_api import expect
from viewer_canvas import eventually
from viewer_tab import Tab

from carts_core.project import ReviewState
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.job_list import JobState
from carts_viewer.state import Phase

pytestmark = pytest.mark.browser

SEQUENCE = Path(__file__).parents[1] / "sequences" / "dvrk_stereo.toml"
GOOD = 0.945
"""Dice of a frame that the test's reviewer accepts."""


class Labeller:
    """Presses keys and buttons, and counts them."""

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self.shared = 0
        """Actions that are about all frames."""
        self.actions: Counter[int] = Counter()
        """By frame."""

    def press(self, key: str) -> None:
        """A key, for the shown frame."""
        self.actions[self._tab.app.state.index] += 1
        self._tab.page.keyboard.press(key)

    def optimize_all(self) -> None:
        """Queue a run on every frame, and wait for it."""
        page = self._tab.page
        page.get_by_role("tab", name="Jobs", exact=True).click()
        self._tab.choose("Which frames", "All")
        self._tab.button("Optimize each alone")
        self.shared += 4
        app = self._tab.app
        eventually(lambda: app.state.jobs, lambda jobs: bool(jobs) and jobs[-1].state is JobState.DONE, timeout=1500)
        expect(page.locator(".carts-jobs li.done")).to_be_visible()

    def judge(self) -> None:
        """Accept the shown frame, after another run if it needs one, or leave it for later."""
        app = self._tab.app
        if self._dice() < GOOD:
            self.press("r")
            eventually(lambda: app.state.run, lambda run: run.phase is Phase.IDLE and bool(run.reason), timeout=120)
        before = app.state.index
        if self._dice() >= GOOD:
            self.press("g")
        else:
            self.press("f")
            eventually(lambda: app.state.review.state, lambda state: state is ReviewState.NEEDS_WORK)
            self.press("y")
        judged = (ReviewState.ACCEPTED, ReviewState.NEEDS_WORK)
        eventually(lambda: app.state.project.review(before).state, lambda state: state in judged)

    def _dice(self) -> float:
        state = eventually(
            lambda: self._tab.app.state, lambda state: state.scores is not None and state.scores.dice is not None
        )
        assert state.scores is not None and state.scores.dice is not None
        return state.scores.dice


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_thirty_real_frames_take_at_most_two_actions_each(
    shared_dir: Path, tmp_path: Path, open_tab: Callable[..., Tab]
) -> None:
    with ViewerApp.open(SEQUENCE, project=tmp_path / "real.carts", port=0) as app:
        app.wait_until_shown(120)
        frames = len(app.sequence)
        labeller = Labeller(open_tab(app))
        labeller.optimize_all()
        for _ in range(frames):
            labeller.judge()
            app.wait_until_shown()
        states = Counter(app.state.project.review(index).state for index in range(frames))
        each = [labeller.actions[index] + labeller.shared / frames for index in range(frames)]
        accepted = [each[i] for i in range(frames) if app.state.project.review(i).state is ReviewState.ACCEPTED]
    print(
        f"{frames} frames: {states[ReviewState.ACCEPTED]} accepted, {states[ReviewState.NEEDS_WORK]} left for later; "
        f"{labeller.shared} actions for all and {sum(labeller.actions.values())} for single ones: "
        f"median {median(each):.2f} a frame, {median(accepted):.2f} of those accepted"
    )
    assert states[ReviewState.ACCEPTED] + states[ReviewState.NEEDS_WORK] == frames
    assert states[ReviewState.ACCEPTED] >= frames / 2 and median(each) <= 2.0
