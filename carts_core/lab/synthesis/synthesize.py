"""`synthesize`: a whole sequence on disk."""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ...errors import SettingsError
from ...files import OutputPath, holds_file, published
from ...model.camera import Camera
from ...settings import SynthesisConfig
from .any_robot import (
    check_instrument_distance,
    enlarged,
    enlargement,
    measurement_error,
    plan_arm,
    small_world,
)
from .domains import Conditions, View
from .layout import is_instrument, load_robot, place_arms, place_cameras
from .measurement import measure
from .motion import plan_motion, sample_times
from .path_tracer import PathTracer
from .sensor import exposure_gain
from .stage import Stage
from .tissue import KINDS, Tissue, grow_tissue
from .writer import frame_name, write_image, write_mask, write_sequence_file, write_table

Progress = Callable[[str, int, int], None]
"""Called with what is going on, how many steps are done and how many there are."""


def synthesize(config: SynthesisConfig, output: OutputPath | Path | str, progress: Progress | None = None) -> Path:
    """Render a sequence of two instruments, or of one arm of any other robot, in all wanted domains.

    The files appear under `output` when everything is there. Until then they lie beside it, and a run that was
    stopped goes on where it was when it is started again with the same settings.

    Args:
        config: what to render.
        output: folder of the sequence; it must not exist, or be empty.
        progress: called after each frame.

    Returns:
        The sequence file.

    Raises:
        SettingsError: `output` holds something already, or no motion fits the settings.
        RobotError: the robot is not usable.
        CartsError: Mitsuba is not installed.
    """
    target = output if isinstance(output, OutputPath) else Path(output)
    output = Path(output)
    if os.path.lexists(output) and (output.is_symlink() or not output.is_dir() or any(output.iterdir())):
        raise SettingsError(f"{output} exists already. Name a folder that does not exist, or remove this one first.")
    with published(target, key=hashlib.sha256(repr(config).encode()).hexdigest()) as work:
        _write_sequence(config, work, output, progress or (lambda what, done, total: None))
    return output / "sequence.toml"


def _write_sequence(config: SynthesisConfig, work: OutputPath, output: Path, report: Progress) -> None:
    """Write into `work` what is not there yet; `output` is where it will lie in the end."""
    frames = config.motion.frames
    report("tissue, robots and motion", 0, frames)
    tissue, other = _grow_tissues(config)
    times, scale = sample_times(config), enlargement(config.endoscope)
    cameras = place_cameras(small_world(config).endoscope)
    robot, error = load_robot(config), config.error
    if is_instrument(robot):
        check_instrument_distance(config.endoscope)
        arms = place_arms(robot, config.tip_link, cameras[0])
        joints = plan_motion(arms, [tissue, other], cameras[0], config)
    else:
        arm, positions = plan_arm(robot, [tissue, other], cameras[0], config, scale)
        arms, joints, error = (arm,), (positions,), measurement_error(robot, error)
    stage = Stage(arms, joints, times, scale, painted=not is_instrument(robot))

    tracing = _Tracing(config, stage, cameras, tissue, other)
    for frame in range(frames):
        if not _is_done(work, frame, cameras):
            tracing.trace(work, frame)
        report("frames", frame + 1, frames)

    measured = [
        measure(table, times, error, config.rng("measurement", arm.name))
        for arm, table in zip(arms, joints, strict=True)
    ]
    write_table(work / "kinematics.csv", arms, times, measured)
    write_table(work / "truth.csv", arms, times, joints)
    seen_by = [enlarged(camera, scale) for camera in cameras]
    write_sequence_file(work / "sequence.toml", config, output, arms, seen_by)


class _Tracing:
    """Renders one frame after the other into the work folder."""

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
        """All pictures of one frame. Its masks come last: they say that the frame is complete."""
        masks = []
        for number, camera in enumerate(self._cameras):
            view, mask = self._view(frame, number)
            masks.append(mask)
            for domain in self._config.domains:
                path = folder / "images" / domain / camera.name / f"{frame_name(frame)}.jpg"
                write_image(path, self._conditions.image(domain, view), self._config.sensor.jpeg_quality)
        for camera, mask in zip(self._cameras, masks, strict=True):
            write_mask(_mask_file(folder, frame, camera), mask)

    def _view(self, frame: int, number: int) -> tuple[View, np.ndarray]:
        camera, stage = self._cameras[number], self._stage
        if not self._gains:
            # The exposure is fixed by the first frame for the whole sequence, as a camera set up by hand has it.
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
            gain=self._gains[0],
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
    """The regular background and another one of another kind."""
    kinds = config.rng("kinds").permutation(KINDS)[:2]
    size = config.render.tissue_resolution, config.render.texture_resolution
    regular, other = (grow_tissue(kind, *size, config.rng("tissue", i)) for i, kind in enumerate(kinds))
    return regular, other


def _mask_file(folder: OutputPath, frame: int, camera: Camera) -> OutputPath:
    return folder / "masks" / camera.name / f"{frame_name(frame)}.png"


def _is_done(folder: OutputPath, frame: int, cameras: tuple[Camera, ...]) -> bool:
    return all(holds_file(_mask_file(folder, frame, camera)) for camera in cameras)
