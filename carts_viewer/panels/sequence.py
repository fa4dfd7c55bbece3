"""Panel of sequence mode, and warning about a wrong calibration."""

import viser

from carts_core.optimization import BASE_FRAME_GAIN
from carts_core.project import ProjectState, between_kept
from carts_core.settings import Direction
from carts_core.wording import counted
from carts_viewer.actions import intents
from carts_viewer.jobs.job_list import Job, JobState
from carts_viewer.panels.inputs import PanelPage, write
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.transport.document import escaped


class CalibrationHint:
    """Warning about a wrong calibration, with a *Calibrate* button and progress."""

    def __init__(self, page: PanelPage, session: Session) -> None:
        frames = min(intents.Calibrate().frames, len(session.sequence))
        self._text = page.gui.add_html("", visible=False)
        self._calibrate = page.button(
            f"Calibrate on {frames} frames",
            intents.Calibrate(frames),
            visible=False,
            hint="Runs as a job, and is one undo step. For other numbers of frames, see Jobs, Calibration frames.",
        )
        self._watched: int | None = None

    def show(self, gain: float | None, state: ViewState) -> None:
        """Update the widgets; `gain` is the share of the residual that free base frames would explain [1]."""
        job = newest_calibration(state.jobs)
        if job is not None and not job.over:
            self._watched, line = job.number, ""
        else:
            line = calibration_line(gain)
        self._calibrate.visible = bool(line)
        self._text.content = f"{line}{self._progress_line(job)}"
        self._text.visible = bool(self._text.content)

    def _progress_line(self, job: Job | None) -> str:
        """Progress of a calibration, or its result if this tab has shown the progress, as HTML."""
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
    """The newest calibration if it is waiting, running or the newest of all jobs; otherwise None."""
    shown = [job for job in jobs if job.state is not JobState.ASKED]
    found = (job for job in reversed(shown) if job.kind == "calibrate" and (not job.over or job is shown[-1]))
    return next(found, None)


def calibration_line(gain: float | None) -> str:
    """Warning about wrong base frames with a remedy, as HTML; empty for a small or unknown gain."""
    if gain is None or gain < BASE_FRAME_GAIN:
        return ""
    return (
        '<p class="carts-caption">The calibration may be wrong: with other poses of the arms\' bases (base frames) or '
        f"of the camera, the residual would be {100 * gain:.0f} % smaller. Good masks can still be "
        "accepted. For better masks and joint positions, <b>calibrate</b> and then run or solve again, before you "
        "accept frames: a calibration changes all masks, so accepted frames become unreviewed.</p>"
    )


_MAX_LISTED = 200
_DIRECTIONS: dict[str, Direction] = {"First frame": "forward", "Last frame": "backward"}


