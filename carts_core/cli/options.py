"""Options shared by several commands: frames, cameras, projects, networks, fitted masks and solver settings."""

import json
import os
import re
from collections import Counter
from collections.abc import Iterable
from collections.abc import Sequence as Names
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tomlkit
import tyro

from ..errors import ProjectError, SettingsError
from ..files import OutputPath, output_path
from ..files.reading import SETTINGS, parse_toml, read_text
from ..settings import CALIBRATION_SETTINGS, FreeParameters, SequenceSettings, SolverName, SolverSettings, SurfaceSolver
from ..settings import solver as named_solver
from ..settings.optimization import Inference
from ..settings.ranges import Range, Ranged
from ..settings.serialization import changed, to_plain
from ..wording import closest, counted, shown

if TYPE_CHECKING:
    from rich.console import Console

    from ..model.scene import Scene
    from ..networks.extractor import FeatureExtractor
    from ..optimization import GivenMasks, MaskPredictor
    from ..optimization.sequence_frame import Ignore
    from ..project import ProjectState
    from ..project.masks import MaskLayer
    from ..recording import Frame, Sequence


ALL = "all"

Mode = Literal["frame", "sequence"]
"""Solve each frame individually, or all frames jointly (docs: sequences)."""


@dataclass(frozen=True)
class Selection:
    """Frames, cameras and domains of a sequence."""

    frames: str | None = None
    """Frame ids as in the recording and the page: `all` (default), `007`, a range in the order of the recording such as
    `001-010`, several separated by commas, or `::3` for every third frame.
    """
    positions: str | None = None
    """Frames by position in the sequence instead of id, counted from 1: `1-10,15`."""
    camera: tuple[str, ...] = (ALL,)
    """Cameras, by name."""
    domain: tuple[str, ...] = ()
    """Domains, by name, or `all`; by default the first domain of the sequence."""

    def frame_indices(self, sequence: "Sequence") -> list[int]:
        """Indices of the selected frames; errors are those of `chosen_frames`."""
        return chosen_frames(self.frames, self.positions, sequence.frame_ids)

    def camera_names(self, scene: "Scene") -> list[str]:
        """Names of the selected cameras; `RobotError` for an unknown camera."""
        if ALL in self.camera:
            return [camera.name for camera in scene.cameras]
        return [scene.camera(name).name for name in self.camera]

    def domain_names(self, sequence: "Sequence") -> list[str]:
        """Names of the selected domains; `SettingsError` for an unknown domain."""
        if not self.domain:
            return [sequence.domains[0]]
        if ALL in self.domain:
            return list(sequence.domains)
        for name in self.domain:
            if name not in sequence.domains:
                known = f"Its domains are: {', '.join(sequence.domains)}.{closest(name, sequence.domains)}"
                raise SettingsError(f"domain {name!r} is not in {sequence.path}. {known}")
        return list(self.domain)


def chosen_frames(frames: str | None, positions: str | None, ids: Names[str]) -> list[int]:
    """0-based indices selected by `--frames` (ids) or `--positions` (from 1); all frames if neither is given.

    Raises:
        SettingsError: both are given, a value is invalid, or a frame is not in the recording.
    """
    if frames is not None and positions is not None:
        raise SettingsError("--frames and --positions are mutually exclusive. Give only one of them.")
    if positions is not None:
        numbers = [str(position) for position in range(1, len(ids) + 1)]
        return _chosen("--positions", positions, numbers, "Positions count from 1, as in the viewer; they range from")
    text = ALL if frames is None else frames
    try:
        return _chosen("--frames", text, ids, "Frames are named as in the recording and the viewer:")
    except SettingsError as error:
        numbers = re.fullmatch(r"\d+(-\d+)?(,\d+(-\d+)?)*", text) and [int(one) for one in re.findall(r"\d+", text)]
        if not numbers or max(numbers) >= len(ids):
            raise
        today = re.sub(r"\d+", lambda number: ids[int(number[0])], text)
        raise SettingsError(f"{error} Earlier versions counted from 0; the equivalent is --frames {today}.") from None


