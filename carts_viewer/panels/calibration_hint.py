"""That the calibration may be off, with the button that mends it, and how that goes."""

from carts_core.optimization import BASE_FRAME_GAIN
from carts_viewer import intents
from carts_viewer.jobs import Job, JobState
from carts_viewer.panels.inputs import Emit, escaped, on_click
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.transport.tab_page import TabPage


class CalibrationHint:
    """Stands below what found the suspicion, and is not there without one."""

    def __init__(self, page: TabPage, session: Session, emit: Emit) -> None:
        frames = min(intents.Calibrate().frames, len(session.sequence))
        self._text = page.gui.add_html("", visible=False)
        self._calibrate = page.gui.add_button(
            f"Calibrate on {frames} frames",
            color="gray",
            visible=False,
            hint="A job: the page stays usable. One step of undo. Jobs, Calibrate takes another number of frames.",
        )
        self._watched: int | None = None
        on_click(self._calibrate, lambda _: intents.Calibrate(frames), emit)

    def show(self, gain: float | None, state: ViewState) -> None:
        """Bring it up to date.

        Args:
            gain: what free base frames would explain of the residual that is left [1]; None where it is not known.
            state: with the jobs.
        """
        job = newest_calibration(state.jobs)
        if job is not None and not job.over:
            self._watched, line = job.number, ""
        else:
            line = calibration_line(gain)
        self._calibrate.visible = bool(line)
        self._text.content = f"{line}{self._progress_line(job)}"
        self._text.visible = bool(self._text.content)

    def _progress_line(self, job: Job | None) -> str:
        """How a calibration goes, or what came of one that this tab has seen going, as HTML."""
        if job is None:
            return ""
        text, title = escaped(job.text), f"<b>{escaped(job.title)}</b>"
        match job.state:
            case JobState.WAITING | JobState.RUNNING:
                line = f"{title}: {text or job.state}"
            case JobState.DONE if job.number == self._watched:
                line = text
            case JobState.FAILED if job.number == self._watched:
                line = f"{title} failed: {text}"
            case _:
                return ""
        return f'<p class="carts-caption" role="status">{line}</p>'


def newest_calibration(jobs: tuple[Job, ...]) -> Job | None:
    """The calibration that waits or runs, or that has ended and no other job has followed."""
    shown = [job for job in jobs if job.state is not JobState.ASKED]
    found = (job for job in reversed(shown) if job.kind == "calibrate" and (not job.over or job is shown[-1]))
    return next(found, None)


def calibration_line(gain: float | None) -> str:
    """That base frames may be wrong, if the residual of a run says so, and what to do, as HTML.

    Args:
        gain: what free base frames would explain of that residual [1]; None where it is not known.
    """
    if gain is None or gain < BASE_FRAME_GAIN:
        return ""
    return (
        '<p class="carts-caption">The calibration may be off: with other poses of the arms\' bases (base frames) or of '
        f"the camera, the remaining residual would be {100 * gain:.0f} % smaller. A good mask can be accepted as it "
        "is. Masks and joint values become better if you <b>calibrate</b> and then run or solve again, best before you "
        "accept frames: a calibration moves all masks, so it takes their acceptance back.</p>"
    )
