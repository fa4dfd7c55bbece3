"""Dataset of an export: frames of a recording, a table or a project, with labelled images that are rendered one at a
time."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Sequence as Items
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np
from jaxtyping import Bool, Int, UInt, UInt8
from numpy import ndarray

from ..errors import CartsError, SequenceError, SettingsError
from ..files import OutputPath, name_fault, unique_file_names, write_bytes
from ..files.reading import IMAGE, read_bytes
from ..model.camera import Camera
from ..model.parts import link_classes, part_classes
from ..model.scene import Scene, SceneState
from ..project import Key, MaskCorrection, ProjectState, Source
from ..project.state import corrected_state, source_of
from ..recording import Sequence
from ..rendering import ImageRenderer
from ..reprs import short_repr
from ..settings import Images, Masks, Parts
from ..wording import counted
from .encodings import image_png, mask_png
from .kinematics import KinematicsRow

if TYPE_CHECKING:
    from ..networks import FeatureExtractor


@dataclass(frozen=True)
class ExportFrame(KinematicsRow):
    """Frame to export: joint positions, their source, and corrected masks."""

    index: int = field(kw_only=True)
    """0-based position in the sequence."""
    review: str | None = field(default=None, kw_only=True)
    """Name of the review state, such as accepted; None without a project."""
    dice: float | None = field(default=None, kw_only=True)
    """Lowest Dice with the recorded mask of a camera [1]; None if unknown."""
    masks: Mapping[str, Bool[ndarray, "height width"]] = field(default_factory=dict, kw_only=True)
    """Camera -> corrected mask at the camera's size; rendered masks are used for other cameras."""
    part_labels: Mapping[str, UInt8[ndarray, "height width"]] = field(default_factory=dict, kw_only=True)
    """Camera -> painted part class number (`carts_core.model.parts.PartClass`) per pixel, 0 if not painted. Painted
    classes override rendered classes, and painted pixels belong to the mask.
    """
    ignored: Mapping[str, Bool[ndarray, "height width"]] = field(default_factory=dict, kw_only=True)
    """Camera -> pixels of occluders, where masks are not refined."""

    __repr__ = short_repr


def measured_frames(sequence: Sequence, indices: Iterable[int]) -> list[ExportFrame]:
    """Frames of `indices` with their measured joint positions."""
    return [
        ExportFrame(
            sequence.frame_ids[index],
            "measured",
            {arm: positions[index] for arm, positions in sequence.measured.items()},
            index=index,
        )
        for index in indices
    ]


def corrected_frames(sequence: Sequence, indices: Iterable[int], rows: Iterable[KinematicsRow]) -> list[ExportFrame]:
    """Frames of `indices` that have a table row, with the joint positions of that row.

    Raises:
        SequenceError: a row refers to a frame that is not in the sequence, or two rows to the same frame.
    """
    known = set(sequence.frame_ids)
    by_id: dict[str, KinematicsRow] = {}
    for row in rows:
        if row.frame_id not in known:
            raise SequenceError(
                f"the kinematics contain frame {row.frame_id!r}, which is not in {sequence.path}. Give the table of "
                "this sequence."
            )
        if row.frame_id in by_id:
            raise SequenceError(f"the kinematics contain frame {row.frame_id!r} twice. Remove one of the rows.")
        by_id[row.frame_id] = row
    chosen = ((index, by_id[sequence.frame_ids[index]]) for index in indices if sequence.frame_ids[index] in by_id)
    return [
        ExportFrame(row.frame_id, row.source, row.joint_positions, row.joint_std, row.verdict, index=index)
        for index, row in chosen
    ]


RenderMask = Callable[[SceneState, str], Bool[np.ndarray, "height width"]]
"""Function that renders the mask of a camera, given by name, at its full size for a scene state."""
_SOURCES = {
    Source.MEASURED: "measured",
    Source.HAND: "edited",
    Source.OPTIMIZER: "optimized",
    Source.PROPAGATED: "propagated",
}
"""Source names as in the tables of `carts optimize`, so that `--keyframes` finds manually edited frames."""


