"""Run, Pause, Step, Reset, how it is going, and which solver."""

import math

import viser

from carts_core.project import ReviewState
from carts_core.settings import SolverName
from carts_viewer import intents
from carts_viewer.panels.calibration_hint import CalibrationHint
from carts_viewer.panels.inputs import Emit, escaped, humanized, on_click, on_input, write
from carts_viewer.session import Session
from carts_viewer.state import Phase, ViewState
from carts_viewer.transport.tab_page import TabPage

SOLVER_LABELS = {
    SolverName.SURFACE: "Surface maps (default)",
    SolverName.OCCLUDED: "Surface maps, past occluders",
    SolverName.ACS: "ACS, per attended area",
    SolverName.PAPER: "ACS as in the paper",
    SolverName.ACS_REFERENCE: "ACS as in the paper's code",
    SolverName.L1: "L1 on predictions",
    SolverName.NONE: "None: compare only",
}
"""What people read for the solvers."""
OBSERVED = {"What the network sees": "network", "Masks": "masks", "Masks, and parts by the network": "both"}
"""What people read for what is fitted."""
MASKS = {"Of the recording": "recording", "Imported": "imported", "Painted": "painted"}
"""The same for whose masks."""
UNDETERMINED = "Not determined by this image"
"""What people read for unknowns that an image says nothing of."""
_CONSEQUENCE = "The mask hardly depends on these, so it can be right although their values are guesses."
_RUN = "Press Run to fit the arm to this frame."
_BEFORE_RUN = {
    ReviewState.ACCEPTED: "This frame is accepted. Run would fit it again; if it moves, it has to be accepted again.",
    ReviewState.REJECTED: "This frame is rejected. Run would fit it all the same.",
    ReviewState.OPTIMIZED: "This frame has been fitted. Run goes on from where it is.",
}
"""What people read before a run."""


class OptimizePanel:
    """The buttons that drive a run, and its state in words."""

    def __init__(self, page: TabPage, session: Session, state: ViewState, emit: Emit) -> None:
        gui = page.gui
        self._session = session
        self._run = gui.add_button("Run", icon=viser.Icon.PLAYER_PLAY, color="teal")
        self._pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE, color="gray", disabled=True)
        page.row(self._run, self._pause)
        self._step = gui.add_button("Step", icon=viser.Icon.PLAYER_SKIP_FORWARD, color="gray")
        self._reset = gui.add_button("Reset", icon=viser.Icon.PLAYER_TRACK_PREV, color="gray")
        page.row(self._step, self._reset)
        self._status = gui.add_html("")
        self._calibration = CalibrationHint(page, session, emit)
        self._unfamiliar = gui.add_html("", visible=False)
        self._adapt = gui.add_button("Adapt the network to this recording", icon=viser.Icon.SCHOOL, visible=False)
        self._solvers = {label: name for name, label in SOLVER_LABELS.items()}
        self._solver = gui.add_dropdown("Solver", list(self._solvers), initial_value=SOLVER_LABELS[state.solver])
        self._observed = gui.add_dropdown("Fit to", list(OBSERVED))
        self._masks = gui.add_dropdown(
            "Whose masks",
            list(MASKS),
            visible=False,
            hint="Imported: by Review, Masks of others. Painted: rendered masks that somebody corrected with a brush.",
        )
        cameras = [camera.name for camera in session.scene.cameras]
        self._cameras = gui.add_dropdown("Cameras", ["All cameras", "Shown camera"], visible=len(cameras) > 1)
        on_click(self._run, lambda _: intents.Run(), emit)
        on_click(self._pause, lambda _: intents.Pause(), emit)
        on_click(self._step, lambda _: intents.Step(), emit)
        on_click(self._adapt, lambda _: intents.Adapt(), emit)
        on_click(self._reset, lambda _: intents.Reset(), emit)
        on_input(self._solver, lambda label: intents.SetSetting("solver", self._solvers[label]), emit)
        on_input(self._observed, lambda what: intents.SetObserved(OBSERVED[what], MASKS[self._masks.value]), emit)
        on_input(self._masks, lambda masks: intents.SetObserved(OBSERVED[self._observed.value], MASKS[masks]), emit)
        on_input(self._cameras, lambda label: intents.SetCameras(label == "All cameras"), emit)

    def show(self, state: ViewState) -> None:
        """Bring the widgets up to date."""
        running = state.run.phase is Phase.RUNNING
        self._run.label = "Continue" if state.run.phase is Phase.PAUSED else "Run"
        self._run.disabled = self._step.disabled = running or state.busy is not None
        self._pause.disabled = not running
        self._reset.disabled = not state.run.curves.loss
        self._unfamiliar.content = "".join(
            f'<p class="carts-notice" role="status">{escaped(warning)}</p>' for warning in state.unfamiliar
        )
        self._unfamiliar.visible = self._adapt.visible = bool(state.unfamiliar)
        write(self._solver, SOLVER_LABELS[state.solver])
        write(self._observed, next(label for label, what in OBSERVED.items() if what == state.observed.what))
        write(self._masks, next(label for label, masks in MASKS.items() if masks == state.observed.masks))
        self._masks.visible = state.observed.what != "network"
        write(self._cameras, "All cameras" if state.every_camera else "Shown camera")
        lines = undetermined_lines(state, self._session)
        self._status.content = f'<p class="carts-status">{status_line(state)}</p>{lines}'
        self._calibration.show(state.run.base_frame_gain, state)


