"""Readers of calibration files: cameras from ROS, OpenCV, Kalibr, camodocal and MATLAB, base frames from the dVRK."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ...decoders.tables import read_matlab
from ...errors import SequenceError, SettingsError
from ...files.decoding import decoded
from ...files.reading import CALIBRATION, VALUES, is_regular, parse_ini, parse_json, parse_xml, parse_yaml, read_text
from ...model.camera import DISTORTION_LENGTHS, T_DVRK_OPENCV, rigid_transform
from ...reprs import short_repr
from ...settings.interchange import Axes
from .found import MALFORMED, PartError, cause, read_json

_MODELS = ("plumb_bob", "rational_polynomial", "radtan", "none", "")
_PINHOLES = ("pinhole", "perspective", "")
_KINDS = (
    "ROS, OpenCV, Kalibr and camodocal YAML, OpenCV XML, JSON with K and distortion, MATLAB .mat, and .ini of the "
    "dVRK's stereo calibration"
)
_MATRICES = ("camera_matrix", "K", "M", "cameraMatrix", "CameraMatrix", "intrinsic_matrix", "intrinsics", "mtx", "KK")
_DISTORTIONS = (
    *("distortion_coefficients", "distortion_coeffs", "distortion", "D", "distCoeffs", "dist_coeffs", "dist"),
    *("dist_coeff", "distCoeff", "distortion_parameters", "kc"),
)
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Names of OpenCV's distortion coefficients, in their order."""
_SIZES = (("image_width", "image_height"), ("width", "height"), ("nx", "ny"), ("res_x", "res_y"))
_PAIRS = ("imageSize", "image_size", "resolution", "img_size")
_WORLD_UNITS = {
    **dict.fromkeys(("mm", "millimeters", "millimetres"), 1e-3),
    **dict.fromkeys(("cm", "centimeters", "centimetres"), 1e-2),
    **dict.fromkeys(("m", "meters", "metres"), 1.0),
    **dict.fromkeys(("in", "inches"), 0.0254),
}
_METRES_TO = 1.0
"""Baseline above which lengths are assumed to be in millimetres [m]."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibration of one camera from a file or message."""

    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy [px]; the first pixel's centre is at 0."""
    distortion: tuple[float, ...] = ()
    """OpenCV's distortion coefficients."""
    size: tuple[int, int] | None = None
    """Width and height of the calibrated images [px]."""
    T_right_left: Float[np.ndarray, "4 4"] | None = None
    """Pose of the left camera in the frame of the right camera [m]; None if not given."""
    R: Float[np.ndarray, "3 3"] | None = None
    """Rectification: rotation from the camera's frame to the common frame of the pair."""
    P: Float[np.ndarray, "3 4"] | None = None
    """Projection of the rectified camera [px]; its last column contains -focal length * baseline [px m]."""
    remarks: tuple[str, ...] = ()
    """Remarks on how the file was interpreted, as sentences."""


def read_calibration(path: Path, side: str, camera: str = "") -> Calibration:
    """Read the calibration of the left or right camera (`side`), or of the camera of this name, from a file."""
    if not is_regular(path):
        raise SequenceError(f"calibration {path} is missing. Correct the path.")
    try:
        suffix = path.suffix.lower()
        if suffix == ".ini":
            return _from_ini(path, side)
        if suffix == ".mat":
            return _from_matlab(decoded(read_matlab, path), side)
        content = _content(path)
        if not isinstance(content, dict):
            raise ValueError("it has no named values")
        return _from_names(content, side, camera)
    except MALFORMED as error:
        raise SequenceError(
            f"calibration {path} cannot be used: {cause(error)}. Supported formats: {_KINDS}."
        ) from error


def calibration_from_info(info: Any) -> Calibration | None:
    """Calibration from a `sensor_msgs/CameraInfo`, None if uncalibrated; `ValueError` unless the model is a pinhole."""

    def numbers(name: str) -> np.ndarray:
        return np.array(getattr(info, name.lower(), getattr(info, name, ())), np.float64).reshape(-1)

    K = numbers("K")
    if len(K) != 9 or K[0] == 0:
        return None
    check_model(str(info.distortion_model))
    size = int(info.width), int(info.height)
    found = _calibration(K, numbers("D"), size if min(size) > 0 else None)
    return replace(found, R=_rotation(numbers("R")), P=_projection(numbers("P")))


