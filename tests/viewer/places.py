"""What the viewer keeps of a tab without a browser."""

from typing import Any

from carts_viewer.app import ViewerApp
from carts_viewer.tabs import Tab, View
from tools.raw_tab import RawTab


def place_of(app: ViewerApp, raw: RawTab) -> Tab:
    """The place of this tab."""
    return next(tab for tab in app.tabs if tab.key == raw.key)


def view_of(app: ViewerApp, raw: RawTab) -> View:
    """What this tab's page is made of."""
    view = place_of(app, raw).view
    assert view is not None
    return view


def widget(app: ViewerApp, raw: RawTab, label: str) -> Any:
    """This tab's widget with this label."""
    return view_of(app, raw).page.find(label)
