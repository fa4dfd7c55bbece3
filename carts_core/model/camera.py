"""Pinhole camera: pose, projection, and undistortion of images."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from ..errors import SettingsError
from ..files.reading import pixels_problem
from ..reprs import short_repr
from ..wording import shown

HALF_PIXEL = 0.5
"""Offset of pixel centres: +0.5 here and 0 in OpenCV, so OpenCV's principal point is smaller by this offset [px]."""

PIXEL_CENTERS = (0.0, HALF_PIXEL)
"""Coordinates of the centre of the first pixel in the two conventions: OpenCV's and the one used here [px]."""

DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)
"""Numbers of coefficients of OpenCV's distortion models."""

RIGID_TOLERANCE = 1e-3
"""Maximum deviation of R^T R from the identity, per element [1]."""
EXACT = 1e-9
"""Deviation of R^T R from the identity [1] below which rotations are not changed; other matrices are projected onto
SO(3)."""
LAST_ROW_TOLERANCE = 1e-6
"""Maximum deviation of the last row from 0, 0, 0, 1, which allows for matrices in single precision [1]."""

T_DVRK_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Transform from OpenCV's camera frame (x right, y down) to the dVRK's camera frame (x left, y up); its own inverse."""

FOCAL_RANGE = 0.3, 20.0
"""Plausible focal lengths, relative to the image's longer side [1]: fields of view from 118 to 3 degrees."""
CENTRE_RANGE = 0.25, 0.75
"""Plausible principal points, relative to the width and height of the image [1]."""
SQUARE_RANGE = 0.9, 1.1
"""Plausible ratios fx / fy [1]; pixels are nearly square."""

UNDISTORTION = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-9)
"""Termination criteria for the undistortion of points: iterations and residual [px]. The default of OpenCV, 5
iterations, leaves several pixels in the corners of images with strong distortion."""

FARTHEST = 1e6
"""Maximum coordinate of a transform [m], focal length and principal point [px]."""


def rigid_transform(value: ArrayLike, what: str) -> Float[np.ndarray, "4 4"]:
    """Convert `value` to a rigid transform in double precision; rounding noise is removed.

    Args:
        value: 4x4 matrix, translation in [m].

    Raises:
        SettingsError: `value` is not 4x4, not finite, or not a rotation with a translation.
    """
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SettingsError(f"{what} is not a matrix of numbers. Give 4 rows of 4 numbers.") from error
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise SettingsError(f"{what} has shape {matrix.shape}. Give 4 rows of 4 finite numbers.")
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not deviation <= RIGID_TOLERANCE:
        raise SettingsError(
            f"{what} is not rigid: R^T R deviates from the identity by {deviation:.2g} (limit {RIGID_TOLERANCE:g}). "
            "Its upper left 3x3 block must be a rotation without scale, given with at least 5 digits."
        )
    if np.linalg.det(rotation) < 0:
        raise SettingsError(
            f"{what} is a reflection: the determinant of its rotation is -1, but must be +1. "
            "Check the axes: camera x right, y down, z forward."
        )
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > LAST_ROW_TOLERANCE:
        raise SettingsError(f"the last row of {what} is {matrix[3].tolist()}, but must be [0, 0, 0, 1].")
    if np.abs(matrix[:3, 3]).max() > FARTHEST:
        raise SettingsError(f"the translation of {what} is {matrix[:3, 3].tolist()}. Give it in metres.")
    matrix[3] = (0, 0, 0, 1)
    if deviation > EXACT:
        # The nearest rotation, by singular value decomposition.
        left, _, right = np.linalg.svd(rotation)
        matrix[:3, :3] = left @ right
    return matrix


