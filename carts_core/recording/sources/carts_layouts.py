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
from ...wording import counted
from ..images import mask_remarks, read_mask, spread_files
from ..importing.cameras import Images, cameras_of, common_ids, find_images, image_files, subfolders
from ..importing.foreign_tables import read_array, read_foreign_table
from ..importing.found import FoundArm, FoundCamera, FoundRecording, Import, Source
from ..importing.joint_units import in_si, psm_joints
from ..importing.row_matching import by_rows, frame_times

_TRUTH = "green_screen"
_FIRST = ("regular",)
_AMBF_COLUMNS = 8
_AMBF_FIELD_OF_VIEW = 1.2
"""Vertical field of view of the simulated camera [rad]."""
_DECIMETRES_FROM = 0.3
"""Insertion above which a simulation counts in decimetres [m]."""


def _ordered(names: Iterable[str]) -> list[str]:
    """Domains, the regular one first."""
    return sorted(names, key=lambda name: (name not in _FIRST, name))


def _domain_images(path: Path, domains: list[str], folders: dict[str, str], job: Import) -> dict[str, Images]:
    """Images of each camera in all domains under one pattern, with the frames that all domains have."""
    images = {}
    for camera, folder in folders.items():
        if not all(image_files(path / domain / folder) for domain in domains):
            continue
        found = {domain: find_images(path / domain / folder) for domain in domains}
        first = found[domains[0]]
        if any(each.pattern != first.pattern or each.size != first.size for each in found.values()):
            raise SequenceError(
                f"{path}: names or sizes of the images of {folder} differ between domains. Make them equal."
            )
        ids = common_ids(found, path)
        if any(len(each.ids) != len(ids) for each in found.values()):
            text = f"{counted(len(ids), 'frame')} in all of {', '.join(domains)}; others are left out."
            job.warning(text, camera)
        place = "{domain}" if len(domains) > 1 else domains[0]
        images[camera] = Images(path, f"{place}/{folder}/{first.pattern}", ids, first.size)
    if not images:
        raise SequenceError(f"{path}: no camera has images in all of {', '.join(domains)}. Remove the incomplete ones.")
    return images


def _with_masks(camera: FoundCamera, folder: Path, ids: tuple[str, ...], job: Import) -> FoundCamera:
    """The camera with the masks of a folder, if they are white on black."""
    if not image_files(folder):
        return camera
    masks = find_images(folder)
    shared = [frame for frame in ids if frame in set(masks.ids)]
    if not shared:
        job.warning(f"masks in {folder} are left out, since none belongs to a frame.", camera.name)
        return camera
    files = [folder / masks.pattern.format(frame=frame) for frame in shared]
    try:
        for file in spread_files(files):
            read_mask(file)
    except SequenceError as error:
        job.missing(f"masks in {folder} are left out: {error}", camera.name)
        return camera
    for text in mask_remarks(files):
        job.found(text, camera.name)
    return replace(camera, masks=str(folder / masks.pattern), sparse_masks=len(shared) < len(ids))


def _read_cts(path: Path, job: Import) -> FoundRecording:
    domains = _ordered(each.name for each in subfolders(path) if image_files(each / "images_l"))
    images = _domain_images(path, domains, {"left": "images_l", "right": "images_r"}, job)
    ids = common_ids(images, path)
    cameras = [
        _with_masks(camera, path / _TRUTH / f"ground_truth_{camera.name[0]}", ids, job)
        for camera in cameras_of(images, job)
    ]
    arms = []
    for name in ("PSM1", "PSM2", "PSM3"):
        file = path / _TRUTH / f"{name.lower()}_js.npy"
        if file.is_file():
            table = read_foreign_table(file)
            values = np.stack(list(table.columns.values())[:6], 1).astype(np.float64)
            arms.append(_arm(name, values, ids, file, job))
    if not arms:
        raise SequenceError(f"{path / _TRUTH} has no psm1_js.npy or psm2_js.npy. Copy the whole set again.")
    found, times = _timed(arms, ids, next(iter(images.values())), job)
    return job.recording("a set of CTS", path.name, cameras, found, ids, times, domains=_domains(domains))


def _domains(names: list[str]) -> dict[str, str]:
    return {name: name for name in names} if len(names) > 1 else {}


def _timed(
    arms: list[FoundArm], ids: tuple[str, ...], images: Images, job: Import
) -> tuple[tuple[FoundArm, ...], np.ndarray | None]:
    """Arms with rows at the times of their images if a frame rate is given, and these times [s]."""
    times = frame_times(images, ids, job).times
    rows = np.arange(len(ids), dtype=float)
    found, _, _ = by_rows([replace(arm, times=rows) for arm in arms], ids, job, times)
    return found, times


