"""Inputs of a fit as users have them: images, masks, intrinsics, arms and joint positions, checked and converted."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.typing import ArrayLike

from ..errors import RobotError, SettingsError
from ..files.reading import pixels_problem
from ..model.camera import (
    HALF_PIXEL,
    Camera,
    implausible_intrinsics,
    pinhole_intrinsics,
    rigid_transform,
    unusual_tangential,
)
from ..model.robot import Robot
from ..model.scene import Arm
from ..recording.images import read_image, read_mask
from ..wording import closest, listed, shown

CAMERA, ARM = "camera", "arm"
"""Name of the camera, and of the arm if there is only one."""

LIMIT_TOLERANCE = 0.1
"""Distance by which joint positions may exceed the limits without a warning, as a share of the range of motion [1]."""

ImageInput: TypeAlias = UInt8[np.ndarray, "height width 3"] | PathLike[str] | str
"""RGB image, or path of an image file."""
MaskInput: TypeAlias = Bool[np.ndarray, "height width"] | PathLike[str] | str
"""Mask, `bool` or 0 and 255, or path of a mask file (white on black)."""
RobotInput: TypeAlias = Robot | PathLike[str] | str
"""Robot, path of a URDF, or `builtin:NAME`."""
JointInput: TypeAlias = ArrayLike | Mapping[str, float]
"""Joint positions [rad, m] in the order of the URDF, or by joint name."""


def rgb_image(value: ImageInput, what: str) -> UInt8[np.ndarray, "height width 3"]:
    """Read an image file, or check and copy an image.

    Raises:
        SettingsError: `value` is neither a path nor an RGB image of type uint8.
        SequenceError: the file is missing, damaged or too large.
    """
    if isinstance(value, str | PathLike):
        return read_image(Path(value))
    image = _array(value, what)
    if image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3:
        if (problem := pixels_problem(image.shape[1], image.shape[0])) is not None:
            raise SettingsError(f"the {what} {problem}. Give a smaller image.")
        return np.array(image, order="C")
    remedy = "Give RGB values of type uint8, [height, width, 3], or the path of an image file."
    if image.ndim == 3 and image.shape[2] != 3 and image.shape[0] == 3:
        remedy = "Move the channels to the end: image.transpose(1, 2, 0)."
    elif image.ndim == 3 and image.shape[2] == 4:
        remedy = "Leave out the transparency: image[..., :3]."
    elif image.ndim == 2:
        remedy = "Repeat a grey image for three channels: np.repeat(image[..., None], 3, 2)."
    elif image.ndim == 3 and np.issubdtype(image.dtype, np.floating):
        remedy = "Convert values from 0 to 1 with (255 * image).astype(np.uint8)."
    raise SettingsError(f"the {what} is an array of type {image.dtype} and shape {list(image.shape)}. {remedy}")


def binary_mask(value: MaskInput, what: str) -> Bool[np.ndarray, "height width"]:
    """Read a mask file, or check and copy a mask.

    Raises:
        SettingsError: `value` is neither a path nor a mask of two values.
        SequenceError: the file is missing, damaged or too large, or holds labels.
    """
    if isinstance(value, str | PathLike):
        return read_mask(Path(value))
    mask = _array(value, what)
    integers = mask.dtype == bool or np.issubdtype(mask.dtype, np.integer)
    if mask.ndim == 2 and integers and set(np.unique(mask).tolist()) <= {0, int(mask.max(initial=1))}:
        return mask.astype(bool)
    raise SettingsError(
        f"the {what} is an array of type {mask.dtype} and shape {list(mask.shape)}. Give bool values, or two whole "
        "numbers such as 0 and 255, [height, width]; convert a label image with `labels == label`."
    )


def check_size(array: np.ndarray, what: str, camera: Camera) -> None:
    """Check that a background or mask has the size of the image; `SettingsError` if not."""
    height, width = array.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise SettingsError(
            f"the {what} has {width} x {height} pixels, but the image has {camera.width} x {camera.height}. Give "
            "both at the same size."
        )


def _array(value: Any, what: str) -> np.ndarray:
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise SettingsError(f"the {what} is {shown(value)}. Give an array or a path.") from error
    if array.dtype == object:
        raise SettingsError(f"the {what} is {shown(value)}. Give an array or a path.")
    return array


def camera_of(
    K: ArrayLike | Camera,
    image: UInt8[np.ndarray, "height width 3"],
    pixel_center: float | None,
    distortion: Sequence[float],
) -> tuple[Camera, list[str]]:
    """Camera of an image, with the identity as pose, and remarks on its intrinsics.

    Args:
        K: intrinsics [px]; those of a `Camera` have a known convention.
        pixel_center: convention of `K`, see `pinhole_intrinsics`; None for OpenCV's, with a remark if another one is
            likely.

    Raises:
        SettingsError: the intrinsics or the distortion are invalid, or belong to another image size.
    """
    height, width = image.shape[:2]
    if isinstance(K, Camera):
        if pixel_center is not None or len(distortion):
            raise SettingsError(
                "K is a Camera, which has its own distortion and convention of pixel centres. Leave out pixel_center "
                "and distortion, or give K as numbers."
            )
        if (K.width, K.height) != (width, height):
            raise SettingsError(
                f"camera {K.name!r} has {K.width} x {K.height} pixels, but the image has {width} x {height}. Give "
                "the camera of this image, or K.resized(width, height)."
            )
        return Camera(CAMERA, width, height, K.intrinsics, np.eye(4), K.distortion), []
    intrinsics = pinhole_intrinsics(K, 0.0 if pixel_center is None else pixel_center)
    coefficients = _array(distortion, "distortion").ravel()
    if coefficients.size and not np.issubdtype(coefficients.dtype, np.number):
        raise SettingsError(f"the distortion is {shown(distortion)}. Give OpenCV's coefficients k1 k2 p1 p2 [k3 ...].")
    camera = Camera(CAMERA, width, height, intrinsics, np.eye(4), tuple(coefficients.astype(float).tolist()))
    found = []
    if (problem := implausible_intrinsics(width, height, intrinsics, camera.distortion)) is not None:
        found.append(f"K is unusual: it has {problem}. Check that K belongs to this image size, in pixels.")
    if (problem := unusual_tangential(camera.distortion)) is not None:
        found.append(f"the distortion is unusual: it has {problem}.")
    if pixel_center is None and intrinsics[2:] == (width / 2 + HALF_PIXEL, height / 2 + HALF_PIXEL):
        found.append(
            f"the principal point of K is ({width / 2:g}, {height / 2:g}), exactly half the image size. In OpenCV's "
            "convention, with pixel centres at integers, the centre of the image is half a pixel less. If K has pixel "
            "centres at 0.5, as Camera.K, COLMAP and renderers have, give pixel_center=0.5; else pixel_center=0."
        )
    return camera, found


@dataclass(frozen=True, eq=False)
class ArmsInput:
    """Arms in front of a camera, and their joint positions."""

    arms: tuple[Arm, ...]
    """Arms with `T_world_base` = T_camera_base."""
    joints: dict[str, Float[np.ndarray, " dofs"]]
    """Arm -> joint positions [rad, m] in the order of the URDF."""
    single: bool
    """Whether the arm was given without a name."""
    by_name: frozenset[str]
    """Arms with joint positions given by joint name."""
    remarks: tuple[str, ...]
    """Remarks on joint positions beyond the limits of the robot."""


def arms_of(
    T_camera_base: ArrayLike | Mapping[str, ArrayLike],
    urdf: RobotInput | Mapping[str, RobotInput],
    joints: JointInput | Mapping[str, JointInput],
    base_link: str | Mapping[str, str | None] | None,
) -> ArmsInput:
    """Load the robots and check poses and joint positions; several arms are mappings by arm name.

    Raises:
        SettingsError: a transform is invalid, or the mappings have different arms.
        RobotError: a URDF is invalid, or joint positions do not match it.
    """
    single = not isinstance(T_camera_base, Mapping)
    Ts = {ARM: T_camera_base} if single else dict(T_camera_base)
    if not Ts or not all(isinstance(name, str) and name for name in Ts):
        raise SettingsError(f"T_camera_base has the keys {listed(map(repr, Ts)) or 'none'}. Give arm name -> 4x4.")
    if single:
        for what, value in (("urdf", urdf), ("base_link", base_link)):
            if isinstance(value, Mapping):
                raise SettingsError(
                    f"{what} is a mapping, but T_camera_base is a single transform. For several arms, give "
                    "T_camera_base, urdf and joints as mappings from arm name."
                )
        given: dict[str, Any] = {ARM: joints}
    else:
        given = _per_arm(joints, Ts, "joints")
    urdfs = _per_arm(urdf, Ts, "urdf") if isinstance(urdf, Mapping) else dict.fromkeys(Ts, urdf)
    links = _per_arm(base_link, Ts, "base_link") if isinstance(base_link, Mapping) else dict.fromkeys(Ts, base_link)
    loaded: dict[tuple[str, str | None], Robot] = {}
    arms, positions, remarks = [], {}, []
    for name, T in Ts.items():
        what = "T_camera_base" if single else f"T_camera_base of arm {name!r}"
        robot = urdfs[name]
        if not isinstance(robot, Robot):
            if not isinstance(robot, str | PathLike):
                raise SettingsError(f"urdf is {shown(robot)}. Give the path of a URDF, builtin:NAME, or a Robot.")
            key = str(robot), links[name]
            robot = loaded.get(key) or loaded.setdefault(key, Robot.load(key[0], base_link=key[1]))
        arms.append(Arm(name, robot, rigid_transform(T, what)))
        where = "joints" if single else f"joints of arm {name!r}"
        positions[name] = joint_vector(given[name], robot, where)
        remarks += limit_remarks(robot, positions[name], where)
    named = frozenset(name for name, value in given.items() if isinstance(value, Mapping))
    return ArmsInput(tuple(arms), positions, single, named, tuple(remarks))


def _per_arm(value: Any, arms: Mapping[str, Any], what: str) -> dict[str, Any]:
    if isinstance(value, Mapping) and set(value) == set(arms):
        return dict(value)
    given = f"has the keys {listed(map(repr, value))}" if isinstance(value, Mapping) else f"is a {type(value).__name__}"
    raise SettingsError(f"{what} {given}, but T_camera_base has the arms {listed(arms)}. Give arm name -> {what}.")


def joint_vector(value: JointInput, robot: Robot, what: str) -> Float[np.ndarray, " dofs"]:
    """Joint positions [rad, m] in the order of `Robot.joint_names`.

    Raises:
        RobotError: joints are missing or unknown, or a position is not a finite number.
    """
    names = robot.joint_names
    if isinstance(value, Mapping):
        unknown = [str(name) for name in value if name not in names]
        missing = [name for name in names if name not in value]
        if unknown or missing:
            fault = (
                f"{what}: there is no joint {unknown[0]!r}." if unknown else f"{what}: {listed(missing)} is missing."
            )
            hint = closest(unknown[0], names) if unknown else ""
            raise RobotError(f"{fault}{hint} Give all degrees of freedom of {robot.name}: {', '.join(names)}.")
        value = [value[name] for name in names]
    try:
        positions = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise RobotError(f"{what}: {shown(value)} are not numbers. Give radians and metres.") from error
    if positions.shape != (len(names),):
        raise RobotError(
            f"{what}: an array of shape {list(positions.shape)} was given, but {robot.name} has {len(names)} degrees "
            f"of freedom. Give one position each, in this order: {', '.join(names)}."
        )
    if not np.isfinite(positions).all():
        wrong = [name for name, position in zip(names, positions, strict=True) if not np.isfinite(position)]
        raise RobotError(f"{what}: the position of {listed(wrong)} is not finite. Give radians and metres.")
    return positions


def limit_remarks(robot: Robot, positions: Float[np.ndarray, " dofs"], what: str) -> Iterable[str]:
    """Remark on joint positions far beyond the limits of a robot, which are probably in another unit."""
    low, high = np.asarray(robot.joint_limits, np.float64).T
    with np.errstate(invalid="ignore"):
        margin = LIMIT_TOLERANCE * np.where(np.isfinite(high - low), high - low, 0.0)
    beyond = np.flatnonzero((positions < low - margin) | (positions > high + margin))
    for index in beyond[:1]:
        angle = robot.joint_types[index] == "revolute"
        unit, other = ("rad", "degrees") if angle else ("m", "millimetres")
        yield (
            f"{what}: {robot.joint_names[index]} is {positions[index]:.4g} {unit}, but its limits are {low[index]:.4g} "
            f"to {high[index]:.4g} {unit}{_others(len(beyond) - 1)}. Joint positions are radians and metres; if they "
            f"are {other}, {'convert them with np.radians' if angle else 'divide them by 1000'}."
        )


def _others(count: int) -> str:
    return f", and {count} more are beyond their limits" if count else ""
