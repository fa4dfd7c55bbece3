"""Events that a tab reports in addition to intents; their types are checked, but their values are not trusted."""

from typing import Annotated, Any, dataclass_transform

import msgspec

_Text = Annotated[str, msgspec.Meta(max_length=4096)]
_Key = Annotated[str, msgspec.Meta(max_length=64)]
_Point = tuple[float, float]
"""u, v: shares of an image's width and height, from its upper left corner."""


@dataclass_transform(frozen_default=True)
class Event(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="type", tag=True):
    """Base class of the events of a tab."""


class Hello(Event):
    """Request of a page for its tab: key of the tab, name of the user, and frame, camera and domain to show."""

    tab: _Key
    name: _Text = ""
    light: bool = False
    frame: int | None = None
    """Index of the frame."""
    camera: _Text | None = None
    domain: _Text | None = None
    settings: dict[str, Any] = {}
    """Choices that the browser has stored, see `stored_choices` in `panels/script_state.py`."""
    scene: bool = False
    """Whether the page shows the 3D view."""


class Theme(Event):
    """The light or the dark theme was chosen."""

    light: bool


class SceneShown(Event):
    """The 3D view was opened or closed."""

    on: bool


class Trace(Event):
    """A curve of the timeline was requested."""

    name: _Text
    first: int
    last: int
    """Index after the last frame."""
    columns: int


class Pressed(Event):
    """The key of an action, or a button of a script, was pressed."""

    key: _Key


class Pointed(Event):
    """A keypoint was placed in the image of the camera with this index."""

    camera: int
    at: _Point


class Dragged(Event):
    """A link was dragged."""

    gesture: float
    """Identifier of the gesture; constant while the pointer is down."""
    camera: int
    start: _Point
    end: _Point


class Chosen(Event):
    """A value was chosen in the document over the page."""

    name: _Text
    value: _Text
