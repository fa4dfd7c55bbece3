"""Layouts of the CaRTS paper (CTS), of its simulated videos (AMBF) and of the SegSTRONG-C challenge.

CTS           SET/DOMAIN/images_l/I.png, SET/green_screen/{ground_truth_l/I.png, psm1_js.npy, psm2_js.npy}
AMBF          VIDEO/{images,segmentations}/I.png, VIDEO/kinematics.npy (eight columns an arm, the jaw twice)
SegSTRONG-C   SUBSET/DOMAIN/{left,right}/I.png, SUBSET/ground_truth/{left,right}/I.png, no kinematics
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...errors import SequenceError
from ...model.psm_kinematics import JOINT_NAMES
from ...settings.interchange import ImportOptions
from ..images import mask_remarks, read_mask, spread_files
from ..importing.cameras import Images, cameras_of, common_ids, find_images, image_files
from ..importing.foreign_tables import read_array, read_foreign_table
from ..importing.found import FoundArm, FoundCamera, FoundRecording, Note, Notes, Source
from ..importing.joint_units import in_si, joints_of_arm
from ..importing.row_matching import by_rows, frame_times
from ..kinematics_table import Joint

_TRUTH = "green_screen"
_FIRST = ("regular",)
_AMBF_COLUMNS = 8
_AMBF_FIELD_OF_VIEW = 1.2
"""Vertical field of view of the simulated camera [rad]."""
_DECIMETRES_FROM = 0.3
"""Insertion above which a simulation counts in decimetres [m]."""


def _subfolders(path: Path) -> list[Path]:
    try:
        return sorted(each for each in path.iterdir() if each.is_dir())
    except OSError:
        return []


def _ordered(names: Iterable[str]) -> list[str]:
    """Domains, the regular one first."""
    return sorted(names, key=lambda name: (name not in _FIRST, name))


def _domain_images(path: Path, domains: list[str], folder: str, notes: Notes) -> tuple[Images, tuple[str, ...]] | None:
    """Images of one camera in all domains under one pattern, and the frames that all domains have."""
    places = [path / domain / folder for domain in domains]
    if not all(image_files(place) for place in places):
        return None
    found = [find_images(place) for place in places]
    if any(each.pattern != found[0].pattern or each.size != found[0].size for each in found):
        raise SequenceError(f"{path}: images of {folder} have other names or sizes in some domains. Name them alike.")
    ids = common_ids(found)
    if any(len(each.ids) != len(ids) for each in found):
        notes.warning(f"{folder}: {len(ids)} frames are in all of {', '.join(domains)}; others are left out.")
    pattern = (
        f"{{domain}}/{folder}/{found[0].pattern}" if len(domains) > 1 else f"{domains[0]}/{folder}/{found[0].pattern}"
    )
    return Images(path, pattern, ids, found[0].size), ids


def _with_masks(camera: FoundCamera, folder: Path, ids: tuple[str, ...], notes: Notes) -> FoundCamera:
    """The camera with the masks of a folder, if they are white on black."""
    if not image_files(folder):
        return camera
    masks = find_images(folder)
    shared = [frame for frame in ids if frame in set(masks.ids)]
    if not shared:
        notes.warning(f"{folder}: no mask is of a frame; they are left out.")
        return camera
    files = [folder / masks.pattern.format(frame=frame) for frame in shared]
    try:
        for file in spread_files(files):
            read_mask(file)
    except SequenceError as error:
        notes.missing(f"{camera.name}: masks in {folder} are left out: {error}")
        return camera
    notes += [Note("found", f"{camera.name}: {text}") for text in mask_remarks(files)]
    return replace(camera, masks=str(folder / masks.pattern), sparse_masks=len(shared) < len(ids))


def _detect_cts(path: Path) -> bool:
    return any(image_files(each / "images_l") for each in _subfolders(path)) and (path / _TRUTH).is_dir()


def _read_cts(path: Path, options: ImportOptions) -> FoundRecording:
    notes = Notes()
    domains = _ordered(each.name for each in _subfolders(path) if image_files(each / "images_l"))
    images: dict[str, Images] = {}
    ids: tuple[str, ...] = ()
    for name, folder in (("left", "images_l"), ("right", "images_r")):
        found = _domain_images(path, domains, folder, notes)
        if found is not None:
            images[name] = found[0]
            ids = tuple(frame for frame in ids if frame in set(found[1])) if ids else found[1]
    if not ids:
        raise SequenceError(
            f"{path}: no frame is in all of the domains {', '.join(domains)}. Remove the incomplete ones."
        )
    cameras = tuple(
        _with_masks(camera, path / _TRUTH / f"ground_truth_{camera.name[0]}", ids, notes)
        for camera in cameras_of(images, options, notes)
    )
    arms = []
    for name in ("PSM1", "PSM2", "PSM3"):
        file = path / _TRUTH / f"{name.lower()}_js.npy"
        if file.is_file():
            table = read_foreign_table(file)
            values = np.stack(list(table.columns.values())[:6], 1).astype(np.float64)
            arms.append(_arm(name, values, ids, file, options, notes))
    if not arms:
        raise SequenceError(f"{path / _TRUTH} has no psm1_js.npy or psm2_js.npy. Copy the set again, whole.")
    found, times = _timed(arms, ids, next(iter(images.values())), options, notes)
    return FoundRecording(
        "a set of CTS",
        path.name,
        cameras,
        found,
        ids,
        times,
        tuple(notes),
        options.time_offset or 0.0,
        domains=_domains(domains),
    )


def _domains(names: list[str]) -> dict[str, str]:
    return {name: name for name in names} if len(names) > 1 else {}


def _timed(
    arms: list[FoundArm], ids: tuple[str, ...], images: Images, options: ImportOptions, notes: Notes
) -> tuple[tuple[FoundArm, ...], np.ndarray | None]:
    """Arms with rows at the times of their images if a frame rate is given, and these times [s]."""
    times = frame_times(images, ids, options, notes).times
    rows = np.arange(len(ids), dtype=float)
    found, _, _ = by_rows([replace(arm, times=rows) for arm in arms], ids, notes, times)
    return found, times


def _arm(
    name: str, values: np.ndarray, ids: tuple[str, ...], file: Path, options: ImportOptions, notes: Notes
) -> FoundArm:
    """Joint positions of the frames: row n is frame n if no row is missing, else rows are matched in order."""
    if values.shape[1] < 6 or not np.isfinite(values).all():
        raise SequenceError(f"{file} does not hold six finite joint positions a row. Copy it again.")
    numbers = np.array([int(frame) for frame in ids])
    if len(values) == len(ids):
        rows = np.arange(len(ids))
    elif numbers.max() < len(values):
        rows = numbers
    else:
        raise SequenceError(
            f"{file} has {len(values)} rows for {len(ids)} images, whose numbers go to {numbers.max()}. "
            "Remove images without kinematics."
        )
    columns = (*JOINT_NAMES, "jaw")[: values.shape[1]]
    robot = options.robot.get(name, "builtin:psm_lnd")
    known = {joint.name: joint for joint in joints_of_arm(name, options)}
    joints = [known.get(column, Joint(column, column != "insertion", -np.inf, np.inf)) for column in columns]
    values = in_si(values, joints, options, notes, arm=name)
    return FoundArm(name, columns, values[rows], None, robot)


def _detect_ambf(path: Path) -> bool:
    return (path / "kinematics.npy").is_file() and bool(image_files(path / "images"))


def _read_ambf(path: Path, options: ImportOptions) -> FoundRecording:
    notes = Notes()
    images = find_images(path / "images")
    (camera,) = cameras_of({"camera": images}, options, notes)
    if camera.intrinsics is None:
        width, height = images.size
        focal = height / 2 / np.tan(_AMBF_FIELD_OF_VIEW / 2)
        camera = replace(camera, intrinsics=(focal, focal, width / 2, height / 2), pixel_center=0.5)
        notes.guessed("the camera sees 1.2 rad from top to bottom (change: --calibration camera FILE).")
    camera = _with_masks(camera, path / "segmentations", images.ids, notes)
    file = path / "kinematics.npy"
    values = read_array(file)
    if values.ndim != 2 or values.shape[1] % _AMBF_COLUMNS or values.dtype.kind not in "fiu":
        raise SequenceError(f"{file} has the shape {values.shape}; expected are eight columns of numbers an arm.")
    arms = []
    for number in range(values.shape[1] // _AMBF_COLUMNS):
        own = values[:, _AMBF_COLUMNS * number : _AMBF_COLUMNS * (number + 1)].astype(np.float64)
        joints = np.column_stack([own[:, :6], own[:, 6] + own[:, 7]])
        chosen = options
        if np.abs(joints[:, 2]).max() > _DECIMETRES_FROM and options.length_unit is None:
            chosen = replace(options, length_unit="dm")
            notes.guessed(f"PSM{number + 1}: insertion is in decimetres (change: --length-unit m).")
        arms.append(_arm(f"PSM{number + 1}", joints, images.ids, file, chosen, notes))
    found, times = _timed(arms, images.ids, images, options, notes)
    return FoundRecording(
        "a simulated video (AMBF)",
        path.name,
        (camera,),
        found,
        images.ids,
        times,
        tuple(notes),
        options.time_offset or 0.0,
    )


def _is_subset(path: Path) -> bool:
    return (path / "ground_truth").is_dir() and any(
        image_files(each / "left") for each in _subfolders(path) if each.name != "ground_truth"
    )


def _subsets(path: Path) -> list[Path]:
    level, found = [path], []
    for _ in range(4):
        found += [each for each in level if _is_subset(each)]
        level = [each for folder in level for each in _subfolders(folder)][:500]
    return found


def _detect_segstrong(path: Path) -> bool:
    return path.is_dir() and (_is_subset(path) or any(_is_subset(each) for each in _subsets(path)))


def _read_segstrong(path: Path, options: ImportOptions) -> FoundRecording:
    if not _is_subset(path):
        subsets = ", ".join(str(each.relative_to(path)) for each in _subsets(path))
        raise SequenceError(f"{path} holds several recordings. Import one of them: {subsets}.")
    notes = Notes()
    domains = _ordered(
        each.name for each in _subfolders(path) if each.name != "ground_truth" and image_files(each / "left")
    )
    images: dict[str, Images] = {}
    for name in ("left", "right"):
        if (found := _domain_images(path, domains, name, notes)) is not None:
            images[name] = found[0]
    ids = common_ids(list(images.values()))
    if not ids:
        raise SequenceError(f"{path}: no frame is in all domains and cameras. Remove the incomplete ones.")
    cameras = tuple(
        _with_masks(camera, path / "ground_truth" / camera.name, ids, notes)
        for camera in cameras_of(images, options, notes)
    )
    return FoundRecording(
        "a subset of SegSTRONG-C", path.name, cameras, (), ids, None, tuple(notes), domains=_domains(domains)
    )


CTS = Source(
    "cts",
    "a set of CaRTS (CTS)",
    "a folder with green_screen/psm1_js.npy and DOMAIN/images_l",
    _detect_cts,
    ("time_offset", "frame_rate"),
    _read_cts,
)
AMBF = Source(
    "ambf",
    "a simulated video of CaRTS (AMBF)",
    "a folder with kinematics.npy and images/",
    _detect_ambf,
    ("time_offset", "frame_rate"),
    _read_ambf,
)
SEGSTRONG_C = Source(
    "segstrong-c",
    "a subset of SegSTRONG-C",
    "a folder with ground_truth/ and DOMAIN/left",
    _detect_segstrong,
    (),
    _read_segstrong,
)
