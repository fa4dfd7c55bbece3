"""The delay between images and kinematics in the form: estimated when somebody asks, taken when somebody agrees."""

from carts_core.recording import TimeOffsetEstimate, estimate_time_offset
from carts_core.recording.importing.found import FoundRecording
from carts_viewer.recording.plots import opened
from carts_viewer.transport.document import button, escaped


def estimated_delay(recording: FoundRecording) -> TimeOffsetEstimate:
    """What the motion in images and table says.

    Raises:
        CartsError: what was found does not make a sequence whose rows have times.
    """
    sequence, folder = opened(recording)
    with folder:
        return estimate_time_offset(sequence)


def delay_note(found: TimeOffsetEstimate | None) -> str:
    """The button that asks, or what was found and, where it is another offset, the button that takes it."""
    if found is None:
        return f"<div class='bar'>{button('estimate-delay', 'Estimate from the motion', kind='quiet')}</div>"
    if found.proposed is None:
        kind = "" if found.problem else " good"
        return f'<div class="note{kind}">{escaped(found.sentence())}</div>'
    share, now = 100 * found.explained, max(100 * found.explained_now, 0.0)
    text = (
        f"The motion gives {found.seconds:.3f} s ± {found.deviation:.3f} s; now it is {found.present:.3f} s. "
        f"It explains {share:.0f} % of the motion in the images instead of {now:.0f} %."
    )
    take = button("accept-delay", f"Use {found.proposed:.3f} s", kind="main")
    return f'<div class="note guessed"><b>Proposed.</b> {escaped(text)}<div class="bar">{take}</div></div>'
