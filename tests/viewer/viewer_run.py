"""A run that is still going on as long as a test needs it."""

from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp

# The default solver converges on a tiny frame within seconds, whatever the other settings say.
_SETTINGS = {"solver": "acs", "iterations": 10_000, "working_width": 96}


def run_without_end(app: ViewerApp) -> None:
    """Have the next runs go on until they are stopped, with short iterations."""
    for name, value in _SETTINGS.items():
        app.queue.put(intents.SetSetting(name, value))
    state = app.wait_until_shown()
    assert state.solver == "acs" and state.settings_error is None, state.settings_error
