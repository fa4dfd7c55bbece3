"""How far the shown pose can be relied on: a verdict with its reason and what to try, and the fit in every camera."""

import viser

from carts_core.optimization import Verdict, fit_words, undetermined_joints
from carts_core.project import FitVerdict
from carts_viewer import intents
from carts_viewer.panels.inputs import Emit, escaped, on_click
from carts_viewer.panels.live import live_text
from carts_viewer.session import Session
from carts_viewer.state import Phase, ViewState
from carts_viewer.transport.tab_page import TabPage

_MEANING = (
    "What the images say of the fit. Good: rely on the mask. Doubtful: look at it. Failed: do not use it. Joints "
    "that the images leave open stay near their measured values; their deviations are under Values."
)


class FitPanel:
    """The verdict, always in view, and a button that asks the images for one."""

    def __init__(self, page: TabPage, session: Session, emit: Emit) -> None:
        gui = page.gui
        self._scene = session.scene
        self._cameras = [camera.name for camera in session.scene.cameras]
        self._text = gui.add_html("")
        self._check = gui.add_button(
            "Check the fit",
            icon=viser.Icon.STETHOSCOPE,
            color="gray",
            hint="Compare the arms as they are with the images of all cameras, and move nothing",
        )
        on_click(self._check, lambda _: intents.Assess(), emit)

    def show(self, state: ViewState) -> None:
        """Bring the verdict up to date."""
        if state.live is not None and state.live.on:
            self._check.visible = False
            self._text.content = live_text(state.live)
            return
        running = state.run.phase is Phase.RUNNING or state.solving
        # It stays where it is, so that nothing below it moves under the pointer.
        self._check.visible = True
        self._check.disabled = running or state.verdict is not None
        self._check.label = "Check the fit" if state.verdict is None else "The fit is checked"
        known = {name: found.standard_deviations or () for name, found in state.project.joints(state.index).items()}
        self._text.content = fit_text(
            state.verdict,
            running=running,
            scores=_scores(state, self._cameras),
            undetermined=undetermined_joints(self._scene, known),
            busy=state.busy,
        )


def fit_text(
    verdict: FitVerdict | None,
    *,
    running: bool,
    scores: dict[str, float],
    undetermined: list[str] | None = None,
    busy: str | None = None,
) -> str:
    """A verdict with its reason, remedy and cameras, as HTML.

    Args:
        verdict: of the shown pose; None where it was not assessed.
        running: whether the pose is still moving.
        scores: Dice of the cameras with a true mask.
        undetermined: joints that the images leave open; None where no deviation is known.
        busy: what is being prepared, for people.
    """
    cameras = dict(verdict.cameras) if verdict is not None else {}
    chips = []
    for name in {**scores, **cameras}:
        dice = f" Dice {scores[name]:.3f}" if name in scores else ""
        mark = f'<span class="carts-dot {quality(cameras[name])}"></span>' if name in cameras else ""
        said = f" {quality(cameras[name])}" if name in cameras else ""
        chips.append(f'<span class="carts-key">{mark}{escaped(name)}{said}{dice}</span>')
    line = f'<div class="carts-cameras">{"".join(chips)}</div>' if len(chips) > 1 or cameras else ""
    if scores and line:
        line += (
            "<small>Dice: overlap of the rendered arms with the mask that came with the recording, as a check.</small>"
        )
    if verdict is None:
        name = "running" if running else "not checked"
        if busy is not None:
            name += f' <span class="carts-spinner"></span>{escaped(busy)} …'
        return f'<div class="carts-verdict unknown" role="status"><b>Fit {name}</b>{line}</div>'
    remedy = f"<br><i>Try:</i> {escaped(verdict.remedy)}" if verdict.remedy else ""
    name, (mask, _, joints) = verdict.verdict, fit_words(verdict.verdict, undetermined).partition(", ")
    listed = ", ".join(undetermined or ()).replace("_", " ")
    known = f', <b title="{escaped(listed)}">{joints}</b>' if joints else ""
    return (
        f'<div class="carts-verdict {name}" role="status" title="{_MEANING}"><b>{mask.capitalize()}</b>{known}<br>'
        f"{escaped(verdict.reason)}{remedy}{line}</div>"
    )


def quality(failure: float) -> str:
    """The verdict that a probability of failure calls for."""
    return Verdict.of(failure).value


def _scores(state: ViewState, cameras: list[str]) -> dict[str, float]:
    known = {} if state.scores is None else state.scores.cameras
    return {name: known[name] for name in cameras if name in known}