class _CorrectedMasks(Mapping[str, Bool[np.ndarray, "height width"]]):
    """Mapping camera -> corrected mask of a frame, rendered on access."""

    def __init__(self, render: RenderMask, pose: SceneState, corrections: Mapping[str, MaskCorrection]) -> None:
        self._render, self._pose, self._corrections = render, pose, corrections

    def __getitem__(self, camera: str) -> Bool[np.ndarray, "height width"]:
        return self._corrections[camera].applied_to(self._render(self._pose, camera))

    def __contains__(self, camera: object) -> bool:
        return camera in self._corrections

    def __iter__(self) -> Iterator[str]:
        return iter(self._corrections)

    def __len__(self) -> int:
        return len(self._corrections)


def project_frame(
    recording: Sequence, project: ProjectState, index: int, cameras: Iterable[str], render: RenderMask
) -> ExportFrame:
    """Frame with the corrections of a project, and with painted masks and parts for the given cameras.

    Args:
        recording: recording with the project's time offset, and possibly its other corrections.
        render: renders masks; called only for cameras with a corrected mask.
    """
    frame = recording.frame(index, cameras=[])
    pose = corrected_state(recording.scene, frame, project)
    known = {name: value.standard_deviations for name, value in project.joints(index).items()}
    painted = {camera: project.get(Key.mask_correction(index, camera)) for camera in cameras}
    labels = {camera: project.get(Key.part_labels(index, camera)) for camera in cameras}
    regions = {camera: project.get(Key.ignore_region(index, camera)) for camera in cameras}
    verdict, figures = project.verdict(index), project.figures(index)
    return ExportFrame(
        frame.frame_id,
        _SOURCES[source_of(project, index)],
        {
            arm.name: values.astype(np.float64)
            for arm, values in zip(recording.scene.arms, pose.joint_positions, strict=True)
        },
        {arm: np.array(std, float) for arm, std in known.items() if std is not None} or None,
        None if verdict is None else verdict.verdict,
        index=index,
        review=project.review(index).state.value,
        dice=None if figures is None else figures.dice,
        part_labels={name: value.labels() for name, value in labels.items() if value is not None},
        ignored={name: value.region() for name, value in regions.items() if value is not None},
        masks=_CorrectedMasks(render, pose, {name: p for name, p in painted.items() if p is not None}),
    )


T = TypeVar("T")


class ExportCancelled(CartsError):
    """Raised when an export is cancelled; its output is removed."""


@dataclass(frozen=True)
class ExportProgress:
    """Progress and cancellation of an export."""

    progress: Callable[[int, int], None] | None = None
    """Called after each step with the number of finished steps and the total."""
    cancelled: Callable[[], bool] | None = None
    """Called before each step; True cancels the export. Example: `threading.Event().is_set`."""

    def track(self, steps: Items[T]) -> Iterator[T]:
        """Yield the steps and report progress; raises `ExportCancelled` if cancelled."""
        for done, step in enumerate(steps):
            self.pause()
            yield step
            if self.progress is not None:
                self.progress(done + 1, len(steps))
        self.pause()

    def pause(self) -> None:
        """Call `cancelled`; raises `ExportCancelled` if it returns True."""
        if self.cancelled is not None and self.cancelled():
            raise ExportCancelled("the export was cancelled. Nothing was written.")


@dataclass(frozen=True)
class Category:
    """Pixel category."""

    id: int
    """Category id, from 1; 0 is the background."""
    name: str
    """The arm's name, `ARM.PART` or `ARM.LINK`."""
    arm: str


@dataclass(frozen=True)
class View:
    """One frame seen by one camera."""

    id: int
    """View id, from 1, unique in the export."""
    frame: ExportFrame
    camera: Camera
    name: str
    """View name, unique in the export; the stem of all files of this view."""
    link_ids: Int[np.ndarray, "height width"]
    """Index of the visible link per pixel, numbered over all arms; -1 for background."""
    mask: "MaskSource"
    """Source of the mask."""


