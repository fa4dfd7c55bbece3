"""Calibrations as used in laboratories: each gives the correct camera, or an error or remark with a remedy."""

import json
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recordings import BagKind, ros_yaml, write_bag
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from carts_core.errors import CartsError
from carts_core.recording.importing.found import FoundRecording
from carts_core.recording.importing.importer import find
from carts_core.settings.interchange import ImportOptions
from carts_viewer.wizard.check import check_form, guess
from carts_viewer.wizard.draft import Draft, changed

SIZE = 640, 480
K = np.array([[700.0, 0, 330], [0, 705, 235], [0, 0, 1]])
D = [-0.2, 0.05, 0.001, -0.002, 0.01]


def imported(folder: Path, files: Mapping[str, Path], size: tuple[int, int] = SIZE, **options: Any) -> FoundRecording:
    """Cameras of these calibrations, with one image each."""
    for name in files:
        (folder / name).mkdir(exist_ok=True)
        cv2.imwrite(str(folder / name / "1.png"), np.zeros((size[1], size[0]), np.uint8))
    chosen = ImportOptions(
        source="folder", images={name: str(folder / name) for name in files}, calibration=dict(files), **options
    )
    return find(folder, chosen)


def said(recording: FoundRecording) -> str:
    return "\n".join(str(note) for note in recording.notes)


def ros(*rectification: np.ndarray | None, more: str = "") -> str:
    return ros_yaml(*rectification, size=SIZE, K=K, D=D, more=more)


def stereo_pair() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """R and T of a pair, and the rectification that OpenCV finds for them."""
    R = Rotation.from_euler("xyz", [0.6, 2.0, -0.8], degrees=True).as_matrix()
    T = np.array([-0.0052, 0.0003, 0.0002])
    found = cv2.stereoRectify(K, np.array(D), K, np.array(D), SIZE, R, T[:, None], flags=cv2.CALIB_ZERO_DISPARITY)
    return R, T, *found[:4]


def rigid(R: np.ndarray, T: np.ndarray) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = R, T
    return result


def test_the_pose_of_the_right_camera_follows_from_the_rectification_of_both(tmp_path: Path) -> None:
    R, T, R1, R2, P1, P2 = stereo_pair()
    (tmp_path / "left.yaml").write_text(ros(R1, P1))
    (tmp_path / "right.yaml").write_text(ros(R2, P2))
    found = imported(tmp_path, {side: tmp_path / f"{side}.yaml" for side in ("left", "right")})
    right = found.cameras[1]
    assert right.T_camera_world is not None and np.allclose(right.T_camera_world, rigid(R, T), atol=1e-9)
    point = np.array([0.01, -0.02, 0.12])
    wanted, _ = cv2.projectPoints(point, R, T, K, np.array(D))
    seen, _ = cv2.projectPoints(point, right.T_camera_world[:3, :3], right.T_camera_world[:3, 3], K, np.array(D))
    assert np.abs(wanted - seen).max() < 1e-6
    assert "right: 5.21 mm from left, rotated by 2.2" in said(found)


@pytest.mark.parametrize("lacking", ["left", "right"])
def test_without_the_rectification_of_one_the_right_camera_stays_free(tmp_path: Path, lacking: str) -> None:
    _, _, R1, R2, P1, P2 = stereo_pair()
    (tmp_path / "left.yaml").write_text(ros(None if lacking == "left" else R1, P1))
    (tmp_path / "right.yaml").write_text(ros(None if lacking == "right" else R2, P2))
    found = imported(tmp_path, {side: tmp_path / f"{side}.yaml" for side in ("left", "right")})
    assert found.cameras[1].T_camera_world is None
    assert f"right: no pose relative to left ({lacking}: no rectification" in said(found)


def test_images_that_are_rectified_use_the_projection(tmp_path: Path) -> None:
    _, T, R1, R2, P1, P2 = stereo_pair()
    (tmp_path / "left.yaml").write_text(ros(R1, P1))
    (tmp_path / "right.yaml").write_text(ros(R2, P2))
    for side in ("left", "right"):
        (tmp_path / f"{side}_rect").mkdir()
        cv2.imwrite(str(tmp_path / f"{side}_rect/1.png"), np.zeros((480, 640), np.uint8))
    sides = ("left", "right")
    options = ImportOptions(
        source="folder",
        images={side: str(tmp_path / f"{side}_rect") for side in sides},
        calibration={side: tmp_path / f"{side}.yaml" for side in sides},
    )
    left, right = find(tmp_path, options).cameras
    assert left.intrinsics == pytest.approx((P1[0, 0], P1[1, 1], P1[0, 2], P1[1, 2])) and not any(left.distortion)
    assert right.T_camera_world is not None
    assert np.allclose(right.T_camera_world, rigid(np.eye(3), np.array([-np.linalg.norm(T), 0, 0])), atol=1e-9)