def _arm(name: str, values: np.ndarray, ids: tuple[str, ...], file: Path, job: Import) -> FoundArm:
    """Joint positions of the frames: row n is frame n if no row is missing, else rows are matched in order."""
    if values.shape[1] < 6 or not np.isfinite(values).all():
        raise SequenceError(f"{file} does not have six finite joint positions per row. Copy it again.")
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
    values = in_si(values, psm_joints(name, columns, job), job, arm=name)
    return FoundArm(name, columns, values[rows], None, job.options.robot.get(name, FoundArm.robot))


def _read_ambf(path: Path, job: Import) -> FoundRecording:
    images = find_images(path / "images")
    (camera,) = cameras_of({"camera": images}, job)
    if camera.intrinsics is None:
        width, height = images.size
        focal = height / 2 / np.tan(_AMBF_FIELD_OF_VIEW / 2)
        camera = replace(camera, intrinsics=(focal, focal, width / 2, height / 2), pixel_center=0.5)
        text = f"the vertical field of view is {_AMBF_FIELD_OF_VIEW} rad."
        job.guessed(text, camera.name, "--calibration camera FILE")
    camera = _with_masks(camera, path / "segmentations", images.ids, job)
    file = path / "kinematics.npy"
    values = read_array(file)
    if values.ndim != 2 or values.shape[1] % _AMBF_COLUMNS or values.dtype.kind not in "fiu":
        raise SequenceError(f"{file} has the shape {values.shape}; expected are eight columns of numbers per arm.")
    arms = []
    for number in range(values.shape[1] // _AMBF_COLUMNS):
        own = values[:, _AMBF_COLUMNS * number : _AMBF_COLUMNS * (number + 1)].astype(np.float64)
        joints = np.column_stack([own[:, :6], own[:, 6] + own[:, 7]])
        chosen = job
        if np.abs(joints[:, 2]).max() > _DECIMETRES_FROM and job.options.length_unit is None:
            chosen = job.with_options(length_unit="dm")
            job.guessed("insertion is in decimetres.", f"PSM{number + 1}", "--length-unit m")
        arms.append(_arm(f"PSM{number + 1}", joints, images.ids, file, chosen))
    found, times = _timed(arms, images.ids, images, job)
    return job.recording("a simulated video (AMBF)", path.name, (camera,), found, images.ids, times)


def _is_subset(path: Path) -> bool:
    return (path / "ground_truth").is_dir() and any(
        image_files(each / "left") for each in subfolders(path) if each.name != "ground_truth"
    )


def _subsets(path: Path) -> list[Path]:
    level, found = [path], []
    for _ in range(4):
        found += [each for each in level if _is_subset(each)]
        level = [each for folder in level for each in subfolders(folder)][:500]
    return found


def _read_segstrong(path: Path, job: Import) -> FoundRecording:
    if not _is_subset(path):
        subsets = ", ".join(str(each.relative_to(path)) for each in _subsets(path))
        raise SequenceError(f"{path} has several recordings. Import one of them: {subsets}.")
    folders = [each for each in subfolders(path) if each.name != "ground_truth"]
    domains = _ordered(each.name for each in folders if image_files(each / "left"))
    images = _domain_images(path, domains, {"left": "left", "right": "right"}, job)
    ids = common_ids(images, path)
    cameras = [_with_masks(camera, path / "ground_truth" / camera.name, ids, job) for camera in cameras_of(images, job)]
    return job.recording("a subset of SegSTRONG-C", path.name, cameras, (), ids, None, domains=_domains(domains))


CTS = Source(
    "cts",
    "a set of CaRTS (CTS)",
    "a folder with green_screen/psm1_js.npy and DOMAIN/images_l",
    lambda path: any(image_files(each / "images_l") for each in subfolders(path)) and (path / _TRUTH).is_dir(),
    ("time_offset", "frame_rate"),
    _read_cts,
)
AMBF = Source(
    "ambf",
    "a simulated video of CaRTS (AMBF)",
    "a folder with kinematics.npy and images/",
    lambda path: (path / "kinematics.npy").is_file() and bool(image_files(path / "images")),
    ("time_offset", "frame_rate"),
    _read_ambf,
)
SEGSTRONG_C = Source(
    "segstrong-c",
    "a subset of SegSTRONG-C",
    "a folder with ground_truth/ and DOMAIN/left",
    lambda path: path.is_dir() and bool(_subsets(path)),
    (),
    _read_segstrong,
)