def _chosen(option: str, text: str, names: Names[str], known: str) -> list[int]:
    """Indices of the names selected by a list of names, ranges and steps."""
    place = {name: index for index, name in enumerate(names)}
    known = f"{known} {names[0]} to {names[-1]}. Give `all`, `{names[0]}`, `{names[0]}-{names[-1]}` or `::3`."
    if text == ALL:
        return list(range(len(names)))
    chosen: set[int] = set()
    for part in [text] if text in place else text.split(","):
        if (step := re.fullmatch("::([1-9][0-9]*)", part)) is not None:
            chosen.update(range(0, len(names), int(step[1])))
            continue
        dashes = [match.start() for match in re.finditer("-", part)]
        spans = [(part, part), *((part[:dash], part[dash + 1 :]) for dash in dashes)]
        span = next((span for span in spans if place.keys() >= set(span)), None)
        if span is None:
            asked = next((name for name in spans[-1] if name and name not in place), part)
            raise SettingsError(f"{option} {text}: there is no {shown(asked)}.{closest(asked, names)} {known}")
        first, last = place[span[0]], place[span[1]]
        if last < first:
            raise SettingsError(f"{option} {text}: {span[1]} comes before {span[0]}. Give {span[1]}-{span[0]}.")
        chosen.update(range(first, last + 1))
    return sorted(chosen)


NO_PROJECT = "none"
"""Value of `--project` that selects the measured recording."""


@dataclass(frozen=True)
class ProjectOption:
    """Project whose corrections are applied."""

    project: str | None = None
    """Project file whose corrections (joints, calibration, time offset, masks) are used; by default the project beside
    the sequence, if it exists; `none` for the measured recording.
    """

    @property
    def named(self) -> bool:
        """Whether a project file was given."""
        return self.project not in (None, NO_PROJECT)

    def path(self, sequence_file: Path) -> Path | None:
        """Path of the project file; None without a project. `SettingsError` if the given file is missing."""
        if self.project == NO_PROJECT:
            return None
        from ..project import default_path

        path = Path(self.project) if self.project is not None else default_path(sequence_file)
        if not path.is_file():
            if self.project is None:
                return None
            raise SettingsError(f"--project {self.project} is missing. Give a project file, or `{NO_PROJECT}`.")
        return path

    def read(self, sequence: "Sequence") -> "ProjectState | None":
        """Read the current state of the project; None without a project. `SettingsError` or `ProjectError` if the
        project cannot be used."""
        path = self.path(sequence.path)
        if path is None:
            return None
        from ..project import Project

        try:
            with Project.open(sequence, path, read_only=True) as project:
                return project.state
        except ProjectError as error:
            raise ProjectError(f"{error} To ignore the project: --project {NO_PROJECT}.") from error

    def sentence(self, sequence: "Sequence", project: "ProjectState | None", frames: Names[int]) -> str | None:
        """Message on the project in use and the review states of the selected frames; None without a project."""
        if project is None:
            return None
        states = Counter(project.review(index).state.value for index in frames)
        counts = ", ".join(f"{count} {state}" for state, count in states.most_common())
        return (
            f"corrections of {self.path(sequence.path)}: {counts} of {counted(len(frames), 'frame')}; "
            f"--project {NO_PROJECT} uses the measured joints"
        )

    def corrected(self, sequence: "Sequence", frames: Names[int], console: "Console") -> "Sequence":
        """Apply the project's corrections to the sequence and print a note; without a project, return the sequence
        unchanged. Errors as in `read`.
        """
        project = self.read(sequence)
        if project is None:
            return sequence
        from ..project.state import corrected_sequence

        console.print(self.sentence(sequence, project, frames), soft_wrap=True)
        return corrected_sequence(sequence, project)


class RangedOptions(Ranged):
    """Base of options with ranges; messages use the command-line names of the options."""

    @classmethod
    def label(cls, field: str) -> str:
        """Command-line name of an option."""
        return f"--{field.replace('_', '-')}"


