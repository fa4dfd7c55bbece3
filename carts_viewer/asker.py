"""Who has asked for a job."""

from dataclasses import dataclass

from carts_viewer.context import Context
from carts_viewer.people import Person
from carts_viewer.state import ViewState

_CHOICES = "index frame domain camera pose settings free solver observed every_camera direction filter".split()
"""What of a tab's state a job depends on."""


@dataclass(frozen=True, eq=False)
class Asker:
    """Who has asked for a job, and what they had chosen then."""

    person: Person
    state: ViewState

    def choose(self, context: Context) -> None:
        """Have a job do what it does with these choices, in this person's name."""
        context.session.editor.person = self.person
        context.change(**{name: getattr(self.state, name) for name in _CHOICES})