MaskSource = Literal["rendered", "refined", "painted"]
"""Source of a view's mask: rendered at the joint positions, rendered and refined by the network, or rendered and
corrected by hand (or given)."""


@dataclass(frozen=True)
class Dataset:
    """Content and options of an export."""

    sequence: Sequence
    frames: tuple[ExportFrame, ...]
    scene: Scene
    """Arms and cameras of the export, with the calibration used for rendering masks."""
    domain: str
    parts: Parts = "arms"
    """Granularity of the categories."""
    images: Images = "named"
    """References to the recording's images, copies of the images, or no images, as far as the format supports it."""
    frame_rate: float | None = None
    """Frame rate of a video [1/s]; None for the recorded rate of the exported frames."""
    masks: Masks = "rendered"
    """Masks that are refined; painted and given masks are not changed."""
    refine: "Refine | None" = None
    """Function that refines a rendered mask, such as `network_refiner`; without it, masks are rendered."""
    rendered_folder: OutputPath | None = None
    """Folder for the rendered masks of refined views."""
    recording: Path | None = None
    """Recording that the sequence was imported from, for formats that add results to it; by default that of the
    sequence file."""

    def __post_init__(self) -> None:
        if not self.frames:
            raise SettingsError("there is no frame to export. Choose other frames, or correct frames first.")
        known = {camera.name for camera in self.sequence.scene.cameras}
        if unknown := {camera for frame in self.frames for camera in frame.masks} - known:
            raise SettingsError(
                f"masks were given for cameras {', '.join(sorted(unknown))}, which are not in {self.sequence.path}. "
                f"Its cameras are: {', '.join(sorted(known))}."
            )
        if self.frame_rate is not None and not 0.1 <= self.frame_rate <= 1000.0:
            raise SettingsError(f"the frame rate is {self.frame_rate}. It must be 0.1 to 1000 frames per second.")

    @cached_property
    def steps(self) -> list[tuple[str, ExportFrame, Camera]]:
        """Unique name, frame and camera of each view, ordered by frame; frames without an image have no view."""
        recorded = {camera.name: set(self.sequence.frames_of(camera.name)) for camera in self.scene.cameras}
        pairs = [
            (frame, camera)
            for frame in self.frames
            for camera in self.scene.cameras
            if frame.index in recorded[camera.name]
        ]
        names = unique_file_names([f"{camera.name}_{frame.frame_id}" for frame, camera in pairs])
        return [(name, *pair) for name, pair in zip(names, pairs, strict=True)]

    @cached_property
    def links(self) -> tuple[Category, ...]:
        """One category per link, in the order of `View.link_ids`."""
        names = [(arm.name, link) for arm in self.scene.arms for link in arm.robot.link_names]
        return tuple(Category(id, f"{arm}.{link}", arm) for id, (arm, link) in enumerate(names, start=1))

    @cached_property
    def arms(self) -> tuple[Category, ...]:
        """One category per arm."""
        return tuple(Category(id, arm.name, arm.name) for id, arm in enumerate(self.scene.arms, start=1))

    @property
    def categories(self) -> tuple[Category, ...]:
        """Categories of the export, as selected by `parts`."""
        return self.categories_of(self.parts)

    def categories_of(self, parts: Parts) -> tuple[Category, ...]:
        """One category per arm, per part or per link."""
        if parts != "parts":
            return self.arms if parts == "arms" else self.links
        classes = part_classes(self.scene.arms)
        return tuple(Category(id, f"{one.arm}.{one.part}", one.arm) for id, one in enumerate(classes, start=1))

    @cached_property
    def link_classes(self) -> Int[np.ndarray, " links"]:
        """Part class number of each link, in the order of `View.link_ids`."""
        return link_classes(self.scene.arms)

    @cached_property
    def renderers(self) -> dict[str, ImageRenderer]:
        """Camera -> renderer of that camera only, at full resolution."""
        return {
            camera.name: ImageRenderer(self.scene, width=camera.width, height=camera.height, cameras=[camera.name])
            for camera in self.scene.cameras
        }

    def state(self, frame: ExportFrame) -> SceneState:
        """State of the scene in a frame, with its joint positions and camera poses."""
        return self.scene.state(frame.joint_positions, device=None, mounts=self.sequence.mounts(frame.index))

    def mask_source(self, frame: ExportFrame, camera: Camera) -> MaskSource:
        """Source of the mask of a view."""
        if camera.name in frame.masks or camera.name in frame.part_labels:
            return "painted"
        wanted = self.masks == "refined" or (self.masks == "auto" and frame.verdict == "good")
        return "refined" if wanted and self.refine is not None else "rendered"

    def views(self, progress: ExportProgress) -> Iterator[View]:
        """Yield the labelled views of all frames and cameras, one `progress` step each.

        Raises:
            CartsError: a mask or painted classes do not have the camera's image size, a mask is not empty although no
                arm is in view, or a painted class belongs to no link.
        """
        for number, (name, frame, camera) in enumerate(progress.track(self.steps), start=1):
            rendered = self.renderers[camera.name].segment_links(self.state(frame))[0]
            mask, painted = frame.masks.get(camera.name), frame.part_labels.get(camera.name)
            where, link_ids = f"frame {frame.frame_id}, camera {camera.name}", rendered
            if mask is not None:
                link_ids = labelled(mask if painted is None else mask & (painted == 0), rendered, where)
            if painted is not None:
                link_ids = painted_links(painted, link_ids, rendered, self.link_classes, where)
            source = self.mask_source(frame, camera)
            if source == "refined":
                assert self.refine is not None
                link_ids = labelled(self.refine(self, frame, camera, rendered >= 0), rendered, where)
                if self.rendered_folder is not None:
                    write_bytes(self.rendered_folder / f"{name}.png", mask_png(rendered >= 0))
            yield View(number, frame, camera, name, link_ids, source)

    def label_image(self, view: View, parts: Parts | None = None) -> UInt[np.ndarray, "height width"]:
        """Label image: category id per pixel, 0 for background; 8 bits if sufficient for all categories, else 16."""
        parts = parts or self.parts
        if parts == "links":
            ids = [link.id for link in self.links]
        elif parts == "arms":
            arms = {arm.name: arm.id for arm in self.arms}
            ids = [arms[link.arm] for link in self.links]
        else:
            numbers = [one.number for one in part_classes(self.scene.arms)]
            # Links without a mesh may have no class.
            ids = [numbers.index(number) + 1 if number in numbers else 0 for number in self.link_classes.tolist()]
        of_link = [0, *ids]
        return np.array(of_link, np.uint8 if max(of_link) <= 255 else np.uint16)[view.link_ids + 1]

    def instances(self, view: View) -> Iterator[tuple[Category, Bool[np.ndarray, "height width"]]]:
        """Visible categories with their masks."""
        labels = self.label_image(view)
        for category in self.categories:
            mask = labels == category.id
            if mask.any():
                yield category, mask

    def recorded_mask(self, view: View) -> Bool[np.ndarray, "height width"]:
        """Mask of all arms in the recorded image of a view, which is not undistorted.

        With distortion, the recorded image may show more than the undistorted image. There, the mask is rendered,
        except where a painted or refined mask differs from the rendering at the nearest border pixel.
        """
        mask, recorded = view.link_ids >= 0, self.sequence.recorded_camera(view.camera.name)
        left, top, width, height = recorded.recorded_window
        if (height, width) == mask.shape:
            return recorded.distorted_mask(mask)
        filled = self._wide_renderers[view.camera.name].segment_links(self.state(view.frame))[0] >= 0
        if view.mask != "rendered":
            rows, columns = mask.shape
            around = (-top, height + top - rows), (-left, width + left - columns)
            rendered = filled[-top : rows - top, -left : columns - left]
            changed = np.pad(mask != rendered, around, mode="edge")
            filled = np.where(changed, np.pad(mask, around, mode="edge"), filled)
        return recorded.distorted_mask(filled)

    @cached_property
    def _wide_renderers(self) -> dict[str, ImageRenderer]:
        """Camera -> renderer of all that its recorded images show."""
        cameras = [self.sequence.recorded_camera(camera.name) for camera in self.scene.cameras]
        return {one.name: ImageRenderer(self.scene, cameras=[one.name], window=one.recorded_window) for one in cameras}

    def image(self, view: View) -> UInt8[np.ndarray, "height width 3"]:
        """Undistorted RGB image of the view; `SequenceError` for a missing or damaged image."""
        return self.sequence.frame(view.frame.index, self.domain, [view.camera.name]).images[view.camera.name]

    @cached_property
    def files(self) -> list[Path | None]:
        """Recorded image file of each view; None if its image is undistorted, cropped or rotated, or comes from a video
        or bag.
        """
        return [self._file(frame, camera) for _, frame, camera in self.steps]

    @property
    def remade_cameras(self) -> tuple[str, ...]:
        """Cameras whose images are not unchanged files of the recording; see `files`."""
        steps = zip(self.steps, self.files, strict=True)
        return tuple(dict.fromkeys(camera.name for (_, _, camera), file in steps if file is None))

    @cached_property
    def image_folder(self) -> Path:
        """Folder to which image names are relative: the folder of the sequence file if it contains the recorded images
        of all exported frames, else the innermost common folder of these images.
        """
        beside = self.sequence.path.parent
        cameras = self.sequence.scene.cameras
        files = [self._file(frame, camera) for frame in self.frames for camera in cameras]
        folders = {file.parent for file in files if file is not None}
        if not folders or all(folder.is_relative_to(beside) for folder in folders):
            return beside
        return Path(os.path.commonpath(folders))

    def image_name(self, view: View) -> str:
        """Image path used in labels: path of the recorded file relative to `image_folder`, or `NAME.png`."""
        return self._image_names[view.id - 1]

    def write_image(self, view: View, folder: OutputPath) -> str:
        """Write the view's image into `folder` if copies are requested or the image is not a recorded file; returns the
        `image_name`. Nothing is written if `images` is `none`.

        Recorded files are copied byte for byte; other images (see `remade_cameras`) are written as PNG.
        """
        name = self.image_name(view)
        if self.images == "none":
            return name
        file = self.files[view.id - 1]
        if file is None or self.images == "copied":
            *folders, last = name.split("/")
            for part in folders:
                folder = folder / part
            self._write_image(view, file, folder / last)
        return name

    def write_image_as(self, view: View, folder: OutputPath, stem: str) -> str:
        """Like `write_image`, for formats that prescribe the stem of the file name; returns the file name."""
        file = self.files[view.id - 1]
        name = f"{stem}{'.png' if file is None else file.suffix.lower()}"
        if self.images != "none":
            self._write_image(view, file, folder / name)
        return name

    def _write_image(self, view: View, file: Path | None, path: OutputPath) -> None:
        write_bytes(path, image_png(self.image(view)) if file is None else read_bytes(file, IMAGE))

    def _file(self, frame: ExportFrame, camera: Camera) -> Path | None:
        file = self.sequence.image_file(frame.index, camera.name, self.domain)
        return None if file is None else Path(os.path.normpath(file))

    @cached_property
    def stems(self) -> list[str]:
        """File stem of each view in flat folders: the stem of its image name if all stems differ and are valid names,
        else the view's name."""
        own = [PurePath(name).stem for name in self._image_names]
        unique = len({stem.casefold() for stem in own}) == len(own) and not any(map(name_fault, own))
        return own if unique else [name for name, _, _ in self.steps]

    @cached_property
    def _image_names(self) -> list[str]:
        """Image name of each view; all names are view names if two label files would collide or a recorded name cannot
        be written.
        """
        files = self.files
        paths = [PurePath(f"{name}.png") for name, _, _ in self.steps]
        paths = [
            own if file is None else file.relative_to(self.image_folder) for own, file in zip(paths, files, strict=True)
        ]
        stems = {path.with_suffix("") for path in paths}
        if len(stems) < len(paths) or any(name_fault(part) for path in paths for part in path.parts):
            suffixes = [".png" if file is None else file.suffix for file in files]
            return [f"{name}{suffix}" for (name, _, _), suffix in zip(self.steps, suffixes, strict=True)]
        return [path.as_posix() for path in paths]