@dataclass(frozen=True)
class Perturbation(RangedOptions):
    """Perturbation of the initial joint positions, for experiments."""

    perturb_deg: Annotated[float, Range(0, 180)] = 0.0
    """Offset of every initial joint position [deg, mm] from the true joint positions, if known, else from the measured
    joint positions. 0 starts at the measured positions.
    """
    seed: Annotated[int, Range(0)] = 0
    """Random seed of the signs of the offsets; in sequence mode, all frames have the same signs."""


_ENGINES: dict[str, Inference] = {"cpu:torch": "torch", "cpu:onnx": "onnx", "cpu:int8": "int8"}
"""Device names that select the CPU and an inference engine of the surface network."""


@dataclass(frozen=True)
class Network:
    """Weights of the networks, and the device that runs them."""

    weights: tuple[Path, ...] = ()
    """Weights files; by default the shipped weights of each network."""
    device: str = "cpu"
    """Device of the networks: `cpu`, or a CUDA device such as `cuda` or `cuda:1`. On a CPU, the surface network runs in
    torch, in ONNX Runtime (results agree to 1e-4), or quantized to 8-bit integers (root mean square difference of
    coverage 0.006; only shipped weights, on x86 with VNNI instructions), whichever is fastest in a benchmark that runs
    once; `cpu:torch`, `cpu:onnx` and `cpu:int8` select the engine.
    """

    def __post_init__(self) -> None:
        if self.device not in _ENGINES:
            check_device(self.device)

    @property
    def processor(self) -> str:
        """PyTorch device string of the networks."""
        return "cpu" if self.device in _ENGINES else self.device

    @property
    def inference(self) -> Inference:
        """Inference engine of the surface network."""
        return _ENGINES.get(self.device, "auto")

    def load(self) -> "FeatureExtractor":
        """Load the networks; `WeightsError` or `SettingsError` if weights, device or engine cannot be used."""
        from ..networks.extractor import FeatureExtractor

        return FeatureExtractor.load(*self.weights, device=self.processor, inference=self.inference)


def check_device(device: str) -> None:
    """Check that a device exists; `SettingsError` otherwise."""
    if device == "cpu":
        return
    import torch

    kind, _, number = device.partition(":")
    cards = torch.cuda.device_count()
    if kind == "cuda" and cards and (not number or (number.isdigit() and int(number) < cards)):
        return
    known = ", ".join(["cpu", *_ENGINES, *(f"cuda:{card}" for card in range(cards))])
    raise SettingsError(f"device {device!r} does not exist on this machine. Available: {known}.")


def output_folder(named: Path | None, *default: str) -> OutputPath:
    """Output folder of a command: the given folder, else the default path below `runs`."""
    return output_path(Path(), "runs", *default) if named is None else output_path(named)


