"""Generic recordings: folders of images or videos, a table of kinematics, and calibration files, found by name."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import SequenceError
from ...model.psm_kinematics import JOINT_NAMES
from ...settings.interchange import NO_TABLE, ImportOptions
from ..image_sources import VIDEO_SUFFIXES
from ..importing.cameras import (
    Images,
    cameras_of,
    files_with,
    find_images,
    image_files,
    side_of,
    subfolders,
    united_ids,
)
from ..importing.columns import ColumnMeanings, arm_in, arm_log, guess_columns, samples
from ..importing.foreign_tables import TABLE_SUFFIXES, ForeignTable, read_foreign_table
from ..importing.found import FoundArm, FoundRecording, Import, PartError, Source
from ..importing.logs import arm_from_log
from ..importing.row_matching import FrameTimes, RowMatch, by_rows, frame_times, match_rows, row_seconds

_DEPTH = 2
_NOT_IMAGES = ("mask", "label", "segment", "ground_truth", "annot", "depth")
_CALIBRATION_SUFFIXES = (".yaml", ".yml", ".mat", ".ini", ".json", ".xml")
_CALIBRATION_WORDS = re.compile(
    rb"camera_matrix|cameraMatrix|intrinsic|projection_parameters|[\"<]K[\">]|^K:|[\"<]?\bM1[\">:]|git-lfs",
    re.MULTILINE,
)


def _folders(path: Path) -> list[Path]:
    """A folder and its visible subfolders, down to two levels."""
    found, level = [path], [path]
    for _ in range(_DEPTH):
        level = sorted(each for folder in level for each in subfolders(folder))[:200]
        found += level
    return found


def _files(path: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return [file for folder in _folders(path) for file in files_with(folder, suffixes)]


def tables_of(path: Path) -> list[Path]:
    """Tables in a folder and its visible subfolders, down to two levels."""
    return _files(path, TABLE_SUFFIXES)


def _image_places(path: Path) -> list[Path]:
    """Videos and folders of images, excluding masks and similar folders."""
    places = [folder for folder in _folders(path) if image_files(folder)] + _files(path, VIDEO_SUFFIXES)
    return [
        place
        for place in places
        if not any(word in part.lower() for part in place.relative_to(path).parts for word in _NOT_IMAGES)
    ]


def _images(path: Path, options: ImportOptions) -> dict[str, Images]:
    if options.images:
        return {name: find_images(path / place) for name, place in options.images.items()}
    places = _image_places(path)
    sides: dict[str, list[Path]] = {}
    for place in places:
        side = side_of("/".join(place.relative_to(path).parts)) or ("camera" if len(places) == 1 else "")
        sides.setdefault(side, []).append(place)
    named = {side: found for side, found in sides.items() if side}
    if not named or any(len(found) > 1 for found in named.values()):
        shown = ", ".join(str(place.relative_to(path)) for place in places)
        raise PartError(
            "images",
            f"{path} has several folders or videos whose names do not identify the cameras: {shown}.",
            "Choose: --images left PLACE right PLACE.",
        )
    return {side: find_images(found[0]) for side, found in sorted(named.items())}


def _calibrations(path: Path, cameras: list[str], job: Import) -> dict[str, Path]:
    """Calibration files for cameras without a given calibration: the file of the same side, or the only file."""
    files = [file for file in _files(path, _CALIBRATION_SUFFIXES) if _looks_like_calibration(file)]
    found: dict[str, Path] = {}
    for camera in cameras:
        own = [file for file in files if side_of(file.stem) == side_of(camera)]
        shared = [file for file in files if side_of(file.stem) is None]
        if len(own) == 1 and side_of(camera) is not None:
            found[camera] = own[0]
        elif len(shared) == 1 or (len(files) == 1 and len(cameras) == 1):
            found[camera] = (shared or files)[0]
    found = {camera: file for camera, file in found.items() if camera not in job.options.calibration}
    for camera, file in found.items():
        job.guessed(f"the calibration is {file.name}.", camera, f"--calibration {camera} FILE")
    return found


def _looks_like_calibration(file: Path) -> bool:
    if file.suffix.lower() in (".mat", ".ini"):
        return True
    try:
        with file.open("rb") as stream:
            head = stream.read(20_000)
    except OSError:
        return False
    return _CALIBRATION_WORDS.search(head) is not None


def kinematics_table(path: Path, options: ImportOptions) -> ForeignTable | None:
    """Find the kinematics table: the given table, a table with an arm, or else a table with at least six numeric
    columns."""
    if options.kinematics == NO_TABLE:
        return None
    if options.kinematics is not None:
        return read_foreign_table(options.kinematics if options.kinematics.is_file() else path / options.kinematics)
    tables = [table for table in map(_readable, tables_of(path)) if table is not None]
    known = (table for table in tables if guess_columns(table, replace(options, columns={})).arms)
    return next(known, None) or next(filter(_is_wide, tables), None)


def _readable(file: Path) -> ForeignTable | None:
    try:
        return read_foreign_table(file)
    except SequenceError:
        return None


def _is_text(file: Path) -> bool:
    """Whether a file is certainly meant as a table of named columns."""
    return file.suffix.lower() in (".csv", ".tsv", ".parquet")


def _is_wide(table: ForeignTable) -> bool:
    """Whether a table with unknown columns may contain joints."""
    return len(table) > 1 and sum(values.dtype.kind in "iuf" for values in table.columns.values()) >= len(JOINT_NAMES)


def _kinematics(path: Path, job: Import) -> list[tuple[ForeignTable, ColumnMeanings]]:
    """Tables of different arms, with the meanings of their columns."""
    options = job.options
    if options.kinematics == NO_TABLE:
        return []
    files = tables_of(path)
    tables = [table for table in map(_readable, files) if table is not None]
    without, chosen = replace(options, columns={}), set(options.columns.values())
    if options.kinematics is not None or (chosen and not any(chosen <= table.columns.keys() for table in tables)):
        table = kinematics_table(path, options)
        found = [] if table is None else [(table, guess_columns(table, options))]
    else:
        # Chosen columns apply to the tables that have all of them.
        own = (options if chosen <= table.columns.keys() else without for table in tables)
        found = [(table, guess_columns(table, each)) for table, each in zip(tables, own, strict=True)]
        readable = {table.path for table in tables}
        unreadable = [file for file in files if file not in readable and _is_text(file)]
        if not any(meanings.arms for _, meanings in found):
            for file in unreadable:
                read_foreign_table(file)  # This raises its error.
            found = [(table, meanings) for table, meanings in found if _is_wide(table)][:1]
        for file in unreadable:
            job.warning(f"{file} cannot be read, and is not used. To see why: --kinematics {file.name}.")
    known: dict[str, ForeignTable] = {}
    chosen = []
    for table, meanings in found:
        if not meanings.arms:
            if options.kinematics is not None or len(found) == 1:
                raise PartError(
                    "columns",
                    f"{table.path} has {len(table)} rows with the columns {samples(table)}, among which neither six "
                    "joints nor a tip pose are recognized.",
                    "Give them: --columns yaw COLUMN pitch COLUMN insertion COLUMN roll COLUMN wrist_pitch COLUMN "
                    "wrist_yaw COLUMN. If the robot is not a PSM, give it: --robot NAME FILE.urdf. To leave the table "
                    "out: --kinematics none.",
                )
            continue
        named = meanings
        if (name := arm_in(table.path.stem)) and "" in meanings.arms:
            named = replace(meanings, arms={arm or name: columns for arm, columns in meanings.arms.items()})
        if taken := [arm for arm in named.arms if arm in known]:
            text = f"{table.path} also has joints or poses of {taken[0] or 'an arm'}, and is not used"
            remedy = "To use it: --kinematics FILE."
            job.warning(f"{text}. Name files of other arms after the arms, such as psm2.csv.", remedy=remedy)
            continue
        known |= dict.fromkeys(named.arms, table)
        chosen.append((table, named))
    return chosen


def _frames(path: Path, images: Images, ids: tuple[str, ...], kinematics: list[Path], job: Import) -> FrameTimes:
    """Frames and their times, from a table with as many rows as images, else as in `frame_times`."""
    for file in tables_of(path):
        table = None if file in kinematics else _readable(file)
        if table is None:
            continue
        meanings = guess_columns(table, replace(job.options, columns={}, kinematics=None))
        if meanings.time is not None and not meanings.arms and len(table) == len(ids):
            job.guessed(f"times of the images are in {file.name}.")
            times = row_seconds(table, meanings.time, None, job)
            found = frame_times(images, ids, Import(replace(job.options, frame_rate=None)))
            if job.options.frame_rate is not None:
                job.warning(f"the given frame rate is not used, since the images have times in {file.name}.")
            return replace(found, times=times, source=file.name, nominal=False)
    return frame_times(images, ids, job)


def _listing(frames: list[str]) -> str:
    return ", ".join(frames[:5]) + (" ..." if len(frames) > 5 else "")


def _read(path: Path, job: Import) -> FoundRecording:
    images = _images(path, job.options)
    cameras = cameras_of(images, job, _calibrations(path, list(images), job))
    ids = united_ids(images, path)
    known = set(ids)
    for place, (name, each) in enumerate(images.items()):
        own = set(each.ids)
        if lacking := [frame for frame in ids if frame not in own]:
            cameras = (*cameras[:place], replace(cameras[place], sparse_images=True), *cameras[place + 1 :])
            text = f"{len(lacking)} of {len(ids)} frames have no image of this camera; they are kept for the others"
            job.warning(f"{text}: {_listing(lacking)}.", name)
        if left_out := [frame for frame in each.ids if frame not in known]:
            text = f"{len(left_out)} of {len(each.ids)} images left out, since another camera has no image of the frame"
            remedy = f"To keep them, import {name} alone: --images {name} {each.path.name}."
            job.warning(f"{text}: {_listing(left_out)}.", name, remedy=remedy)
    found = _kinematics(path, job)
    if not found:
        _note_missing_kinematics(path, job)
        return job.recording("images without kinematics", path.name, cameras, (), ids, None)
    frames = _frames(path, next(iter(images.values())), ids, [table.path for table, _ in found], job)
    arms, match = _matched(found, frames, job)
    times = match.frame_times
    if match.by_image:
        arms, ids, kept = by_rows(arms, ids, job, times)
        cameras = tuple(camera if camera.pattern else replace(camera, numbers=kept) for camera in cameras)
        times = arms[0].times
    offset = match.time_offset if job.options.time_offset is None else job.options.time_offset
    kind = "a folder with images and a table"
    return job.recording(kind, path.name, cameras, arms, ids, times, time_offset=float(offset))


def _note_missing_kinematics(path: Path, job: Import) -> None:
    """Report why no kinematics were found, with the columns of the tables that were considered."""
    if job.options.kinematics == NO_TABLE:
        job.found("kinematics are left out, as requested.")
        return
    tables = [table for table in map(_readable, tables_of(path)) if table is not None and len(table.columns) > 1]
    if not tables:
        job.missing(f"no table of joints or poses in {path}.", remedy="Give one: --kinematics FILE.")
        return
    seen = "; ".join(f"{table.path.name} has {', '.join([*table.columns][:12])}" for table in tables[:3])
    text = f"no table in {path} has six joints or a tip pose (x, y, z, qx, qy, qz, qw): {seen}."
    job.missing(text, remedy="Give another one: --kinematics FILE.")


def _matched(
    found: list[tuple[ForeignTable, ColumnMeanings]], frames: FrameTimes, job: Import
) -> tuple[tuple[FoundArm, ...], RowMatch]:
    """Arms of all tables, and the common matching of rows and images."""
    arms: list[FoundArm] = []
    matches: list[RowMatch] = []
    for table, meanings in found:
        text = f"kinematics: {table.path}, {len(table)} rows."
        job.found(text, option="--kinematics", given=job.options.kinematics is not None)
        for remark in table.remarks:
            job.found(f"{table.path.name}: {remark}.")
        try:
            match = match_rows(frames, table, meanings, job)
        except PartError as error:
            others = [f"{other.path.name}, {len(other)} rows" for other, _ in found if other is not table]
            also = f" Other tables: {'; '.join(others)}." if others else ""
            raise PartError(error.part, f"{error.problem}{also}", error.remedy) from error
        arms += _arms(table, meanings, match.rows, job)
        matches.append(match)
    first = matches[0]
    if any((each.by_image, each.time_offset) != (first.by_image, first.time_offset) for each in matches):
        names = ", ".join(table.path.name for table, _ in found)
        raise PartError(
            "columns",
            f"the rows of {names} are matched with the images differently: by frame or by time, or with different time "
            "offsets. Give all tables times of the same clock, or choose one table.",
            "Use --time-offset or --kinematics FILE.",
        )
    return tuple(arms), first


def _arms(table: ForeignTable, meanings: ColumnMeanings, rows: np.ndarray, job: Import) -> tuple[FoundArm, ...]:
    """Arms with the time or image index of each row; rows without an image are dropped."""
    arms = []
    for recorded, found in meanings.arms.items():
        known = job.arm_name(recorded)
        if known is None and len(meanings.arms) > 1:
            continue
        name = known or recorded or next(iter(job.options.arms), "PSM1")
        arms.append(arm_from_log(arm_log(table, name, found, rows, job, meanings.stated), job))
    return tuple(arms)


SOURCE = Source(
    "folder",
    "images or videos with a table of kinematics",
    "a folder with images or videos and a .csv, .parquet, .npy or .npz file, at most two levels deep",
    lambda path: path.is_dir() and bool(_image_places(path)) and bool(tables_of(path)),
    ("images", "kinematics", "columns", "clock", "time_offset", "frame_rate", "row_rate"),
    _read,
)
