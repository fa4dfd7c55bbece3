"""Following a live stream: where frames come from, start and stop, and how it goes."""

import viser

from carts_viewer import intents
from carts_viewer.panels.inputs import Emit, escaped, on_click, on_input
from carts_viewer.state import LiveState, ViewState
from carts_viewer.transport.tab_page import TabPage

_REPLAY, _SOCKET, _CAMERA = "Replay", "Socket", "Camera"
_PORT = 7000
_RATE = 30.0


class LivePanel:
    """Starts and stops a stream that is shown in the place of the recording."""

    def __init__(self, page: TabPage, emit: Emit) -> None:
        gui = page.gui
        with gui.add_folder("Follow a live stream"):
            self._source = gui.add_dropdown(
                "Source",
                [_REPLAY, _SOCKET, _CAMERA],
                hint="This recording as it was recorded, messages of another program, or a camera of this machine",
            )
            self._device = gui.add_number("Device", 0, min=0, max=63, step=1, hint="Number of the camera, from 0")
            self._port = gui.add_number(
                "Port", _PORT, min=1024, max=65535, step=1, hint="Of 127.0.0.1, where messages are sent to"
            )
            self._repeat = gui.add_checkbox("Repeat", False, hint="Begin again when the recording ends")
            self._rate = gui.add_number(
                "Images per second", _RATE, min=0.1, max=1000, hint="Of this recording, whose images have no times"
            )
            self._record = gui.add_checkbox(
                "Record", False, hint="Keep images, joints and corrections in a new folder beside the project"
            )
            self._start = gui.add_button("Start", icon=viser.Icon.PLAYER_RECORD, color="teal")
            self._stop = gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP, color="gray")
            self._text = gui.add_html("")
        on_click(self._start, lambda _: self._intent(), emit)
        on_click(self._stop, lambda _: intents.StopLive(), emit)
        on_input(self._source, lambda _: intents.Refresh(), emit)

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
        """Bring the widgets up to date."""
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
    """The tracker's verdict on the frame that is shown, as HTML."""
    if live.busy:
        return f'<div class="carts-verdict unknown" role="status"><b>Live</b> {escaped(live.text)}</div>'
    reason = {
        "good": "The arms are followed.",
        "doubtful": "The image does not fit for the moment; shown is what the frames before let expect.",
        "lost": "The arms are not found; shown are the measured joints with the last known correction.",
    }[live.verdict]
    style = {"good": "good", "doubtful": "doubtful", "lost": "failed"}[live.verdict]
    age = f"{1000.0 * live.age:.0f} ms after the frame"
    return f'<div class="carts-verdict {style}" role="status"><b>Live: {live.verdict}</b> {reason} <i>{age}</i></div>'