def labelled(
    mask: Bool[np.ndarray, "height width"], rendered: Int[np.ndarray, "height width"], where: str
) -> Int[np.ndarray, "height width"]:
    """Restrict `rendered` labels (-1 for background) to `mask`; additional pixels get the nearest rendered label.

    Raises:
        CartsError: the mask of the view `where` has another size, or is not empty although the view has no rendered
            label.
    """
    if mask.shape != rendered.shape or mask.dtype != bool:
        raise CartsError(
            f"{where}: the mask is {mask.dtype} {mask.shape}, but the camera's images are {rendered.shape}. "
            "Give a Boolean mask of the camera's height and width."
        )
    if not mask.any():
        return np.full_like(rendered, -1)
    if (rendered < 0).all():
        raise CartsError(
            f"{where}: the mask has {counted(int(mask.sum()), 'pixel')}, but no arm is in view, so the arm of the mask "
            "is unknown. Correct the joint positions of this frame, clear its mask, or leave the frame out."
        )
    rows, columns = _nearest(rendered >= 0)
    return np.where(mask, rendered[rows, columns], -1)


def _nearest(pixels: Bool[np.ndarray, "height width"]) -> Int[np.ndarray, "2 height width"]:
    """For each pixel, row and column of the nearest True pixel."""
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415  takes 0.3 s

    return np.asarray(distance_transform_edt(~pixels, return_distances=False, return_indices=True))