def check_writable(folder: Path) -> None:
    """Check in advance that a folder can be written to or created; `SettingsError` otherwise."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not (there.is_dir() and os.access(there, os.W_OK)):
        raise SettingsError(
            f"{folder} cannot be created or written to: {there} is not a writable folder. Give another folder."
        )


SequencePath = Annotated[Path, tyro.conf.Positional]
"""Sequence file, given as the first argument."""


@dataclass(frozen=True)
class FrameFreeParameters(FreeParameters):
    """Free parameters of frames; rarely used parameters are set with --settings."""

    locked_cameras: tyro.conf.Suppress[tuple[str, ...]] = ()


@dataclass(frozen=True)
class SolverOptions:
    """Solver and its settings."""

    solver: Annotated[SolverName, tyro.conf.EnumChoicesFromValues] = SolverName.SURFACE
    """Solver: `surface` is the default; `occluded` repeats the optimization without occluded pixels; `acs`,
    `acs_reference`, `l1` and `paper` compare image features, as in the paper; `none` only evaluates the initial state.
    """
    settings: tuple[str, ...] = ()
    """Settings that override the defaults of the solver: TOML files as written by --print-settings, or single settings
    such as `iterations=20`, `sequence.initial_frames=3` and `free.locked_cameras=["left"]`."""

    def __post_init__(self) -> None:
        _ = self.chosen, self.sequence, self.freed(FreeParameters())  # Unusable files are reported immediately.

    @property
    def chosen(self) -> SolverSettings:
        """Settings of the solver."""
        return changed(named_solver(self.solver), _table(self.settings, "solver"), "[solver]")

    @property
    def sequence(self) -> SequenceSettings:
        """Settings of sequence mode."""
        return changed(SequenceSettings(), _table(self.settings, "sequence"), "[sequence]")

    def freed(self, free: FreeParameters) -> FreeParameters:
        """Merge the free parameters of options and settings."""
        return changed(free, _table(self.settings, "free"), "[free]")

    def check_surface(self, what: str) -> None:
        """Check that the solver is `surface`, whose standard deviations `what` requires."""
        if self.solver is not SolverName.SURFACE:
            raise SettingsError(
                f"{what} requires --solver surface, but --solver {self.solver} was given. Remove one of the options."
            )

    def printed(self) -> str:
        """All settings, formatted as a settings file."""
        return tomlkit.dumps({"solver": to_plain(self.chosen), "sequence": to_plain(self.sequence)})


@dataclass(frozen=True)
class CalibrationOptions:
    """Settings of a calibration."""

    settings: tuple[str, ...] = ()
    """Settings that override the defaults: TOML files as written by --print-settings, or single settings such as
    `iterations=20`."""

    def __post_init__(self) -> None:
        _ = self.chosen

    @property
    def chosen(self) -> SurfaceSolver:
        """Settings of the solver."""
        return changed(CALIBRATION_SETTINGS, _table(self.settings, "solver", ("solver",)), "[solver]")

    def printed(self) -> str:
        """All settings, formatted as a settings file."""
        return tomlkit.dumps({"solver": to_plain(self.chosen)})


def _table(
    given: tuple[str, ...], name: str, allowed: tuple[str, ...] = ("solver", "sequence", "free")
) -> dict[str, Any]:
    """Table `name` of all --settings merged; later values take precedence."""
    found: dict[str, Any] = {}
    for text in given:
        remedy = "Give a file in the format of --print-settings, or `NAME=VALUE`."
        try:
            single = "=" in text and not os.path.exists(text)
            content = parse_toml(_of_solver(text) if single else read_text(Path(text), SETTINGS))
        except (OSError, UnicodeDecodeError) as error:
            raise SettingsError(f"--settings {text} cannot be read: {error}. {remedy}") from error
        except ValueError as error:
            raise SettingsError(f"--settings {text} is not TOML: {error}. {remedy}") from error
        strangers = set(content) - set(allowed)
        if strangers or not all(isinstance(table, dict) for table in content.values()):
            wrong = ", ".join(sorted(strangers)) or "values outside tables"
            tables = ", ".join(f"[{table}]" for table in allowed)
            raise SettingsError(f"--settings {text} contains {wrong}; allowed: tables {tables}.")
        found.update(content.get(name, {}))
    return found


def _of_solver(text: str) -> str:
    """Convert a single setting to TOML; a setting without a table belongs to the solver, and a bare word is a
    string."""
    key, _, value = (part.strip() for part in text.partition("="))
    key = key if "." in key else f"solver.{key}"
    try:
        parse_toml(f"value = {value}")
    except ValueError:
        value = json.dumps(value)
    return f"{key} = {value}"


RECORDING = "recording"
"""Value of `--masks` for the masks of the sequence file."""
LAYERS: dict[str, "MaskLayer"] = {"imported": "imported", "painted": "painted"}
"""Value of `--masks` -> layer of the sequence's project."""


