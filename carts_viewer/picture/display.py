"""Sends changed pictures and widgets to a tab, no faster than the tab draws them."""

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache

from carts_core.model.scene import SceneState
from carts_core.project import IgnoreRegion, Key, Kind, MaskCorrection
from carts_viewer.panels.inputs import Panel
from carts_viewer.picture.comparison import compared_poses, composed, outlines, painted
from carts_viewer.picture.layers import Layer, Rgba, imported, paint_over, parts, transparent
from carts_viewer.picture.overlay import OverlayRenderer, with_imported
from carts_viewer.picture.scene_view import FRAME, OVERLAY, SceneView
from carts_viewer.session import Session
from carts_viewer.state import ComparedPose, CompareMode, ViewState
from carts_viewer.transport.page import TabPage


@cache
def _threads() -> ThreadPoolExecutor:
    """Threads for the cameras shown side by side; the renderer is thread-safe."""
    return ThreadPoolExecutor(4, thread_name_prefix="overlay")


Poses = Mapping[ComparedPose, SceneState | None]
"""The compared poses; None for a pose that does not exist."""


class PageDisplay:
    """Display of a tab; used on the worker's thread."""

    def __init__(
        self,
        page: TabPage,
        session: Session,
        renderer: OverlayRenderer,
        scene_view: SceneView,
        panels: Sequence[Panel],
        *,
        scene_shown: bool = False,
    ) -> None:
        """`scene_shown`: whether the page shows the 3D view, see `show_scene`."""
        self._page = page
        self._scene = session.scene
        self._session = session
        self._renderer = renderer
        self._scene_view = scene_view
        self._panels = panels
        self._scene_shown = scene_shown
        self._rate_limit = RateLimit()
        self._shown: ViewState | None = None

    def drawn(self, number: int) -> None:
        """Record that the tab has drawn the picture with this number. Thread-safe."""
        self._rate_limit.drawn(number)

    def ready_in(self) -> float:
        """Time until the page can receive another picture [s]."""
        return self._rate_limit.ready_in()

    def show_picture(self, state: ViewState) -> None:
        """Send changes of frame, overlay and 3D scene."""
        old = self._shown
        camera = self._scene.camera(state.camera)
        new_frame = old is None or state.frame is not old.frame
        new_pose = old is None or state.pose is not old.pose or state.camera != old.camera
        if new_frame or new_pose or old is None or _picture(state) != _picture(old):
            overlays = self._overlays(state, self._shown_cameras(state))
            # Before sending, since a tab may acknowledge the picture before `flush` is called.
            number = self._rate_limit.sent()
            # Sent together, so that a new frame never appears under the old frame's overlay.
            with self._page.atomic():
                if old is None or (state.index, state.camera) != (old.index, old.camera):
                    self._page.call("setPicture", state.index, state.camera, camera.width, camera.height)
                changed = []
                if new_frame and self._scene_view.show_frame(state.frame.images[state.camera], camera):
                    changed.append(FRAME)
                if self._scene_view.show_overlay(overlays[state.camera], camera):
                    changed.append(OVERLAY)
                self._show_others(state, old, overlays)
                self._page.call("expectPicture", number, changed)
            self._page.flush()
            self._acknowledge({} if old is None else old.brush.painted, state.brush.painted)
            if self._scene_shown or old is None:
                self._show_scene(state)
        self._shown = state

    def show_scene(self, on: bool) -> None:
        """Set whether each picture updates the arms and cameras of the 3D view.

        The first picture always does, since the first poses determine the viewpoint.
        """
        self._scene_shown = on
        if on and self._shown is not None:
            self._show_scene(self._shown)

    def _show_scene(self, state: ViewState) -> None:
        self._scene_view.show_pose(state.pose.scene, state.camera)
        self._scene_view.show_measured(self._session.measured(state.frame))

    def _shown_cameras(self, state: ViewState) -> list[str]:
        """The cameras whose images are shown, the active camera first."""
        others = [camera.name for camera in self._scene.cameras if camera.name != state.camera]
        return [state.camera, *(name for name in others if state.beside and name in state.frame.images)]

    def _overlays(self, state: ViewState, cameras: list[str]) -> dict[str, Rgba]:
        """Overlays by camera, rendered in parallel."""
        # The project is read on the worker's thread.
        poses = compared_poses(state, self._session) if state.compare.mode or state.compare.peek else {}
        if len(cameras) == 1:
            return {cameras[0]: self._overlay(state, cameras[0], poses)}
        overlays = _threads().map(lambda camera: self._overlay(state, camera, poses), cameras)
        return dict(zip(cameras, overlays, strict=True))

    def _overlay(self, state: ViewState, camera: str, poses: Poses) -> Rgba:
        compare, correction = state.compare, state.mask_correction_of(camera)
        if compare.mode is CompareMode.OUTLINES and not compare.peek:
            masks = {which: self._renderer.arm_ids(pose, camera) for which, pose in poses.items() if pose is not None}
            own = self._scene.camera(camera)
            overlay = outlines(masks, (own.height, own.width))
        elif compare.mode is CompareMode.PAINTED:
            rendered = self._renderer.arm_ids(state.pose.scene, camera)
            before, after = painted(rendered, correction, camera, state.opacity)
            overlay = composed(after, before, compare.share)
        else:
            overlay = self._layer(state, camera, poses.get(compare.right) if compare.mode else state.pose.scene)
            if compare.share > 0.0:
                overlay = composed(overlay, self._layer(state, camera, poses[compare.left]), compare.share)
        if compare.mode is not CompareMode.PAINTED:
            # A comparison of poses shows corrections of the mask only while a painting tool is selected.
            shown = correction if compare.mode is None or state.brush.tool.paints else None
            _draw_paint(overlay, state, shown, state.ignore_region_of(camera))
        return overlay

    def _layer(self, state: ViewState, camera: str, scene: SceneState | None) -> Rgba:
        """The chosen layer of a pose; transparent without a pose."""
        if scene is None:
            own = self._scene.camera(camera)
            return transparent(own.height, own.width)
        correction = state.mask_correction_of(camera)
        truth = state.layer is Layer.TRUTH and not state.streaming
        frame = with_imported(state.frame, self._scene, state.project) if truth else state.frame

        if state.layer is Layer.IMPORTED and not state.streaming:
            return self._imported(state, camera)
        if state.layer is Layer.REFINED:
            return self._renderer.refined(scene, camera, state.refined_mask(scene, camera), state.opacity)
        if state.layer is Layer.PARTS:
            labels = state.part_labels_of(camera)
            return parts(self._renderer.classes(scene, camera, correction, labels), state.opacity)
        maps = state.maps if scene is state.pose.scene else None
        return self._renderer.overlay(scene, frame, camera, state.layer, state.opacity, maps, correction)

    def _imported(self, state: ViewState, camera: str) -> Rgba:
        """Picture of imported masks and keypoints."""
        own = self._scene.camera(camera)
        layer = state.project.get(Key.imported_mask(state.index, camera))
        points = state.project.get(Key.imported_keypoints(state.index, camera))
        labels = None if layer is None else layer.labels()
        return imported(labels, () if points is None else points.points, (own.height, own.width), state.opacity)

    def _show_others(self, state: ViewState, old: ViewState | None, overlays: Mapping[str, Rgba]) -> None:
        """Show or hide the images of the other cameras."""
        active = self._scene.camera(state.camera)
        again = old is None or old.frame is not state.frame or old.camera != state.camera or not old.beside
        for camera in self._scene.cameras:
            if camera.name != state.camera and camera.name in overlays:
                image = state.frame.images[camera.name] if again else None
                self._scene_view.show_beside(camera, active, image, overlays[camera.name])
            else:
                self._scene_view.hide_beside(camera)

    def _acknowledge(self, old: Mapping[int, int], new: Mapping[int, int]) -> None:
        """Acknowledge strokes that are in the sent overlay, so that the tab no longer draws them."""
        own = self._page.client.client_id
        if own in new and old.get(own) != new[own]:
            self._page.call("painted", new[own])

    def show_panels(self, state: ViewState) -> None:
        """Update every widget."""
        for panel in self._panels:
            panel.show(state)