def painted_links(
    painted: UInt8[np.ndarray, "height width"],
    link_ids: Int[np.ndarray, "height width"],
    rendered: Int[np.ndarray, "height width"],
    classes: Int[np.ndarray, " links"],
    where: str,
) -> Int[np.ndarray, "height width"]:
    """Replace `link_ids` in pixels painted as a part class (0: not painted) by the nearest rendered link of that class,
    or by its first link if none is rendered.

    Args:
        rendered: like `link_ids` (-1 for background), before masks were applied.
        classes: part class number of each link.

    Raises:
        CartsError: the labels of the view `where` have another size, or contain a class that no link has.
    """
    if painted.shape != link_ids.shape:
        raise CartsError(
            f"{where}: painted classes have shape {painted.shape}, but the camera's images have {link_ids.shape}."
        )
    numbers = np.unique(painted[painted > 0])
    if unknown := set(numbers.tolist()) - set(classes.tolist()):
        raise CartsError(
            f"{where}: a pixel has the painted class {min(unknown)}, but no link of the scene has this class."
        )
    found = link_ids.copy()
    for number in numbers:
        own = np.isin(rendered, np.flatnonzero(classes == number))
        pixels = painted == number
        if own.any():
            rows, columns = _nearest(own)
            found[pixels] = rendered[rows, columns][pixels]
        else:
            found[pixels] = np.flatnonzero(classes == number)[0]
    return found


Refine = Callable[[Dataset, ExportFrame, Camera, Bool[np.ndarray, "height width"]], Bool[np.ndarray, "height width"]]
"""Function that refines the rendered mask of a view."""


def network_refiner(load: "Callable[[], FeatureExtractor]") -> Refine:
    """Refinement by the networks, which are loaded when the first mask is refined."""
    loaded = cache(load)

    def refine(
        dataset: Dataset, frame: ExportFrame, camera: Camera, rendered: Bool[np.ndarray, "height width"]
    ) -> Bool[np.ndarray, "height width"]:
        from ..optimization import Backgrounds, MaskRefiner, NetworkPredictor  # noqa: PLC0415

        backgrounds = Backgrounds.of(dataset.sequence, (camera.name,), dataset.domain)
        recorded = dataset.sequence.frame(frame.index, dataset.domain, [camera.name])
        refiner = MaskRefiner(NetworkPredictor(loaded()), backgrounds)
        masks = refiner.refine(dataset.scene, recorded, dataset.state(frame), {camera.name: rendered}, frame.ignored)
        return masks[camera.name]

    return refine
