"""Tabs: the queue of intents, the state and view of each tab, and the state that all tabs share."""

import logging
import math
import threading
import time
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import viser

from carts_core.errors import CartsError
from carts_core.optimization import FreeParameters, SurfaceSolver
from carts_core.recording import Sequence
from carts_viewer.actions import intents
from carts_viewer.actions.import_export import Deliver
from carts_viewer.actions.intents import Intent
from carts_viewer.controller import Controller, JobRunner
from carts_viewer.editing import People, Person
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.panels.inputs import PanelPage
from carts_viewer.panels.layout import Layout, choose_theme
from carts_viewer.panels.script_state import restored_choices
from carts_viewer.picture.display import PageDisplay
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.picture.scene_view import SceneView
from carts_viewer.session import Session, Storage
from carts_viewer.state import ViewState
from carts_viewer.transport.events import Hello

_log = logging.getLogger(__name__)

T = TypeVar("T", bound=Hashable)


@dataclass(frozen=True)
class QueuedIntent(Generic[T]):
    """An intent and the tab that it came from."""

    tab: T
    intent: Intent


_BOUNDARIES = (intents.Released, intents.ShowFrame)
"""Classes of intents that give earlier and later intents another meaning: another gesture, or another frame."""
_EDITS = (intents.SetJoint, intents.DragLink, intents.PointAt, intents.SetNote)
"""Classes of intents that depend on gesture or frame."""
_WITHOUT_ORDER = (intents.Drawn, intents.Refresh)
"""Classes of intents whose place among others does not matter."""


class IntentQueue(Generic[T]):
    """Queue of intents. Any thread may put; only the worker takes."""

    def __init__(self) -> None:
        self._waiting: list[tuple[Hashable, QueuedIntent[T]]] = []
        self._changed = threading.Condition()
        self._woken = False

    def put(self, tab: T, intent: Intent) -> None:
        """Add an intent; it replaces a pending one with the same tab and key, unless an intent between them separates
        the two."""
        with self._changed:
            key = object() if intent.key is None else (tab, intent.key)
            self._remove_older(key)
            self._waiting.append((key, QueuedIntent(tab, intent)))
            self._changed.notify()

    def _remove_older(self, key: Hashable) -> None:
        for place in reversed(range(len(self._waiting))):
            if self._waiting[place][0] == key:
                older = self._waiting[place][1]
                if not any(_separates(older, other) for _, other in self._waiting[place + 1 :]):
                    del self._waiting[place]
                return

    def take(self, timeout: float | None = None) -> list[QueuedIntent[T]]:
        """Take all pending intents; if there are none, wait up to `timeout` [s] for one (None: without limit)."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._woken, timeout)
            self._woken = False
            waiting = [queued for _, queued in self._waiting]
            self._waiting.clear()
            return waiting

    def wake(self) -> None:
        """End a waiting `take` with an empty result."""
        with self._changed:
            self._woken = True
            self._changed.notify()

    def empty(self) -> bool:
        """Whether no intent is pending."""
        with self._changed:
            return not self._waiting

    def waits(self, tab: T, key: Hashable) -> bool:
        """Whether an intent with this tab and key is pending."""
        with self._changed:
            return any(pending == (tab, key) for pending, _ in self._waiting)


def _separates(older: QueuedIntent[T], between: QueuedIntent[T]) -> bool:
    """Whether an intent must not be replaced by a newer one because of another intent that was queued after it."""
    first, then = older.intent, between.intent
    if between.tab != older.tab or isinstance(first, _WITHOUT_ORDER):
        return False
    return (
        then.key is None
        or (isinstance(first, _EDITS) and isinstance(then, _BOUNDARIES))
        or (isinstance(first, _BOUNDARIES) and isinstance(then, _EDITS))
    )


RECONNECT_TIME = 20.0
"""Time for a page to reconnect, as after a reload, before the run of its tab is ended [s]."""


class View:
    """Widgets, scene and display of a tab's page.

    Attributes:
        page: the tab's widgets and scene.
        layout: its panels.
        scene: the 3D scene, frame and overlay included.
        display: shows states on the page.
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
        *,
        scene_shown: bool,
    ) -> None:
        self.page = PanelPage(client, emit, waits)
        with self.page.atomic():
            self.layout = Layout(self.page, session, storage, state)
            self.scene = SceneView(self.page.scene, session.scene, state.pose.scene, state.camera)
        self.display = PageDisplay(
            self.page, session, renderer, self.scene, self.layout.panels, scene_shown=scene_shown
        )


