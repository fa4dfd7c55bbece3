"""Which frames, cameras and domains a command works on, and from where. Shared by commands, declared once."""

import os
import re
from collections import Counter
from collections.abc import Sequence as Names
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..errors import ProjectError, SettingsError
from ..files import OutputPath, output_path
from ..settings.optimization import Inference
from ..wording import closest, counted, shown

if TYPE_CHECKING:
    from rich.console import Console

    from ..model.scene import Scene
    from ..networks.extractor import FeatureExtractor
    from ..project import ProjectState
    from ..recording import Sequence

ALL = "all"

Mode = Literal["frame", "sequence"]
"""Each frame alone, or all together, each knowing what the others found (docs: sequences)."""


@dataclass(frozen=True)
class Selection:
    """What of a sequence is worked on."""

    frames: str | None = None
    """Frames by their ids, as the recording and the page name them: `all` (the default), `007`, `001-010` in the
    recording's order, several with commas, or `::3` for every third."""
    positions: str | None = None
    """Frames by position, counted from 1 as in the page, instead: `1-10,15`."""
    camera: tuple[str, ...] = (ALL,)
    """Cameras, by name."""
    domain: tuple[str, ...] = ()
    """Domains, by name, or `all`; the sequence's first one if none is named."""

    def frame_indices(self, sequence: "Sequence") -> list[int]:
        """Positions of the chosen frames.

        Raises:
            SettingsError: `frames` or `positions` is not readable, or names a frame that is not in the sequence.
        """
        return chosen_frames(self.frames, self.positions, sequence.frame_ids)

    def camera_names(self, scene: "Scene") -> list[str]:
        """Names of the chosen cameras.

        Raises:
            RobotError: there is no such camera.
        """
        if ALL in self.camera:
            return [camera.name for camera in scene.cameras]
        return [scene.camera(name).name for name in self.camera]

    def domain_names(self, sequence: "Sequence") -> list[str]:
        """Names of the chosen domains.

        Raises:
            SettingsError: there is no such domain.
        """
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
    """0-based indices that `--frames` or `--positions` chooses.

    Args:
        frames: by id; all frames where neither is given.
        positions: counted from 1.
        ids: of the frames, in the recording's order.

    Raises:
        SettingsError: both are given, or one is not readable, or names a frame that the recording does not have.
    """
    if frames is not None and positions is not None:
        raise SettingsError("--frames and --positions are both given. Give one of them.")
    if positions is not None:
        numbers = [str(position) for position in range(1, len(ids) + 1)]
        return _chosen("--positions", positions, numbers, "Positions count from 1, as in the page; there are")
    text = ALL if frames is None else frames
    try:
        return _chosen("--frames", text, ids, "Frames are named as in the recording and the page:")
    except SettingsError as error:
        if (today := _counted_from_0(text, ids)) is None:
            raise
        raise SettingsError(f"{error} Earlier versions counted from 0; then this was --frames {today}.") from None


def _chosen(option: str, text: str, names: Names[str], known: str) -> list[int]:
    """Indices of the names in a text of names, ranges and steps."""
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


def _counted_from_0(text: str, ids: Names[str]) -> str | None:
    """A text of numbers and ranges counted from 0, as `--frames` once was, with ids instead; None for another one."""
    if not re.fullmatch(r"\d+(-\d+)?(,\d+(-\d+)?)*", text) or max(map(int, re.findall(r"\d+", text))) >= len(ids):
        return None
    return re.sub(r"\d+", lambda number: ids[int(number[0])], text)


NO_PROJECT = "none"
"""The recording as measured, whatever project lies beside it."""