def _picture(state: ViewState) -> tuple:
    brush = state.brush
    painted_kinds = Kind.MASK_CORRECTION, Kind.IGNORE_REGION, Kind.PART_LABELS
    keys = *painted_kinds, Kind.IMPORTED_MASK, Kind.IMPORTED_KEYPOINTS
    entries = state.project.records.get(state.index)
    layers = [] if entries is None else [e for key, e in entries.entries.items() if key.kind in keys]
    compared = (state.project, state.run.start) if state.compare.mode else None
    painted = layers, brush.tool.paints, brush.target, brush.painted
    return state.layer, state.opacity, id(state.maps), id(state.refined), state.beside, state.compare, compared, painted


def _draw_paint(
    overlay: Rgba, state: ViewState, corrected: MaskCorrection | None, ignored: IgnoreRegion | None
) -> None:
    """Draw painted layers, unless only the frame is shown and no painting tool is selected."""
    at_work = state.brush.tool.paints
    if at_work or state.layer is not Layer.NONE:
        # The layers of ground truth and parts show the corrected mask itself.
        correction = None if state.layer in (Layer.TRUTH, Layer.PARTS) else corrected
        paint_over(overlay, correction, ignored, max(state.opacity, 0.4) if at_work else state.opacity)


FIRST_WAIT = 0.08
"""Least time after which the next picture is sent if the last one is not acknowledged [s]."""
LONGEST_WAIT = 5.0
"""Longest such time [s]."""
_MARGIN = 1.5
"""This time, relative to that from sending to acknowledging the last acknowledged picture [1]."""


class RateLimit:
    """Decides when the next picture may be sent: once the tab has drawn the last picture, or after a wait.

    An image that is replaced while it is loaded is never drawn. The wait is therefore longer than the tab needed for
    the last acknowledged picture, and doubles with each unacknowledged one.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._wait = FIRST_WAIT
        self._sent_at = {0: float("-inf")}
        """Times [s] of the last acknowledged picture and of later ones, by number."""
        self._sent = self._drawn = 0
        """Numbers of the last sent picture, and of the last acknowledged one."""

    def sent(self) -> int:
        """Record that a picture is sent; returns its number."""
        if self._drawn != self._sent:
            self._wait = min(2.0 * self._wait, LONGEST_WAIT)
        self._sent_at[self._sent + 1] = self._clock()
        self._sent += 1
        return self._sent

    def drawn(self, number: int) -> None:
        """Record that the tab has drawn the picture with this number. Thread-safe."""
        if self._drawn < number <= self._sent:
            needed = self._clock() - self._sent_at[number]
            self._wait = min(max(_MARGIN * needed, FIRST_WAIT), LONGEST_WAIT)
            for earlier in range(self._drawn, number):
                del self._sent_at[earlier]
            self._drawn = number

    def ready_in(self) -> float:
        """Time until the next picture may be sent [s]."""
        sent = self._sent
        return 0.0 if self._drawn == sent else max(0.0, self._sent_at[sent] + self._wait - self._clock())