@dataclass(frozen=True)
class Observer:
    """Source of the observations: a network, given masks, or both."""

    predictor: "FeatureExtractor | MaskPredictor"
    weights: str
    """Fingerprint of the networks and their engine; empty without networks."""
    masked: bool
    """Whether masks are fitted."""
    given: "GivenMasks | None" = None
    """Fitted masks; None for the masks of the sequence file."""
    every: bool = False
    """Whether each frame needs a mask."""

    @property
    def ignore(self) -> "Ignore":
        """Frame index -> camera name -> pixels excluded from comparison."""
        return (lambda _: {}) if self.given is None else self.given.ignored

    def completed(self, frame: "Frame") -> "Frame":
        """Copy of a frame, with the given masks for cameras without a recorded mask."""
        return frame if self.given is None else self.given.filled(frame)

    def mask_inputs(
        self, sequence: "Sequence", index: int, cameras: Iterable[str], domain: str | None
    ) -> tuple[object, ...]:
        """Masks that the result of a frame depends on, as inputs of a fingerprint."""
        if self.given is None:
            return tuple((camera, str(sequence.mask_fingerprint(index, camera, domain))) for camera in sorted(cameras))
        return tuple(sorted(masks(index).items()) for masks in (self.given.masks, self.given.ignored))

    def check(
        self, sequence: "Sequence", frames: Iterable[int], cameras: Iterable[str], domains: Iterable[str | None]
    ) -> None:
        """Check that all frames have the required masks; `SettingsError` otherwise."""
        if not self.masked:
            return
        frames = list(frames)
        for camera, domain in product(cameras, domains):
            shown = sequence.with_image(frames, [camera])
            without = [index for index in shown if not self.has_mask(sequence, index, camera, domain)]
            # If the network is also used, recorded masks may be missing, but external masks must belong to this
            # recording.
            if without and (self.every or (self.given is not None and len(without) == len(shown))):
                raise SettingsError(
                    f"{len(without)} of {counted(len(shown), 'frame')} have no {self._origin} for camera "
                    f"{camera!r}; the first is frame {sequence.frame_ids[without[0]]}. Choose other frames or "
                    "cameras with --frames and --camera, or use the network for these frames with --observe both."
                )

    @property
    def _origin(self) -> str:
        return "mask" if self.given is None else self.given.origin

    def has_mask(self, sequence: "Sequence", index: int, camera: str, domain: str | None = None) -> bool:
        """Whether a frame has a mask to be fitted."""
        if self.given is None:
            return sequence.has_masks(camera, domain, index)
        return self.given.available(index, camera)

    def warnings(
        self, sequence: "Sequence", index: int, domain: str | None, cameras: tuple[str, ...], *, background: bool
    ) -> list[str]:
        """Warnings based on one frame: arms or images are outside the network's domain, or masks of cameras are
        missing.

        Args:
            background: whether the solver uses the empty background.
        """
        if self.masked:
            without = [camera for camera in cameras if not self.has_mask(sequence, index, camera, domain)]
            if not without or len(without) == len(cameras):
                return []
            return [
                f"Frame {sequence.frame_ids[index]} has no {self._origin} for camera {', '.join(without)}, so all "
                f"cameras fitted together ({', '.join(cameras)}) use the network in this frame, even those with masks. "
                "Leave out that camera with --camera, or give masks for it."
            ]
        from ..optimization import check_domain

        frame = sequence.frame(index, domain, cameras)
        found = check_domain(sequence.scene.with_cameras(cameras), frame, self.predictor)
        return found.warnings(", ".join(cameras), background=background)


