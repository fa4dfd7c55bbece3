"""Cameras: invalid values, undistortion and resizing."""

import cv2
import numpy as np
import pytest

from carts_core.errors import SettingsError
from carts_core.model.camera import Camera, pinhole_intrinsics, rigid_transform

INTRINSICS = (110.0, 115.0, 63.0, 46.0)
BARREL = (-0.3, 0.08, 0.002, -0.001)


def camera(**changes: object) -> Camera:
    values: dict = {"name": "left", "width": 128, "height": 96, "intrinsics": INTRINSICS, "T_camera_world": np.eye(4)}
    return Camera(**{**values, **changes})


def spot_image(u: float, v: float) -> np.ndarray:
    """A bright spot whose centre is at (u, v) [px], pixel centres at +0.5."""
    x, y = np.meshgrid(np.arange(128) + 0.5, np.arange(96) + 0.5)
    return (255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 3.0**2))).astype(np.float32)


def spot_centre(image: np.ndarray) -> np.ndarray:
    x, y = np.meshgrid(np.arange(128) + 0.5, np.arange(96) + 0.5)
    return np.array([(image * x).sum(), (image * y).sum()]) / image.sum()


def distorted_projection(point: np.ndarray) -> np.ndarray:
    """Where a point lands in the recorded image, by OpenCV's model with its own pixel centres, shifted to ours."""
    K_opencv = camera().K
    K_opencv[:2, 2] -= 0.5
    projected, _ = cv2.projectPoints(point[None], np.zeros(3), np.zeros(3), K_opencv, np.array(BARREL))
    return projected.ravel() + 0.5


@pytest.mark.parametrize("point", [(0.0, 0.0, 1.0), (0.3, -0.2, 1.0), (-0.35, 0.25, 1.0)])
def test_an_undistorted_point_is_where_the_pinhole_projects_it(point):
    distorted = camera(distortion=BARREL)
    image = distorted.undistort(spot_image(*distorted_projection(np.array(point))))
    u, v, w = distorted.K @ point
    assert spot_centre(image) == pytest.approx([u / w, v / w], abs=0.15)


def test_without_distortion_an_image_stays_as_it_is():
    image = np.random.default_rng(0).integers(0, 256, (96, 128, 3), dtype=np.uint8)
    assert camera().undistort(image) is image
    assert camera(distortion=(0.0,) * 5).undistort(image) is image


def test_an_image_of_another_size_is_not_undistorted():
    with pytest.raises(SettingsError, match=r"'left' is 128 x 96 but the image is 64 x 48"):
        camera(distortion=BARREL).undistort(np.zeros((48, 64, 3), np.uint8))


def test_a_resized_camera_projects_to_the_same_place_in_the_view():
    small = camera(distortion=BARREL).resized(64, 24)
    point = np.array([0.2, -0.1, 1.0])
    u, v, w = camera().K @ point
    assert (small.K @ point)[:2] == pytest.approx([u / w * 64 / 128, v / w * 24 / 96])
    assert (small.width, small.height, small.distortion) == (64, 24, ())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "the image size is 0 x 96"),
        ({"intrinsics": (0.0, 1.0, 2.0, 3.0)}, "focal lengths .* must be positive"),
        ({"intrinsics": (1.0, -1.0, 2.0, 3.0)}, "focal lengths .* must be positive"),
        ({"intrinsics": (1.0, 1.0, float("nan"), 3.0)}, "four finite numbers"),
        ({"distortion": (0.1, 0.2, 0.3)}, "there are 3 distortion coefficients. Give 0, 4, 5, 8, 12 or 14"),
        (
            {"T_camera_world": np.diag([2.0, 2.0, 2.0, 1.0])},
            "T_camera_world is not rigid: .* deviates from the identity by 3",
        ),
        ({"T_camera_world": np.diag([1.0, 1.0, -1.0, 1.0])}, "T_camera_world is a reflection"),
        ({"T_camera_world": np.eye(3)}, r"T_camera_world has shape \(3, 3\)"),
        ({"T_camera_world": np.eye(4).T + np.eye(4, k=-3)}, "the last row of T_camera_world"),
    ],
)
def test_an_impossible_camera_is_refused(changes, message):
    with pytest.raises(SettingsError, match=message):
        camera(**changes)