def check_model(model: str, camera_model: str = "") -> None:
    """Check that a camera model is OpenCV's pinhole model; `ValueError` otherwise."""
    pinhole = camera_model.lower() in _PINHOLES
    if not pinhole or model.lower() not in _MODELS:
        given = f"distortion model {model!r}" if pinhole else f"camera model {camera_model!r}"
        raise ValueError(
            f"it has the {given}; allowed: pinhole models with plumb_bob or rational_polynomial (radtan in Kalibr). "
            "Rectify the images, or calibrate them with an allowed model"
        )


def _content(path: Path) -> Any:
    suffix = path.suffix.lower()
    if suffix == ".json":
        return parse_json(read_text(path, VALUES))
    text = read_text(path, CALIBRATION)
    if suffix == ".xml" or text.lstrip().startswith("<"):
        return _opencv_xml(text)
    # OpenCV's files begin with an invalid YAML directive, and have tagged matrices.
    return parse_yaml(re.sub(r"^%YAML.*$", "", text, flags=re.MULTILINE).replace("!!opencv-matrix", ""))


def _opencv_xml(text: str) -> dict[str, Any]:
    """Values of an XML file of OpenCV's FileStorage."""
    values: dict[str, Any] = {}
    for entry in parse_xml(text):
        data = entry.find("data")
        words = (entry if data is None else data).text or ""
        try:
            numbers = [float(word) for word in words.split()]
            values[entry.tag] = numbers[0] if data is None and len(numbers) == 1 else numbers
        except ValueError:
            values[entry.tag] = " ".join(words.split())
    return values


def _from_names(content: Mapping[str, Any], side: str, camera: str = "") -> Calibration:
    """Calibration from named values: ROS, OpenCV, Kalibr, camodocal and JSON."""
    own, kalibr = content.get(camera, content.get(side)), content.get("cam1" if side == "right" else "cam0")
    if isinstance(kalibr, dict):
        return _from_kalibr(own if isinstance(own, dict) else kalibr)
    if isinstance(own, dict):
        content = {**content, **own}
    if content.get("fisheye_model") or content.get("fisheye"):
        check_model("fisheye")
    check_model(str(content.get("distortion_model") or ""), str(content.get("camera_model") or ""))
    if "projection_parameters" in content:
        return _from_camodocal(content)
    suffixes = ("", "1" if side == "left" else "2", f"_{side}", "_l" if side == "left" else "_r", f"_{side[0].upper()}")
    K, D = _first(content, _MATRICES, suffixes), _first(content, _DISTORTIONS, suffixes)
    if K is None and (fc := _first(content, ("fc",), suffixes)) is not None:
        # Bouguet's toolbox for MATLAB counts pixels from 0.
        cc = _first(content, ("cc",), suffixes)
        K = np.array([*fc.reshape(-1)[:2], *np.asarray(cc).reshape(-1)[:2]])
    elif K is None and {"fx", "fy", "cx", "cy"} <= set(content):
        K = np.array([content[name] for name in ("fx", "fy", "cx", "cy")], np.float64)
    if K is None:
        raise ValueError(f"it has none of camera_matrix, K, M1 and cam0, only {', '.join(map(str, content))}")
    D = _coefficients(content) if D is None else D
    found = _calibration(K, D, _size(content))
    if D is None:
        found = replace(found, remarks=(*found.remarks, "it has no distortion coefficients; none are assumed."))
    T = _first(content, ("T", "t", "T_stereo"))
    if side == "right":
        R = _first(content, ("R", "R_stereo"))
        if R is None and (om := _first(content, ("om",))) is not None and om.size == 3:
            R = Rotation.from_rotvec(om.reshape(3)).as_matrix()
        if R is not None and T is not None and R.size == 9 and T.size == 3:
            in_mm = float(np.linalg.norm(T)) > _METRES_TO
            remark = f"its translation of {np.linalg.norm(T):.4g} is assumed to be in millimetres."
            found = _placed(found, R, T * 1e-3 if in_mm else T, *([remark] if in_mm else []))
    P = _first(content, ("projection_matrix", "P"), suffixes)
    # Beside a translation, R without a suffix is the rotation between the cameras.
    R = _first(content, ("rectification_matrix", "R"), suffixes if T is None else suffixes[1:])
    return replace(found, R=_rotation(R), P=_projection(P))


