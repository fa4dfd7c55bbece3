"""Panels of the verdict on the shown pose, and of live streams."""

import viser

from carts_core.optimization import Verdict, joint_words, undetermined_joints
from carts_core.project import FitVerdict
from carts_viewer.actions import intents
from carts_viewer.panels.inputs import PanelPage
from carts_viewer.session import Session
from carts_viewer.state import LiveState, Phase, ViewState
from carts_viewer.transport.document import escaped

_REPLAY, _SOCKET, _CAMERA = "Replay", "Socket", "Camera"
_PORT = 7000
_RATE = 30.0


class LivePanel:
    """Starts and stops a live stream, which is shown in place of the recording."""

    def __init__(self, page: PanelPage) -> None:
        gui = page.gui
        with gui.add_folder("Follow a live stream"):
            self._source = gui.add_dropdown(
                "Source",
                [_REPLAY, _SOCKET, _CAMERA],
                hint="Replay of this recording, messages from another program, or a camera of this machine",
            )
            self._device = gui.add_number("Device", 0, min=0, max=63, step=1, hint="Number of the camera, from 0")
            self._port = gui.add_number(
                "Port", _PORT, min=1024, max=65535, step=1, hint="Port on 127.0.0.1 that receives messages"
            )
            self._repeat = gui.add_checkbox("Repeat", False, hint="Restart when the recording ends")
            self._rate = gui.add_number(
                "Images per second",
                _RATE,
                min=0.1,
                max=1000,
                hint="Frame rate of this recording, whose images have no timestamps",
            )
            self._record = gui.add_checkbox(
                "Record", False, hint="Save images, joints and corrections in a new folder beside the project"
            )
            self._start = page.button("Start", lambda _: self._intent(), icon=viser.Icon.PLAYER_RECORD, color="teal")
            self._stop = page.button("Stop", intents.StopLive(), icon=viser.Icon.PLAYER_STOP)
            self._text = gui.add_html("")
        page.on_input(self._source, lambda _: intents.Refresh())

    def _intent(self) -> intents.StartLive:
        port = int(self._port.value)
        source, joints_port = {
            _SOCKET: (f"socket:{port}", None),
            _CAMERA: (f"camera:{int(self._device.value)}", port),
        }.get(self._source.value, ("replay", None))
        rate = float(self._rate.value) if self._rate.visible else None
        return intents.StartLive(
            source, joints_port, repeat=bool(self._repeat.value), record=bool(self._record.value), rate=rate
        )

    def show(self, state: ViewState) -> None:
        """Update the widgets."""
        on = state.live is not None and state.live.on
        self._device.visible = self._source.value == _CAMERA
        self._port.visible = self._source.value != _REPLAY
        self._repeat.visible = self._source.value == _REPLAY
        self._rate.visible = self._source.value == _REPLAY and state.frame.timestamp is None
        for widget in (self._source, self._device, self._port, self._repeat, self._rate, self._record, self._start):
            widget.disabled = on
        self._start.visible, self._stop.visible = not on, on
        text = "" if state.live is None else f'<p class="carts-caption" role="status">{escaped(state.live.text)}</p>'
        if self._text.content != text:
            self._text.content = text


def live_text(live: LiveState) -> str:
    """The tracker's verdict on the shown frame, as HTML."""
    if live.busy:
        return _live_box("unknown", "Live", live.text)
    if live.silent:
        return _live_box("doubtful", f"Live: no new frame for {live.silent:.0f} s", "The last result is shown.")
    reason, meaning = {
        "good": ("The arms are tracked.", ""),
        "doubtful": ("Predicted from earlier frames.", "The fit does not match the image."),
        "lost": ("The arms were not found.", "The measured joints with the last correction are shown."),
    }[live.verdict]
    style = {"good": "good", "doubtful": "doubtful", "lost": "failed"}[live.verdict]
    age = f"latency {1000.0 * live.age:.0f} ms{'' if live.current else ', outdated'}"
    style = style if live.current or style != "good" else "doubtful"
    return _live_box(style, f"Live: {live.verdict}, {age}", reason, meaning)