class Tab:
    """State of one browser tab: frame, camera, tools and run, and the page that shows it.

    Attributes:
        key: identifier sent by the browser tab; None before a page is attached.
        person: the user.
        session: the recording and its project, with the draft of this tab.
        controller: holds the state and changes it.
        view: widgets and scene of its page; None without a page.
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
        self._panels_at = -math.inf
        """Time of the last update of the widgets [s, monotonic]."""
        self._scored = True
        self._left_at: float | None = None
        """Time at which the page was closed [s, monotonic]; None while the page is open and after the run was ended."""
        self._gone = False
        """Whether the page has been closed for `RECONNECT_TIME`, so that maps and scores are not needed."""

    def put(self, intent: Intent) -> None:
        """Queue an intent for the worker. Thread-safe."""
        self._queue.put(self, intent)

    def waits(self, key: Hashable) -> bool:
        """Whether an intent with this key is pending."""
        return self._queue.waits(self, key)

    @property
    def client_id(self) -> int | None:
        """Client id of the page; None without a page."""
        return None if self.view is None else self.view.page.client.client_id

    def attach(self, client: viser.ClientHandle, renderer: OverlayRenderer, storage: Storage, hello: Hello) -> None:
        """Show this tab in a page, which replaces its earlier page."""
        choose_theme(client.gui, light=hello.light)
        self.person.present = True
        state, session = self.controller.state, self.session
        self.view = View(client, session, renderer, storage, state, self.put, self.waits, scene_shown=hello.scene)
        self._shown = self._pictured = self._left_at = None
        self._panels_at, self._gone = -math.inf, False

    def detach(self) -> None:
        """Detach the closed page; the run continues for `RECONNECT_TIME`."""
        self.view = None
        self.person.present = False
        self._left_at = time.monotonic()

    def away_in(self) -> float | None:
        """Time until `leave` ends the run [s]; None if the page is open or the run was ended."""
        return None if self._left_at is None else max(0.0, self._left_at + RECONNECT_TIME - time.monotonic())

    def leave(self) -> None:
        """End the run once the page has been closed for `RECONNECT_TIME`.

        Raises:
            CartsError: the pose could not be saved.
        """
        if self.away_in() == 0.0:
            self._left_at, self._gone = None, True
            self.controller.leave()

    @property
    def pictured(self) -> bool:
        """Whether a page shows a picture of this tab."""
        return self.view is not None and self._pictured is not None

    def show_wait(self) -> float | None:
        """Time until the page takes a changed state [s]; None if it shows the current one."""
        state, display = self.controller.state, None if self.view is None else self.view.display
        if display is None or (self._pictured is state and self._shown is state):
            return None
        ready = display.ready_in()
        return ready if self._shown is state else min(ready, self._panels_wait())

    def _panels_wait(self) -> float:
        """Time after which widgets are updated also if a picture is not acknowledged [s]."""
        return max(0.0, self._panels_at + _PANELS_WAIT - time.monotonic())

    def show_picture(self, attempt: Callable[[Callable[[], None]], None]) -> None:
        """Show a changed picture if it is due; `attempt` calls a function and shows its errors."""
        controller, display = self.controller, None if self.view is None else self.view.display
        due = not self._gone if display is None else display.ready_in() <= 0.0
        if due and self._pictured is not controller.state:
            attempt(controller.map)
            if display is not None:
                attempt(lambda: display.show_picture(controller.state))
            # Set also after an error, which would otherwise recur endlessly.
            self._pictured, self._scored = controller.state, False

    def publish(self, attempt: Callable[[Callable[[], None]], None]) -> None:
        """Show a changed state; `attempt` as in `show_picture`."""
        self.show_picture(attempt)
        if not self._scored:
            # Scores come after the picture, which matters more during a drag.
            pictured = self._pictured is self.controller.state
            attempt(self.controller.score)
            self._scored = True
            if pictured:
                self._pictured = self.controller.state
        if self.view is None or self.view.display.ready_in() == 0.0 or self._panels_wait() == 0.0:
            self.show_panels(attempt)

    def show_panels(self, attempt: Callable[[Callable[[], None]], None]) -> None:
        """Update the widgets; `attempt` as in `show_picture`."""
        state, view = self.controller.state, self.view
        if self._shown is not state:
            if view is not None:
                attempt(lambda: view.display.show_panels(state))
                self._panels_at = time.monotonic()
            # Set also after an error, which would otherwise recur endlessly.
            self._shown = self.controller.state

    def close(self) -> None:
        """Save unfinished edits, and stop prefetching frames.

        Raises:
            CartsError: the edits could not be saved.
        """
        try:
            self.controller.close()
        finally:
            self.session.close()


_PANELS_WAIT = 0.25
"""Time between updates of the widgets while a picture is not acknowledged [s]. A slow page handles messages in order,
so more updates would delay its pictures."""
_MAX_CLOSED_TABS = 8
"""Maximum number of tabs that are kept after their pages were closed."""


class Tabs:
    """All tabs and their shared state; used on the worker's thread only, except for `of_client` and `first`.

    Attributes:
        job_runner: long-running work.
        people: users of the project.
        first: the initial tab, which is assigned to the first page.
    """

    def __init__(
        self,
        sequence: Sequence,
        storage: Storage,
        renderer: OverlayRenderer,
        optimizers: OptimizerFactory,
        deliver: Deliver,
        queue: IntentQueue[Tab],
        folders: Iterable[Path] = (),
    ) -> None:
        self._folders = tuple(folders)
        self._sequence, self._storage, self._renderer = sequence, storage, renderer
        self._optimizers, self._deliver, self._queue = optimizers, deliver, queue
        self.people = People(storage.project)
        session = Session(sequence, self.people, Person(0, present=False))
        self._session = session
        self.job_runner = JobRunner(self._initial_state(session), session, renderer, optimizers)
        self._tabs: tuple[Tab, ...] = ()
        self.first = self._add()

    def __iter__(self) -> Iterator[Tab]:
        return iter(self._tabs)

    def of_client(self, client_id: int) -> Tab | None:
        """The tab whose page has this client id, if any. Thread-safe."""
        return next((tab for tab in self._tabs if tab.client_id == client_id), None)

    def attach(self, client: viser.ClientHandle, hello: Hello) -> None:
        """Assign a tab to a page: its earlier tab, an unused tab, or a new tab.

        Raises:
            CartsError: a discarded tab could not be saved.
        """
        known = next((tab for tab in self._tabs if tab.key == hello.tab), None)
        tab = known or next((tab for tab in self._tabs if tab.key is None), None) or self._add()
        tab.key = hello.tab
        if hello.name:
            tab.controller.handle(intents.SetName(hello.name))
        if known is None:
            self._handle_all(tab, restored_choices(hello.settings, tab.controller.state))
        self._show_address(tab, hello)
        tab.attach(client, self._renderer, self._storage, hello)
        self._forget_oldest()

    def detach(self, client_id: int) -> None:
        """Detach a closed page."""
        tab = self.of_client(client_id)
        if tab is not None:
            tab.detach()
            tab.controller.handle(intents.Play(False))
            # The most recently closed tabs are kept longest.
            self._tabs = (*(other for other in self._tabs if other is not tab), tab)

    def forget_images(self) -> None:
        """Drop cached images of the recording and values computed from them."""
        for session in (self._session, *(tab.session for tab in self._tabs)):
            session.sequence.forget_images()
            self._optimizers.forget_images(session.sequence)

    def close(self) -> None:
        """Save all unfinished work.

        Raises:
            CartsError: some work could not be saved; all other work is saved.
            Exception: likewise, after an unexpected error, which is logged.
        """
        problems: list[Exception] = []
        for close in (self.job_runner.close, self._session.close, *(tab.close for tab in self._tabs)):
            try:
                close()
            except Exception as error:
                if not isinstance(error, CartsError):
                    _log.error("Unexpected error while unfinished work was saved", exc_info=error)
                problems.append(error)
        if problems:
            raise problems[0]

    def _show_address(self, tab: Tab, hello: Hello) -> None:
        """Show the frame, camera and domain of the page's address, if they exist."""
        if tab.controller.state.streaming:
            return
        sequence = self._sequence
        found: list[intents.Intent] = []
        if hello.domain in sequence.domains:
            found.append(intents.ShowDomain(hello.domain))
        if hello.camera in [camera.name for camera in sequence.scene.cameras]:
            found.append(intents.ShowCamera(hello.camera))
        if hello.frame is not None and hello.frame != tab.controller.state.index:
            found.append(intents.ShowFrame(hello.frame))
        self._handle_all(tab, found)

    @staticmethod
    def _handle_all(tab: Tab, requests: Iterable[intents.Intent]) -> None:
        for intent in requests:
            try:
                tab.controller.handle(intent)
            except CartsError as error:
                tab.controller.fail(error, stop=False)

    def _add(self) -> Tab:
        person = self.people.join()
        person.present = False
        session = Session(self._sequence, self.people, person, self._folders)
        controller = Controller(
            self._initial_state(session), session, self._renderer, self._optimizers, self.job_runner, self._deliver
        )
        tab = Tab(self._queue, session, person, controller)
        self._tabs = (*self._tabs, tab)
        return tab

    def _forget_oldest(self) -> None:
        gone = [tab for tab in self._tabs if tab.view is None and tab.key is not None]
        for tab in gone[: max(len(gone) - _MAX_CLOSED_TABS, 0)]:
            self._tabs = tuple(other for other in self._tabs if other is not tab)
            self.people.leave(tab.person)
            tab.close()

    def _initial_state(self, session: Session) -> ViewState:
        """Initial state of a tab."""
        sequence = session.sequence
        domain, camera = sequence.domains[0], sequence.scene.cameras[0].name
        frame = session.frame(0, domain, camera)
        return ViewState(
            index=0,
            frame=frame,
            domain=domain,
            camera=camera,
            pose=session.pose(frame),
            layer=Layer.MASK,
            opacity=0.5,
            settings=SurfaceSolver(),
            free=FreeParameters(),
            project=session.editor.view,
            can_undo=session.editor.can_undo,
            can_redo=session.editor.can_redo,
        )