def pinhole_intrinsics(K: ArrayLike, pixel_center: float, what: str = "K") -> tuple[float, float, float, float]:
    """Convert an intrinsic matrix to fx, fy, cx, cy [px] with pixel centres at +0.5.

    Args:
        K: intrinsic matrix [3, 3], or fx, fy, cx, cy, in [px].
        pixel_center: coordinate of the centre of the first pixel in the convention of `K`: 0 for pixel centres at
            integers (OpenCV, ROS, MATLAB minus 1), 0.5 for an image that spans [0, width] (COLMAP, OpenGL).

    Raises:
        SettingsError: `K` has neither form, is not finite, has skew or is transposed, or `pixel_center` is another
            number.
    """
    if pixel_center not in PIXEL_CENTERS:
        raise SettingsError(
            f"pixel_center is {pixel_center!r}. Give 0 if pixel centres are at integers (OpenCV, ROS), or 0.5 if the "
            "centre of the first pixel is at (0.5, 0.5)."
        )
    try:
        given = np.array(K, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SettingsError(f"{what} is {shown(K)}. Give 3 rows of 3 numbers, or fx, fy, cx, cy [px].") from error
    if given.shape not in ((3, 3), (4,)) or not np.isfinite(given).all():
        raise SettingsError(
            f"{what} is {shown(given.tolist())}, of shape {given.shape}. Give 3 rows of 3 finite numbers, or fx, fy, "
            "cx, cy [px]."
        )
    fx, fy, cx, cy = given.tolist() if given.shape == (4,) else given[(0, 1, 0, 1), (0, 1, 2, 2)].tolist()
    if given.shape == (3, 3) and not np.allclose(given, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], atol=1e-6 * abs(fx)):
        raise SettingsError(
            f"{what} is {shown(given.tolist())}, but must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, without "
            "skew and not transposed."
        )
    offset = HALF_PIXEL - pixel_center
    return fx, fy, cx + offset, cy + offset


def implausible_intrinsics(
    width: int, height: int, intrinsics: tuple[float, float, float, float], distortion: tuple[float, ...] = ()
) -> str | None:
    """Description of implausible intrinsics as a phrase that follows "it has"; None for plausible intrinsics.

    Args:
        width, height: image size [px].
        intrinsics: fx, fy, cx, cy [px].
    """
    fx, fy, cx, cy = intrinsics
    size = f"images of {width} x {height} px"
    if min(fx, fy) <= 0:
        return f"focal lengths of {fx:g} and {fy:g} px, which must be positive"
    low, high = (share * max(width, height) for share in FOCAL_RANGE)
    if not (low <= fx <= high and low <= fy <= high):
        unit = "; if they are in millimetres, divide them by the pixel size" if max(fx, fy) < low else ""
        return f"focal lengths of {fx:g} and {fy:g} px for {size}; the usual range is {low:.0f} to {high:.0f}{unit}"
    if not SQUARE_RANGE[0] <= fx / fy <= SQUARE_RANGE[1]:
        return (
            f"focal lengths of {fx:g} and {fy:g} px, which differ by {abs(fx / fy - 1):.0%}; pixels would not be square"
        )
    for what, value, side in (("cx", cx, width), ("cy", cy, height)):
        if not CENTRE_RANGE[0] * side <= value <= CENTRE_RANGE[1] * side:
            place = "outside" if not 0 <= value <= side else "near the edge of"
            return f"the principal point {cx:g}, {cy:g} px, {place} {size} ({what})"
    if distortion and _folds(width, height, intrinsics, distortion):
        return f"distortion {list(distortion)} that is not one-to-one in {size}; the distortion model may be wrong"
    return None


def _folds(
    width: int, height: int, intrinsics: tuple[float, float, float, float], distortion: tuple[float, ...]
) -> bool:
    """Whether radial distortion is not monotonic between the principal point and the farthest image corner."""
    fx, fy, cx, cy = intrinsics
    k = [*distortion, *[0.0] * 8]
    reach = np.hypot(max(cx, width - cx) / fx, max(cy, height - cy) / fy)
    r = np.linspace(0.0, reach, 200)
    numerator = 1 + k[0] * r**2 + k[1] * r**4 + k[4] * r**6
    distorted = r * numerator / (1 + k[5] * r**2 + k[6] * r**4 + k[7] * r**6)
    return bool((np.diff(distorted) <= 0).any())


_MAX_TANGENTIAL = 0.01
"""Magnitude beyond which tangential distortion is unusual [1]."""


def unusual_tangential(distortion: tuple[float, ...]) -> str | None:
    """Description of unusually large tangential distortion as a phrase that follows "it has", with a remedy; None for
    usual coefficients. Fisheye coefficients k1 k2 k3 k4 without the name of their model have such values."""
    p1, p2 = (*distortion, *[0.0] * 4)[2:4]
    if max(abs(p1), abs(p2)) <= _MAX_TANGENTIAL:
        return None
    return (
        f"the unusual tangential distortion p1 = {p1:g}, p2 = {p2:g}. Is it a fisheye calibration (cv2.fisheye: k1 k2 "
        "k3 k4)? That model is not supported: rectify the images, or calibrate with cv2.calibrateCamera (k1 k2 p1 p2)"
    )