@dataclass(frozen=True)
class ObservationOptions(Network):
    """Options for the fitted observations: predictions of the network, masks, or both."""

    observe: Literal["network", "masks", "both"] = "network"
    """Fitted observations: predictions of the network, the sequence's masks (no network is loaded), or both: masks for
    coverage, and the network for parts, normals and frames without a mask.
    """
    masks: str = RECORDING
    """Masks to fit: `recording` for the masks of the sequence file, `imported` or `painted` for the masks of its
    project (`carts import-masks`, `carts view`), a layer of another project such as `other.carts:painted`, or a file or
    folder of masks (docs: masks).
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.masks != RECORDING and self.observe == "network":
            raise SettingsError(
                f"--masks {self.masks} requires --observe masks or both. Add --observe, or leave out --masks."
            )
        if self.masks in (RECORDING, *LAYERS):
            return
        named = self._layer[0] or Path(self.masks)
        if not named.exists():
            raise SettingsError(
                f"--masks {self.masks} is missing. Give {RECORDING}, {', '.join(LAYERS)}, a layer of another project, "
                "such as other.carts:painted, or a file or folder of masks."
            )

    def observer(self, settings: SolverSettings, sequence: "Sequence") -> Observer:
        """Create the observer of a sequence for a solver.

        Raises:
            CartsError: the solver compares image features, or weights or masks cannot be used.
        """
        if self.observe != "network" and not isinstance(settings, SurfaceSolver):
            raise SettingsError(
                f"--observe {self.observe} requires the solver surface, occluded or none; the given solver compares "
                "image features. Leave out --solver or --observe."
            )
        if self.observe == "masks" and self.weights:
            raise SettingsError("--observe masks loads no network, but --weights was given. Remove one of the options.")
        from ..optimization import MaskPredictor, NetworkPredictor

        given = self._given(sequence)
        masks, origin = (None, "mask") if given is None else (given.masks, given.origin)
        if self.observe == "masks":
            only = MaskPredictor(None, masks, origin=origin)
            return Observer(only, "", masked=True, given=given, every=True)
        extractor = self.load()
        if self.observe == "both":
            both = MaskPredictor(NetworkPredictor(extractor), masks, origin=origin)
            return Observer(both, extractor.fingerprint, masked=True, given=given)
        return Observer(extractor, extractor.fingerprint, masked=False)

    @property
    def _layer(self) -> "tuple[Path | None, MaskLayer | None]":
        """Project file (None for the default one) and fitted layer; the layer is None for masks that are not in a
        project.
        """
        from ..project.identity import SUFFIX

        project, _, name = self.masks.rpartition(":")
        layer = LAYERS.get(name)
        if layer is None or (project and not project.endswith(SUFFIX)):
            return None, None
        return Path(project) if project else None, layer

    def _given(self, sequence: "Sequence") -> "GivenMasks | None":
        """Masks to be fitted; None for the masks of the sequence file."""
        if self.masks == RECORDING:
            return None
        from ..project import Project
        from ..project.masks import file_masks, project_masks

        path, layer = self._layer
        if layer is None:
            return file_masks(Path(self.masks), sequence)
        with Project.open(sequence, path, read_only=True) as project:
            state = project.state
        return project_masks(layer, state, sequence)

    @property
    def observed(self) -> dict[str, str]:
        """Description of the observations, for a results file."""
        elsewhere = {} if self.masks == RECORDING else {"masks": self.masks}
        return {"observed": self.observe, **elsewhere}

    @property
    def caution(self) -> str | None:
        """Remark that Dice scores refer to the fitted masks; None without fitted masks."""
        if self.observe == "network":
            return None
        text = "Dice is computed with the fitted masks, so it measures agreement with these masks instead of accuracy."
        return text if self.masks == RECORDING else f"If the recording has no masks, {text}"


@dataclass(frozen=True)
class OptimizeOptions:
    """Options of `carts optimize`."""

    sequence: SequencePath
    """Sequence file."""
    output: Path | None = None
    """Output folder; by default `runs/NAME`. Results are written to its subfolder `DOMAIN/CAMERA`, where CAMERA
    combines the names of all cameras with --together."""
    overwrite: bool = False
    """Discard earlier results in the folder and start over."""
    mode: Mode = "frame"
    """Correct each frame individually, or all frames jointly (docs: sequences)."""
    together: bool = False
    """Optimize each frame jointly over all selected cameras (stereo); otherwise once per camera."""
    keyframes: Path | None = None
    """In `sequence` mode: kinematics table whose rows with source `edited` are keyframes."""
    start: Annotated[Perturbation, tyro.conf.arg(name="")] = field(default_factory=Perturbation)
    select: Annotated[Selection, tyro.conf.arg(name="")] = field(default_factory=Selection)
    free: Annotated[FrameFreeParameters, tyro.conf.arg(name="")] = field(default_factory=FrameFreeParameters)
    network: Annotated[ObservationOptions, tyro.conf.arg(name="")] = field(default_factory=ObservationOptions)
    solving: Annotated[SolverOptions, tyro.conf.arg(name="")] = field(default_factory=SolverOptions)

    def __post_init__(self) -> None:
        if self.keyframes is not None and self.mode != "sequence":
            raise SettingsError(
                f"--keyframes {self.keyframes} requires --mode sequence. Add --mode sequence, or leave out --keyframes."
            )
        if self.mode == "sequence":
            self.solving.check_surface("--mode sequence")
