"""Masks to be fitted: those of a project, imported or painted, and those of a file or folder of others."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool

from ..errors import ProjectError
from ..model.scene import Scene
from ..optimization import GivenMasks
from ..recording import Frame
from ..recording import Sequence as Recording
from ..recording.annotations import read_annotations
from ..rendering import Renderer
from .calibrated import corrected_state
from .keys import Key
from .layers import ImportedMask
from .state import ProjectState

MaskLayer = Literal["imported", "painted"]
"""Which masks of a project."""

_LEFT_OUT = {"ignore", "ignored", "void"}
"""Labels of pixels of which others have not said whether they show an instrument."""

Masks = dict[str, Bool[np.ndarray, "height width"]]


def project_masks(layer: MaskLayer, state: ProjectState, recording: Recording) -> GivenMasks:
    """Masks that a project holds, as they are in this state; its ignore regions are left out.

    Args:
        layer: imported ones, or rendered ones that somebody has corrected with a brush.
        state: of the project.
        recording: whose project it is.
    """
    cameras = [camera.name for camera in recording.scene.cameras]
    if layer == "imported":
        known = state.get(Key.imported_labels())
        names = () if known is None else known.names
        return _labelled("imported mask", cameras, lambda i, c: state.get(Key.imported_mask(i, c)), names, state)
    offset = state.get(Key.time_offset())
    if offset is not None and recording.matching is not None:
        recording = recording.with_time_offset(offset.seconds)
    painted = _Painted(state, recording.scene, lambda index: recording.frame(index, cameras=[]))
    return GivenMasks("painted mask", painted.masks, painted.there, partial(_ignored, state, cameras))


def file_masks(source: Path, recording: Recording) -> GivenMasks:
    """Masks of others, from a file or folder as `read_annotations` takes it; none of them goes into a project.

    Raises:
        SequenceError: it cannot be read.
        ProjectError: it has no mask of any frame.
    """
    found = read_annotations(source, recording)
    layers = {
        (frame.frame, frame.camera): ImportedMask.of(frame.labels) for frame in found.frames if frame.labels is not None
    }
    if not layers:
        there = f" Its images are called {', '.join(map(repr, found.unknown[:3]))}." if found.unknown else ""
        raise ProjectError(
            f"no mask in {source} belongs to a frame.{there} Frames are called "
            f"{', '.join(map(repr, recording.frame_ids[:3]))}, ...; name the images by them."
        )
    cameras = [camera.name for camera in recording.scene.cameras]
    return _labelled(f"mask in {source}", cameras, lambda i, c: layers.get((i, c)), found.label_names)


def ignored_labels(layer: ImportedMask, names: Sequence[str]) -> Bool[np.ndarray, "height width"]:
    """Pixels of a layer whose label says that they are to be left out, such as `ignore`."""
    numbers = [number for number, name in enumerate(names, start=1) if name.casefold() in _LEFT_OUT]
    return np.isin(layer.labels(), numbers)


def _labelled(
    origin: str,
    cameras: Iterable[str],
    layer: Callable[[int, str], ImportedMask | None],
    names: Sequence[str],
    state: ProjectState | None = None,
) -> GivenMasks:
    """Masks whose pixels have labels; those of an ignore region and of labels such as `ignore` are left out."""
    cameras = tuple(cameras)

    def layers(index: int) -> dict[str, ImportedMask]:
        return {name: found for name in cameras if (found := layer(index, name)) is not None}

    def masks(index: int) -> Masks:
        return {name: found.mask() & ~ignored_labels(found, names) for name, found in layers(index).items()}

    def ignored(index: int) -> Masks:
        regions = {} if state is None else _ignored(state, cameras, index)
        for name, found in layers(index).items():
            left_out = ignored_labels(found, names)
            if left_out.any():
                regions[name] = left_out | regions.get(name, False)
        return regions

    return GivenMasks(origin, masks, lambda index, name: layer(index, name) is not None, ignored)


def _ignored(state: ProjectState, cameras: Iterable[str], index: int) -> Masks:
    regions = {name: state.get(Key.ignore_region(index, name)) for name in cameras}
    return {name: region.region() for name, region in regions.items() if region is not None}


class _Painted:
    """Masks rendered at the poses that a project has, as somebody corrected them."""

    def __init__(self, state: ProjectState, scene: Scene, load: Callable[[int], Frame]) -> None:
        self._state, self._scene, self._load = state, scene, load
        self._renderers: dict[str, Renderer] = {}

    def there(self, index: int, camera: str) -> bool:
        """Whether somebody corrected the mask of a frame."""
        return self._state.get(Key.mask_correction(index, camera)) is not None

    def masks(self, index: int) -> Masks:
        """Camera -> mask of a frame, of the cameras whose mask somebody corrected."""
        found: Masks = {}
        for camera in self._scene.cameras:
            correction = self._state.get(Key.mask_correction(index, camera.name))
            if correction is not None:
                pose = corrected_state(self._scene, self._load(index), self._state)
                found[camera.name] = correction.applied_to(self._renderer(camera.name).segment(pose)[0] >= 0)
        return found

    def _renderer(self, name: str) -> Renderer:
        if name not in self._renderers:
            own = self._scene.camera(name)
            self._renderers[name] = Renderer(self._scene, width=own.width, height=own.height, cameras=[name])
        return self._renderers[name]
