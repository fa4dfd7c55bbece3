"""Synthesis of a sequence on disk."""

import csv
import hashlib
import io
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from ...errors import CartsError, SettingsError
from ...files import OutputPath, holds_file, published, write_bytes, write_text
from ...html import render_page
from ...model.camera import Camera
from ...model.instruments import SCHEME, SHIPPED
from ...model.scene import Arm
from ...resources import shipped_robot
from ...settings import SynthesisConfig
from .domains import Conditions, View, exposure_gain
from .motion import INSTRUMENT_DISTANCE, enlargement, measure, measurement_error, plan_arm, plan_motion, sample_times
from .path_tracer import INTENSITY, LIGHTS_CAMERA, PathTracer, Stage
from .scene import KINDS, Tissue, grow_tissue, is_instrument, load_robot, place_arms, place_cameras

Progress = Callable[[str, int, int], None]
"""Callback with a description, the number of finished steps, and the total."""


def write_table(
    path: OutputPath,
    arms: Sequence[Arm],
    times: Float[np.ndarray, " frames"],
    joints: Sequence[Float[np.ndarray, "frames dofs"]],
) -> None:
    """Write a CSV file with one row per frame: id, time [s], and the joint positions of every arm [rad, m]."""
    columns = [f"{arm.name}.{joint}" for arm in arms for joint in arm.robot.joint_names]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["frame", "time", *columns])
    for frame, time in enumerate(times):
        values = np.concatenate([table_of_arm[frame] for table_of_arm in joints])
        table.writerow([_name(frame), f"{time:.4f}", *(f"{value:.7f}" for value in values)])
    write_text(path, text.getvalue())


def synthesize(config: SynthesisConfig, output: OutputPath | Path | str, progress: Progress | None = None) -> Path:
    """Render a sequence of two instruments, or of one arm of another robot, in all domains of the settings.

    Files are written to a folder beside `output`, which is renamed at the end. A stopped run is resumed by a call with
    the same settings.

    Args:
        config: settings of the synthesis.
        output: folder of the sequence, which must be missing or empty.
        progress: called after each frame.

    Returns:
        Path of the sequence file.

    Raises:
        SettingsError: `output` is not empty, or no motion satisfies the settings.
        RobotError: the robot cannot be used.
        CartsError: Mitsuba is not installed.
    """
    target = output if isinstance(output, OutputPath) else Path(output)
    output = Path(output)
    if os.path.lexists(output) and (output.is_symlink() or not output.is_dir() or any(output.iterdir())):
        raise SettingsError(f"{output} exists. Choose a new folder, or remove this one.")
    with published(target, key=hashlib.sha256(repr(config).encode()).hexdigest()) as work:
        _write_sequence(config, work, output, progress or (lambda what, done, total: None))
    return output / "sequence.toml"


def _write_sequence(config: SynthesisConfig, work: OutputPath, output: Path, report: Progress) -> None:
    """Write missing files into `work`; `output` is their final folder."""
    frames = config.motion.frames
    report("tissue, robots and motion", 0, frames)
    endoscope, times, scale = config.endoscope, sample_times(config), enlargement(config.endoscope)
    # Distant cameras are placed in the reduced world.
    near = replace(endoscope, distance=endoscope.distance / scale, baseline=endoscope.baseline / scale)
    cameras = place_cameras(near)
    robot, error = load_robot(config), config.error
    if is_instrument(robot) and scale != 1.0:
        raise SettingsError(
            f"EndoscopeConfig.distance is {endoscope.distance} m, but the robot is a surgical instrument. The limit "
            f"for instruments is {INSTRUMENT_DISTANCE} m; other robots may be farther away."
        )
    tissue, other = _grow_tissues(config)
    if is_instrument(robot):
        arms = place_arms(robot, config.tip_link, cameras[0])
        joints = plan_motion(arms, [tissue, other], cameras[0], config)
    else:
        arm, positions = plan_arm(robot, [tissue, other], cameras[0], config, scale)
        arms, joints, error = (arm,), (positions,), measurement_error(robot, error)
    stage = Stage(arms, joints, times, scale, painted=not is_instrument(robot))

    tracing = _Tracing(config, stage, cameras, tissue, other)
    for frame in range(frames):
        if not all(holds_file(_mask_file(work, frame, camera)) for camera in cameras):
            tracing.trace(work, frame)
        report("frames", frame + 1, frames)

    measured = [
        measure(table, times, error, config.rng("measurement", arm.name))
        for arm, table in zip(arms, joints, strict=True)
    ]
    write_table(work / "kinematics.csv", arms, times, measured)
    write_table(work / "truth.csv", arms, times, joints)
    written = [replace(camera, T_camera_world=_enlarged(camera.T_camera_world, scale)) for camera in cameras]
    robot_path = _robot_reference(config.robot, output)
    page = render_page("synthetic_sequence.toml", config=config, robot=robot_path, arms=arms, cameras=written)
    write_text(work / "sequence.toml", page)


