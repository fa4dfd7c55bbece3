"""Time offsets of an import, estimated from the motion in the images where they are not given."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from ...errors import CartsError
from ...settings.interchange import ImportOptions
from ..sequence import Sequence
from ..time_delay import TimeOffsetEstimate, estimate_time_offsets, offsets_to_write
from .found import FoundRecording, Note
from .writing import write_sequence

ASSUMED_RATE = 30.0
"""Frame rate at which a delay is sought if neither rows nor images have times [1/s]."""


def open_recording(recording: FoundRecording) -> tuple[Sequence, TemporaryDirectory[str]]:
    """The recording as a sequence, with the temporary folder of its tables; `CartsError` if it is invalid."""
    folder = TemporaryDirectory(prefix="carts-import-")
    try:
        return Sequence.open(write_sequence(recording, Path(folder.name) / "sequence")), folder
    except BaseException:
        folder.cleanup()
        raise


def is_timed(recording: FoundRecording) -> bool:
    """Whether rows of an arm are matched with images by time."""
    return any(arm.times is not None for arm in recording.arms)


def estimated_delays(
    recording: FoundRecording, progress: Callable[[int, int], None] | None = None
) -> tuple[tuple[TimeOffsetEstimate, ...], dict[str, float]]:
    """Estimates of `estimate_time_offsets`, and the proposed offsets of `offsets_to_write`.

    Raises:
        CartsError: rows have no times, or an image cannot be read.
    """
    sequence, folder = open_recording(recording)
    with folder:
        found = estimate_time_offsets(sequence, progress=progress)
        return found, offsets_to_write(found, sequence)


def with_times(
    recording: FoundRecording, options: ImportOptions, again: Callable[[ImportOptions], FoundRecording]
) -> tuple[FoundRecording, ImportOptions]:
    """The recording and its options, with an assumed frame rate if neither rows nor images have times.

    Args:
        again: function that reads the recording with other options.
    """
    if is_timed(recording) or options.frame_rate is not None:
        return recording, options
    assumed = replace(options, frame_rate=ASSUMED_RATE)
    return again(assumed), assumed


def with_delays(options: ImportOptions, offsets: dict[str, float]) -> ImportOptions:
    """Options with the offsets of `offsets_to_write`."""
    arms = {arm: seconds for arm, seconds in offsets.items() if arm and seconds}
    return replace(options, time_offset=offsets[""], arm_time_offset=arms)


def compensated(
    recording: FoundRecording,
    options: ImportOptions,
    again: Callable[[ImportOptions], FoundRecording],
    progress: Callable[[int, int], None] | None = None,
) -> FoundRecording:
    """Recording with estimated time offsets, where the motion determines them, and with notes on them; `again` as in
    `with_times`."""
    trial, timed = with_times(recording, options, again)
    if not is_timed(trial):
        return recording
    try:
        found, offsets = estimated_delays(trial, progress)
    except CartsError as error:
        note = Note("guessed", f"the time offset is not estimated: {error}")
        return replace(recording, notes=(*recording.notes, note))
    if offsets:
        recording = again(with_delays(timed, offsets))
    notes = [note for each in found if (note := _note(each)) is not None]
    if offsets and timed is not options:
        notes.append(Note("guessed", f"{ASSUMED_RATE:g} images/s are assumed.", option="--frame-rate"))
    return replace(recording, notes=(*recording.notes, *notes))


def _note(found: TimeOffsetEstimate) -> Note | None:
    """Note on an estimate; None if nothing was estimated, as without motion or with too few frames."""
    about, option = found.arm, f"--arm-time-offset {found.arm} SECONDS" if found.arm else "--time-offset"
    if found.problem is not None:
        if found.deviation == float("inf"):
            return None
        kind = "warning" if found.others else "guessed"
        return Note(kind, f"the delay between images and kinematics is unknown: {found.problem}", about, option)
    text = f"time offset {found.seconds:.3f} s ± {found.deviation:.3f} s, estimated from the motion"
    if found.proposed is None:
        return Note("found", f"{text}, agrees with {found.present:.3f} s.", about)
    return Note("guessed", f"{text}, of which it explains {100 * found.explained:.0f} %.", about, option)