def test_camera_info_of_bags_is_combined_in_the_same_way(tmp_path: Path) -> None:
    R, T, R1, R2, P1, P2 = stereo_pair()

    def info(values: dict[str, Any]) -> None:
        right = next(values[name] for name in ("P", "p") if name in values)[3] != 0
        own = {"K": K, "D": np.array(D), "R": R2 if right else R1, "P": P2 if right else P1}
        for name, value in own.items():
            values[name if name in values else name.lower()] = value.reshape(-1)
        values.update(width=SIZE[0], height=SIZE[1])

    found = find(write_bag(tmp_path / "bag", BagKind(info=info)))
    right = next(camera for camera in found.cameras if camera.name == "right")
    assert "camera_info of right is for images of 640 x 480; it is scaled to 96 x 72" in said(found)
    assert right.T_camera_world is not None and np.allclose(right.T_camera_world, rigid(R, T), atol=1e-9)


def opencv_xml() -> str:
    def matrix(name: str, values: np.ndarray) -> str:
        rows, columns = values.shape
        data = " ".join(map(str, values.reshape(-1)))
        return (
            f'<{name} type_id="opencv-matrix"><rows>{rows}</rows><cols>{columns}</cols><dt>d</dt><data>{data}</data>'
            f"</{name}>"
        )

    return (
        f'<?xml version="1.0"?><opencv_storage><image_width>640</image_width><image_height>480</image_height>'
        f"{matrix('camera_matrix', K)}{matrix('distortion_coefficients', np.array([D]))}</opencv_storage>"
    )


def opencv_yaml() -> str:
    def matrix(name: str, values: np.ndarray) -> str:
        rows, columns = values.shape
        data = ", ".join(map(str, values.reshape(-1)))
        return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"

    size = "image_width: 640\nimage_height: 480\n"
    return f"%YAML:1.0\n---\n{size}{matrix('camera_matrix', K)}{matrix('distortion_coefficients', np.array([D]))}"


CAMODOCAL = """%YAML:1.0
---
model_type: PINHOLE
camera_name: endoscope
image_width: 640
image_height: 480
distortion_parameters:
   k1: -0.2
   k2: 0.05
   p1: 0.001
   p2: -0.002
projection_parameters:
   fx: 700.
   fy: 705.
   cx: 330.
   cy: 235.
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_model: radtan
  intrinsics: [700, 705, 330, 235]
  distortion_coeffs: [-0.2, 0.05, 0.001, -0.002]
  resolution: [640, 480]
"""
OWN = {"K": K.tolist(), "distortion": D}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("opencv.xml", opencv_xml()),
        ("opencv.yml", opencv_yaml()),
        ("camodocal.yaml", CAMODOCAL),
        ("kalibr.yaml", KALIBR),
        ("ros.yaml", ros()),
        ("own.json", json.dumps(OWN)),
        ("open3d.json", json.dumps({"width": 640, "height": 480, "intrinsic_matrix": K.T.reshape(-1).tolist()})),
        ("transposed.json", json.dumps({**OWN, "K": K.T.tolist()})),
        ("four.json", json.dumps({"fx": 700, "fy": 705, "cx": 330, "cy": 235, "width": 640, "height": 480})),
        ("twice_as_large.json", json.dumps({**OWN, "K": [[1400, 0, 660.5], [0, 1410, 470.5], [0, 0, 1]],
                                            "width": 1280, "height": 960})),
        ("fourteen.json", json.dumps({**OWN, "distortion": [*D, 0.01, 0.02, 0.003, 0, 0, 0, 0, 0, 0]})),
        ("eight.json", json.dumps({**OWN, "distortion": [*D, 0.01, 0.02, 0.003]})),
    ],
)  # fmt: skip
def test_calibrations_of_any_kind_give_the_same_camera(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)
    (camera,) = imported(tmp_path, {"left": tmp_path / name}).cameras
    assert camera.intrinsics == pytest.approx((700, 705, 330, 235)) and camera.pixel_center == 0.0
    if "distortion" in content:
        assert camera.distortion[:4] == pytest.approx(tuple(D[:4]))