def test_a_transform_that_is_not_made_of_numbers_is_refused():
    with pytest.raises(SettingsError, match="T_world_base is not a matrix of numbers"):
        rigid_transform([["a", "b"], ["c"]], "T_world_base")


def test_a_mask_returns_to_the_recorded_image():
    distorted = camera(distortion=BARREL)
    x, y = np.meshgrid(np.arange(128), np.arange(96))
    recorded = np.hypot(x - 80, y - 30) < 15
    returned = distorted.distorted_mask(distorted.undistort(recorded))
    assert (returned != recorded).sum() < 0.03 * recorded.sum()
    assert (distorted.undistort(recorded) != recorded).sum() > 0.06 * recorded.sum()
    assert camera().distorted_mask(recorded) is recorded


def test_the_window_of_a_barrel_reaches_beyond_the_image_and_that_of_a_pincushion_does_not():
    left, top, width, height = camera(distortion=BARREL).recorded_window
    corners = camera(distortion=BARREL).undistort_points(np.array([[0.5, 0.5], [127.5, 95.5]]))
    assert left < -5 and top < -5
    assert (left < corners[0, 0] < left + 2) and (left + width - 2 < corners[1, 0] < left + width)
    assert (top < corners[0, 1] < top + 2) and (top + height - 2 < corners[1, 1] < top + height)
    for plain in (camera(), camera(distortion=(0.3, 0.1, 0.0, 0.0))):
        assert plain.recorded_window == (0, 0, 128, 96)
    _, _, width, height = camera(distortion=(-30.0, 5.0, 0.0, 0.0)).recorded_window
    assert 128 <= width <= 256 and 96 <= height <= 192


def test_a_mask_of_the_window_fills_the_recorded_image_to_its_border():
    distorted = camera(distortion=BARREL)
    _, _, width, height = distorted.recorded_window
    assert distorted.distorted_mask(np.ones((height, width), bool)).all()
    assert not distorted.distorted_mask(np.ones((96, 128), bool))[:, 0].any()
    with pytest.raises(SettingsError, match=rf"the mask is 64 x 48. Give a mask .* `recorded_window`, {width} x"):
        distorted.distorted_mask(np.zeros((48, 64), bool))


@pytest.mark.parametrize("distortion", [BARREL, (-0.45, 0.2, 0.0, 0.0)])
def test_undistorted_points_are_distorted_to_the_same_points(distortion):
    distorted = camera(distortion=distortion, width=640, height=480, intrinsics=(400.0, 400.0, 320.0, 240.0))
    x, y = np.meshgrid(np.linspace(0.0, 640.0, 9), np.linspace(0.0, 480.0, 7))
    points = np.column_stack([x.ravel(), y.ravel()])
    rays = np.column_stack([(distorted.undistort_points(points) - distorted.K[:2, 2]) / 400.0, np.ones(len(points))])
    back, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), distorted.K, np.array(distortion))
    assert np.abs(back[:, 0] - points).max() < 1e-3
    plain = camera()
    assert plain.undistort_points(points) is points


def test_intrinsics_of_both_pixel_conventions_are_converted_to_centres_at_one_half():
    K = np.array([[110.0, 0.0, 63.0], [0.0, 115.0, 46.0], [0.0, 0.0, 1.0]])
    assert pinhole_intrinsics(K, 0.0) == (110.0, 115.0, 63.5, 46.5)
    assert pinhole_intrinsics((110, 115, 63, 46), 0.5) == INTRINSICS
    np.testing.assert_array_equal(camera(intrinsics=pinhole_intrinsics(K, 0.0)).K_opencv, K)
