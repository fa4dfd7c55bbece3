"""The list of jobs with progress, remaining time and log, and buttons for the chosen job."""

import time

import viser

from carts_core.wording import duration_text
from carts_viewer.actions import intents
from carts_viewer.jobs.job_list import MAX_CALIBRATION_FRAMES, MAX_TRAINING_TIME, Job, JobState
from carts_viewer.jobs.networks import STARTED
from carts_viewer.panels.inputs import PanelPage, write
from carts_viewer.panels.sequence import newest_calibration, whole_label
from carts_viewer.state import ViewState
from carts_viewer.transport.document import escaped

_NONE = "None"
_MAX_LISTED = 5
"""Maximum number of jobs listed in a question."""
_UNREVIEWED, _RANGE = "Unreviewed", "Range in the timeline"
_FRAMES: dict[str, intents.Frames] = {
    _UNREVIEWED: "unreviewed",
    "Frames found (Review, Find)": "found",
    _RANGE: "range",
    "All": "all",
}


class JobsPanel:
    """Queues jobs and shows their progress."""

    def __init__(self, page: PanelPage) -> None:
        gui = page.gui
        self._numbers: dict[str, int] = {}
        self._ranged = False
        self._asked = gui.add_html("", visible=False)
        self._run = page.button(
            "Run jobs", intents.AnswerJobs(True), icon=viser.Icon.CHECK, color="teal", visible=False
        )
        self._discard = page.button("Discard jobs", intents.AnswerJobs(False), icon=viser.Icon.X, visible=False)
        page.row(self._run, self._discard)
        self._asked_network = gui.add_html("", visible=False)
        self._accept = page.button(
            "Accept network", intents.AnswerNetwork(True), icon=viser.Icon.CHECK, color="teal", visible=False
        )
        self._refuse = page.button("Refuse network", intents.AnswerNetwork(False), icon=viser.Icon.X, visible=False)
        page.row(self._accept, self._refuse)
        with gui.add_folder("New job"):
            self._frames = gui.add_dropdown("Which frames", list(_FRAMES))
            page.button(
                "Optimize individually",
                lambda _: intents.OptimizeFrames(_FRAMES.get(self._frames.value, "unreviewed")),
                icon=viser.Icon.PLAYER_PLAY,
                color="teal",
            )
            self._count = gui.add_number(
                "Calibration frames",
                intents.Calibrate().frames,
                min=1,
                max=MAX_CALIBRATION_FRAMES,
                step=1,
                hint="Number of frames, evenly spaced over the whole sequence regardless of the range",
            )
            page.button("Calibrate", lambda _: intents.Calibrate(int(self._count.value)), icon=viser.Icon.RULER_MEASURE)
            self._minutes = gui.add_number(
                "Training limit [min]",
                intents.Adapt().minutes,
                min=1,
                max=MAX_TRAINING_TIME,
                step=1,
                hint="Processor time limit; training stops earlier if validation no longer improves",
            )
            page.button(
                "Adapt the network",
                lambda _: intents.Adapt(int(self._minutes.value)),
                icon=viser.Icon.SCHOOL,
                hint="Train the network for this recording's robots, cameras, distances and backgrounds",
            )
        self._network = gui.add_dropdown(
            "Network", [STARTED], visible=False, hint="Network of all tabs; the choice is saved"
        )
        self._newest = page.button(
            "Use newest network",
            lambda _: intents.UseNetwork(self._network.options[-1]),
            icon=viser.Icon.CHECK,
            color="teal",
            visible=False,
        )
        with gui.add_folder("Jobs"):
            self._list = gui.add_html("")
            self._solve = page.button(
                "Solve all", intents.Solve(whole=True), icon=viser.Icon.ARROWS_HORIZONTAL, color="teal", visible=False
            )
            self._chosen = gui.add_dropdown("Job", [_NONE])
            self._cancel = page.button("Cancel", lambda _: intents.CancelJob(self._number()), icon=viser.Icon.X)
            self._again = page.button(
                "Start again", lambda _: intents.RepeatJob(self._number()), icon=viser.Icon.REFRESH
            )
            self._forget = page.button("Clear ended jobs", intents.RemoveEndedJobs())
            page.row(self._cancel, self._again)
            self._log = gui.add_html("")
        page.on_input(self._network, intents.UseNetwork)
        page.on_input(self._chosen, lambda _: intents.Refresh())

    def show(self, state: ViewState) -> None:
        """Update the widgets, and select a new job."""
        self._show_networks(state)
        self._show_question(self._asked, jobs_question(state), self._run, self._discard)
        self._show_question(self._asked_network, network_question(state), self._accept, self._refuse)
        self._follow_range(state)
        calibration = newest_calibration(state.jobs)
        self._solve.label = whole_label(state)
        self._solve.visible = calibration is not None and calibration.state is JobState.DONE
        jobs = tuple(reversed(state.jobs))
        numbers = {f"{job.number}. {job.kind.capitalize()}": job.number for job in jobs}
        if numbers != self._numbers:
            newer = jobs and max(numbers.values()) > max(self._numbers.values(), default=0)
            self._numbers = numbers
            self._chosen.options = tuple(numbers) or (_NONE,)
            if newer:
                self._chosen.value = next(iter(numbers))
        now = time.time()
        self._list.content = (
            f'<ul class="carts-jobs" aria-label="Jobs">{"".join(job_line(job, now) for job in jobs)}</ul>'
            if jobs
            else '<p class="carts-caption">No jobs</p>'
        )
        job = next((job for job in jobs if job.number == self._number()), None)
        for handle in (self._chosen, self._cancel, self._again, self._forget, self._log):
            handle.visible = bool(jobs)
        self._cancel.disabled = job is None or job.over
        self._again.disabled = job is None or not job.over
        self._forget.disabled = not any(job.over for job in jobs)
        lines = "<br>".join(escaped(line) for line in (job.log[-12:] if job else ()))
        self._log.content = f'<p class="carts-caption carts-log" role="log">{lines}</p>'

    @staticmethod
    def _show_question(text: viser.GuiHtmlHandle, question: str, *buttons: viser.GuiButtonHandle) -> None:
        text.content = f'<p class="carts-notice" role="status">{escaped(question)}</p>'
        for handle in (text, *buttons):
            handle.visible = bool(question)

    def _follow_range(self, state: ViewState) -> None:
        """Select the frames in the range when a range is marked, and unreviewed frames when it is removed."""
        ranged = state.range is not None
        before, now = (_UNREVIEWED, _RANGE) if ranged else (_RANGE, _UNREVIEWED)
        if ranged != self._ranged and self._frames.value == before:
            self._frames.value = now
        self._ranged = ranged

    def _show_networks(self, state: ViewState) -> None:
        names = state.networks or (STARTED,)
        if tuple(self._network.options) != names:
            self._network.options = names
        write(self._network, state.network or STARTED)
        self._network.visible = len(names) > 1
        self._newest.visible = len(names) > 1 and state.network != names[-1]

    def _number(self) -> int:
        return self._numbers.get(self._chosen.value, -1)