def matlab(path: Path, size: tuple[int, int] = SIZE, **changes: Any) -> None:
    own = {
        "K": K + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]]),
        "RadialDistortion": np.array(D[:2]),
        "TangentialDistortion": np.array(D[2:4]),
        "ImageSize": np.array([size[1], size[0]]),
    }
    savemat(path, {"cameraParams": {**own, **changes}})


@pytest.mark.parametrize(
    "write",
    [
        matlab,
        lambda path: savemat(path, {"K": K, "D": np.array(D)}),
        lambda path: savemat(path, {"fc": K[[0, 1], [0, 1]], "cc": K[:2, 2], "kc": np.array(D), "nx": 640, "ny": 480}),
    ],
)
def test_matlab_files_count_pixels_as_their_programs_do(tmp_path: Path, write: Callable[[Path], None]) -> None:
    write(tmp_path / "camera.mat")
    (camera,) = imported(tmp_path, {"left": tmp_path / "camera.mat"}).cameras
    assert camera.intrinsics == pytest.approx((700, 705, 330, 235))


FLAT = dict(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True))


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("flat.json", lambda path: path.write_text(json.dumps({"K": K.tolist(), **FLAT}))),
        ("named.json", lambda path: path.write_text(json.dumps({"K": K.tolist(), "distortion": FLAT}))),
        ("tutorial.yml", lambda path: path.write_text(opencv_yaml().replace("distortion_coefficients", "dist_coeff"))),
        ("Calib_Results.mat", lambda path: savemat(path, {"KK": K, "fc": K[[0, 1], [0, 1]], "cc": K[:2, 2], "kc": D})),
    ],
)
def test_distortion_is_read_under_all_its_names(tmp_path: Path, name: str, write: Callable[[Path], None]) -> None:
    write(tmp_path / name)
    (camera,) = imported(tmp_path, {"left": tmp_path / name}).cameras
    assert camera.distortion == pytest.approx(tuple(D))


def test_a_calibration_without_distortion_is_remarked(tmp_path: Path) -> None:
    (tmp_path / "own.json").write_text(json.dumps({"K": K.tolist()}))
    assert "has no distortion coefficients; none are assumed" in said(
        imported(tmp_path, {"left": tmp_path / "own.json"})
    )


@pytest.mark.parametrize(("unit", "millimetres"), [("m", 1000.0), ("cm", 10.0), ("millimeters", 1.0)])
def test_baselines_of_matlab_have_the_units_of_the_file(tmp_path: Path, unit: str, millimetres: float) -> None:
    own = {"K": K, "RadialDistortion": np.array(D[:2]), "WorldUnits": unit}
    pair = {"CameraParameters1": own, "CameraParameters2": own, "RotationOfCamera2": np.eye(3)}
    T = np.array([-5.0, 0.0, 0.0]) / millimetres
    savemat(tmp_path / "stereo.mat", {"stereoParams": {**pair, "TranslationOfCamera2": T}})
    found = imported(tmp_path, dict.fromkeys(("left", "right"), tmp_path / "stereo.mat"))
    assert found.cameras[1].T_camera_world is not None
    assert found.cameras[1].T_camera_world[:3, 3] == pytest.approx([-0.005, 0, 0])
    assert "5.00 mm from left, given by its calibration" in said(found)


def test_an_unusual_baseline_is_a_warning(tmp_path: Path) -> None:
    pair = {"M1": K.tolist(), "M2": K.tolist(), "D1": D, "D2": D, "R": np.eye(3).tolist(), "T": [-0.5, 0, 0]}
    (tmp_path / "stereo.json").write_text(json.dumps(pair))
    found = imported(tmp_path, dict.fromkeys(("left", "right"), tmp_path / "stereo.json"))
    assert "a baseline of 500 mm is unusual for a stereo endoscope" in said(found)


@pytest.mark.parametrize("names", [("cam0", "cam1"), ("camera1", "camera2"), ("scope_a", "scope_b")])
def test_the_second_of_two_cameras_gets_the_second_calibration(tmp_path: Path, names: tuple[str, str]) -> None:
    pose = "  T_cn_cnm1: [[1, 0, 0, -0.005], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    second = KALIBR.replace("cam0", "cam1").replace("700", "720") + pose
    (tmp_path / "camchain.yaml").write_text(KALIBR + second)
    first, other = imported(tmp_path, dict.fromkeys(names, tmp_path / "camchain.yaml")).cameras
    assert first.intrinsics is not None and other.intrinsics is not None
    assert (first.intrinsics[0], other.intrinsics[0]) == (700, 720) and other.T_camera_world is not None


