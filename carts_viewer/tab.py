"""One tab: where somebody is in the recording and what they do there, whether or not a page shows it just now."""

import time
from collections.abc import Callable, Hashable

import viser

from carts_viewer.controller import Controller
from carts_viewer.display import PageDisplay
from carts_viewer.intent_queue import IntentQueue
from carts_viewer.intents import Intent
from carts_viewer.layout import Layout, choose_theme
from carts_viewer.overlay import OverlayRenderer
from carts_viewer.people import Person
from carts_viewer.scene_view import SceneView
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.storage import Storage
from carts_viewer.transport.tab_page import TabPage

AWAY = 20.0
"""Time for a page to come back, as by reloading, before the run of its tab is ended [s]."""


class View:
    """What the page of a tab is made of.

    Attributes:
        page: the tab's widgets and scene.
        layout: its panels.
        scene: what is seen in 3D, frame and overlay included.
        display: what puts states on the page.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        session: Session,
        renderer: OverlayRenderer,
        storage: Storage,
        state: ViewState,
        emit: Callable[[Intent], None],
        waits: Callable[[Hashable], bool],
    ) -> None:
        """Build widgets and scene in a tab that shows nothing yet."""
        self.page = TabPage(client)
        with self.page.atomic():
            self.layout = Layout(self.page, session, storage, state, emit, waits)
            self.scene = SceneView(self.page.scene, session.scene, state.pose.scene, state.camera)
        self.display = PageDisplay(self.page, session, renderer, self.scene, self.layout.panels)


class Tab:
    """Somebody's place: frame, camera, tools and run, and the page that shows it.

    Attributes:
        key: what the tab calls itself; None until one has taken this place.
        person: who works here.
        session: the recording and its project, as they are used here.
        controller: holds the state and changes it.
        view: what shows it; None while no page does.
    """

    def __init__(self, queue: IntentQueue["Tab"], session: Session, person: Person, controller: Controller) -> None:
        self.key: str | None = None
        self.person = person
        self.controller = controller
        self.view: View | None = None
        self._queue = queue
        self.session = session
        self._shown: ViewState | None = None
        self._pictured: ViewState | None = None
        self._left_at: float | None = None
        """When the page left [s, monotonic]; None while there is one, and once its run is ended."""

    def put(self, intent: Intent) -> None:
        """Have the worker do something here. Any thread may ask."""
        self._queue.put(self, intent)

    def waits(self, key: Hashable) -> bool:
        """Whether an intent of this key waits for the worker."""
        return self._queue.waits(self, key)

    @property
    def client_id(self) -> int | None:
        """The connection of the page; None while there is none."""
        return None if self.view is None else self.view.page.client.client_id

    def attach(self, client: viser.ClientHandle, renderer: OverlayRenderer, storage: Storage, *, light: bool) -> None:
        """Show this place in a page, and no longer in an earlier one."""
        choose_theme(client.gui, light=light)
        self.person.present = True
        self.view = View(client, self.session, renderer, storage, self.controller.state, self.put, self.waits)
        self._shown = self._pictured = self._left_at = None

    def detach(self) -> None:
        """The page is gone; what is under way goes on for as long as it may come back."""
        self.view = None
        self.person.present = False
        self._left_at = time.monotonic()

    def away_in(self) -> float | None:
        """How long until `leave` is due [s]; None: it is not."""
        return None if self._left_at is None else max(0.0, self._left_at + AWAY - time.monotonic())

    def leave(self) -> None:
        """End what only the page could show, once it has been gone for long.

        Raises:
            CartsError: it could not be saved.
        """
        if self.away_in() == 0.0:
            self._left_at = None
            self.controller.leave()

    @property
    def pictured(self) -> bool:
        """Whether a page shows a picture here."""
        return self.view is not None and self._pictured is not None

    def picture_wait(self) -> float | None:
        """How long until a picture should be sent [s]; None: there is nothing to send."""
        if self.view is None or self._pictured is self.controller.state:
            return None
        return self.view.display.ready_in()

    def publish(self, attempt: Callable[[Callable[[], None]], None]) -> None:
        """Show the state, as far as it is not shown.

        Args:
            attempt: does something and shows its errors.
        """
        controller, display = self.controller, None if self.view is None else self.view.display
        if self._pictured is not controller.state and (display is None or display.ready_in() <= 0.0):
            attempt(controller.map)
            if display is not None:
                attempt(lambda: display.show_picture(controller.state))
            # Numbers come after the picture: somebody may be dragging.
            attempt(controller.score)
            # Also after an error, which would otherwise be met again at once, and for ever.
            self._pictured = controller.state
        self.show_panels()

    def show_panels(self) -> None:
        """Bring the widgets up to date."""
        if self._shown is not self.controller.state:
            self._shown = self.controller.state
            if self.view is not None:
                self.view.display.show_panels(self._shown)

    def close(self) -> None:
        """Save what is under way, and stop reading frames in advance.

        Raises:
            CartsError: it could not be saved.
        """
        try:
            self.controller.close()
        finally:
            self.session.close()
