"""Which frames, cameras and domains a command works on, and from where. Shared by commands, declared once."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..errors import SettingsError
from ..files import OutputPath, output_path
from ..settings.inference import Inference

if TYPE_CHECKING:
    from ..model.scene import Scene
    from ..networks.extractor import FeatureExtractor
    from ..recording import Sequence

ALL = "all"

Mode = Literal["frame", "sequence"]
"""Each frame alone, or all together, each knowing what the others found (docs: sequences)."""


@dataclass(frozen=True)
class Selection:
    """What of a sequence is worked on."""

    frames: str = ALL
    """Positions of frames, counted from 0: `all`, numbers and ranges such as `0-9,15`, or `::3` for every third."""
    camera: tuple[str, ...] = (ALL,)
    """Cameras, by name."""
    domain: tuple[str, ...] = ()
    """Domains, by name, or `all`; the sequence's first one if none is named."""

    def frame_indices(self, sequence: "Sequence") -> list[int]:
        """Positions of the chosen frames.

        Raises:
            SettingsError: `frames` is not readable or leaves the sequence.
        """
        return parse_frames(self.frames, len(sequence))

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
                known = ", ".join(sequence.domains)
                raise SettingsError(f"domain {name!r} is not in {sequence.path}. Its domains are: {known}.")
        return list(self.domain)


def parse_frames(text: str, count: int) -> list[int]:
    """Positions that a `--frames` text means in a sequence of `count` frames.

    Raises:
        SettingsError: the text is not readable, names no frame or leaves the sequence.
    """
    hint = "Give `all`, numbers and ranges such as `0-9,15`, or a slice such as `::3`."
    if text == ALL:
        return list(range(count))
    chosen: list[int] = []
    try:
        for part in text.split(","):
            if ":" in part:
                chosen += range(count)[slice(*(int(bound) if bound else None for bound in part.split(":")))]
            else:
                first, _, last = part.partition("-")
                chosen += range(int(first), int(last or first) + 1)
    except (ValueError, TypeError) as error:
        raise SettingsError(f"--frames {text!r} is not readable. {hint}") from error
    outside = [index for index in chosen if not 0 <= index < count]
    if outside or not chosen:
        wrong = f"frame {outside[0]} is outside" if outside else f"{text!r} names no frame"
        raise SettingsError(f"--frames: {wrong}; the sequence has positions 0 to {count - 1}. {hint}")
    return sorted(set(chosen))


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
