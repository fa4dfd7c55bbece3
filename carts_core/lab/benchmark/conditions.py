"""Altered frames: occluded instruments, crossing arms, and images that contradict their kinematics."""

import dataclasses
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ...errors import SettingsError
from ...model.robot import Robot
from ...model.scene import Scene
from ...recording import Frame
from ...rendering import Renderer
from ...settings import SensorConfig
from ..synthesis.domains import expose, linear, smooth_noise, smoothstep
from .sources import Recording

OCCLUSION = "occlusion"
"""Name of the domain with occluded instruments."""
SHARE = 0.3
"""Covered share of the visible pixels of the instruments [1]."""
_SENSOR = dataclasses.replace(SensorConfig(), vignette=0.0)
_SURROUNDINGS = 0.3
"""Assumed reflectance of the surroundings, from which the light is estimated."""


@dataclass(frozen=True)
class Occluded:
    """Image with occluders."""

    image: UInt8[np.ndarray, "h w 3"]
    hidden: Bool[np.ndarray, "h w"]
    """Pixels of the occluders."""


def occlude(
    image: UInt8[np.ndarray, "h w 3"],
    instruments: Bool[np.ndarray, "h w"],
    rng: np.random.Generator,
    share: float = SHARE,
) -> Occluded:
    """Cover the instruments with one to three occluders of the same kind, with folds, soft edges and a soft shadow.

    `share` is the exact share of visible instrument pixels that are covered.
    """
    if not instruments.any():
        return Occluded(image, np.zeros_like(instruments))
    height, width = instruments.shape
    scale = width / 640.0
    level = _pieces(instruments, scale, rng)
    level -= np.quantile(level[instruments], 1.0 - share)
    hidden = level > 0.0
    normal = _normals(level, scale, rng)
    reflectance = _KINDS[int(rng.integers(len(_KINDS)))]((height, width), scale, normal, rng)
    brightness = float(np.median(linear(image))) / _SURROUNDINGS
    lit = expose(brightness * normal[..., 2:] ** 1.5 * reflectance, _SENSOR, rng)
    shadow = cv2.GaussianBlur(hidden.astype(np.float32), (0, 0), 7.0 * scale)
    shift = np.array([[1, 0, rng.uniform(-8, 8) * scale], [0, 1, rng.uniform(0, 10) * scale]])
    shadow = cv2.warpAffine(shadow, shift, (width, height), borderMode=cv2.BORDER_REPLICATE)
    cover = cv2.GaussianBlur(hidden.astype(np.float32), (0, 0), 0.8 * scale)[..., None]
    below = image * (1.0 - 0.45 * shadow[..., None])
    return Occluded(np.rint(cover * lit + (1.0 - cover) * below).astype(np.uint8), hidden)