class KeyframesPanel:
    """Marks keyframes and solves between them, with progress and a stop button."""

    def __init__(self, page: PanelPage, session: Session) -> None:
        gui = page.gui
        self._ids = session.sequence.frame_ids
        self._seen: tuple[ProjectState | None, int, tuple[int, int] | None] = (None, -1, None)
        self._solvable, self._open, self._plan = False, True, ""
        self._index = 0
        with gui.add_folder("Keyframes"):
            self._keyframe = gui.add_checkbox(
                "Keyframe",
                False,
                hint="Solving does not change this frame. Frames that you moved or accepted are also kept.",
            )
            self._text = gui.add_html("")
            self._between = page.button(
                "Solve between", intents.Solve(), icon=viser.Icon.ARROWS_HORIZONTAL, color="teal"
            )
            self._all = page.button("Solve all", intents.Solve(whole=True))
            page.row(self._between, self._all, weights=(13, 10))
            self._direction = gui.add_dropdown("Begin at", list(_DIRECTIONS))
            self._calibration = CalibrationHint(page, session)
            self._progress = gui.add_progress_bar(0.0, visible=False)
            self._listed = gui.add_html("", visible=False)
            self._take = page.button("Take solved pose", lambda _: intents.TakeSolved(self._index), visible=False)
            self._take_all = page.button("Take all", intents.TakeSolved(), visible=False)
            page.row(self._take, self._take_all, weights=(3, 2))
            self._drop = page.button("Discard all", intents.DiscardSolved(), icon=viser.Icon.X, visible=False)
            self._stop = page.button("Stop and keep", intents.StopSolving(), icon=viser.Icon.PLAYER_STOP, visible=False)
        page.on_input(self._keyframe, lambda on: intents.SetKeyframe(bool(on)))
        page.on_input(self._direction, lambda label: intents.SetDirection(_DIRECTIONS[label]))

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        write(self._keyframe, state.project.is_keyframe(state.index))
        write(self._direction, next(label for label, name in _DIRECTIONS.items() if name == state.direction))
        self._all.label = whole_label(state)
        self._direction.disabled = state.solving
        self._progress.visible = self._stop.visible = state.solving
        self._plan_ahead(state)
        self._between.disabled = state.solving or not self._solvable
        self._all.disabled = state.solving or not self._open
        # A range is usually selected in order to solve all its frames.
        bright = self._between if self._solvable and state.range is None else self._all
        for button in (self._between, self._all):
            button.color = "teal" if button is bright else "gray"
        lines = [] if state.solving else [self._plan]
        if state.solve is not None:
            done, total = state.solve.progress
            self._progress.value = 100.0 * done / total
            text = escaped(state.solve.text)
            lines.append(f"<b>{text}</b>" if state.solving else f"Last solve: {text}")
        self._show_listed(state)
        self._text.content = "".join(f'<p class="carts-caption">{line}</p>' for line in lines)
        self._calibration.show(None if state.solve is None else state.solve.suspicion(state.project), state)

    def _show_listed(self, state: ViewState) -> None:
        """Update the list of frames that became worse or are doubtful, with links to them."""
        self._index = state.index
        listed = () if state.solve is None or state.solving else state.solve.listed
        unchanged = [frame.index for frame in listed if not frame.taken]
        self._listed.visible = self._drop.visible = bool(listed)
        self._take.visible = self._take_all.visible = bool(unchanged)
        self._take.disabled = state.index not in unchanged
        rows = "".join(
            f'<li><a href="#" data-frame="{frame.index}">{escaped(self._ids[frame.index])}</a> '
            f"{escaped(frame.reason)}{'' if frame.taken else ' <b>not changed</b>'}</li>"
            for frame in listed[:_MAX_LISTED]
        )
        more = f"<li>and {len(listed) - _MAX_LISTED} more</li>" if len(listed) > _MAX_LISTED else ""
        self._listed.content = f'<ul class="carts-list" aria-label="Frames to inspect">{rows}{more}</ul>'

    def _plan_ahead(self, state: ViewState) -> None:
        """Update the text about the frames to be solved, except during an unfinished gesture."""
        seen = (state.project, state.index, state.range)
        if self._seen == seen or (state.unsaved and self._seen[1:] == seen[1:]):
            return
        self._seen = seen
        self._plan = f"{self._between_plan(state)}<br>{self._all_plan(state)}"

    def _between_plan(self, state: ViewState) -> str:
        name = "<b>Solve between</b>"
        frames = between_kept(state.project, state.index, state.part)
        kept = set(state.project.kept_frames) & set(state.part)
        count = sum(frame not in kept for frame in frames)
        self._solvable = state.index in state.part and bool(kept) and count > 0
        if state.index not in state.part:
            return f"{name} is limited to the range, but this frame lies outside of it"
        if not kept:
            return f"{name} requires a kept frame; there is none {'yet' if state.range is None else 'in the range'}"
        where = f"{name}, {escaped(self._ids[frames[0]])} to {escaped(self._ids[frames[-1]])}"
        return f"{where}: " + (
            f"{counted(count, 'frame')} would be fitted, {len(frames) - count} kept" if count else "every frame is kept"
        )

    def _all_plan(self, state: ViewState) -> str:
        count = len(state.part) - len(set(state.project.kept_frames) & set(state.part))
        self._open = count > 0
        return f"<b>{whole_label(state)}</b>: " + (
            f"{counted(count, 'frame')} would be fitted" if count else "every frame is kept"
        )


def whole_label(state: ViewState) -> str:
    """Label of the button that solves all frames, or those in the range."""
    return "Solve all" if state.range is None else "Solve range"