def test_a_dump_of_camera_info_rectifies_images_that_are_called_rectified(tmp_path: Path) -> None:
    _, _, R1, _, P1, _ = stereo_pair()
    dump = {"K": K.reshape(-1).tolist(), "D": D, "R": R1.reshape(-1).tolist(), "P": P1.reshape(-1).tolist()}
    (tmp_path / "info.json").write_text(json.dumps({**dump, "distortion_model": "plumb_bob"}))
    raw, rectified = imported(tmp_path, dict.fromkeys(("left", "right_rect"), tmp_path / "info.json")).cameras
    assert raw.intrinsics == pytest.approx((700, 705, 330, 235)) and raw.distortion
    assert rectified.intrinsics == pytest.approx(tuple(P1[[0, 1, 0, 1], [0, 1, 2, 2]])) and not rectified.distortion
    (tmp_path / "own.json").write_text(json.dumps(OWN))
    found = imported(tmp_path, {"left_rect": tmp_path / "own.json"})
    assert "indicate rectified images, but" in said(found) and "has no projection matrix P" in said(found)


def test_a_matlab_calibration_of_another_size_is_scaled_and_said_or_refused(tmp_path: Path) -> None:
    matlab(tmp_path / "camera.mat")
    found = imported(tmp_path, {"left": tmp_path / "camera.mat"}, size=(320, 240))
    assert found.cameras[0].intrinsics == pytest.approx((350, 352.5, 164.75, 117.25))
    assert "is for images of 640 x 480; it is scaled to 320 x 240" in said(found)
    with pytest.raises(CartsError, match=r"camera.mat is for images of 640 x 480, but those of left are 310 x 244"):
        imported(tmp_path, {"left": tmp_path / "camera.mat"}, size=(310, 244))


def objects_of_matlab(path: Path) -> None:
    """A file of version 5 with an object, whose content scipy cannot read."""

    def element(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)

    inner = (
        element(6, struct.pack("<II", 9, 0))
        + element(5, struct.pack("<ii", 1, 4))
        + element(1, b"")
        + element(2, b"abcd")
    )
    opaque = (
        element(6, struct.pack("<II", 17, 0))
        + element(1, b"stereoParams")
        + element(1, b"MCOS")
        + element(1, b"stereoParameters")
        + element(14, inner)
    )
    header = b"MATLAB 5.0 MAT-file, Platform: GLNXA64".ljust(124) + struct.pack("<H2s", 0x0100, b"IM")
    path.write_bytes(header + element(14, opaque))


WRONG: list[tuple[str, Any, str]] = [
    ("fisheye.yaml", ros(more="camera_model: fisheye\n"), "camera model 'fisheye'.*Rectify the images"),
    ("equidistant.yaml", ros(more="distortion_model: equidistant\n"), "distortion model 'equidistant'"),
    ("omni.yaml", KALIBR.replace("pinhole", "omni"), "camera model 'omni'"),
    ("mei.yaml", CAMODOCAL.replace("PINHOLE", "MEI"), "camera model 'MEI'"),
    ("opencv_fisheye.yml", opencv_yaml() + "fisheye_model: 1\n", "fisheye"),
    ("lines.yaml", "hello", "it has no named values"),
    ("negative.json", json.dumps({**OWN, "K": [[-700, 0, 330], [0, 705, 235], [0, 0, 1]]}), "-700 and 705 px, which"),
    ("millimetres.json", json.dumps({**OWN, "K": [[4.2, 0, 3.2], [0, 4.2, 2.4], [0, 0, 1]]}), "are in millimetres"),
    (
        "other.json",
        json.dumps({**OWN, "K": [[1400, 0, 660], [0, 1410, 470], [0, 0, 1]]}),
        "outside images of 640 x 480",
    ),
    ("aspect.json", json.dumps({**OWN, "K": [[700, 0, 330], [0, 350, 235], [0, 0, 1]]}), "differ by 100%"),
    ("cropped.json", json.dumps({**OWN, "width": 1280, "height": 720}), "which have another aspect ratio"),
    ("three.json", json.dumps({**OWN, "distortion": [1, 2, 3]}), "3 distortion coefficients; allowed: 0, 4, 5"),
    ("count.json", json.dumps({**OWN, "K": [700, 0, 330, 0, 705]}), "camera matrix has 5 numbers; 9 numbers, or fx"),
    ("nan.yaml", "K: [700, 0, 330, 0, .nan, 235, 0, 0, 1]\ndistortion: []\n", "a number that is not finite"),
    ("skew.json", json.dumps({**OWN, "K": [[700, 30, 330], [0, 705, 235], [0, 0, 1]]}), "a skew of 30"),
    ("folds.json", json.dumps({**OWN, "distortion": [-2.5, 0.1, 0, 0]}), "is not one-to-one"),
    ("objects.mat", objects_of_matlab, r"before saving: s = toStruct\(stereoParams\)"),
    ("new.mat", b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(600, b"\0"), "-v7"),
    ("pointer.yaml", "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12\n", "git lfs pull"),
]