def _placed(found: Calibration, R: np.ndarray, T: np.ndarray, *remarks: str) -> Calibration:
    """Copy of a calibration with an extrinsic rotation and translation [m]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.asarray(R, np.float64).reshape(3, 3), np.asarray(T, np.float64).reshape(3)
    return replace(found, T_right_left=pose, remarks=(*found.remarks, *remarks))


def _from_kalibr(content: Mapping[str, Any]) -> Calibration:
    check_model(str(content.get("distortion_model") or ""), str(content.get("camera_model") or ""))
    intrinsics = np.array(content["intrinsics"], np.float64)
    if intrinsics.size != 4:
        raise ValueError(f"its intrinsics have {intrinsics.size} numbers; those of a pinhole are fu, fv, pu, pv")
    found = _calibration(intrinsics, np.array(content.get("distortion_coeffs", ()), np.float64), _size(content))
    if "T_cn_cnm1" in content:
        found = replace(found, T_right_left=np.array(content["T_cn_cnm1"], np.float64).reshape(4, 4))
    return found


def _from_camodocal(content: Mapping[str, Any]) -> Calibration:
    check_model("", str(content.get("model_type") or ""))
    projection, distortion = content["projection_parameters"], content.get("distortion_parameters") or {}
    K = np.array([projection[name] for name in ("fx", "fy", "cx", "cy")], np.float64)
    D = np.array([distortion.get(name, 0.0) for name in ("k1", "k2", "p1", "p2")], np.float64)
    return _calibration(K, D, _size(content))


def _calibration(K: np.ndarray, D: np.ndarray | None, size: tuple[int, int] | None) -> Calibration:
    """Calibration from a matrix of 9 numbers, or fx, fy, cx, cy; `ValueError` for models that OpenCV does not
    support."""
    numbers, remarks = np.asarray(K, np.float64).reshape(-1), ()
    if numbers.size not in (4, 9):
        raise ValueError(f"its camera matrix has {numbers.size} numbers; 9 numbers, or fx, fy, cx and cy, are required")
    if not np.isfinite(numbers).all():
        raise ValueError("its camera matrix contains a number that is not finite; all must be finite")
    if numbers.size == 9:
        matrix = numbers.reshape(3, 3)
        if matrix[0, 2] == matrix[1, 2] == 0 and matrix[2, 0] != 0 and matrix[2, 1] != 0:
            matrix, remarks = matrix.T, ("its matrix has the principal point in the last row; it was transposed.",)
        if np.abs(matrix[[1, 2, 2], [0, 0, 1]]).max() > 1e-6 * abs(matrix[0, 0]) or abs(matrix[2, 2] - 1) > 1e-6:
            raise ValueError(f"its matrix is {matrix.tolist()}, which is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
        if abs(matrix[0, 1]) > 1e-3 * abs(matrix[0, 0]):
            raise ValueError(f"its matrix has a skew of {matrix[0, 1]:g}; calibrate without skew")
        numbers = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    if min(numbers[:2]) <= 0:
        raise ValueError(f"its focal lengths are {numbers[0]:g} and {numbers[1]:g} px, which must be positive")
    coefficients = () if D is None else tuple(float(value) for value in np.asarray(D).reshape(-1))
    if len(coefficients) not in DISTORTION_LENGTHS or not np.isfinite(coefficients).all():
        allowed = ", ".join(map(str, DISTORTION_LENGTHS))
        raise ValueError(
            f"it has {len(coefficients)} distortion coefficients; allowed: {allowed}, in the order k1 k2 p1 p2 k3 ..."
        )
    fx, fy, cx, cy = (float(value) for value in numbers)
    return Calibration((fx, fy, cx, cy), coefficients, size, remarks=remarks)


def _size(content: Mapping[str, Any]) -> tuple[int, int] | None:
    """Width and height of the images; None if not given."""
    for wide, high in _SIZES:
        if wide in content and high in content:
            return int(float(content[wide])), int(float(content[high]))
    for name in _PAIRS:
        value = content.get(name)
        if isinstance(value, list) and len(value) == 2:
            return int(value[0]), int(value[1])
    return None


def _first(content: Mapping[str, Any], names: tuple[str, ...], suffixes: tuple[str, ...] = ("",)) -> np.ndarray | None:
    for name in names:
        for suffix in suffixes:
            value = content.get(name + suffix)
            if isinstance(value, dict):
                numbers = [value[key] for key in ("fx", "fy", "cx", "cy") if key in value]
                value = value.get("data", numbers or _coefficients(value))
            if value is not None and not isinstance(value, str):
                return np.array(value, np.float64)
    return None


def _coefficients(content: Mapping[str, Any]) -> np.ndarray | None:
    """Distortion coefficients with names; missing ones are 0. None if there are none."""
    known = [place for place, name in enumerate(_COEFFICIENTS) if name in content]
    if not known:
        return None
    count = min(length for length in DISTORTION_LENGTHS if length > max(known))
    return np.array([float(content.get(name, 0.0)) for name in _COEFFICIENTS[:count]])


def _rotation(values: np.ndarray | None) -> np.ndarray | None:
    """Rectification matrix; None for a zero matrix, which means no rectification."""
    return values.reshape(3, 3) if values is not None and values.size == 9 and np.abs(values).max() > 0 else None


def _projection(values: np.ndarray | None) -> np.ndarray | None:
    return values.reshape(3, 4) if values is not None and values.size == 12 and values.flat[0] > 0 else None


def _from_ini(path: Path, side: str) -> Calibration:
    """Calibration from the dVRK's MATLAB stereo calibration, with pixels counted from 1 and lengths in millimetres."""
    parser = parse_ini(read_text(path, CALIBRATION))
    section = parser["StereoRight" if side == "right" else "StereoLeft"]

    def numbers(key: str, indices: range) -> list[float]:
        return [float(section.get(f"{key}_{index}", "0")) for index in indices]

    K = np.array([float(section[name]) for name in ("fc_x", "fc_y", "cc_x", "cc_y")])
    found = _from_one(_calibration(K, np.array(numbers("kc", range(5))), _size(section)))
    if side != "right":
        return found
    return _placed(found, np.array(numbers("R", range(9))), np.array(numbers("T", range(3))) * 1e-3)


