"""Puts states on the page: pictures into the stage, values into the panels, only what changed and only when asked."""

from collections.abc import Sequence

from carts_viewer.marks import draw_keypoints, labelled_keypoints
from carts_viewer.pace import Pace
from carts_viewer.page import Page
from carts_viewer.panels.inputs import Panel
from carts_viewer.picture import Painter
from carts_viewer.session import Session
from carts_viewer.stage import Stage
from carts_viewer.state import ViewState


class PageDisplay:
    """The page as the worker sees it; used on the worker's thread."""

    def __init__(self, page: Page, session: Session, painter: Painter, stage: Stage, panels: Sequence[Panel]) -> None:
        self._page = page
        self._scene = session.scene
        self._painter = painter
        self._stage = stage
        self._panels = panels
        self._keypoints = tuple(labelled_keypoints(session.scene).values())
        self._pace = Pace()
        self._shown: ViewState | None = None
        self.drawn = self._pace.drawn

    def ready_in(self) -> float:
        """How long until the page can take another picture [s]; 0 when it can now."""
        return self._pace.ready_in()

    def show_picture(self, state: ViewState) -> None:
        """Send frame, overlay and 3D scene, as far as they changed."""
        old = self._shown
        camera = self._scene.camera(state.camera)
        new_frame = old is None or state.frame is not old.frame
        new_pose = old is None or state.pose is not old.pose or state.camera != old.camera
        if new_frame or new_pose or old is None or _picture(state) != _picture(old):
            overlay = self._painter.overlay(
                state.pose.scene, state.frame, state.camera, state.layer, state.opacity, state.maps
            )
            if state.keypoints.shown:
                draw_keypoints(
                    overlay, self._scene, state.pose.scene, state.camera, self._keypoints, state.keypoints.pins
                )
            # Together, or a new frame would be seen for a moment under the old frame's overlay.
            with self._page.server.atomic():
                if new_frame:
                    self._stage.show_frame(state.frame.images[state.camera], camera)
                self._stage.show_overlay(overlay, camera)
            self._page.server.flush()
            self._pace.sent()
            # The 3D scene is hidden behind the frame most of the time, so the overlay does not wait for it.
            if new_pose:
                self._stage.show_pose(state.pose.scene, state.camera)
        self._shown = state

    def show_panels(self, state: ViewState) -> None:
        """Bring every widget up to date."""
        for panel in self._panels:
            panel.show(state)


def _picture(state: ViewState) -> tuple:
    return state.layer, state.opacity, id(state.maps), state.keypoints.shown, state.keypoints.pins