def jobs_question(state: ViewState) -> str:
    """Question about jobs of another user, as text; empty if there are none."""
    titles = [job.title for job in state.jobs if job.state is JobState.ASKED]
    if not titles:
        return ""
    more = len(titles) - _MAX_LISTED
    shown = "; ".join(titles[:_MAX_LISTED]) + (f"; and {more} more" if more > 0 else "")
    return (
        "These jobs in the list beside this project are not run, since you did not queue them on this computer: "
        f"{shown}. Run or discard them."
    )


def network_question(state: ViewState) -> str:
    """Question about a network of another user, as text; empty if there is none."""
    if not state.asked_network:
        return ""
    return (
        f"You have neither trained nor accepted the network {state.asked_network!r} beside this project on this "
        f"computer, so the network {state.network!r} is used. Accept it only if you trust its author."
    )


def job_line(job: Job, now: float) -> str:
    """A job with its progress and remaining time, as HTML."""
    left = job.seconds_left(now)
    about = "at most" if job.kind == "calibrate" else "about"  # A calibration may converge earlier.
    eta = "" if left is None else f", {about} {duration_text(left)} left"
    running = job.state is JobState.RUNNING
    # The text of a solve already contains frames and time.
    steps = f" {job.done} of {job.total}{eta}" if running and job.total and job.kind != "solve" else ""
    share = 100.0 * job.done / job.total if job.total else 0.0
    bar = f'<progress max="100" value="{share:.0f}"></progress>' if running else ""
    return (
        f'<li class="{job.state}"><b>{job.number}. {escaped(job.title)}</b> {job.state}{steps}{bar}'
        f"<br>{escaped(job.text)}</li>"
    )
