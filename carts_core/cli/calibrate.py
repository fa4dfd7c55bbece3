"""`carts hand-eye`, `carts time-offset` and `carts calibrate`: base frames, cameras, and the delay of images."""

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from ..console import Bar, Terminal
from ..errors import SequenceError, SettingsError
from ..settings import CALIBRATION, FreeParameters
from ..settings.serialization import to_plain
from ..stopping import message_if_stopped
from ..wording import counted
from .options import CalibrationOptions, ObservationOptions, Selection, SequencePath, output_folder

if TYPE_CHECKING:
    from collections.abc import Sequence as Points

    from ..optimization import CalibrationOptimizer, CalibrationResult
    from ..optimization.hand_eye import HandEyeResult, ImagePoint
    from ..recording import Sequence


@dataclass(frozen=True)
class HandEye:
    """Estimate base frames without an initial pose, from landmarks clicked in 3 to 6 images, or from masks of an arm.

    The points are read from a table (docs/howto/own_recording.md). To click points, use *New recording* in `carts
    view`. Masks must contain the whole visible arm and nothing else; `carts calibrate --observe masks` refines the
    result.
    """

    sequence: SequencePath
    """Sequence file. Its base frames are ignored."""
    points: Path | None = None
    """CSV file with the columns frame (its id), camera, arm, landmark (tip, wrist yaw joint, wrist pitch joint,
    shaft edge, shaft middle), u and v [px of the undistorted image, from its upper left corner]."""
    output: Path | None = None
    """Folder to write to; by default `runs/NAME/hand_eye`."""
    overwrite: bool = False
    """Replace an earlier result in the folder."""
    focal_length: bool = False
    """Also estimate the focal lengths, and print their standard deviations. Requires points at several depths."""
    free_cameras: tuple[str, ...] = ()
    """Cameras whose pose relative to the other cameras is unknown."""
    pixel_error: float = 2.0
    """Expected error of a point [px]."""
    masks: str | None = None
    """Masks instead of points: `recording` or a source of masks as in `carts calibrate --masks`."""
    camera: str | None = None
    """With masks: camera whose images are masked; by default the first one."""

    def __post_init__(self) -> None:
        if (self.points is None) == (self.masks is None):
            raise SettingsError("give either --points FILE (clicked landmarks) or --masks (masks of the arm).")

    def run(self) -> None:
        """Solve and write the result; no files are left after an error."""
        if self.masks is None:
            self._from_points()
        else:
            self._from_masks(self.masks)

    def _from_masks(self, masks: str) -> None:
        from ..files import MARKER, published, write_text
        from ..optimization.hand_eye.silhouettes import placed, pose_from_masks
        from ..recording import Sequence, calibrated_sequence_file, evenly_spaced

        console = Terminal()
        sequence = Sequence.open(self.sequence, progress=console.print)
        (camera,) = Selection(camera=(self.camera or sequence.scene.cameras[0].name,)).camera_names(sequence.scene)
        arm = sequence.scene.arms[0].name
        if len(sequence.scene.arms) > 1 or camera in sequence.moving_cameras:
            raise SettingsError(
                "a hand-eye calibration from masks needs one arm and a camera that does not move. Click points: "
                "--points, or import one arm: carts import --arms."
            )
        observer = ObservationOptions(observe="masks", masks=masks).observer(CalibrationOptions().chosen, sequence)
        known = [n for n in range(len(sequence)) if observer.has_mask(sequence, n, camera)]
        if not known:
            raise SettingsError(
                f"no frame has a mask for camera {camera!r}. Give other masks, or click points: --points."
            )
        chosen = [known[n] for n in evenly_spaced(len(known), _MASKED_FRAMES)]
        given = observer.given
        seen = [sequence.frame(n, cameras=[camera]).masks or {} if given is None else given.masks(n) for n in chosen]
        whole = [found[camera] >= 0.5 for found in seen]
        found = pose_from_masks(sequence.scene, arm, camera, sequence.measured[arm][chosen], whole)
        scene = placed(sequence.scene, arm, camera, found.T_camera_base)
        output = output_folder(self.output, sequence.name, "hand_eye")
        with published(output, overwrite=self.overwrite) as folder:
            text = calibrated_sequence_file(sequence.path, output.path, sequence.scene, scene, "hand-eye")
            write_text(folder / "sequence.toml", text)
            write_text(folder / MARKER, json.dumps({"format": "hand-eye", "sequence": str(self.sequence)}, indent=1))
        console.print(f"{arm} in {camera}: mean IoU {found.iou:.2f} with the masks of {len(chosen)} frames")
        console.print(
            f"wrote {output}. To refine it: carts calibrate {output}/sequence.toml --observe masks --masks {masks}"
        )

    def _from_points(self) -> None:
        from ..files import MARKER, published, write_text
        from ..optimization.hand_eye import (
            RESULT_FILE,
            HandEyeSettings,
            mounts_of_points,
            moved_cameras,
            read_points,
            result_json,
            solve_hand_eye,
        )
        from ..recording import Sequence, calibrated_sequence_file

        console = Terminal()
        settings = HandEyeSettings(self.pixel_error, self.focal_length, self.free_cameras)
        sequence = Sequence.open(self.sequence, progress=console.print)
        assert self.points is not None
        points = read_points(self.points, sequence)
        mounts = mounts_of_points(sequence, points)
        result = solve_hand_eye(moved_cameras(sequence.scene, mounts), sequence.measured, points, settings)
        # Written poses of arms in cameras are those at the time of the points.
        content = result_json(sequence, points, result, self.free_cameras)
        result = replace(result, scene=moved_cameras(result.scene, mounts, back=True))
        output = output_folder(self.output, sequence.name, "hand_eye")
        with published(output, overwrite=self.overwrite) as folder:
            text = calibrated_sequence_file(sequence.path, output.path, sequence.scene, result.scene, "hand-eye")
            write_text(folder / "sequence.toml", text)
            write_text(folder / RESULT_FILE, json.dumps(content, indent=1))
            write_text(folder / MARKER, json.dumps({"format": "hand-eye", "sequence": str(self.sequence)}, indent=1))
        _print(console, sequence, points, result)
        console.print(f"wrote {output}. To refine it on the whole recording: carts calibrate {output}/sequence.toml")


