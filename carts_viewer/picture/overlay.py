"""The overlay of a pose over its frame, keypoints in the image, and scores against ground-truth masks."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from carts_core.evaluation.metrics import dice, joint_mae_deg
from carts_core.export.dataset import labelled
from carts_core.model.keypoints import Keypoint, keypoints, project_keypoints
from carts_core.model.parts import link_classes
from carts_core.model.scene import Scene, SceneState
from carts_core.project import Key, MaskCorrection, PartLabels, ProjectState
from carts_core.project.masks import ignored_labels
from carts_core.recording import Frame, Sequence
from carts_core.rendering import ImageRenderer, pick_point
from carts_viewer.picture import layers
from carts_viewer.picture.layers import Layer
from carts_viewer.state import Maps, Scores


class OverlayRenderer:
    """Renders poses into the scene's cameras; keeps one renderer per camera."""

    def __init__(self, sequence: Sequence) -> None:
        self._scene = sequence.scene
        self._measured_joints = sequence.measured_joints
        self._renderers: dict[str, ImageRenderer] = {}
        self._last: dict[str, tuple[SceneState, layers.ArmIds]] = {}

    def arm_ids(self, state: SceneState, camera: str) -> layers.ArmIds:
        """Index of the visible arm per pixel of the camera's own image, -1 for background."""
        # The result is cached, since overlay and scores of a pose are requested one after the other.
        if camera not in self._last or self._last[camera][0] is not state:
            self._last[camera] = (state, self._renderer(camera).segment(state)[0])
        return self._last[camera][1]

    def classes(
        self, state: SceneState, camera: str, correction: MaskCorrection | None, painted: PartLabels | None
    ) -> Int[np.ndarray, "height width"]:
        """Class number (`carts_core.model.parts.PartClass`) of every pixel, as in an export; 0 for no class.

        Pixels added to the mask of an image without rendered arms have no class.
        """
        rendered = self._renderer(camera).segment_links(state)[0]
        classes = np.append(link_classes(self._scene.arms), 0)
        links = rendered
        if correction is not None and (rendered >= 0).any():
            links = labelled(correction.applied_to(rendered >= 0), rendered, camera)
        found = classes[links]
        if painted is not None:
            labels = painted.labels()
            found = np.where(labels > 0, labels, found)
        return found

    def mask(
        self, state: SceneState, camera: str, correction: MaskCorrection | None = None
    ) -> Bool[np.ndarray, "height width"]:
        """Mask of the visible arms in the camera's own image, as rendered and then corrected."""
        rendered = self.arm_ids(state, camera) >= 0
        return rendered if correction is None else correction.applied_to(rendered)

    def overlay(
        self,
        state: SceneState,
        frame: Frame,
        camera: str,
        layer: Layer,
        opacity: float,
        maps: Maps | None,
        correction: MaskCorrection | None = None,
    ) -> layers.Rgba:
        """The layer over one camera's image.

        Args:
            state: The pose of the whole scene.
            frame: The frame, with ground-truth masks for the comparison.
            camera: The camera's name.
            layer: What to draw.
            opacity: Opacity, 0..1.
            maps: Attention and similarity; without maps, these layers are empty.
            correction: Correction of the mask that is compared with ground truth.
        """
        size = self._scene.camera(camera).height, self._scene.camera(camera).width
        if layer is Layer.SHADED:
            return self._shaded(state, camera, opacity)
        if layer is Layer.MASK:
            return layers.mask(self.arm_ids(state, camera), opacity)
        if layer is Layer.CONTOUR:
            return layers.contour(self.arm_ids(state, camera), opacity)
        if layer is Layer.TRUTH:
            truth = None if frame.masks is None else frame.masks.get(camera)
            predicted = self.mask(state, camera, correction)
            return layers.transparent(*size) if truth is None else layers.against_truth(predicted, truth, opacity)
        if layer in (Layer.ATTENTION, Layer.SIMILARITY) and maps is not None and camera in maps.cameras:
            # Similarity is not negative, because features are not negative.
            values = maps.iterate.attention if layer is Layer.ATTENTION else maps.iterate.similarity
            return layers.heat(values[maps.cameras.index(camera)], 0.0, 1.0, size, opacity)
        return layers.transparent(*size)

    def refined(
        self, state: SceneState, camera: str, mask: Bool[np.ndarray, "height width"] | None, opacity: float
    ) -> layers.Rgba:
        """Picture of a refined mask with the outline of the rendered mask; the rendered mask if `mask` is None."""
        rendered = self.arm_ids(state, camera)
        if mask is None or not (rendered >= 0).any():
            return layers.mask(rendered, opacity)
        return layers.refined(labelled(mask, rendered, camera), rendered, opacity)

    def pick(self, state: SceneState, camera: str, pixel: tuple[float, float], radius: float) -> Keypoint | None:
        """The visible point of an arm at a pixel, or the nearest within `radius` [px]; None if there is none."""
        return pick_point(self._scene, self._renderer(camera), state, pixel, radius)

    def scores(self, state: SceneState, frame: Frame, camera: str, correction: MaskCorrection | None = None) -> Scores:
        """Scores of the pose and its corrected mask against the frame's ground truth."""
        mask = None if frame.masks is None else frame.masks.get(camera)
        overlap = None if mask is None else dice(self.mask(state, camera, correction), mask)
        others = {
            name: dice(self.mask(state, name), mask) for name, mask in (frame.masks or {}).items() if name != camera
        }
        known = others if overlap is None else {camera: overlap, **others}
        values = (joints.astype(np.float64) for joints in state.joint_positions)
        estimate = {arm.name: joints for arm, joints in zip(self._scene.arms, values, strict=True)}
        return Scores(overlap, joint_mae_deg(self._scene, estimate, frame.truth or {}, self._measured_joints), known)

    def _shaded(self, state: SceneState, camera: str, opacity: float) -> layers.Rgba:
        images, arm_ids = self._renderer(camera).shaded(state)
        self._last[camera] = (state, arm_ids[0])
        return layers.shaded(images[0], arm_ids[0], opacity)

    def _renderer(self, camera: str) -> ImageRenderer:
        if camera not in self._renderers:
            own = self._scene.camera(camera)
            self._renderers[camera] = ImageRenderer(self._scene, width=own.width, height=own.height, cameras=[camera])
        return self._renderers[camera]


