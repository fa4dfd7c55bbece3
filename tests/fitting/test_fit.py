"""`carts_core.fit`: one call from an image to a mask, joint positions and a verdict."""

import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pytest
from tiny import recorded_mask, tiny_images, tiny_scene

import carts_core as carts
from carts_core.errors import CartsError, RobotError, SequenceError, SettingsError
from carts_core.evaluation import dice
from carts_core.export import mask_png
from carts_core.model.robot import Robot
from carts_core.optimization import Verdict
from carts_core.recording import Sequence
from carts_core.rendering import Renderer

WIDTH, HEIGHT = 128, 96
UNKNOWN_CENTER = "exactly half the image size"
CENTER = {"pixel_center": 0.5}


@pytest.fixture(autouse=True)
def _warnings_are_errors() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        yield


@pytest.fixture(scope="module")
def tiny(shipped_psm: Robot) -> dict[str, Any]:
    """Arguments of `fit`: an image of a tiny scene with its mask, and intrinsics in OpenCV's convention."""
    scene = tiny_scene(shipped_psm, 1, ("left",), WIDTH, HEIGHT)
    (view,) = tiny_images(shipped_psm, 1, ("left",), WIDTH, HEIGHT)
    return {
        "image": np.rint(255 * view.image).astype(np.uint8),
        "K": scene.scene.cameras[0].K_opencv,
        "T_camera_base": scene.scene.cameras[0].T_camera_world,
        "urdf": shipped_psm,
        "joints": scene.measured[0],
        "mask": view.mask,
    }


def fitted_with(tiny: dict[str, Any], **changes: Any) -> carts.Fit:
    return carts.fit(**{**tiny, **changes})


@pytest.fixture(scope="module")
def fitted(tiny: dict[str, Any]) -> carts.Fit:
    return carts.fit(**tiny)


def test_importing_the_package_loads_neither_torch_nor_numpy() -> None:
    check = "import carts_core as carts, sys; assert {'fit', 'open'} <= set(dir(carts)); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True).stdout.split()
    assert "carts_core" in loaded and not {"torch", "numpy", "cv2"} & set(loaded)


def test_an_unknown_name_of_the_package_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'fits'"):
        carts.fits  # type: ignore[attr-defined]  # noqa: B018


def test_the_joints_are_corrected_and_the_mask_fits(
    fitted: carts.Fit, tiny: dict[str, Any], shipped_psm: Robot
) -> None:
    truth = tiny_scene(shipped_psm, 1, ("left",), WIDTH, HEIGHT).truth[0]
    insertion = shipped_psm.joint_index("insertion")
    assert fitted.mask.dtype == bool and fitted.mask.shape == (HEIGHT, WIDTH)
    assert dice(fitted.mask, tiny["mask"]) > 0.97 > dice(fitted.measured_mask, tiny["mask"])
    assert abs(fitted.joints - truth)[insertion] < abs(tiny["joints"] - truth)[insertion]
    assert fitted.verdict == "good" and fitted.verdict is Verdict.GOOD and fitted.reason
    assert np.array_equal(fitted.measured_joints, tiny["joints"])
    assert fitted.std.shape == fitted.joints.shape and (fitted.std > 0).all()
    np.testing.assert_allclose(fitted.T_camera_base, tiny["T_camera_base"], atol=1e-6)
    assert np.array_equal(fitted.arm_masks["arm"], fitted.mask)


def test_the_rows_name_joints_units_and_deviations(fitted: carts.Fit, shipped_psm: Robot) -> None:
    rows = fitted.rows()
    assert [row.joint for row in rows] == list(shipped_psm.joint_names)
    assert {row.joint: row.unit for row in rows} | {"insertion": "m", "yaw": "rad"} == {
        row.joint: row.unit for row in rows
    }
    np.testing.assert_array_equal([row.corrected for row in rows], fitted.joints)
    undetermined = [f"arm.{row.joint}" for row in rows if row.determined is False]
    assert undetermined == fitted.undetermined and len(undetermined) < len(rows)


# --- Pixels ---