def _print(console: Console, sequence: "Sequence", points: "Points[ImagePoint]", result: "HandEyeResult") -> None:
    used = len(result.distances) - len(result.contradicting)
    console.print(f"{used} points, residual {result.error:.1f} px")
    for (arm, camera), deviation in result.deviations.items():
        console.print(
            f"{arm} in {camera}: standard deviation {deviation.sideways_mm:.1f} mm lateral, {deviation.depth_mm:.1f} "
            f"mm in depth and {deviation.rotation_deg:.1f} deg"
        )
    for camera, deviation in result.focal_deviation.items():
        focal = result.scene.camera(camera).intrinsics[0]
        console.print(f"{camera}: focal length {focal:.0f} px, standard deviation {100 * deviation:.0f} %")
    for (arm, camera), more in result.missing.items():
        console.print(f"{arm} in {camera} is not calibrated: {more} more points are needed")
    for warning in result.warnings:
        console.print(warning)
    for index in result.contradicting:
        point = points[index]
        where = f"{point.arm} {point.landmark} in frame {sequence.frame_ids[point.frame]}, camera {point.camera}"
        console.print(f"row {index + 2} ({where}) is an outlier: residual {result.distances[index]:.0f} px")


@dataclass(frozen=True)
class TimeOffset:
    """Estimate the delay between images and joint positions from the motion of the arms, and propose a time_offset, or
    one for each arm if they differ.

    This requires neither a hand-eye calibration nor a network. The sequence file is not changed.
    """

    sequence: SequencePath
    """Sequence file; table rows must be matched to frames by time ([frames])."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder to create for a sequence file with the proposed time_offset; by default the offset is only printed."""
    overwrite: bool = False
    """Replace an earlier result in the folder."""
    camera: str | None = None
    """Camera whose images are used; by default the first camera."""
    domain: str | None = None
    """Domain of the images; by default the first domain."""
    largest: float = 3.0
    """Half-width of the search range around the current time_offset [s]."""

    def run(self) -> None:
        """Print the estimate, and write a sequence file if a folder is given."""
        from ..files import MARKER, published, write_text
        from ..recording import Sequence, calibrated_sequence_file, estimate_time_offsets, offsets_to_write

        console = Terminal()
        sequence = Sequence.open(self.sequence, progress=console.print)
        with Bar(console=console) as bar:
            task = bar.add_task("motion in the images", total=None)
            found = estimate_time_offsets(
                sequence,
                self.camera,
                domain=self.domain,
                largest=self.largest,
                progress=lambda done, total: bar.update(task, completed=done, total=total),
            )
        for each in found:
            console.print(each.sentence())
        if not (offsets := offsets_to_write(found, sequence)):
            return
        if missing := sequence.missing_rows(offsets):
            if len(missing) == len(sequence):
                raise SequenceError("No frame has rows at the proposed offset. Check the clocks.")
            console.print(
                f"{len(missing)} of {counted(len(sequence), 'frame')} have no rows at the proposed offset and are left "
                'out (missing_rows = "omit").'
            )
        if self.output is None:
            where = ", ".join(f"{value:g} in [[arms]] of {arm}" for arm, value in offsets.items() if arm)
            text = f"Set time_offset in {self.sequence}: {offsets['']:g} in [frames]{', ' if where else ''}{where}"
            text += ', and missing_rows = "omit" in [frames]' if missing else ""
            console.print(f"{text}; or give an output folder with -o.")
            return
        with published(self.output, overwrite=self.overwrite) as folder:
            scene = sequence.scene
            text = calibrated_sequence_file(
                sequence.path, self.output, scene, scene, "time-offset", offsets, omit=bool(missing)
            )
            write_text(folder / "sequence.toml", text)
            write_text(folder / MARKER, json.dumps({"format": "time-offset", "sequence": str(self.sequence)}, indent=1))
        console.print(f"wrote {self.output}/sequence.toml")