@pytest.mark.parametrize(("name", "content", "message"), WRONG, ids=[name for name, _, _ in WRONG])
def test_impossible_calibrations_are_refused(tmp_path: Path, name: str, content: Any, message: str) -> None:
    path = tmp_path / name
    if callable(content):
        content(path)
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(CartsError, match=message) as error:
        imported(tmp_path, {"left": path})
    assert str(path) in str(error.value) or "--calibration left" in str(error.value)
    assert not any(word in str(error.value) for word in ("Error(", "array(", "dtype"))


def test_the_size_of_the_calibrated_images_answers_what_a_file_does_not_state(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"K": [[1400, 0, 660.5], [0, 1410, 470.5], [0, 0, 1]]}))
    found = imported(tmp_path, {"left": path}, calibration_size={"left": "1280x960"})
    assert found.cameras[0].intrinsics == pytest.approx((700, 705, 330, 235))
    as_it_is = imported(tmp_path, {"left": path}, calibration_size={"left": "640x480"})
    assert as_it_is.cameras[0].intrinsics == pytest.approx((1400, 1410, 660.5, 470.5))
    assert "outside images of 640 x 480" in said(as_it_is)
    with pytest.raises(CartsError, match="give width and height, such as 640x480"):
        ImportOptions(calibration_size={"left": "large"})


@pytest.mark.parametrize(
    ("R", "T", "message"),
    [
        (np.eye(3), [-4.8, 0.1, 0], "translation of 4.801 is assumed to be in millimetres"),
        (np.eye(3), [0.0048, 0, 0], "swapped, or the calibration is the inverse"),
    ],
)
def test_millimetres_and_swapped_sides_are_said(tmp_path: Path, R: np.ndarray, T: list[float], message: str) -> None:
    path = tmp_path / "stereo.json"
    path.write_text(json.dumps({"K1": K.tolist(), "K2": K.tolist(), "R": R.tolist(), "T": T}))
    found = imported(tmp_path, {"left": path, "right": path})
    T_right_left = found.cameras[1].T_camera_world
    assert T_right_left is not None and abs(T_right_left[0, 3]) == pytest.approx(0.0048)
    assert message in said(found)


def test_the_calibration_of_the_other_camera_is_said(tmp_path: Path) -> None:
    (tmp_path / "right.yaml").write_text(ros())
    assert "right.yaml has the name of the other camera" in said(imported(tmp_path, {"left": tmp_path / "right.yaml"}))


def test_new_recording_asks_for_the_size_of_the_calibrated_images(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"K": [[1400, 0, 660.5], [0, 1410, 470.5], [0, 0, 1]]}))
    (tmp_path / "left").mkdir()
    cv2.imwrite(str(tmp_path / "left/1.png"), np.zeros((480, 640), np.uint8))
    draft = Draft(source=str(tmp_path / "left")).with_options(calibration={"camera": path})
    found = guess(draft)
    assert "--" not in found.problems["calibration", "camera"] and found.recording is None
    assert "calibration_size camera" in check_form(draft, found, {})
    answered = changed(draft, "calibration_size camera", "1280 × 960", {})
    assert answered is not None
    recording = guess(answered).recording
    assert recording is not None and recording.cameras[0].intrinsics == pytest.approx((700, 705, 330, 235))


@pytest.mark.parametrize(("distortion", "warned"), [([-0.05, 0.06, -0.09, 0.03], True), (D[:4], False), (D, False)])
def test_coefficients_that_may_be_those_of_a_fisheye_lens_are_a_warning(
    tmp_path: Path, distortion: list[float], warned: bool
) -> None:
    (tmp_path / "fisheye.json").write_text(json.dumps({"K": K.tolist(), "D": distortion}))
    found = imported(tmp_path, {"left": tmp_path / "fisheye.json"})
    warnings = [str(note) for note in found.notes if note.kind == "warning" and "Is it a fisheye" in str(note)]
    assert len(warnings) == warned
    assert not warned or "p1 = -0.09, p2 = 0.03" in warnings[0]
