"""Puts states on the page: pictures into the stage, values into the panels, only what changed and only when asked."""

from collections.abc import Mapping, Sequence

from carts_viewer.layers import Layer, Rgba, paint_over
from carts_viewer.marks import draw_keypoints, labelled_keypoints
from carts_viewer.overlay import OverlayRenderer
from carts_viewer.panels.inputs import Panel
from carts_viewer.rate_limit import RateLimit
from carts_viewer.scene_view import SceneView
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.strokes import Tool
from carts_viewer.transport.page import Page


class PageDisplay:
    """The page as the worker sees it; used on the worker's thread."""

    def __init__(
        self, page: Page, session: Session, renderer: OverlayRenderer, scene_view: SceneView, panels: Sequence[Panel]
    ) -> None:
        self._page = page
        self._scene = session.scene
        self._renderer = renderer
        self._scene_view = scene_view
        self._panels = panels
        self._keypoints = tuple(labelled_keypoints(session.scene).values())
        self._rate_limit = RateLimit()
        self._shown: ViewState | None = None
        self.drawn = self._rate_limit.drawn

    def ready_in(self) -> float:
        """How long until the page can take another picture [s]; 0 when it can now."""
        return self._rate_limit.ready_in()

    def show_picture(self, state: ViewState) -> None:
        """Send frame, overlay and 3D scene, as far as they changed."""
        old = self._shown
        camera = self._scene.camera(state.camera)
        new_frame = old is None or state.frame is not old.frame
        new_pose = old is None or state.pose is not old.pose or state.camera != old.camera
        if new_frame or new_pose or old is None or _picture(state) != _picture(old):
            overlay = self._renderer.overlay(
                state.pose.scene,
                state.frame,
                state.camera,
                state.layer,
                state.opacity,
                state.maps,
                state.mask_correction,
            )
            _draw_paint(overlay, state)
            if state.keypoints.shown:
                draw_keypoints(
                    overlay, self._scene, state.pose.scene, state.camera, self._keypoints, state.keypoints.pins
                )
            # Together, or a new frame would be seen for a moment under the old frame's overlay.
            with self._page.server.atomic():
                if new_frame:
                    self._scene_view.show_frame(state.frame.images[state.camera], camera)
                self._scene_view.show_overlay(overlay, camera)
            self._page.server.flush()
            self._acknowledge({} if old is None else old.brush.painted, state.brush.painted)
            self._rate_limit.sent()
            # The 3D scene is hidden behind the frame most of the time, so the overlay does not wait for it.
            if new_pose:
                self._scene_view.show_pose(state.pose.scene, state.camera)
        self._shown = state

    def _acknowledge(self, old: Mapping[int, int], new: Mapping[int, int]) -> None:
        """Acknowledge strokes that are in the overlay that was just sent: their tabs need not draw them any more."""
        clients = self._page.server.get_clients()
        for tab, number in new.items():
            if old.get(tab) != number and tab in clients:
                self._page.call(clients[tab], "painted", number)

    def show_panels(self, state: ViewState) -> None:
        """Bring every widget up to date."""
        for panel in self._panels:
            panel.show(state)


def _picture(state: ViewState) -> tuple:
    brush = state.brush
    keypoints = state.keypoints.shown, state.keypoints.pins
    painted = state.mask_correction, state.ignore_region, brush.tool is Tool.OFF, brush.target, brush.painted
    return state.layer, state.opacity, id(state.maps), keypoints, painted


def _draw_paint(overlay: Rgba, state: ViewState) -> None:
    """Draw what was painted, unless somebody wants to see nothing but the frame."""
    at_work = state.brush.tool is not Tool.OFF
    if at_work or state.layer is not Layer.NONE:
        # The comparison with the truth shows the corrected mask itself.
        correction = None if state.layer is Layer.TRUTH else state.mask_correction
        paint_over(overlay, correction, state.ignore_region, max(state.opacity, 0.4) if at_work else state.opacity)