_SPREAD = "spread:"
_MASKED_FRAMES = 12
"""Maximum number of frames of a hand-eye calibration from masks."""


@dataclass(frozen=True)
class Calibrate:
    """Estimate base frames and cameras jointly from many frames; write a calibrated sequence file and a report."""

    sequence: SequencePath
    """Sequence file."""
    output: Path | None = None
    """Folder to write to; by default `runs/NAME/calibration`."""
    overwrite: bool = False
    """Replace an earlier calibration in the folder."""
    frames: str | None = None
    """Frames used for the calibration: `spread:20` (default) for 20 evenly spaced frames, or frame ids as in `carts
    evaluate`: `all`, `001-010,015`, `::3`."""
    positions: str | None = None
    """Frames by position in the sequence instead of id, counted from 1: `1-10,15`."""
    camera: tuple[str, ...] = Selection.camera
    """Cameras, by name; all are calibrated jointly."""
    domain: str | None = None
    """Domain, by name; by default the first domain of the sequence."""
    joint_prior_deg: float = 0.1
    """With `--joints`: standard deviation of the joint errors in a frame [deg]. Output files contain the measured
    joints.
    """
    beyond_hand_eye: bool = False
    """Write the calibration even if a base frame moves by more than the uncertainty estimated by `carts hand-eye`."""
    free: Annotated[FreeParameters, tyro.conf.arg(name="")] = CALIBRATION
    network: Annotated[ObservationOptions, tyro.conf.arg(name="")] = field(default_factory=ObservationOptions)
    solving: Annotated[CalibrationOptions, tyro.conf.arg(name="")] = field(default_factory=CalibrationOptions)

    def run(self) -> None:
        """Calibrate; no files are left after Ctrl-C or an error."""
        from ..evaluation import calibration_warning, frame_residuals, mean_dice, write_calibration
        from ..evaluation.calibration import beyond_prior
        from ..files import MARKER, published, write_text
        from ..optimization import Backgrounds, CalibrationOptimizer
        from ..optimization.hand_eye import read_prior
        from ..recording import Sequence
        from .printing import blank_hint, calibration_hint, print_hints

        console = Terminal()
        sequence = Sequence.open(self.sequence, progress=console.print)
        cameras = Selection(camera=self.camera).camera_names(sequence.scene)
        chosen = frame_indices(self.frames, self.positions, sequence)
        if not (indices := sequence.with_image(chosen, cameras)):
            raise SettingsError(
                f"no chosen frame has an image of {', '.join(cameras)}. Choose other frames or cameras."
            )
        print_hints(console, blank_hint(", ".join(cameras), chosen, indices))
        output = output_folder(self.output, sequence.name, "calibration")
        observer = self.network.observer(self.solving.chosen, sequence)
        prior = read_prior(sequence.path, sequence.scene)
        # Cameras whose poses were known before the hand-eye calibration are locked.
        known_cameras = [name for name in cameras if prior is not None and name not in prior.free_cameras]
        free = replace(self.free, locked_cameras=tuple(dict.fromkeys((*self.free.locked_cameras, *known_cameras))))
        observer.check(sequence, indices, cameras, [self.domain])
        if known_cameras and free.extrinsics:
            console.print(f"fixed, since known before `carts hand-eye`: the pose of {', '.join(known_cameras)}")
        with (
            message_if_stopped(f"nothing was written to {output}"),
            published(output, overwrite=self.overwrite) as folder,
        ):
            frames = [observer.completed(sequence.frame(index, self.domain, cameras)) for index in indices]
            domain = self.domain or sequence.domains[0]
            backgrounds = None if observer.masked else Backgrounds.of(sequence, cameras, domain)
            known = backgrounds is not None and backgrounds.covers(sequence.scene.with_cameras(cameras))
            hints = observer.warnings(sequence, indices[0], self.domain, tuple(cameras), background=known)
            print_hints(console, *(backgrounds.problems if backgrounds else ()), *hints)
            optimizer = CalibrationOptimizer(
                sequence.scene,
                frames,
                observer.predictor,
                settings=self.solving.chosen,
                free=free,
                joint_prior_deg=self.joint_prior_deg,
                ignore=[observer.ignore(index) for index in indices],
                cameras=cameras,
                backgrounds=backgrounds,
                known_base_frames=prior and prior.base_covariances,
            )
            result = _optimized(optimizer, console)
            text = beyond_prior(sequence.scene, result, prior.base_covariances) if prior else None
            if text is not None and not self.beyond_hand_eye:
                raise SettingsError(
                    f"{text[0].upper()}{text[1:]} Nothing was written. Check the clicked points, the joints and the "
                    "masks, or write it anyway with --beyond-hand-eye."
                )
            residuals = frame_residuals(sequence, frames, result)
            named = [sequence.frame_ids[index] for index in indices]
            write_calibration(folder, output.path, sequence, result, residuals)
            write_text(folder / MARKER, json.dumps(self._summary(observer.weights, named, cameras), indent=1))
        for camera in cameras:
            if (means := mean_dice(residuals, camera)) is not None:
                console.print(f"{camera}: mean Dice {means[0]:.4f} before, {means[1]:.4f} after")
        print_hints(console, self.network.caution)
        console.print(f"wrote {output}: sequence.toml, calibration.json and the report README.md")
        print_hints(
            console,
            calibration_hint(result.assessment, result.stop_reason),
            calibration_warning(sequence.scene, result),
        )

    def _summary(self, weights: str, frames: list[str], cameras: list[str]) -> dict:
        """Description of the run, for the marker file of the folder."""
        return {
            "format": "calibration",
            "sequence": str(self.sequence),
            "weights": weights,
            **self.network.observed,
            "frames": frames,
            "cameras": cameras,
            "domain": self.domain,
            "joint_prior_deg": self.joint_prior_deg,
            "free": asdict(self.free),
            "solver": to_plain(self.solving.chosen),
        }