def _from_matlab(content: Any, side: str) -> Calibration:
    """Calibration from MATLAB structs, with pixels counted from 1, or plain matrices, with pixels counted from 0."""
    while len(content) == 1 and isinstance(only := next(iter(content.values())), dict):
        content = only
    right = side == "right"
    own = content.get("CameraParameters2" if right else "CameraParameters1", content)
    if "MappingCoefficients" in own or "DistortionCenter" in own:
        check_model("fisheye")
    toolbox = {"IntrinsicMatrix", "RadialDistortion", "ImageSize", "TangentialDistortion"} & set(own)
    if not toolbox:
        plain = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in own.items()}
        return _from_names(plain, side)
    K = np.asarray(own["K"], np.float64) if "K" in own else np.asarray(own["IntrinsicMatrix"], np.float64).T
    radial = np.atleast_1d(np.asarray(own.get("RadialDistortion", [0, 0]), np.float64)).tolist() + [0.0] * 3
    tangential = np.atleast_1d(np.asarray(own.get("TangentialDistortion", [0, 0]), np.float64)).tolist()
    rows_columns = np.asarray(own.get("ImageSize", ())).reshape(-1)
    size = (int(rows_columns[1]), int(rows_columns[0])) if rows_columns.size == 2 else None
    D = np.array([radial[0], radial[1], tangential[0], tangential[1], radial[2]])
    found = _from_one(_calibration(K, D, size))
    if right and "RotationOfCamera2" in content:
        T = np.asarray(content["TranslationOfCamera2"], np.float64) * _matlab_unit(own, content)
        return _placed(found, np.asarray(content["RotationOfCamera2"]).T, T)
    if right and isinstance(pose := content.get("PoseCamera2"), dict):
        T = np.asarray(pose["Translation"], np.float64) * _matlab_unit(own, content)
        return _placed(found, np.asarray(pose["R"]), T)
    return found