def status_line(state: ViewState) -> str:
    """Iteration, time per iteration and why it stopped, as HTML."""
    curves, phase = state.run.curves, state.run.phase
    if state.busy is not None:
        return f'<span class="carts-spinner"></span>{escaped(state.busy)} …'
    parts = []
    if curves.loss:
        parts.append(f"Iteration <b>{len(curves.loss) - 1}</b> of {state.settings.iterations}")
        parts.append(f"{1e3 * sum(curves.seconds) / len(curves.seconds):.0f} ms each")
    if phase is Phase.RUNNING:
        parts.append("running")
    elif phase is Phase.PAUSED:
        parts.append("paused")
    elif state.run.reason:
        parts.append(escaped(state.run.reason))
    if state.run_outdated and phase is Phase.IDLE:
        parts.append("changed since")
    return " · ".join(parts) or _BEFORE_RUN.get(state.review.state, _RUN)


def undetermined_lines(state: ViewState, session: Session) -> str:
    """Which unknowns the images of a run left open, and what it did to them, as HTML; empty while running."""
    known = None if state.maps is None or not state.maps.of_run else state.maps.iterate.uncertainty
    if known is None or state.run.phase is Phase.RUNNING:
        return ""
    lines: list[str] = []
    for how, meaning in (("weak", "Weakly determined by this image"), ("not visible", UNDETERMINED)):
        these = [name for name in known.names if known.observability(name) == how]
        names = [_spoken(name) + _moved(name, state, session) for name in these]
        if names:
            lines.append(f'<p class="carts-caption">{meaning}: {escaped(", ".join(names))}</p>')
    return "".join([*lines, f'<p class="carts-caption">{_CONSEQUENCE}</p>' if lines else ""])


def _moved(unknown: str, state: ViewState, session: Session) -> str:
    """By how much a run has moved a joint, in brackets; nothing for other unknowns."""
    arm, _, joint = unknown.partition("/")
    found = [limits for limits in session.ranges if limits.arm == arm]
    places = [number for number, limits in enumerate(found) if limits.joint == joint]
    if not places or state.run.start is None:
        return ""
    before, now = (session.joints(scene)[arm][places[0]] for scene in (state.run.start, state.pose.scene))
    revolute = found[places[0]].revolute
    by = math.degrees(now - before) if revolute else 1e3 * (now - before)
    return " (stayed)" if abs(by) < 0.05 else f" (moved by {by:+.1f}{'°' if revolute else ' mm'})"


def _spoken(unknown: str) -> str:
    owner, _, name = unknown.partition("/")
    return f"{owner} {humanized(name).lower()}"