def frame_indices(frames: str | None, positions: str | None, sequence: "Sequence") -> list[int]:
    """0-based indices selected by `--frames`, which may be `spread:COUNT`, or `--positions`; errors as in
    `Selection`."""
    frames = f"{_SPREAD}20" if frames is None and positions is None else frames
    if frames is None or not frames.startswith(_SPREAD):
        return Selection(frames, positions).frame_indices(sequence)
    count = frames.removeprefix(_SPREAD)
    if not (count.isdecimal() and int(count) >= 1):
        raise SettingsError(f"--frames {frames!r} selects no frame. Give a number of at least 1, such as `spread:20`.")
    if positions is not None:
        raise SettingsError("--frames and --positions are mutually exclusive. Give only one of them.")
    from ..recording import evenly_spaced

    return evenly_spaced(len(sequence), int(count))


def _optimized(optimizer: "CalibrationOptimizer", console: Console) -> "CalibrationResult":
    with Bar(console=console, transient=True) as bar:
        task = bar.add_task("calibrating", total=None)
        for iterate in optimizer:
            text = f"stage {iterate.stage + 1} of {iterate.stages}, loss {iterate.loss:.4f}"
            bar.update(task, description=text, total=iterate.stages, completed=iterate.stage)
    return optimizer.result()