@dataclass(frozen=True)
class FromProject:
    """Whose corrections are used."""

    project: str | None = None
    """Project whose corrections (joints, calibration, time offset, masks) are used: by default that beside the
    sequence, if there is one; `none` for the recording as measured, or a file."""

    @property
    def named(self) -> bool:
        """Whether a file was named."""
        return self.project not in (None, NO_PROJECT)

    def path(self, sequence_file: Path) -> Path | None:
        """The project's file; None where there is none, or none is to be used.

        Raises:
            SettingsError: the file that was named is missing.
        """
        if self.project == NO_PROJECT:
            return None
        from ..project import default_path

        path = Path(self.project) if self.project is not None else default_path(sequence_file)
        if not path.is_file():
            if self.project is None:
                return None
            raise SettingsError(f"--project {self.project} is missing. Name a project file, or `{NO_PROJECT}`.")
        return path

    def read(self, sequence: "Sequence") -> "ProjectState | None":
        """The project as it is now; None where there is none, or none is to be used.

        Raises:
            SettingsError: the file that was named is missing.
            ProjectError: it is of another sequence, or cannot be read.
        """
        path = self.path(sequence.path)
        if path is None:
            return None
        from ..project import Project

        try:
            with Project.open(sequence, path, read_only=True) as project:
                return project.state
        except ProjectError as error:
            raise ProjectError(f"{error} Or leave it out: --project {NO_PROJECT}.") from error

    def sentence(self, sequence: "Sequence", project: "ProjectState | None", frames: Names[int]) -> str | None:
        """Which project is used, with the review states of the chosen frames; None without one."""
        if project is None:
            return None
        states = Counter(project.review(index).state.value for index in frames)
        counts = ", ".join(f"{count} {state}" for state, count in states.most_common())
        return (
            f"as corrected in {self.path(sequence.path)}: {counts} of {counted(len(frames), 'frame')}; "
            f"--project {NO_PROJECT} for the recording as measured"
        )

    def corrected(self, sequence: "Sequence", frames: Names[int], console: "Console") -> "Sequence":
        """The sequence as its project corrects it, which is printed; as it is without one.

        Raises:
            CartsError: as `read`, or the project's time offset leaves a frame without joint positions.
        """
        project = self.read(sequence)
        if project is None:
            return sequence
        from ..project.calibrated import corrected_sequence

        console.print(self.sentence(sequence, project, frames), soft_wrap=True)
        return corrected_sequence(sequence, project)


@dataclass(frozen=True)
class Perturbation:
    """Wrong joint positions on purpose, to see what becomes of them."""

    perturb_deg: float = 0.0
    """Start that many degrees (and millimetres) off on every measured joint: off the true joint positions where the
    sequence has them, else off the measured ones. 0 starts at the measured ones."""
    seed: int = 0
    """Seed of the error's signs; these are the same in all frames in sequence mode."""

    def __post_init__(self) -> None:
        if not 0 <= self.perturb_deg <= 180:
            raise SettingsError(
                f"--perturb-deg is {self.perturb_deg:g}; allowed is 0 to 180. Give a size; signs are drawn from --seed."
            )
        if self.seed < 0:
            raise SettingsError(f"--seed is {self.seed}; allowed is 0 or more.")


_ENGINES: dict[str, Inference] = {"cpu:torch": "torch", "cpu:onnx": "onnx"}
"""Devices that say who runs the surface network there."""


@dataclass(frozen=True)
class Network:
    """The networks and where they run."""

    weights: tuple[Path, ...] = ()
    """Weights files; a network that none is given of is the shipped one."""
    device: str = "cpu"
    """`cpu`, or a CUDA device such as `cuda` or `cuda:1` for the networks. On a CPU the surface network is run by torch
    or ONNX Runtime (the same to 1e-4), whichever was faster when it was measured here, once; `cpu:torch` and `cpu:onnx`
    name one."""

    def __post_init__(self) -> None:
        if self.device not in _ENGINES:
            check_device(self.device)

    @property
    def processor(self) -> str:
        """Device of the networks, as torch names it."""
        return "cpu" if self.device in _ENGINES else self.device

    @property
    def inference(self) -> Inference:
        """Who runs the surface network."""
        return _ENGINES.get(self.device, "auto")

    def load(self) -> "FeatureExtractor":
        """The networks.

        Raises:
            WeightsError: a weights file cannot be used.
            SettingsError: nobody here can run them as asked for.
        """
        from ..networks.extractor import FeatureExtractor

        return FeatureExtractor.load(*self.weights, device=self.processor, inference=self.inference)


def check_device(device: str) -> None:
    """See that a device exists.

    Raises:
        SettingsError: it does not.
    """
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
    """The folder that a command writes to: the one that a person named, else the one of these names in `runs`.

    Raises:
        OutputError: one of the names cannot be part of a path.
    """
    return output_path(Path(), "runs", *default) if named is None else output_path(named)


def check_writable(folder: Path) -> None:
    """See that a folder can be written to or made, before any work is done.

    Raises:
        SettingsError: it cannot.
    """
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not (there.is_dir() and os.access(there, os.W_OK)):
        raise SettingsError(f"{folder} cannot be made or written to, because of {there}. Name another folder.")


SequencePath = Annotated[Path, tyro.conf.Positional]
"""A sequence file as the first argument."""