def with_imported(frame: Frame, scene: Scene, project: ProjectState) -> Frame:
    """The frame with imported masks for cameras without a mask in the recording."""
    masks = dict(frame.masks or {})
    labels = project.get(Key.imported_labels())
    for camera in scene.cameras:
        layer = None if camera.name in masks else project.get(Key.imported_mask(frame.index, camera.name))
        if layer is not None:
            masks[camera.name] = layer.mask() & ~ignored_labels(layer, () if labels is None else labels.names)
    return replace(frame, masks=masks or None)


def labelled_keypoints(scene: Scene) -> dict[str, Keypoint]:
    """All keypoints of a scene by label, which contains the arm's name if there are several arms."""
    points = [point for arm in scene.arms for point in keypoints(arm)]
    several = len(scene.arms) > 1
    return {f"{point.arm} {point.name}" if several else point.name: point for point in points}


def keypoints_in_image(
    scene: Scene, state: SceneState, camera: str, points: Mapping[str, Keypoint]
) -> list[tuple[str, float, float]]:
    """Label, column and row of every keypoint that is in or near a camera's image, relative to its size."""
    own = scene.camera(camera)
    found = []
    for label, (u, v) in zip(
        points, project_keypoints(scene, state, list(points.values()), camera).tolist(), strict=True
    ):
        x, y = u / own.width, v / own.height
        if math.isfinite(x) and math.isfinite(y) and -0.2 < x < 1.2 and -0.2 < y < 1.2:
            found.append((label, round(x, 5), round(y, 5)))
    return found