def _pieces(instruments: np.ndarray, scale: float, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Noisy scalar field that decreases with the distance from the occluders' centres, which lie on the instruments."""
    rows, columns = np.indices(instruments.shape, dtype=np.float32)
    places = np.argwhere(instruments)
    level = np.full(instruments.shape, -np.inf, np.float32)
    for row, column in places[rng.integers(len(places), size=int(rng.integers(1, 4)))]:
        angle, longer = rng.uniform(0.0, np.pi), rng.uniform(1.0, 2.0)
        x, y = columns - column, rows - row
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        size = 60.0 * scale * rng.uniform(0.6, 1.4)
        level = np.maximum(level, -np.hypot(along / longer, across) / size)
    frayed = smooth_noise(instruments.shape, 70.0 * scale, rng, octaves=3, gain=0.35)
    return (level + 0.12 * frayed).astype(np.float32)


def _normals(level: np.ndarray, scale: float, rng: np.random.Generator) -> Float[np.ndarray, "h w 3"]:
    """Unit normals of a bulging, folded body; z points towards the camera."""
    bulge = 22.0 * scale * np.sqrt(np.clip(level, 0.0, None) + 1e-3)
    folds = 3.0 * scale * smooth_noise(level.shape, 35.0 * scale, rng, octaves=3)
    dy, dx = np.gradient(cv2.GaussianBlur((bulge + folds).astype(np.float32), (0, 0), 1.2 * scale))
    normal = np.stack([-dx, -dy, np.ones_like(dx)], -1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _gauze(shape: tuple[int, int], scale: float, normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Reflectance of an off-white, slightly bloody weave."""
    rows, columns = np.indices(shape, dtype=np.float32) / (rng.uniform(4.0, 7.0) * scale)
    warp = 1.2 * smooth_noise(shape, 90.0 * scale, rng)
    angle = rng.uniform(0.0, np.pi)
    warped = (
        columns * np.cos(angle) + rows * np.sin(angle) + warp,
        rows * np.cos(angle) - columns * np.sin(angle) + warp,
    )
    threads = 0.5 + 0.25 * (np.cos(2 * np.pi * warped[0]) + np.cos(2 * np.pi * warped[1]))
    soaked = smoothstep(smooth_noise(shape, 110.0 * scale, rng, octaves=3), rng.uniform(-0.5, 1.5), 2.5)[..., None]
    white = (0.50 + 0.30 * threads)[..., None] * np.array([1.0, 0.97, 0.90])
    return white * (1.0 - soaked * np.array([0.35, 0.88, 0.90]))


def _tissue(shape: tuple[int, int], scale: float, normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Reflectance of red to pink tissue with fat, and with highlights on surfaces facing the lamp."""
    fat = smoothstep(smooth_noise(shape, 70.0 * scale, rng, octaves=4), 0.2, 1.4)[..., None]
    red = np.array([0.50, 0.14, 0.11]) * rng.uniform(0.7, 1.3)
    flesh = red * (1.0 + 0.2 * smooth_noise(shape, 25.0 * scale, rng, octaves=4)[..., None])
    glint = 2.5 * np.clip(normal[..., 2:], 0.0, 1.0) ** 300.0
    return np.clip(flesh + fat * (np.array([0.62, 0.44, 0.20]) - flesh), 0.02, 1.0) + glint


def _cloth(shape: tuple[int, int], scale: float, normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Uniform reflectance of drapes and gloves: blue, green or white."""
    colors = ((0.10, 0.25, 0.50), (0.10, 0.38, 0.30), (0.65, 0.65, 0.62))
    shade = 1.0 + 0.06 * smooth_noise(shape, 12.0 * scale, rng, octaves=3)
    return shade[..., None] * np.array(colors[int(rng.integers(len(colors)))])


_KINDS = (_gauze, _tissue, _cloth)


CROSSING = "crossing arms"
"""Name of the domain with crossing arms."""
_HIDDEN = 0.15, 0.9
"""Range of the share of an arm that is occluded by the other arm [1]."""
_SHOWN = 0.02, 0.25
"""Range of the share of the image that each arm covers [1]."""
_TURN, _REACH = 0.2, 0.008
"""Standard deviations of the random yaw and pitch [rad], and of the insertion [m]."""
_DRAWS = 2000
_COARSE = 160
"""Image width at which random draws are checked [px]."""
_BLUR, _NOISE = 0.65, 2.0
"""Standard deviations of lens blur [px] and noise [grey levels]."""


def crossing_frame(recording: Recording, index: int, camera: str, seed: int = 0) -> Frame:
    """Frame of the regular domain with its arms moved so that they cross.

    Measured joints keep the errors of the original frame. The arms may intersect.

    Raises:
        SettingsError: no random draw has crossing arms, or the recording does not have two arms with known joints.
    """
    frame, scene = recording.frame(index, "regular", [camera]), recording.scene.with_cameras([camera])
    if len(scene.arms) != 2 or not frame.truth:
        raise SettingsError(f"{CROSSING} requires a recording of two arms with known joints. Choose such a recording.")
    rng = np.random.default_rng((seed, index))
    truth = _crossing_joints(scene, dict(frame.truth), rng)
    with_error = {name: truth[name] + frame.measured[name] - frame.truth[name] for name in truth}
    rendering = Renderer(scene)(scene.state(truth))
    arms = rendering.silhouette[0].numpy()[..., None]
    image = 255.0 * rendering.image[0].movedim(0, -1).numpy()
    picture = arms * image + (1.0 - arms) * recording.background(camera, "regular")
    picture = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), _BLUR) + rng.normal(0.0, _NOISE, picture.shape)
    return replace(
        frame,
        images={camera: np.rint(picture.clip(0, 255)).astype(np.uint8)},
        masks={camera: arms[..., 0] > 0.5},
        measured=with_error,
        truth=truth,
    )


def _crossing_joints(scene: Scene, around: dict[str, np.ndarray], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Random joint positions of both arms near the given positions [rad, m] at which the arms cross."""
    width, height = _COARSE, round(_COARSE * scene.cameras[0].height / scene.cameras[0].width)
    both = Renderer(scene, width=width, height=height)
    alone = {arm.name: scene.with_arms([arm.name]) for arm in scene.arms}
    renderers = {name: Renderer(part, width=width, height=height) for name, part in alone.items()}
    for _ in range(_DRAWS):
        drawn = {}
        for arm in scene.arms:
            low, high = arm.robot.joint_limits[:3].T
            step = rng.normal(0.0, [_TURN, _TURN, _REACH])
            drawn[arm.name] = around[arm.name].copy()
            drawn[arm.name][:3] = np.clip(around[arm.name][:3] + step, low, high)
        labels = both.segment(scene.state(drawn))[0]
        seen = np.array([(labels == arm).mean() for arm in range(2)])
        if not (_SHOWN[0] <= seen.min() and seen.max() <= _SHOWN[1]):
            continue
        whole = [
            (renderers[name].segment(part.state({name: drawn[name]}))[0] >= 0).mean() for name, part in alone.items()
        ]
        if _HIDDEN[0] <= float((1.0 - seen / np.array(whole)).max()) <= _HIDDEN[1]:
            return drawn
    raise SettingsError(f"in {_DRAWS} random draws, these arms never cross in camera {scene.cameras[0].name!r}.")


NO_ARM = "no arm"
OTHER_FRAME = "joints of another frame"
OTHER_CAMERA = "image of another camera"
OTHER_INSTRUMENT = "another instrument"
WRONG = (NO_ARM, OTHER_FRAME, OTHER_CAMERA, OTHER_INSTRUMENT)
_STAND_INS = ("double_fenestrated_grasper", "clip_applier", "maryland_bipolar_forceps", "curved_scissors")
"""Built-in instruments that are rendered instead of the instrument in the image, alternating between frames."""


def wrong_inputs(frames: int, cameras: int, *, built_in: bool) -> tuple[str, ...]:
    """Kinds of wrong inputs that a recording allows; `built_in` robots can be replaced by other instruments."""
    possible = (True, frames > 1, cameras > 1, built_in)
    return tuple(kind for kind, needed in zip(WRONG, possible, strict=True) if needed)


def with_other_instruments(scene: Scene, index: int) -> Scene:
    """Scene with the instruments replaced by another built-in instrument, selected by the frame index."""
    robot = Robot.load(f"builtin:{_STAND_INS[index % len(_STAND_INS)]}")
    return replace(scene, arms=tuple(replace(arm, robot=robot) for arm in scene.arms))


def contradicting_frame(recording: Recording, kind: str, index: int, camera: str) -> Frame:
    """Frame of the regular domain whose image contradicts its kinematics in one of the ways in `WRONG`.

    Masks match the image of the returned frame.
    """
    frame = recording.frame(index, "regular", [camera])
    match kind:
        case "no arm":
            image = recording.background(camera, "regular")
            return replace(frame, images={camera: image}, masks={camera: np.zeros(image.shape[:2], bool)})
        case "joints of another frame":
            other = (index + len(recording) // 2) % len(recording)
            return replace(frame, measured=recording.frame(other, "regular", ()).measured)
        case "image of another camera":
            (other,) = [known.name for known in recording.scene.cameras if known.name != camera][:1]
            seen = recording.frame(index, "regular", [other])
            assert seen.masks is not None
            return replace(frame, images={camera: seen.images[other]}, masks={camera: seen.masks[other]})
        case "another instrument":
            # The joints of different instruments cannot be compared.
            return replace(frame, truth=None)
    raise AssertionError(f"unknown kind of wrong input: {kind}")