def _matlab_unit(own: Mapping[str, Any], content: Mapping[str, Any]) -> float:
    """Size of the unit of translations [m]; `ValueError` for unknown units."""
    unit = str(own.get("WorldUnits") or content.get("WorldUnits") or "mm").lower()
    if unit not in _WORLD_UNITS:
        raise ValueError(f"its WorldUnits are {unit!r}; allowed: {', '.join(_WORLD_UNITS)}")
    return _WORLD_UNITS[unit]


def _from_one(found: Calibration) -> Calibration:
    """Convert intrinsics with pixels counted from 1 (MATLAB) to pixels counted from 0 (OpenCV)."""
    fx, fy, cx, cy = found.intrinsics
    return replace(found, intrinsics=(fx, fy, cx - 1.0, cy - 1.0))


_BASE_FRAME_KINDS = (
    'a registration ({"base-frame": {"transform"}}), a configuration ({"arms": [{"name", "base_frame"}]}) or fixed '
    'set-up joints ({"arms": [{"name", "measured_cp"}]})'
)


@dataclass(frozen=True, eq=False)
class DvrkBaseFrame:
    """Base frame of an arm."""

    arm: str
    """Name of the arm; empty if neither the file nor its name contains it."""
    reference: str
    """Name of the reference frame of the transform; empty if not given."""
    T_camera_base: Float[np.ndarray, "4 4"]
    """Pose of the base in the camera frame, with OpenCV's axes [m]; equals `T_world_base` if the camera frame is the
    world."""

    __repr__ = short_repr


def read_base_frames(path: Path, axes: Axes | None = None) -> tuple[DvrkBaseFrame, ...]:
    """Read base frames from a JSON file of the dVRK (see `_BASE_FRAME_KINDS`).

    Args:
        axes: axes of the camera in the file; by default those of the file's format and name.
    """
    content = read_json(path)
    found = _entries(content, path)
    if not found:
        raise SequenceError(f"{path} has no base frame. Supported formats: {_BASE_FRAME_KINDS}.")
    axes = axes or _axes_of(content, path)
    T = T_DVRK_OPENCV if axes == "dvrk" else np.eye(4)
    try:
        return tuple(
            DvrkBaseFrame(arm, reference, T @ rigid_transform(value, f"{path}: {where}"))
            for arm, reference, value, where in found
        )
    except SettingsError as error:
        raise SequenceError(str(error)) from error


def _entries(content: Any, path: Path) -> list[tuple[str, str, Any, str]]:
    """Arm, reference, transform and location of every base frame."""
    if not isinstance(content, dict):
        return []
    if (frame := _either(content, "base_frame")) is not None:
        arm = re.match(r"(?:.*[^A-Za-z])?((?:PSM|ECM|MTM)[0-9RL]?)(?![A-Za-z0-9])", path.name)
        return [(arm[1] if arm else "", *_base_frame(frame))]
    arms = content.get("arms")
    entries = []
    for entry in arms if isinstance(arms, list) else []:
        if not isinstance(entry, dict) or not isinstance(name := entry.get("name"), str):
            continue
        if (frame := _either(entry, "base_frame")) is not None:
            entries.append((name, *_base_frame(frame, f"arm {name!r}: ")))
        elif "measured_cp" in entry:
            entries.append((name, "", entry["measured_cp"], f"arm {name!r}: measured_cp"))
    return entries


def _base_frame(frame: Any, where: str = "") -> tuple[str, Any, str]:
    if not isinstance(frame, dict):
        return "", frame, f"{where}base_frame"
    reference = _either(frame, "reference_frame")
    return reference if isinstance(reference, str) else "", frame.get("transform"), f"{where}base_frame: transform"


def _either(table: dict[str, Any], key: str) -> Any:
    return table.get(key, table.get(key.replace("_", "-")))


def _axes_of(content: dict[str, Any], path: Path) -> Axes:
    if "arms" in content:
        return "dvrk"
    name = path.name.lower()
    if "open-cv" in name or "opencv" in name:
        return "opencv"
    if "dvrk" in name:
        return "dvrk"
    raise PartError(
        "recording",
        f"{path}: neither its content nor its name (-open-cv.json or -dVRK.json) states the camera axes. Give them: "
        "opencv (x right, y down) or dvrk (x left, y up).",
        "Use --axes.",
    )
