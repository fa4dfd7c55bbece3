"""All tabs of a viewer: which place belongs to which page, and what every place is made of."""

import json
import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import viser

from carts_core.errors import CartsError
from carts_core.optimization import Backgrounds, FreeParameters, SurfaceSolver
from carts_core.recording import Sequence
from carts_viewer import intents
from carts_viewer.background import Background
from carts_viewer.controller import Controller
from carts_viewer.handlers.exporting import Deliver
from carts_viewer.intent_queue import IntentQueue
from carts_viewer.layers import Layer
from carts_viewer.overlay import OverlayRenderer
from carts_viewer.page_state import chosen
from carts_viewer.people import LONGEST_NAME, People, Person
from carts_viewer.running import OptimizerFactory
from carts_viewer.session import Session
from carts_viewer.state import ViewState
from carts_viewer.storage import Storage
from carts_viewer.tab import Tab

_log = logging.getLogger(__name__)
_KEPT = 8
"""Places of pages that are gone; who reloads or comes back finds theirs."""
_LONGEST_KEY = 64
"""Characters."""


@dataclass(frozen=True)
class Hello:
    """What a page says when it comes: who it is, and where it wants to be."""

    key: str
    name: str = ""
    light: bool = False
    frame: int | None = None
    """From 0."""
    camera: str | None = None
    domain: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    """What was chosen there earlier, see `page_state.remembered`; anything, if the page is none of ours."""


def read_hello(text: str) -> Hello | None:
    """What a page has said, as far as it makes sense; None if it does not say who it is."""
    try:
        said: dict[str, Any] = json.loads(text)
        key, name = str(said["tab"])[:_LONGEST_KEY], " ".join(str(said.get("name") or "").split())[:LONGEST_NAME]
        frame = None if said.get("frame") is None else int(said["frame"])
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        _log.info("Refused: a tab does not say who it is: %.100s", text)
        return None
    camera, domain = (None if said.get(what) is None else str(said[what]) for what in ("camera", "domain"))
    settings = said.get("settings")
    return Hello(
        key, name, said.get("theme") == "light", frame, camera, domain, settings if isinstance(settings, dict) else {}
    )


class Tabs:
    """Everybody's places, and what they share. Used on the worker's thread, but for `of_client` and `first`.

    Attributes:
        background: what takes long.
        people: who works on the project.
        first: the place that is there from the beginning; the first page takes it.
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
        """
        Args:
            sequence: The recording.
            storage: Its project.
            renderer: Renders poses.
            optimizers: Makes optimizers.
            deliver: Sends a file to a page.
            queue: Where intents wait for the worker.
            folders: What files may be brought in from, besides the sequence's own.
        """
        self._folders = tuple(folders)
        self._sequence, self._storage, self._renderer = sequence, storage, renderer
        self._optimizers, self._deliver, self._queue = optimizers, deliver, queue
        self.people = People(storage.project)
        session = Session(sequence, self.people, Person(0, present=False))
        self._session = session
        self.background = Background(self._begin(session), session, renderer, optimizers, deliver)
        self._tabs: tuple[Tab, ...] = ()
        self.first = self._add()

    def __iter__(self) -> Iterator[Tab]:
        return iter(self._tabs)

    def of_client(self, client_id: int) -> Tab | None:
        """The place that this connection shows; any thread may ask."""
        return next((tab for tab in self._tabs if tab.client_id == client_id), None)

    def attach(self, client: viser.ClientHandle, hello: Hello) -> None:
        """Show a page its place: the one it had, one that nobody has had yet, or a new one.

        Raises:
            CartsError: a place could not be given up.
        """
        known = next((tab for tab in self._tabs if tab.key == hello.key), None)
        tab = known or next((tab for tab in self._tabs if tab.key is None), None) or self._add()
        tab.key = hello.key
        if hello.name:
            tab.controller.handle(intents.SetName(hello.name))
        if known is None:
            self._do(tab, chosen(hello.settings, tab.controller.state))
        self._go(tab, hello)
        tab.attach(client, self._renderer, self._storage, light=hello.light)
        self._forget_oldest()

    def detach(self, client_id: int) -> None:
        """A page is gone."""
        tab = self.of_client(client_id)
        if tab is not None:
            tab.detach()
            tab.controller.handle(intents.Play(False))
            # The places of those who left last are kept longest.
            self._tabs = (*(other for other in self._tabs if other is not tab), tab)

    def forget_images(self) -> None:
        """Drop the images of the recording that are kept for the next time, and what was computed from them."""
        self._sequence.forget_images()
        for session in (self._session, *(tab.session for tab in self._tabs)):
            Backgrounds.forget(session.sequence)

    def close(self) -> None:
        """Save everything that is under way.

        Raises:
            CartsError: something could not be saved; the rest is.
        """
        problems = []
        for close in (self.background.close, self._session.close, *(tab.close for tab in self._tabs)):
            try:
                close()
            except CartsError as error:
                problems.append(error)
        if problems:
            raise problems[0]

    def _go(self, tab: Tab, hello: Hello) -> None:
        """Go where the page wants to be, as far as there is such a place."""
        if tab.controller.state.streaming:
            return
        sequence = self._sequence
        wishes: list[intents.Intent] = []
        if hello.domain in sequence.domains:
            wishes.append(intents.ShowDomain(hello.domain))
        if hello.camera in [camera.name for camera in sequence.scene.cameras]:
            wishes.append(intents.ShowCamera(hello.camera))
        if hello.frame is not None and hello.frame != tab.controller.state.index:
            wishes.append(intents.ShowFrame(hello.frame))
        self._do(tab, wishes)

    @staticmethod
    def _do(tab: Tab, wishes: Iterable[intents.Intent]) -> None:
        for wish in wishes:
            try:
                tab.controller.handle(wish)
            except CartsError as error:
                tab.controller.fail(error, stop=False)

    def _add(self) -> Tab:
        person = self.people.join()
        person.present = False
        session = Session(self._sequence, self.people, person, self._folders)
        controller = Controller(
            self._begin(session), session, self._renderer, self._optimizers, self.background, self._deliver
        )
        tab = Tab(self._queue, session, person, controller)
        self._tabs = (*self._tabs, tab)
        return tab

    def _forget_oldest(self) -> None:
        gone = [tab for tab in self._tabs if tab.view is None and tab.key is not None]
        for tab in gone[: max(len(gone) - _KEPT, 0)]:
            self._tabs = tuple(other for other in self._tabs if other is not tab)
            self.people.leave(tab.person)
            tab.close()

    def _begin(self, session: Session) -> ViewState:
        """What somebody new sees."""
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
