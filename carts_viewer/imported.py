"""Masks of others, where the recording has none of its own."""

from dataclasses import replace

from carts_core.model.scene import Scene
from carts_core.project import Key, ProjectState
from carts_core.project.masks import ignored_labels
from carts_core.recording import Frame


def with_imported(frame: Frame, scene: Scene, project: ProjectState) -> Frame:
    """The frame with the masks of others for cameras that the recording has no mask of."""
    masks = dict(frame.masks or {})
    labels = project.get(Key.imported_labels())
    for camera in scene.cameras:
        layer = None if camera.name in masks else project.get(Key.imported_mask(frame.index, camera.name))
        if layer is not None:
            masks[camera.name] = layer.mask() & ~ignored_labels(layer, () if labels is None else labels.names)
    return replace(frame, masks=masks or None)
