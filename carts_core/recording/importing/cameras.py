"""Cameras of foreign recordings: which one a name means, and calibrations of ROS, OpenCV, Kalibr and MATLAB."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...decoders.tables import read_matlab
from ...errors import SequenceError
from ...files.decoding import decoded
from ...files.reading import CALIBRATION, VALUES, is_regular, parse_ini, parse_json, parse_yaml, read_text
from ...settings.importing import ImportOptions
from .found import FoundCamera, Note

_MODELS = ("plumb_bob", "rational_polynomial", "radtan", "none", "")
_KINDS = (
    "ROS, OpenCV and Kalibr YAML, JSON with K and distortion, MATLAB .mat, and .ini of the dVRK's stereo calibration"
)


def side_of(name: str) -> str | None:
    """`left` or `right`, where a topic's or folder's name says it."""
    words = re.split(r"[^a-z0-9]+", re.sub(r"([a-z])([A-Z])", r"\1_\2", name).lower())
    for side in ("left", "right"):
        short = (side, f"{side}s", f"{side}img", f"img{side}", f"camera{side[0]}", f"cam{side[0]}", f"l{side}")
        if any(word in short or word.startswith(side) for word in words):
            return side
    endings = {"l": "left", "r": "right"}
    found = [endings[word] for word in words if word in endings]
    return found[-1] if found else None


def camera_from_info(name: str, size: tuple[int, int], images: Path, info: Any, *, rectified: bool) -> FoundCamera:
    """A camera with the calibration of a `sensor_msgs/CameraInfo`, None for one without.

    Args:
        name: of the camera.
        size: of its images [px].
        images: where they lie.
        info: message; its image may be of another size of the same shape.
        rectified: the images are rectified, so that P holds, and no distortion.

    Raises:
        SequenceError: a distortion model that is not OpenCV's pinhole, or another shape of image.
    """
    camera = FoundCamera(name, size, images)
    if info is None:
        return camera
    K = np.array(getattr(info, "k", getattr(info, "K", ())), np.float64).reshape(-1)
    D = np.array(getattr(info, "d", getattr(info, "D", ())), np.float64).reshape(-1)
    P = np.array(getattr(info, "p", getattr(info, "P", ())), np.float64).reshape(-1)
    R = np.array(getattr(info, "r", getattr(info, "R", ())), np.float64).reshape(-1)
    if len(K) != 9 or K[0] <= 0:
        return camera
    if rectified and len(P) == 12 and P[0] > 0:
        K, D = P.reshape(3, 4)[:, :3].reshape(-1), np.empty(0)
    check_model(str(info.distortion_model), f"camera_info of {name}")
    T = np.eye(4)
    if len(P) == 12 and P[0] > 0:
        T[0, 3] = P[3] / P[0]
        if not rectified and len(R) == 9 and np.abs(R).max() > 0:
            T[:3, 3] = R.reshape(3, 3).T @ T[:3, 3]
    found = replace(camera, intrinsics=(K[0], K[4], K[2], K[5]), distortion=tuple(D), T_camera_world=T)
    return scaled(found, (int(info.width), int(info.height)), f"camera_info of {name}")


def check_model(model: str, what: str) -> None:
    """See that a distortion model is OpenCV's pinhole.

    Raises:
        SequenceError: it is another one.
    """
    if model.lower() not in _MODELS:
        raise SequenceError(
            f"{what} has the distortion model {model!r}; allowed are plumb_bob and rational_polynomial (radtan in "
            "Kalibr). Rectify the images, or calibrate them with such a model and give the file with --calibration."
        )


def scaled(camera: FoundCamera, size: tuple[int, int], what: str) -> FoundCamera:
    """The camera whose intrinsics are for images of `size`, for its own images.

    Raises:
        SequenceError: the images have another shape.
    """
    if size == camera.size or min(size) < 1 or camera.intrinsics is None:
        return camera
    x, y = camera.size[0] / size[0], camera.size[1] / size[1]
    if abs(x / y - 1) > 0.01:
        raise SequenceError(
            f"{what} is for images of {size[0]} x {size[1]}, but those of {camera.name} are {camera.size[0]} x "
            f"{camera.size[1]}, which is another shape. Give the right calibration: --calibration {camera.name} FILE."
        )
    fx, fy, cx, cy = camera.intrinsics
    shift = 0.5 - camera.pixel_center
    intrinsics = (fx * x, fy * y, (cx + shift) * x - shift, (cy + shift) * y - shift)
    return replace(camera, intrinsics=intrinsics)


def calibration_of(camera: FoundCamera, options: ImportOptions, notes: list[Note], **changes: Any) -> FoundCamera:
    """The camera with the calibration that a person gave for it, and further changes.

    Raises:
        SequenceError: the file is missing or of an unknown kind.
    """
    camera = replace(camera, **changes)
    path = options.calibration.get(camera.name)
    if path is None:
        if camera.intrinsics is not None:
            notes.append(Note("found", f"calibration of {camera.name}: from the recording."))
        return camera
    notes.append(Note("found", f"calibration of {camera.name}: from {path}."))
    return with_calibration_file(camera, path)


def with_calibration_file(camera: FoundCamera, path: Path) -> FoundCamera:
    """The camera with the intrinsics, distortion and, for the right one of a pair, the extrinsics of a file.

    Raises:
        SequenceError: the file is missing, damaged or of an unknown kind.
    """
    if not is_regular(path):
        raise SequenceError(f"calibration {path} of {camera.name} is missing. Correct the path.")
    try:
        if path.suffix.lower() == ".ini":
            return _from_ini(camera, path)
        if path.suffix.lower() == ".mat":
            return _from_matlab(camera, path)
        content = parse_json(read_text(path, VALUES)) if path.suffix.lower() == ".json" else _yaml(path)
        if not isinstance(content, dict):
            raise TypeError("it holds no named values")
        return _from_names(camera, content, path)
    except (
        OSError,
        UnicodeDecodeError,
        ValueError,
        KeyError,
        TypeError,
        IndexError,
        AttributeError,
    ) as error:
        raise SequenceError(
            f"calibration {path} of {camera.name} cannot be used ({error!r}). Known are: {_KINDS}."
        ) from error


def _yaml(path: Path) -> Any:
    # OpenCV's files begin with a directive that is not YAML, and tag their matrices.
    text = re.sub(r"^%YAML.*$", "", read_text(path, CALIBRATION), flags=re.MULTILINE).replace("!!opencv-matrix", "")
    return parse_yaml(text)


def _from_names(camera: FoundCamera, content: dict[str, Any], path: Path) -> FoundCamera:
    """ROS, OpenCV, Kalibr and our own JSON, by the names of their values."""
    side = side_of(camera.name) or "left"
    kalibr = content.get("cam1" if side == "right" else "cam0")
    if isinstance(kalibr, dict):
        check_model(str(kalibr.get("distortion_model", "")), str(path))
        fx, fy, cx, cy = kalibr["intrinsics"]
        camera = replace(
            camera, intrinsics=(fx, fy, cx, cy), distortion=tuple(kalibr.get("distortion_coeffs", ())), pixel_center=0.0
        )
        if "T_cn_cnm1" in kalibr:
            camera = replace(camera, T_camera_world=np.array(kalibr["T_cn_cnm1"], np.float64).reshape(4, 4))
        resolution = kalibr.get("resolution", camera.size)
        return scaled(camera, (int(resolution[0]), int(resolution[1])), str(path))
    if isinstance(content.get(side), dict):
        content = {**content, **content[side]}
    suffixes = ("", "1" if side == "left" else "2", f"_{side}", "_l" if side == "left" else "_r", f"_{side[0].upper()}")
    K = _first(content, ("camera_matrix", "K", "M", "cameraMatrix", "CameraMatrix"), suffixes)
    if K is None:
        raise KeyError(f"none of camera_matrix, K, M1, cam0 is in it; it has {', '.join(map(str, content))}")
    D = _first(content, ("distortion_coefficients", "distortion", "D", "distCoeffs", "dist_coeffs"), suffixes)
    check_model(str(content.get("distortion_model", "")), str(path))
    matrix = K.reshape(3, 3)
    camera = replace(
        camera,
        intrinsics=(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]),
        distortion=() if D is None else tuple(D.reshape(-1)),
        pixel_center=0.0,
    )
    if side == "right":
        R, T = _first(content, ("R",), ("",)), _first(content, ("T",), ("",))
        P = _first(content, ("projection_matrix",), ("",))
        if R is not None and T is not None and R.size == 9 and T.size == 3:
            camera = replace(camera, T_camera_world=_stereo(R, T))
        elif P is not None and P.size == 12 and P.reshape(3, 4)[0, 0] > 0:
            P = P.reshape(3, 4)
            camera = replace(camera, T_camera_world=_stereo(np.eye(3), np.array([P[0, 3] / P[0, 0], 0, 0])))
    size = (int(content.get("image_width", camera.size[0])), int(content.get("image_height", camera.size[1])))
    return scaled(camera, size, str(path))


def _first(content: dict[str, Any], names: tuple[str, ...], suffixes: tuple[str, ...]) -> np.ndarray | None:
    for name in names:
        for suffix in suffixes:
            value = content.get(name + suffix)
            if isinstance(value, dict):
                value = value.get("data")
            if value is not None:
                return np.array(value, np.float64)
    return None


def _stereo(R: np.ndarray, T: np.ndarray) -> np.ndarray:
    """T_right_left [m] of a rotation and a translation in metres or, where it is longer than a metre, millimetres."""
    result = np.eye(4)
    translation = np.asarray(T, np.float64).reshape(3)
    result[:3, :3] = np.asarray(R, np.float64).reshape(3, 3)
    result[:3, 3] = translation * (1e-3 if np.linalg.norm(translation) > 1.0 else 1.0)
    return result


def _from_ini(camera: FoundCamera, path: Path) -> FoundCamera:
    """The dVRK's stereo calibration from MATLAB: pixels count from 1, lengths are millimetres."""
    parser = parse_ini(read_text(path, CALIBRATION))
    left, right = parser["StereoLeft"], parser["StereoRight"]
    section = right if side_of(camera.name) == "right" else left

    def numbers(key: str, indices: range) -> list[float]:
        return [float(section.get(f"{key}_{index}", "0")) for index in indices]

    k = numbers("kc", range(8))
    camera = replace(
        camera,
        intrinsics=(float(section["fc_x"]), float(section["fc_y"]), float(section["cc_x"]), float(section["cc_y"])),
        distortion=(k[0], k[1], k[2], k[3], k[4]),
    )
    camera = _from_one(camera)
    if section is right:
        T = np.array(numbers("T", range(3))) * 1e-3
        camera = replace(camera, T_camera_world=_stereo(np.array(numbers("R", range(9))), T))
    return scaled(camera, (int(float(section["res_x"])), int(float(section["res_y"]))), str(path))