def _enlarged(T: Float[np.ndarray, "4 4"], scale: float) -> Float[np.ndarray, "4 4"]:
    enlarged = T.copy()
    enlarged[:3, 3] *= scale
    return enlarged


def _robot_reference(robot: Path, output: Path) -> str:
    if str(robot).startswith(SCHEME):
        return str(robot)
    if robot.resolve() == shipped_robot().resolve():
        return SCHEME + SHIPPED
    return Path(os.path.relpath(robot.resolve(), output.resolve())).as_posix()


class _Tracing:
    """Renderer of single frames into the work folder."""

    def __init__(
        self, config: SynthesisConfig, stage: Stage, cameras: tuple[Camera, ...], tissue: Tissue, other: Tissue
    ) -> None:
        self._config, self._stage, self._cameras = config, stage, cameras
        self._tracers = [PathTracer(tissue, config.render)]
        if "background_change" in config.domains:
            self._tracers.append(PathTracer(other, config.render))
        self._conditions = Conditions(config, tissue)
        self._gains: list[float] = []

    def trace(self, folder: OutputPath, frame: int) -> None:
        """Render all images of a frame; the masks are written last and mark the frame as complete."""
        masks = []
        for number, camera in enumerate(self._cameras):
            view, mask = self._view(frame, number)
            masks.append(mask)
            for domain in self._config.domains:
                image = cv2.cvtColor(self._conditions.image(domain, view), cv2.COLOR_RGB2BGR)
                path = folder / "images" / domain / camera.name / f"{_name(frame)}.jpg"
                _write(path, image, [cv2.IMWRITE_JPEG_QUALITY, self._config.sensor.jpeg_quality])
        for camera, mask in zip(self._cameras, masks, strict=True):
            pixels = mask.astype(np.uint8) * 255
            options = [cv2.IMWRITE_PNG_BILEVEL, 1, cv2.IMWRITE_PNG_COMPRESSION, 9]
            _write(_mask_file(folder, frame, camera), pixels, options)

    def _view(self, frame: int, number: int) -> tuple[View, np.ndarray]:
        camera, stage = self._cameras[number], self._stage
        if not self._gains:
            # The first frame determines the exposure of the sequence, as with a camera without automatic exposure.
            first = [self._radiance(tracer, 0, 0) for tracer in self._tracers]
            self._gains = [exposure_gain(radiance, self._config.sensor) for radiance in first]
        light = [
            gain * self._radiance(tracer, frame, number)
            for gain, tracer in zip(self._gains, self._tracers, strict=True)
        ]
        parts = stage.parts(frame)
        surface = self._tracers[0].surface(parts, camera, seed=frame)
        mask = self._tracers[0].coverage(parts, camera) >= 0.5
        view = View(
            frame=frame,
            time=float(stage.times[frame]),
            camera=number,
            light=light[0],
            lamp=INTENSITY * len(LIGHTS_CAMERA) * self._gains[0],
            other_light=light[1] if len(light) > 1 else None,
            surface=surface,
            motion=stage.motion_in_image(frame, surface, camera, self._config.sensor.shutter),
            lens=np.linalg.inv(camera.T_camera_world)[:3, 3],
            Ts_world_link=stage.Ts_world_link(frame),
        )
        return view, mask

    def _radiance(self, tracer: PathTracer, frame: int, number: int) -> np.ndarray:
        seed = frame * len(self._cameras) + number
        light_frame = self._cameras[0].T_camera_world
        return tracer.radiance(self._stage.parts(frame), self._cameras[number], light_frame, seed)


def _grow_tissues(config: SynthesisConfig) -> tuple[Tissue, Tissue]:
    """Regular background, and a background of a different kind."""
    kinds = config.rng("kinds").permutation(KINDS)[:2]
    size = config.render.tissue_resolution, config.render.texture_resolution
    regular, other = (grow_tissue(kind, *size, config.rng("tissue", i)) for i, kind in enumerate(kinds))
    return regular, other


def _name(frame: int) -> str:
    """Id of a frame, starting at 001."""
    return f"{frame + 1:03d}"


def _mask_file(folder: OutputPath, frame: int, camera: Camera) -> OutputPath:
    return folder / "masks" / camera.name / f"{_name(frame)}.png"


def _write(path: OutputPath, pixels: np.ndarray, options: list[int]) -> None:
    """Atomically write an image file."""
    encoded, data = cv2.imencode(path.path.suffix, pixels, options)
    if not encoded:
        raise CartsError(f"{path} could not be encoded.")
    write_bytes(path, data.tobytes())
