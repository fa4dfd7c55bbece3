"""The images of an export with the labels of their pixels, one at a time."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Int, UInt, UInt8
from scipy.ndimage import distance_transform_edt

from ..errors import CartsError, SettingsError
from ..files import OutputPath, unique_file_names, write_bytes
from ..model.camera import Camera
from ..model.scene import Scene, SceneState
from ..recording import Sequence
from ..rendering import Renderer
from ..settings import Parts
from ..wording import counted
from .frames import ExportFrame
from .monitor import Monitor
from .png import image_png


@dataclass(frozen=True)
class Category:
    """What a pixel can be."""

    id: int
    """From 1; 0 is the background."""
    name: str
    """The arm's name, or `ARM.LINK`."""
    arm: str


@dataclass(frozen=True)
class View:
    """One frame through one camera."""

    id: int
    """From 1, through the whole export."""
    frame: ExportFrame
    camera: Camera
    name: str
    """Unique in the export; the stem of every file of this view."""
    link_ids: Int[np.ndarray, "height width"]
    """Index of the visible link, counted through all arms, -1 for background."""


@dataclass(frozen=True)
class Dataset:
    """What is exported, and how."""

    sequence: Sequence
    frames: tuple[ExportFrame, ...]
    scene: Scene
    """Arms and cameras of the export, with the calibration that masks are rendered with."""
    domain: str
    parts: Parts = "arms"
    """What gets a category of its own."""
    images: bool = True
    """Write the (undistorted) images beside their labels."""
    frame_rate: float | None = None
    """Of a video [1/s]; as recorded if None."""

    def __post_init__(self) -> None:
        if not self.frames:
            raise SettingsError("there is no frame to export. Choose other frames, or correct some first.")
        known = {camera.name for camera in self.sequence.scene.cameras}
        if unknown := {camera for frame in self.frames for camera in frame.masks} - known:
            raise SettingsError(
                f"there are masks for cameras {', '.join(sorted(unknown))}, which {self.sequence.path} does not have. "
                f"Its cameras are: {', '.join(sorted(known))}."
            )
        if self.frame_rate is not None and not 0.1 <= self.frame_rate <= 1000.0:
            raise SettingsError(f"the frame rate is {self.frame_rate}. It must be 0.1 to 1000 frames per second.")

    @cached_property
    def steps(self) -> list[tuple[str, ExportFrame, Camera]]:
        """Name, frame and camera of every view, frame by frame; names are unique."""
        pairs = [(frame, camera) for frame in self.frames for camera in self.scene.cameras]
        names = unique_file_names([f"{camera.name}_{frame.frame_id}" for frame, camera in pairs])
        return [(name, *pair) for name, pair in zip(names, pairs, strict=True)]

    @cached_property
    def links(self) -> tuple[Category, ...]:
        """A category for each link, in the order of `View.link_ids`."""
        names = [(arm.name, link) for arm in self.scene.arms for link in arm.robot.link_names]
        return tuple(Category(id, f"{arm}.{link}", arm) for id, (arm, link) in enumerate(names, start=1))

    @cached_property
    def arms(self) -> tuple[Category, ...]:
        """A category for each arm."""
        return tuple(Category(id, arm.name, arm.name) for id, arm in enumerate(self.scene.arms, start=1))

    @property
    def categories(self) -> tuple[Category, ...]:
        """The categories that `parts` asks for."""
        return self.arms if self.parts == "arms" else self.links

    @cached_property
    def renderers(self) -> dict[str, Renderer]:
        """Camera -> a renderer of that camera alone, at its full size."""
        return {
            camera.name: Renderer(self.scene, width=camera.width, height=camera.height, cameras=[camera.name])
            for camera in self.scene.cameras
        }

    def state(self, frame: ExportFrame) -> SceneState:
        """The scene at a frame's joint positions, seen from where its cameras are."""
        return self.scene.state(frame.joint_positions, mounts=self.sequence.mounts(frame.index))

    def views(self, monitor: Monitor) -> Iterator[View]:
        """Every frame through every camera, labelled; a step of `monitor` each.

        Raises:
            CartsError: a mask is of another size than its camera, or of pixels that no arm is near.
        """
        for number, (name, frame, camera) in enumerate(monitor.track(self.steps), start=1):
            link_ids = self.renderers[camera.name].segment_links(self.state(frame))[0]
            if camera.name in frame.masks:
                link_ids = labelled(frame.masks[camera.name], link_ids, f"frame {frame.frame_id}, camera {camera.name}")
            yield View(number, frame, camera, name, link_ids)

    def label_image(self, view: View, parts: Parts | None = None) -> UInt[np.ndarray, "height width"]:
        """Category of every pixel, 0 for background; 8 bits if that is enough for all categories, else 16."""
        ids = {arm.name: arm.id for arm in self.arms}
        links = (parts or self.parts) == "links"
        of_link = [0, *(link.id if links else ids[link.arm] for link in self.links)]
        return np.array(of_link, np.uint8 if max(of_link) <= 255 else np.uint16)[view.link_ids + 1]

    def instances(self, view: View) -> Iterator[tuple[Category, Bool[np.ndarray, "height width"]]]:
        """The categories that are visible, each with its mask."""
        labels = self.label_image(view)
        for category in self.categories:
            mask = labels == category.id
            if mask.any():
                yield category, mask

    def image(self, view: View) -> UInt8[np.ndarray, "height width 3"]:
        """The view's image, RGB, undistorted.

        Raises:
            SequenceError: it is missing or damaged.
        """
        return self.sequence.frame(view.frame.index, self.domain, [view.camera.name]).images[view.camera.name]

    def write_image(self, view: View, folder: OutputPath) -> str:
        """Write the view's image as PNG into `folder`, if images are asked for; the file's name."""
        name = f"{view.name}.png"
        if self.images:
            write_bytes(folder / name, image_png(self.image(view)))
        return name


def labelled(
    mask: Bool[np.ndarray, "height width"], rendered: Int[np.ndarray, "height width"], where: str
) -> Int[np.ndarray, "height width"]:
    """`rendered` labels cut to `mask`; what it adds gets the label of the nearest rendered pixel.

    Args:
        mask: where arms are visible.
        rendered: labels from 0, -1 for background.
        where: what errors call the view.

    Raises:
        CartsError: the mask has another size, or nothing is rendered that could name its pixels.
    """
    if mask.shape != rendered.shape or mask.dtype != bool:
        raise CartsError(
            f"{where}: the mask is {mask.dtype} {mask.shape}, the camera's images are {rendered.shape}. "
            "Give a Boolean mask of the camera's height and width."
        )
    if not mask.any():
        return np.full_like(rendered, -1)
    if (rendered < 0).all():
        raise CartsError(
            f"{where}: the mask has {counted(int(mask.sum()), 'pixel')}, but no arm is in view there, so it is not "
            "known whose they are. Correct the joint positions of this frame, clear its mask, or leave it out."
        )
    rows, columns = np.asarray(distance_transform_edt(rendered < 0, return_distances=False, return_indices=True))
    return np.where(mask, rendered[rows, columns], -1)