# Cameras are compared by identity, since element-wise comparison of arrays has no single truth value.
@dataclass(frozen=True, eq=False)
class Camera:
    """OpenCV pinhole camera (x right, y down, z forward) for undistorted images.

    Raises:
        SettingsError: a size, focal length, transform or the number of distortion coefficients is invalid.
    """

    name: str
    width: int
    """Width of the image [px]."""
    height: int
    """Height of the image [px]."""
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy [px] of the undistorted image, pixel centres at +0.5."""
    T_camera_world: Float[np.ndarray, "4 4"]
    """Extrinsics [m] (C of the paper)."""
    distortion: tuple[float, ...] = ()
    """OpenCV's distortion coefficients k1 k2 p1 p2 [k3 ...] of the recorded image; empty without distortion."""

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise SettingsError(f"the image size is {self.width} x {self.height}. Both must be at least 1 pixel.")
        if (problem := pixels_problem(self.width, self.height)) is not None:
            raise SettingsError(f"the image {problem}. Use smaller images.")
        if len(self.intrinsics) != 4 or not np.isfinite(self.intrinsics).all():
            raise SettingsError(f"the intrinsics are {self.intrinsics}. Give four finite numbers fx, fy, cx, cy [px].")
        if min(self.intrinsics[:2]) <= 0:
            raise SettingsError(
                f"the focal lengths are fx = {self.intrinsics[0]:g}, fy = {self.intrinsics[1]:g}. "
                "Both must be positive, in pixels."
            )
        if max(map(abs, self.intrinsics)) > FARTHEST or min(self.intrinsics[:2]) < 1 / FARTHEST:
            raise SettingsError(
                f"the intrinsics are {self.intrinsics}. Give fx, fy, cx, cy [px] with magnitudes of at most "
                f"{FARTHEST:g}."
            )
        if len(self.distortion) not in DISTORTION_LENGTHS or not np.isfinite(self.distortion).all():
            raise SettingsError(
                f"there are {len(self.distortion)} distortion coefficients. Give 0, 4, 5, 8, 12 or 14 finite numbers, "
                "in OpenCV's order k1 k2 p1 p2 k3 ..."
            )
        object.__setattr__(self, "T_camera_world", rigid_transform(self.T_camera_world, "T_camera_world"))

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """Intrinsic matrix [px], with pixel centres at +0.5; see `K_opencv` for OpenCV's convention."""
        fx, fy, cx, cy = self.intrinsics
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def K_opencv(self) -> Float[np.ndarray, "3 3"]:
        """Intrinsic matrix [px] in OpenCV's convention, with pixel centres at integers."""
        return opencv_matrix(self.intrinsics)

    def undistort(self, image: np.ndarray, interpolation: int = cv2.INTER_LINEAR) -> np.ndarray:
        """Undistort an image [height, width, ...]; unchanged if the camera has no distortion.

        Args:
            image: recorded image, `uint8` or floating point, or mask, `bool` (nearest-neighbour interpolation).

        Raises:
            SettingsError: the size of the image differs from that of the camera.
        """
        if image.shape[:2] != (self.height, self.width):
            raise SettingsError(
                f"camera {self.name!r} is {self.width} x {self.height} but the image is "
                f"{image.shape[1]} x {image.shape[0]}. Undistortion requires images of the camera's size."
            )
        if not any(self.distortion):
            return image
        maps = _undistortion_maps(self.width, self.height, self.intrinsics, self.distortion)
        if image.dtype == bool:
            return cv2.remap(image.astype(np.uint8), *maps, cv2.INTER_NEAREST).astype(bool)
        return cv2.remap(image, *maps, interpolation)

    def undistort_points(self, points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
        """Positions in the undistorted image of points (u, v) of the recorded image [px], pixel centres at +0.5."""
        if not any(self.distortion) or not len(points):
            return points
        return _undistorted(points - HALF_PIXEL, self.intrinsics, self.distortion) + HALF_PIXEL

    @property
    def recorded_window(self) -> tuple[int, int, int, int]:
        """Left, top, width and height [px], in the undistorted image, of the image extended to all that the recorded
        image shows, at most to twice its size; for the `window` of a renderer."""
        if not any(self.distortion):
            return 0, 0, self.width, self.height
        return _distortion_maps(self.width, self.height, self.intrinsics, self.distortion)[0]

    def distorted_mask(self, mask: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "height width"]:
        """Mask of a recorded image; the inverse of `undistort` up to rounding.

        Args:
            mask: mask of the undistorted image, or of its `recorded_window`. With barrel distortion, the border of the
                recorded image shows more than the undistorted image, so only the window covers it.

        Raises:
            SettingsError: the mask has another size.
        """
        if not any(self.distortion):
            return mask
        window, map_x, map_y = _distortion_maps(self.width, self.height, self.intrinsics, self.distortion)
        left, top, width, height = window
        canvas = np.zeros((height, width), np.uint8)
        if mask.shape == (self.height, self.width):
            canvas[-top : self.height - top, -left : self.width - left] = mask
        elif mask.shape == canvas.shape:
            canvas[:] = mask
        else:
            raise SettingsError(
                f"camera {self.name!r} is {self.width} x {self.height} but the mask is {mask.shape[1]} x "
                f"{mask.shape[0]}. Give a mask of the camera's size, or of its `recorded_window`, {width} x {height}."
            )
        return cv2.remap(canvas, map_x, map_y, cv2.INTER_NEAREST).astype(bool)

    def resized(self, width: int, height: int) -> "Camera":
        """Copy of the camera at another image resolution, without distortion."""
        x, y = width / self.width, height / self.height
        fx, fy, cx, cy = self.intrinsics
        # With pixel centres at +0.5 the image spans [0, width], so the principal point scales like the focal length.
        return replace(self, width=width, height=height, intrinsics=(fx * x, fy * y, cx * x, cy * y), distortion=())


@lru_cache(maxsize=8)
def _undistortion_maps(
    width: int, height: int, intrinsics: tuple[float, ...], distortion: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    K = opencv_matrix(intrinsics)
    return cv2.initUndistortRectifyMap(K, np.array(distortion), np.eye(3), K, (width, height), cv2.CV_32FC1)


@lru_cache(maxsize=8)
def _distortion_maps(
    width: int, height: int, intrinsics: tuple[float, ...], distortion: tuple[float, ...]
) -> tuple[tuple[int, int, int, int], np.ndarray, np.ndarray]:
    """`Camera.recorded_window`, and column and row in it of each pixel of a recorded image."""
    rows, columns = np.mgrid[0:height, 0:width]
    pixels = np.stack([columns.ravel(), rows.ravel()], 1).astype(np.float64)
    found = _undistorted(pixels, intrinsics, distortion).reshape(height, width, 2)
    left, right = _margins(found[..., 0], width)
    top, bottom = _margins(found[..., 1], height)
    window = -left, -top, left + width + right, top + height + bottom
    return window, (found[..., 0] + left).astype(np.float32), (found[..., 1] + top).astype(np.float32)


def _margins(positions: Float[np.ndarray, "height width"], size: int) -> tuple[int, int]:
    """Number of pixels before and after an axis of a size [px] that positions on it reach, at most half of the size."""
    finite = positions[np.isfinite(positions)]
    first, last = (finite.min(), finite.max()) if len(finite) else (0, 0)
    before, after = np.clip([-first, last - (size - 1)], 0, size // 2)
    return int(np.ceil(before)), int(np.ceil(after))


def _undistorted(
    points: Float[np.ndarray, "points 2"], intrinsics: tuple[float, ...], distortion: tuple[float, ...]
) -> Float[np.ndarray, "points 2"]:
    """Undistorted positions of points [px], pixel centres at integers."""
    K, values = opencv_matrix(intrinsics), np.array(distortion)
    # OpenCV 5 replaces this function by an argument of `undistortPoints`.
    iterate = getattr(cv2, "undistortPointsIter", None)
    if iterate is not None:
        return iterate(points[:, None], K, values, np.eye(3), K, UNDISTORTION)[:, 0]
    return cv2.undistortPoints(points[:, None], K, values, P=K, criteria=UNDISTORTION)[:, 0]


def opencv_matrix(intrinsics: Iterable[float]) -> Float[np.ndarray, "3 3"]:
    """Intrinsic matrix [px] in OpenCV's convention, from fx, fy, cx, cy [px] with pixel centres at +0.5."""
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0.0, cx - HALF_PIXEL], [0.0, fy, cy - HALF_PIXEL], [0.0, 0.0, 1.0]])