def _from_matlab(camera: FoundCamera, path: Path) -> FoundCamera:
    """Stereo parameters as a struct of MATLAB: K or IntrinsicMatrix (transposed), radial and tangential distortion."""
    content: Any = decoded(read_matlab, path)
    while len(content) == 1 and isinstance(only := next(iter(content.values())), dict):
        content = only
    right = side_of(camera.name) == "right"
    own = content.get("CameraParameters2" if right else "CameraParameters1", content)
    if "K" in own:
        K = np.asarray(own["K"], np.float64)
    else:
        K = np.asarray(own["IntrinsicMatrix"], np.float64).T
    radial = np.atleast_1d(np.asarray(own.get("RadialDistortion", [0, 0]), np.float64)).tolist() + [0.0] * 3
    tangential = np.atleast_1d(np.asarray(own.get("TangentialDistortion", [0, 0]), np.float64)).tolist()
    camera = replace(
        camera,
        intrinsics=(K[0, 0], K[1, 1], K[0, 2], K[1, 2]),
        distortion=(radial[0], radial[1], tangential[0], tangential[1], radial[2]),
    )
    camera = _from_one(camera)
    if right and "RotationOfCamera2" in content:
        T = np.asarray(content["TranslationOfCamera2"], np.float64) * 1e-3
        camera = replace(camera, T_camera_world=_stereo(np.asarray(content["RotationOfCamera2"]).T, T))
    return camera


def _from_one(camera: FoundCamera) -> FoundCamera:
    """MATLAB counts pixels from 1, OpenCV from 0."""
    assert camera.intrinsics is not None
    fx, fy, cx, cy = camera.intrinsics
    return replace(camera, intrinsics=(fx, fy, cx - 1.0, cy - 1.0), pixel_center=0.0)
