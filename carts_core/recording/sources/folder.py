"""Anything else: folders of images or videos, a table of kinematics, and calibration files, found by their names."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import SequenceError
from ...settings.importing import ImportOptions
from ..importing.assembling import by_rows, cameras_of
from ..importing.cameras import side_of
from ..importing.columns import ColumnMeanings, arm_log, guess_clock, guess_columns, seconds
from ..importing.foreign_tables import TABLE_SUFFIXES, ForeignTable, read_foreign_table
from ..importing.found import FoundArm, FoundCamera, FoundRecording, Note
from ..importing.logs import arm_from_log
from ..importing.media import Images, common_ids, find_images, image_files
from ..video import SUFFIXES
from .protocol import Source

_DEPTH = 2
_NOT_IMAGES = ("mask", "label", "segment", "ground_truth", "annot", "depth")
_CALIBRATION_SUFFIXES = (".yaml", ".yml", ".mat", ".ini", ".json")
_STAMPED_DIGITS = 13
"""Names of images with numbers this long are times."""


def _detect(path: Path) -> bool:
    return path.is_dir() and (bool(_image_places(path)) and bool(_tables(path)))


def _folders(path: Path) -> list[Path]:
    """The folder and what lies in it, two levels down, without hidden ones."""
    found, level = [path], [path]
    for _ in range(_DEPTH):
        try:
            level = sorted(each for folder in level for each in folder.iterdir() if each.is_dir())
        except OSError:
            return found
        level = [each for each in level if not each.name.startswith(".")][:200]
        found += level
    return found


def _files(path: Path, suffixes: tuple[str, ...]) -> list[Path]:
    found = []
    for folder in _folders(path):
        try:
            found += sorted(each for each in folder.iterdir() if each.suffix.lower() in suffixes and each.is_file())
        except OSError:
            continue
    return found


def _tables(path: Path) -> list[Path]:
    return _files(path, TABLE_SUFFIXES)


def _image_places(path: Path) -> list[Path]:
    """Folders of images, and videos; masks and the like are not among them."""
    places = [folder for folder in _folders(path) if image_files(folder)] + _files(path, SUFFIXES)
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
        raise SequenceError(
            f"{path} has several places with images, and it is not clear which camera is which: {shown}. "
            "Choose: --images left PLACE right PLACE."
        )
    return {side: find_images(found[0]) for side, found in sorted(named.items())}


def _calibrations(path: Path, cameras: list[str], notes: list[Note]) -> dict[str, Path]:
    """Calibration files by camera: of the same side, or the only one."""
    files = [file for file in _files(path, _CALIBRATION_SUFFIXES) if _looks_like_calibration(file)]
    found: dict[str, Path] = {}
    for camera in cameras:
        own = [file for file in files if side_of(file.stem) == side_of(camera)]
        shared = [file for file in files if side_of(file.stem) is None]
        if len(own) == 1 and side_of(camera) is not None:
            found[camera] = own[0]
        elif len(shared) == 1 or (len(files) == 1 and len(cameras) == 1):
            found[camera] = (shared or files)[0]
    for camera, file in found.items():
        notes.append(
            Note("guessed", f"{file.name} is the calibration of {camera} (change: --calibration {camera} FILE).")
        )
    return found


def _looks_like_calibration(file: Path) -> bool:
    if file.suffix.lower() in (".mat", ".ini"):
        return True
    try:
        with file.open("rb") as stream:
            head = stream.read(20_000)
    except OSError:
        return False
    return any(
        word in head for word in (b"camera_matrix", b"intrinsics", b'"K"', b"\nK:", b"M1:", b'"M1"', b"cameraMatrix")
    )


def _kinematics(path: Path, options: ImportOptions) -> tuple[ForeignTable, ColumnMeanings] | None:
    """The table that has an arm, and what its columns mean."""
    if options.kinematics is not None:
        table = read_foreign_table(options.kinematics if options.kinematics.is_file() else path / options.kinematics)
        meanings = guess_columns(table, options)
        if not meanings.arms:
            raise SequenceError(
                f"{table.path} has the columns {', '.join(table.columns)}, among which six joints or a tip's pose are "
                "not recognized. Name them: --columns yaw COLUMN pitch COLUMN insertion COLUMN roll COLUMN "
                "wrist_pitch COLUMN wrist_yaw COLUMN."
            )
        return table, meanings
    for file in _tables(path):
        try:
            table = read_foreign_table(file)
        except SequenceError:
            continue
        if (meanings := guess_columns(table, options)).arms:
            return table, meanings
    return None


def _image_times(
    path: Path, images: Images, kinematics: Path, options: ImportOptions, notes: list[Note]
) -> np.ndarray | None:
    """Times of the images [s]: of the video, in the names, in a table, or of a frame rate; None without any."""
    if images.times is not None:
        notes.append(Note("found", f"times of the images are those of {images.path.name}."))
        return images.times
    if all(len(frame) >= _STAMPED_DIGITS for frame in images.ids):
        numbers = np.array([int(frame) for frame in images.ids], np.float64)
        clock = guess_clock(numbers)
        notes.append(Note("guessed", f"names of the images are times in {clock}."))
        return numbers * {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[clock]
    for file in _tables(path):
        if file == kinematics:
            continue
        try:
            table = read_foreign_table(file)
        except SequenceError:
            continue
        time = guess_columns(table, replace(options, columns={})).time
        if time is not None and len(table) == len(images.ids):
            notes.append(Note("guessed", f"times of the images are in {file.name}."))
            return seconds(table, time, None, notes.append)
    if options.frame_rate is not None:
        return np.arange(len(images.ids)) / options.frame_rate
    return None


def _frame_positions(table: ForeignTable, meanings: ColumnMeanings, ids: tuple[str, ...]) -> np.ndarray | None:
    """Which frame each row of the table is, -1 for none; None where rows do not say and are not as many as frames."""
    if meanings.frame is not None:
        position = {int(frame): index for index, frame in enumerate(ids)}
        cells = table.columns[meanings.frame]
        digits = ["".join(filter(str.isdigit, Path(str(cell)).stem)) for cell in cells]
        rows = np.array([position.get(int(text), -1) if text else -1 for text in digits])
        if 2 * (rows >= 0).sum() >= min(len(ids), len(rows)):
            return rows
    return np.arange(len(ids)) if len(table) == len(ids) else None


def _read(path: Path, options: ImportOptions) -> FoundRecording:
    notes: list[Note] = []
    images = _images(path, options)
    cameras = cameras_of(images, options, notes, _calibrations(path, list(images), notes))
    ids = common_ids(list(images.values()))
    for name, each in images.items():
        if len(each.ids) != len(ids):
            notes.append(Note("warning", f"{name} has {len(each.ids)} images, of which {len(ids)} are of all cameras."))
    if not ids:
        raise SequenceError(f"{path}: no frame has an image of every camera. Number them alike, or import one camera.")
    first = next(iter(images.values()))
    found = _kinematics(path, options)
    if found is None:
        notes.append(Note("missing", f"no table with joints or poses in {path}. Name one: --kinematics FILE."))
        return FoundRecording("images without kinematics", path.name, cameras, (), ids, None, tuple(notes))
    table, meanings = found
    notes.append(Note("guessed", f"kinematics: {table.path}, {len(table)} rows (change: --kinematics)."))
    positions = _frame_positions(table, meanings, ids)
    if positions is not None and options.time_offset is None:
        arms = _arms(table, meanings, positions.astype(float), options, notes)
        arms, kept_ids, kept = by_rows(arms, ids, notes)
        notes.append(Note("guessed", "each row belongs to one image, by its number or its place."))
        numbered = tuple(camera if camera.pattern else replace(camera, numbers=kept) for camera in cameras)
        return FoundRecording(
            "a folder with images and a table", path.name, numbered, arms, kept_ids, None, tuple(notes)
        )
    return _by_time(path, first, cameras, ids, table, meanings, options, notes)


def _by_time(
    path: Path,
    first: Images,
    cameras: tuple[FoundCamera, ...],
    ids: tuple[str, ...],
    table: ForeignTable,
    meanings: ColumnMeanings,
    options: ImportOptions,
    notes: list[Note],
) -> FoundRecording:
    times = _image_times(path, first, table.path, options, notes)
    if times is None or meanings.time is None:
        raise SequenceError(
            f"{path} has {len(ids)} images and {table.path.name} has {len(table)} rows, and "
            f"{'the images have no times' if times is None else 'the table has no times'}. Make them as many, name the "
            "column of times (--columns time COLUMN), or give the images' rate (--frame-rate)."
        )
    log_times = seconds(table, meanings.time, options.clock, notes.append)
    arms = _arms(table, meanings, log_times, options, notes)
    offset = options.time_offset
    if offset is None:
        apart = times[0] > log_times[-1] or times[-1] < log_times[0]
        offset = float(log_times[0] - times[0]) if apart else 0.0
        text = "the clocks do not overlap: the first row is taken for the time of the first image" if apart else "0 s"
        notes.append(Note("guessed", f"time offset: {text} (change: --time-offset)."))
    return FoundRecording(
        "a folder with images and a table", path.name, cameras, arms, ids, times, tuple(notes), float(offset)
    )


def _arms(
    table: ForeignTable, meanings: ColumnMeanings, times: np.ndarray, options: ImportOptions, notes: list[Note]
) -> tuple[FoundArm, ...]:
    rename = {recorded: name for name, recorded in options.arms.items()}
    arms = []
    for recorded, found in meanings.arms.items():
        if options.arms and recorded not in rename and len(meanings.arms) > 1:
            continue
        name = rename.get(recorded) or recorded or next(iter(options.arms), "PSM1")
        known = times >= 0 if times.dtype.kind == "f" and len(times) == len(table) else np.ones(len(table), bool)
        log = arm_log(table, name, found, np.where(known, times, np.nan), options, notes.append)
        arms.append(arm_from_log(log, options, notes.append))
    return tuple(arms)


SOURCE = Source(
    "folder",
    "images or videos with a table of kinematics",
    "a folder with images or videos and a .csv, .parquet, .npy or .npz file, two levels deep",
    _detect,
    _read,
)
