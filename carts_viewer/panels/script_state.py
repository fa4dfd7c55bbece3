"""State for the page's scripts: cameras with their fit, keypoints, clicked points, and the frame."""

import math
from collections.abc import Mapping
from typing import Any

from carts_viewer.actions import intents
from carts_viewer.actions.frame_filter import review_name
from carts_viewer.panels.fit import quality
from carts_viewer.picture.comparison import compared_poses, legend, side_names
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.overlay import keypoints_in_image, labelled_keypoints
from carts_viewer.session import Session
from carts_viewer.state import Reach, ViewState
from carts_viewer.transport.page import TabPage


class ScriptState:
    """Sends state to the page's scripts when it has changed."""

    def __init__(self, page: TabPage, session: Session) -> None:
        self._page = page
        self._session = session
        self._points = labelled_keypoints(session.scene)
        self._labels = {point: label for label, point in self._points.items()}
        self._sent: dict[str, Any] = {}

    def show(self, state: ViewState) -> None:
        """Send changes."""
        message = self._message(state)
        if message != self._sent:
            self._sent = message
            self._page.call("setPage", message)

    def _message(self, state: ViewState) -> dict[str, Any]:
        scene, names = self._session.scene, [camera.name for camera in self._session.scene.cameras]
        dice = {} if state.scores is None else dict(state.scores.cameras)
        failures = {} if state.verdict is None else dict(state.verdict.cameras)
        if state.verdict is not None and not failures:
            failures = {names[0]: state.verdict.failure} if len(names) == 1 else {}
        cameras = []
        for index, name in enumerate(names):
            if name != state.camera and not (state.beside and name in state.frame.images):
                continue
            shown = state.keypoints.shown or bool(state.keypoints.pins)
            own = scene.camera(name)
            cameras.append(
                {
                    "index": index,
                    "name": name,
                    "dice": dice.get(name),
                    "fit": quality(failures[name]) if name in failures else None,
                    "points": keypoints_in_image(scene, state.pose.scene, name, self._points) if shown else [],
                    "pins": [
                        (self._labels[pin.keypoint], pin.pixel[0] / own.width, pin.pixel[1] / own.height)
                        for pin in state.keypoints.pins
                        if pin.camera == name
                    ],
                }
            )
        poses = {} if state.compare.mode is None else compared_poses(state, self._session)
        return {
            "cameras": cameras,
            "active": names.index(state.camera),
            "chosen": state.keypoints.chosen,
            "frame": state.index,
            "names": names,
            "name": state.name,
            "domain": state.domain,
            "label": state.frame.frame_id,
            "review": review_name(state.project, state.index),
            "fit": None if state.verdict is None else state.verdict.verdict,
            "range": state.range,
            "playing": state.playing,
            "notice": state.notice,
            "compare": {
                "sides": side_names(state, poses),
                "share": state.compare.swipe,
                "legend": legend(state, poses),
            },
            "settings": stored_choices(state),
        }


def stored_choices(state: ViewState) -> dict[str, Any]:
    """Choices that a browser stores."""
    return {
        "layer": str(state.layer),
        "opacity": state.opacity,
        "reach": str(state.reach),
        "beside": state.beside,
        "fps": state.fps,
        "keys": dict(state.keys),
    }


def restored_choices(settings: Mapping[str, Any], state: ViewState) -> list[intents.Intent]:
    """Intents that restore stored choices, if they are valid."""
    found: list[intents.Intent] = []
    layer, reach, beside = (settings.get(name) for name in ("layer", "reach", "beside"))
    # Layers of imported masks or of ground truth do not exist in every recording.
    if isinstance(layer, str) and layer in {Layer.SHADED, Layer.MASK, Layer.CONTOUR, Layer.NONE} - {state.layer}:
        found.append(intents.ShowLayer(Layer(layer)))
    if isinstance(reach, str) and reach in set(Reach) - {state.reach}:
        found.append(intents.SetReach(Reach(reach)))
    if isinstance(beside, bool) and beside is not state.beside:
        found.append(intents.ShowBeside(beside))
    keys = settings.get("keys")
    if isinstance(keys, dict) and all(isinstance(one, str) for one in (*keys, *keys.values())):
        found.append(intents.SetKeys(keys))
    for name, make in (("opacity", intents.SetOpacity), ("fps", intents.SetSpeed)):
        value = settings.get(name)
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            found.append(make(float(value)))
    return found
