"""Annotate a sequence in CVAT: an auto-annotation function that predicts a mask per arm.

cvat-cli --server-host URL task auto-annotate TASK \
    --function-file examples/integrations/cvat_function.py -p sequence=str:sequence.toml

Detection matches images with frames by their names. Tracking, `-p kind=str:tracking` with `cvat-cli function
create-native` and `run-agent`, follows the arm that a mask or polygon covers; since CVAT sends no names for it, images
are matched with frames by their content. In both, masks are those of `carts optimize`, from the images of the sequence.
The labels of the task are the names of the arms. Requires `pip install cvat-cli "cvat-sdk[masks]"`.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path

import cv2
import cvat_sdk.auto_annotation as cvataa
import numpy as np
from cvat_sdk.masks import decode_mask, encode_mask
from jaxtyping import Bool, Float
from PIL.Image import Image

from carts_core.errors import CartsError
from carts_core.evaluation import Setup
from carts_core.export.encodings import polygons
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FreeParameters, SurfacePredictor, SurfaceSolver
from carts_core.process import tune_process
from carts_core.recording import Sequence as Recording
from carts_core.recording.annotations import find_frame
from carts_core.recording.annotations.shapes import mask_of_polygon
from carts_core.resources import sample_sequence

Mask = Bool[np.ndarray, "height width"]
Place = tuple[int, str]
"""Index of a frame, and name of a camera."""

_THUMBNAIL = (64, 48)
"""Width and height at which images are compared [px]."""
_SAME = 4.0
"""Root mean square difference of thumbnails up to which an image is a frame; JPEG causes about 1 [grey levels]."""


class Masks:
    """Masks of the arms in the frames of a recording, as `carts optimize` corrects them."""

    def __init__(self, recording: Recording, predictor: FeatureExtractor | SurfacePredictor) -> None:
        self.recording, self._predictor = recording, predictor
        self.arms = [arm.name for arm in recording.scene.arms]
        self._last = lru_cache(maxsize=8)(self._optimized)

    def of(self, place: Place) -> Mapping[str, Mask]:
        """Arm name -> mask in a frame."""
        return self._last(place)

    def check_size(self, image: Image, camera: str) -> None:
        """Raise `CartsError` for an image whose pixels are not those of the camera."""
        recorded = self.recording.recorded_camera(camera)
        if any(recorded.distortion):
            raise CartsError(
                f"Camera {camera!r} has distortion, but masks refer to undistorted images. Undistort them."
            )
        if image.size != (recorded.width, recorded.height):
            raise CartsError(
                f"The image has {image.width} x {image.height} pixels, camera {camera!r} {recorded.width} x "
                f"{recorded.height}. Create the task from images in their original size."
            )

    def _optimized(self, place: Place) -> Mapping[str, Mask]:
        index, camera = place
        solver = self._predictor, SurfaceSolver(), FreeParameters()
        return Setup(self.recording, self.recording.domains[0], (camera,), *solver).arm_masks(index)


class Detection:
    """Detection of the arms in images that are named after frames."""

    def __init__(self, masks: Masks) -> None:
        self._masks = masks
        labels = [cvataa.label_spec(arm, number, type="mask") for number, arm in enumerate(masks.arms)]
        self.spec = cvataa.DetectionFunctionSpec(labels=labels)

    def detect(self, context: cvataa.DetectionFunctionContext, image: Image) -> list[cvataa.DetectionAnnotation]:
        """Masks (or polygons, if the context asks for them) of the visible arms; none for other images."""
        place = find_frame(context.frame_name, self._masks.recording)
        if place is None:
            return []
        self._masks.check_size(image, place[1])
        shapes: list[cvataa.DetectionAnnotation] = []
        for number, mask in enumerate(self._masks.of(place).values()):
            if context.conv_mask_to_poly:
                shapes += [cvataa.polygon(number, outline) for outline in _outlines(mask)]
            elif mask.any():
                shapes.append(cvataa.mask(number, encode_mask(mask)))
        return shapes


class Tracking:
    """Tracking of an arm through images that show frames."""

    spec = cvataa.TrackingFunctionSpec(supported_shape_types=["mask", "polygon"])

    def __init__(self, masks: Masks) -> None:
        self._masks = masks

    def preprocess_image(self, context: cvataa.TrackingFunctionContext, image: Image) -> Place | None:
        """Frame and camera of an image; None for other images."""
        places, known = self._thumbnails
        distances = np.sqrt(np.square(known - _thumbnail(np.asarray(image.convert("RGB")))).mean(1))
        nearest = int(distances.argmin())
        if distances[nearest] > _SAME:
            return None
        self._masks.check_size(image, places[nearest][1])
        return places[nearest]

    def init_tracking_state(
        self, context: cvataa.TrackingFunctionShapeContext, pp_image: Place | None, shape: cvataa.TrackableShape
    ) -> str:
        """Name of the arm that the shape covers."""
        if pp_image is None:
            raise CartsError(f"The image is no frame of {self._masks.recording.name}. Choose its sequence.")
        arms = self._masks.of(pp_image)
        drawn = _drawn(shape, next(iter(arms.values())).shape)
        common = {arm: int((mask & drawn).sum()) for arm, mask in arms.items()}
        best = max(common, key=lambda arm: common[arm])
        if not common[best]:
            raise CartsError(f"The shape covers none of the arms {', '.join(arms)}. Draw it on the arm.")
        return best

    def track(
        self, context: cvataa.TrackingFunctionShapeContext, pp_image: Place | None, state: str
    ) -> cvataa.TrackableShape | None:
        """Shape of the arm in an image; None where it is not visible. A polygon is the largest visible part."""
        mask = None if pp_image is None else self._masks.of(pp_image)[state]
        if mask is None or not mask.any():
            return None
        kind = context.original_shape_type
        points = encode_mask(mask) if kind == "mask" else max(_outlines(mask), key=_area)
        return cvataa.TrackableShape(type=kind, points=points)

    @cached_property
    def _thumbnails(self) -> tuple[list[Place], Float[np.ndarray, "images pixels"]]:
        recording = self._masks.recording
        places, thumbnails = [], []
        for index in range(len(recording)):
            for camera, image in recording.frame(index).images.items():
                places.append((index, camera))
                thumbnails.append(_thumbnail(image))
        return places, np.stack(thumbnails)


def _thumbnail(image: np.ndarray) -> Float[np.ndarray, " pixels"]:
    return cv2.resize(image, _THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32).ravel()


def _outlines(mask: Mask) -> list[list[float]]:
    """Polygons of a mask through the centres of its boundary pixels: x and y of each vertex [px]."""
    return [(points + 0.5).ravel().tolist() for points in polygons(mask)]


def _area(outline: list[float]) -> float:
    return cv2.contourArea(np.array(outline, np.float32).reshape(-1, 2))


def _drawn(shape: cvataa.TrackableShape, size: Sequence[int]) -> Mask:
    """Pixels of a shape in an image of a height and width."""
    height, width = size
    if shape.type == "mask":
        return decode_mask(shape.points, image_width=width, image_height=height)
    return mask_of_polygon(np.array(shape.points).reshape(-1, 2), height, width)


def create(sequence: str = "", kind: str = "detection") -> Detection | Tracking:
    """The function; `sequence` is the sequence file, `kind` is detection or tracking."""
    kinds = {"detection": Detection, "tracking": Tracking}
    if kind not in kinds:
        raise CartsError(f"kind is {kind!r}. Choose one of: {', '.join(kinds)}.")
    tune_process()
    recording = Recording.open(Path(sequence) if sequence else sample_sequence(), progress=print)
    return kinds[kind](Masks(recording, FeatureExtractor.load(inference="auto")))