def _live_box(style: str, title: str, text: str, meaning: str = "") -> str:
    hint = f' title="{escaped(f"{text} {meaning}".strip())}"'
    return (
        f'<div class="carts-verdict {style}" role="status"{hint}><b>{escaped(title)}</b>'
        f"<small>{escaped(text)}</small></div>"
    )


_MEANING = (
    "Agreement of the fit with the images. Good: the mask is reliable. Doubtful: inspect it. Failed: do not use it. "
    "Undetermined joints stay near their measured values; the tab Values shows their standard deviations."
)


class FitPanel:
    """The verdict on the shown pose, and a button that computes the verdict."""

    def __init__(self, page: PanelPage, session: Session) -> None:
        gui = page.gui
        self._scene = session.scene
        self._cameras = [camera.name for camera in session.scene.cameras]
        self._text = gui.add_html("")
        self._check = page.button(
            "Check the fit",
            intents.Assess(),
            icon=viser.Icon.STETHOSCOPE,
            hint="Compare the arms at their current pose with the images of all cameras, without moving them",
        )
        page.row(self._check, icons=(self._check,))

    def show(self, state: ViewState) -> None:
        """Update the verdict."""
        if state.live is not None and state.live.on:
            self._check.visible = False
            self._text.content = live_text(state.live)
            return
        running = state.run.phase is Phase.RUNNING or state.solving
        # The button stays visible, so that the elements below do not move under the pointer.
        self._check.visible = True
        self._check.disabled = running or state.verdict is not None
        self._check.label = "Check the fit" if state.verdict is None else "Fit checked"
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
        verdict: verdict on the shown pose; None if it was not assessed.
        running: whether the pose is still changing.
        scores: Dice of the cameras with a ground-truth mask.
        undetermined: joints that the images do not determine; None if no standard deviation is known.
        busy: text about the current preparation.
    """
    cameras = dict(verdict.cameras) if verdict is not None else {}
    chips = []
    for name in {**scores, **cameras}:
        dice = f" Dice {scores[name]:.3f}" if name in scores else ""
        mark = f'<span class="carts-dot {quality(cameras[name])}"></span>' if name in cameras else ""
        said = f" {quality(cameras[name])}" if name in cameras else ""
        chips.append(f'<span class="carts-key">{mark}{escaped(name)}{said}{dice}</span>')
    line = f'<div class="carts-cameras">{"".join(chips)}</div>' if len(chips) > 1 or cameras else ""
    if verdict is None:
        name = "running" if running else "not checked"
        waits = "" if busy is None else f'<small><span class="carts-spinner"></span>{escaped(busy)} …</small>'
        return f'<div class="carts-verdict unknown" role="status"><b>Fit {name}</b>{waits}{line}</div>'
    name, joints, reason = verdict.verdict, joint_words(undetermined), escaped(verdict.reason)
    remedy = f"<p><i>Try:</i> {escaped(verdict.remedy)}</p>" if verdict.remedy else ""
    listed = ", ".join(undetermined or ()).replace("_", " ")
    known = f'<small title="{escaped(listed)}">{joints}</small>' if joints else ""
    # The reason is shown on request, over the widgets below, which keep their place.
    return (
        f'<div class="carts-verdict {name}" role="status"><details><summary title="{_MEANING}"><b>Mask {name}</b>'
        f"{known or f'<small>{reason}</small>'}</summary>"
        f'<div class="carts-why"><p>{reason}</p>{remedy}{line}</div></details></div>'
    )


def quality(failure: float) -> str:
    """The verdict for a probability of failure."""
    return Verdict.of(failure).value


def _scores(state: ViewState, cameras: list[str]) -> dict[str, float]:
    known = {} if state.scores is None else state.scores.cameras
    return {name: known[name] for name in cameras if name in known}
