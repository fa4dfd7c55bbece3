"""Import of a recording of any known format as a sequence file."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ...errors import SequenceError
from ...settings.interchange import ImportOptions
from ...wording import closest, shown
from ..sources import SOURCES, Source
from .delays import compensated, is_timed
from .found import FoundRecording, Import, Part, PartError
from .writing import completed, write_sequence

_UNFINISHED = {
    ".bag.active": "the recorder did not close it. Rename a copy to .bag, run `rosbag reindex` on it, and import it.",
    ".mcap.zstd": "the whole file is compressed. Decompress it with `zstd -d`, and import the result.",
    ".db3.zstd": "it is one file of a bag. Give the folder with its metadata.yaml.",
}
"""Suffix of incomplete, compressed or partial bags -> remedy."""


def known_kinds() -> str:
    """List of supported formats in order of detection, one per line."""
    return "\n".join(f"  {source.name}: {source.label} ({source.looked_for})" for source in SOURCES)


def detect(path: Path, name: str | None = None) -> Source:
    """Detect the format of a recording."""
    kinds = known_kinds()
    if not path.exists():
        raise SequenceError(f"{path} is missing. Give the file or folder of a recording.")
    if name is not None:
        for source in SOURCES:
            if source.name == name:
                return source
        meant = closest(name, [source.name for source in SOURCES])
        raise SequenceError(f"the format {name!r} is unknown.{meant} Supported formats:\n{kinds}")
    for suffix, remedy in _UNFINISHED.items():
        if path.name.lower().endswith(suffix):
            raise SequenceError(f"{path} ends with {suffix}: {remedy}")
    for source in SOURCES:
        if source.detect(path):
            return source
    raise SequenceError(f"{path} is not a recording of a supported format. Tried, in this order:\n{kinds}")


def find(path: Path, options: ImportOptions | None = None) -> FoundRecording:
    """Read a recording and complete it with defaults; nothing is written. `CartsError` for unusable content."""
    path = path.absolute()
    options = _with_places(path, options or ImportOptions())
    source = detect(path, options.source)
    parts: dict[str, Part] = {"images": "images", "kinematics": "kinematics"}
    for name in ("images", "kinematics", "columns", "clock", "time_offset", "frame_rate", "row_rate"):
        if name not in source.uses and _is_given(options, name):
            what = name.replace("_", " ")
            problem = (
                f"the option {what} is not used for {source.label}, since this format determines or lacks this "
                "information."
            )
            remedy = f"Leave out {_option(name)}, or choose another format: --source."
            raise PartError(parts.get(name, "columns"), problem, remedy)
    try:
        recording = replace(source.read(path, Import(options)), path=path)
        _check_names(recording, options)
        arms = (replace(arm, time_offset=options.arm_time_offset.get(arm.name, 0.0)) for arm in recording.arms)
        recording = replace(recording, arms=tuple(arms))
        return completed(recording, options)
    except OSError as error:
        named = "" if error.filename is None else f" {shown(str(error.filename))}"
        raise SequenceError(
            f"{path} cannot be read:{named} {error.strerror or error}. Check that the copy is complete and readable."
        ) from error


def _with_places(path: Path, options: ImportOptions) -> ImportOptions:
    """Resolve relative paths in the options against the working directory, else against the recording."""
    folder = path if path.is_dir() else path.parent

    def placed(given: Path | str) -> str:
        found = [place for place in (Path(given), folder / given) if os.path.exists(place)]
        return str(found[0].absolute() if found else given)

    return replace(
        options,
        images={name: placed(given) for name, given in options.images.items()},
        calibration={name: Path(placed(given)) for name, given in options.calibration.items()},
        kinematics=None if options.kinematics is None else Path(placed(options.kinematics)),
        robot={name: placed(given) for name, given in options.robot.items()},
        base={name: Path(placed(given)) for name, given in options.base.items()},
    )


def _check_names(recording: FoundRecording, options: ImportOptions) -> None:
    """Check that all names in the options are names of arms and cameras of the recording."""
    arms = [arm.name for arm in recording.arms]
    cameras = [camera.name for camera in recording.cameras]
    for what, given, known in (
        ("arms", options.arms, arms),
        ("robot", options.robot, arms or ["PSM1"]),
        ("base", options.base, arms),
        ("arm_time_offset", options.arm_time_offset, arms),
        ("calibration", options.calibration, cameras),
        ("calibration_size", options.calibration_size, cameras),
    ):
        if unknown := [name for name in given if name not in known]:
            kind = "camera" if known is cameras else "arm"
            problem = f"{recording.name} has no {kind} {unknown[0]!r}. It has: {', '.join(known) or 'none'}."
            raise PartError("recording", problem, f"Correct {_option(what)}.")
    if not arms and (
        unused := [name for name in ("flip", "units", "angle_unit", "length_unit") if _is_given(options, name)]
    ):
        problem = f"the option {unused[0].replace('_', ' ')} is not used, since {recording.name} has no kinematics."
        raise PartError("recording", problem, f"Leave out {_option(unused[0])}.")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _is_given(options: ImportOptions, name: str) -> bool:
    return getattr(options, name) not in (None, (), {})


def import_recording(
    path: Path,
    folder: Path,
    options: ImportOptions | None = None,
    *,
    overwrite: bool = False,
    estimate_delays: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Path, FoundRecording]:
    """Write the sequence file and tables of a recording into a folder, without copying images; returns the file and the
    content. `CartsError` for an unknown format or damaged or contradictory content, in which case nothing is written.

    Time offsets that are not given are estimated from the motion in the images if `estimate_delays`; `progress` is
    called with the number of frames read for this, and the total.
    """
    options = options or ImportOptions()
    recording = find(path, options)
    if estimate_delays and options.time_offset is None and not options.arm_time_offset:
        uses = detect(path, options.source).uses
        if "time_offset" in uses and (is_timed(recording) or "frame_rate" in uses):
            recording = compensated(recording, options, lambda changed: find(path, changed), progress)
    return write_sequence(recording, folder, overwrite=overwrite), recording