def shift_between(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Translation of a mask [px], in x and y, by least squares on the gradient of the blurred masks."""
    first, second = (cv2.GaussianBlur(mask.astype(np.float64), (0, 0), 2.0) for mask in (before, after))
    inner = np.s_[8:-8, 8:-8]
    gradient = [part[inner].ravel() for part in reversed(np.gradient((first + second) / 2))]
    return np.linalg.lstsq(-np.stack(gradient, 1), (second - first)[inner].ravel(), rcond=None)[0]


def test_the_other_pixel_convention_is_half_a_pixel_away(tiny: dict[str, Any]) -> None:
    (fx, _, cx), (_, fy, cy), _ = tiny["K"]
    opencv, explicit, other = (fitted_with(tiny, **options) for options in ({}, {"pixel_center": 0}, CENTER))
    assert opencv.camera.intrinsics == explicit.camera.intrinsics == (fx, fy, cx + 0.5, cy + 0.5)
    assert other.camera.intrinsics == (fx, fy, cx, cy)
    shift = shift_between(other.measured_mask, opencv.measured_mask)
    np.testing.assert_allclose(shift, [0.5, 0.5], atol=0.25)


def test_points_projected_by_opencv_lie_in_the_middle_of_the_mask(tiny: dict[str, Any], fitted: carts.Fit) -> None:
    camera = fitted.camera
    np.testing.assert_allclose(camera.K_opencv, tiny["K"])
    renderer = Renderer(fitted.scene)
    (row, *_), (column, *_) = np.nonzero(fitted.measured_mask)
    faces, inverse_depth = renderer.visibility(fitted.start)
    depth = 1 / float(inverse_depth[0, row, column])
    assert faces[0, row, column] >= 0
    # The centre of the pixel (column, row), by the internal convention, is the integer pixel of OpenCV.
    fx, fy, cx, cy = camera.intrinsics
    point = depth * np.array([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1.0])
    projected = cv2.projectPoints(point[None], np.zeros(3), np.zeros(3), tiny["K"], np.zeros(4))[0].ravel()
    np.testing.assert_allclose(projected, [column, row], atol=1e-6)


def test_four_numbers_and_a_camera_give_the_same_as_a_matrix(tiny: dict[str, Any], fitted: carts.Fit) -> None:
    fx, fy, cx, cy = tiny["K"][(0, 1, 0, 1), (0, 1, 2, 2)]
    for K in ((fx, fy, cx, cy), fitted.camera):
        assert fitted_with(tiny, K=K).camera.intrinsics == fitted.camera.intrinsics


def test_a_principal_point_of_the_other_convention_warns_unless_the_convention_is_given(
    tiny: dict[str, Any], fitted: carts.Fit
) -> None:
    K = fitted.camera.K  # With pixel centres at 0.5.
    with pytest.warns(UserWarning, match=UNKNOWN_CENTER) as caught:
        found = fitted_with(tiny, K=K)
    assert caught[0].filename == __file__
    assert UNKNOWN_CENTER in found.remarks[0] and UNKNOWN_CENTER in found._repr_html_()
    assert fitted_with(tiny, K=K, pixel_center=0.5).camera.intrinsics == fitted.camera.intrinsics


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"pixel_center": 1}, r"pixel_center is 1\. Give 0 .* or 0\.5"),
        ({"K": np.eye(4)}, r"of shape \(4, 4\). Give 3 rows of 3 finite numbers, or fx, fy, cx, cy"),
        ({"K": [[150, 0, 0], [0, 150, 0], [64, 48, 1]]}, "without skew and not transposed"),
        ({"K": [150, 150, np.nan, 48]}, "finite"),
        ({"K": "K.yaml"}, "Give 3 rows of 3 numbers, or fx"),
        ({"K": [-150, 150, 64, 48]}, "must be positive"),
        ({"distortion": [0.1]}, "Give 0, 4, 5, 8, 12 or 14"),
        ({"distortion": ["a"]}, "Give OpenCV's coefficients"),
    ],
)
def test_wrong_intrinsics_are_refused(tiny: dict[str, Any], changed: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        fitted_with(tiny, **changed)


def test_a_camera_has_its_own_size_and_convention(tiny: dict[str, Any], fitted: carts.Fit) -> None:
    with pytest.raises(SettingsError, match="Leave out pixel_center"):
        fitted_with(tiny, K=fitted.camera, pixel_center=0)
    with pytest.raises(SettingsError, match=r"has 64 x 48 pixels, but the image has 128 x 96"):
        fitted_with(tiny, K=fitted.camera.resized(64, 48))


def test_with_distortion_the_mask_belongs_to_the_given_image_to_its_border(
    tiny: dict[str, Any], fitted: carts.Fit, shipped_psm: Robot
) -> None:
    distortion = (-0.25, 0.05, 0.0, 0.0)
    known = tiny_scene(shipped_psm, 1, ("left",), WIDTH, HEIGHT)
    recorded = replace(known.scene.cameras[0], distortion=distortion)
    mask = recorded_mask(known.scene, known.scene.state({"PSM1": known.truth[0]}), recorded)
    found = fitted_with(tiny, mask=mask, distortion=distortion)
    assert dice(found.mask, mask) > 0.998 and dice(recorded.distorted_mask(tiny["mask"]), mask) < 0.992
    assert found.camera.distortion == distortion and found.scene.cameras[0].distortion == ()


# --- Images and masks ---


def test_images_and_masks_may_be_files(tiny: dict[str, Any], fitted: carts.Fit, tmp_path: Path) -> None:
    image, mask = tmp_path / "image.png", tmp_path / "mask.png"
    cv2.imwrite(str(image), tiny["image"][..., ::-1])
    mask.write_bytes(mask_png(tiny["mask"]))
    found = fitted_with(tiny, image=str(image), mask=mask)
    assert np.array_equal(found.image, tiny["image"]) and np.array_equal(found.joints, fitted.joints)


def test_the_image_is_copied(tiny: dict[str, Any]) -> None:
    image = tiny["image"].copy()
    found = fitted_with(tiny, image=image)
    image[:] = 0
    assert np.array_equal(found.image, tiny["image"])


GREY = np.zeros((HEIGHT, WIDTH), np.uint8)


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        ({"image": GREY}, SettingsError, "Repeat a grey image"),
        ({"image": np.zeros((HEIGHT, WIDTH, 3))}, SettingsError, r"\(255 \* image\)"),
        ({"image": np.zeros((3, HEIGHT, WIDTH), np.uint8)}, SettingsError, r"transpose\(1, 2, 0\)"),
        ({"image": np.zeros((HEIGHT, WIDTH, 4), np.uint8)}, SettingsError, r"image\[\.\.\., :3\]"),
        ({"image": None}, SettingsError, "the image is None. Give an array or a path"),
        ({"image": np.zeros((0, 0, 3), np.uint8)}, SettingsError, "the image is 0 x 0 pixels"),
        ({"image": "missing.png"}, SequenceError, r"image missing\.png is missing"),
        ({"mask": GREY[:-1]}, SettingsError, "the mask has 128 x 95 pixels, but the image has 128 x 96"),
        ({"mask": GREY.astype(float)}, SettingsError, "the mask is an array of type float64"),
        ({"mask": np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)}, SettingsError, "convert a label image"),
        ({"background": GREY}, SettingsError, "the background is an array"),
        ({"ignore": GREY[:, :5]}, SettingsError, "the mask to ignore has 5 x 96 pixels"),
    ],
)
def test_wrong_images_and_masks_are_refused(
    tiny: dict[str, Any], changed: dict[str, Any], error: type[CartsError], message: str
) -> None:
    with pytest.raises(error, match=message):
        fitted_with(tiny, **changed)


# --- Arms ---


def test_joints_by_name_come_back_by_name(tiny: dict[str, Any], fitted: carts.Fit, shipped_psm: Robot) -> None:
    named = dict(reversed(list(zip(shipped_psm.joint_names, tiny["joints"], strict=True))))
    found = fitted_with(tiny, joints=named, urdf=shipped_psm.urdf)
    assert found.joints == dict(zip(shipped_psm.joint_names, fitted.joints, strict=True))
    assert found.std.keys() == found.measured_joints.keys() == named.keys()


def test_several_arms_are_mappings_by_arm(tiny: dict[str, Any]) -> None:
    beside = np.array(tiny["T_camera_base"])
    beside[0, 3] += 0.01
    both = {"T_camera_base": {"a": tiny["T_camera_base"], "b": beside}, "joints": dict.fromkeys("ab", tiny["joints"])}
    found = fitted_with(tiny, **both, urdf="builtin:psm_lnd")
    assert list(found.joints) == list(found.std) == list(found.T_camera_base) == ["a", "b"]
    assert found.joints["a"].shape == tiny["joints"].shape
    assert not (found.arm_masks["a"] & found.arm_masks["b"]).any()
    assert np.array_equal(found.arm_masks["a"] | found.arm_masks["b"], found.mask)
    assert {row.arm for row in found.rows()} == {"a", "b"} and "<th>arm</th>" in found._repr_html_()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"joints": [0.0] * 6}, r"joints: an array of shape \[6\] was given, but .* has 7 degrees of freedom.*yaw"),
        ({"joints": [0, 0, 0.15, 0, 0, 0, np.inf]}, "joints: the position of jaw is not finite"),
        ({"joints": ["a"] * 7}, "are not numbers. Give radians and metres"),
        ({"joints": {"yaww": 0.0}}, r"joints: there is no joint 'yaww'\. Did you mean 'yaw'\?"),
        ({"joints": {"yaw": 0.0}}, "joints: pitch, insertion, .* is missing"),
        ({"urdf": "missing.urdf"}, r"missing\.urdf is missing"),
        ({"urdf": 3}, "urdf is 3. Give the path of a URDF"),
        ({"urdf": {"a": "arm.urdf"}}, "urdf is a mapping, but T_camera_base is a single transform"),
        ({"T_camera_base": {}}, "has the keys none"),
        ({"T_camera_base": np.eye(3)}, r"T_camera_base has shape \(3, 3\)"),
        ({"T_camera_base": {"a": np.eye(4)}}, "joints is a ndarray, but T_camera_base has the arms a"),
        ({"T_camera_base": {"a": np.eye(4)}, "joints": {"b": [0] * 7}}, "joints has the keys 'b', but .* the arms a"),
        ({"T_camera_base": 2 * np.eye(4)}, "T_camera_base is not rigid"),
    ],
)
def test_wrong_arms_are_refused(tiny: dict[str, Any], changed: dict[str, Any], message: str) -> None:
    with pytest.raises((SettingsError, RobotError), match=message):
        fitted_with(tiny, **changed)


def test_degrees_and_millimetres_are_recognized_by_the_limits(tiny: dict[str, Any]) -> None:
    with pytest.warns(UserWarning) as caught:
        fitted_with(tiny, joints=tiny["joints"] * 1000)
    texts = [str(warning.message) for warning in caught]
    assert any("joints: insertion is" in text and "if they are millimetres, divide" in text for text in texts) or any(
        "if they are degrees, convert them with np.radians" in text for text in texts
    )


def test_an_arm_out_of_view_is_a_failed_fit_with_a_hint_at_the_inverse(tiny: dict[str, Any]) -> None:
    with pytest.warns(UserWarning, match=r"no arm is in view.*T_base_camera may have been given"):
        found = fitted_with(tiny, T_camera_base=np.linalg.inv(tiny["T_camera_base"]))
    assert found.verdict == "failed" and "T_camera_base" in found.remedy
    np.testing.assert_allclose(found.joints, tiny["joints"], atol=1e-6)


# --- Display ---


class Tags(HTMLParser):
    """Names of the elements of a text, and of those that are not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.seen: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append(tag)
        self.open += [] if tag == "img" else [tag]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_a_fit_is_shown_as_overlay_and_table(fitted: carts.Fit, shipped_psm: Robot) -> None:
    text = fitted._repr_html_()
    tags = Tags(text)
    assert not tags.open and tags.seen.count("tr") == 1 + len(shipped_psm.joint_names)
    assert 'src="data:image/jpeg;base64,' in text and "mask good" in text and fitted.reason in text
    assert all(f"<td>{joint}</td>" in text for joint in shipped_psm.joint_names)


def test_names_cannot_add_markup(tiny: dict[str, Any]) -> None:
    name = "<script>alert(1)</script>"
    arms = {"T_camera_base": {name: tiny["T_camera_base"]}, "joints": {name: tiny["joints"]}}
    text = fitted_with(tiny, **arms)._repr_html_()
    assert "script" not in Tags(text).seen and "&lt;script&gt;" in text


def test_a_repr_is_one_short_line(fitted: carts.Fit) -> None:
    assert repr(fitted).startswith("Fit(mask good, ") and "128 x 96 px" in repr(fitted)
    for item in (fitted, fitted.result, fitted.scene, fitted.camera, fitted.start):
        assert "\n" not in repr(item) and len(repr(item)) < 2500 and "tensor(" not in repr(item)


def test_the_overlay_has_both_outlines_and_leaves_the_image(fitted: carts.Fit, tiny: dict[str, Any]) -> None:
    drawn = fitted.overlay()
    colours = {tuple(colour) for colour in drawn.reshape(-1, 3).tolist()}
    assert {(255, 170, 40), (80, 255, 120)} <= colours
    assert np.array_equal(fitted.image, tiny["image"])


def test_a_plot_draws_the_outlines_on_given_axes(fitted: carts.Fit, monkeypatch: pytest.MonkeyPatch) -> None:
    figure, ax = plt.subplots()
    try:
        assert fitted.plot(ax) is ax
        legend = ax.get_legend()
        assert legend is not None and [text.get_text() for text in legend.get_texts()] == ["measured", "corrected"]
        corrected = np.concatenate([path.vertices for path in ax.collections[1].get_paths()])
        rows, columns = np.nonzero(fitted.mask)
        # Axes of OpenCV's convention: the outline is half a pixel outside of the centres of the outermost pixels.
        inner = corrected[(corrected > 0.5).all(1) & (corrected < [WIDTH - 1.5, HEIGHT - 1.5]).all(1)]
        assert rows.min() - 0.5 <= inner[:, 1].min() and columns.max() + 0.5 >= inner[:, 0].max()
    finally:
        plt.close(figure)


# --- Recordings ---


def test_a_recording_opens_and_its_frame_is_fitted(shared_sequence: Callable[..., Path]) -> None:
    sequence = carts.open(shared_sequence())
    assert isinstance(sequence, Sequence)
    frame = sequence.frame(1)
    assert frame.masks is not None and frame.truth is not None
    found = carts.fit_frame(sequence, 1, mask=frame.masks["left"])
    assert found.verdict == "good" and dice(found.mask, frame.masks["left"]) > 0.96
    assert np.array_equal(found.measured_joints["PSM1"], frame.measured["PSM1"])
    text = sequence._repr_html_()
    assert not Tags(text).open and "tiny: 3 frames" in text and "data:image/jpeg" in text
    assert "<td>PSM1</td>" in text and "96 x 72 px, with masks" in text
    with pytest.raises(SequenceError, match="no camera 'right'"):
        carts.fit_frame(sequence, camera="right")


def test_a_recording_with_a_damaged_image_is_shown_without_a_picture(tiny_sequence: Callable[..., Path]) -> None:
    path = tiny_sequence()
    (path.parent / "regular" / "left" / "001.png").write_bytes(b"")
    text = carts.open(path)._repr_html_()
    assert "data:image" not in text and "is damaged" in text and "<table>" in text


@pytest.mark.slow
def test_the_network_and_a_background_give_the_result_of_the_frame_optimizer(sample_sequence_path: Path) -> None:
    sequence = carts.open(sample_sequence_path)
    camera, frame = sequence.scene.cameras[0], sequence.frame(0)
    arms = {arm.name: camera.T_camera_world @ arm.T_world_base for arm in sequence.scene.arms}
    found = carts.fit(
        frame.images["left"],
        K=[560, 560, 319.5, 239.5],
        T_camera_base=arms,
        urdf="builtin:psm_lnd",
        joints=frame.measured,
        background=sequence.background("left"),
    )
    assert frame.masks is not None
    assert found.verdict == "good" and dice(found.mask, frame.masks["left"]) > 0.95
    assert not found.remarks
