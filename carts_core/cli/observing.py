"""What is fitted: predictions of the network, given masks, or both."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..errors import SettingsError
from ..settings import SolverSettings, SurfaceSolver
from ..wording import counted
from .selection import Network

if TYPE_CHECKING:
    from ..networks.extractor import FeatureExtractor
    from ..optimization import GivenMasks, MaskPredictor
    from ..optimization.measurement import Ignore
    from ..project.target_masks import MaskLayer
    from ..recording import Frame, Sequence

RECORDING = "recording"
"""Masks of the sequence file."""
LAYERS: dict[str, "MaskLayer"] = {"imported": "imported", "painted": "painted"}
"""Masks of its project."""


@dataclass(frozen=True)
class Observer:
    """Who says what images show."""

    predictor: "FeatureExtractor | MaskPredictor"
    weights: str
    """Fingerprint of the networks and of who runs them; empty without any."""
    masked: bool
    """Whether masks are fitted."""
    given: "GivenMasks | None" = None
    """The masks that are fitted, where they are not those of the sequence file."""
    every: bool = False
    """Whether each frame needs a mask."""

    @property
    def ignore(self) -> "Ignore":
        """Position of a frame -> camera name -> pixels that are not compared."""
        return (lambda _: {}) if self.given is None else self.given.ignored

    def completed(self, frame: "Frame") -> "Frame":
        """A frame with the masks that are fitted, for cameras that the recording has no mask of."""
        return frame if self.given is None else self.given.filled(frame)

    def inputs(self, frame: "Frame") -> tuple[object, ...]:
        """What of a frame's masks its result depends on, for a fingerprint."""
        if self.given is None:
            return tuple(sorted((frame.masks or {}).items()))
        return tuple(sorted(what(frame.index).items()) for what in (self.given.masks, self.given.ignored))

    def check(
        self, sequence: "Sequence", frames: Iterable[int], cameras: Iterable[str], domains: Iterable[str | None]
    ) -> None:
        """See that all frames have what is to be fitted, before any of them is solved.

        Raises:
            SettingsError: they have not.
        """
        if not self.masked:
            return
        frames = list(frames)
        for camera, domain in product(cameras, domains):
            without = [index for index in frames if not self._has_mask(sequence, index, camera, domain)]
            # With the network beside them, masks of others have to be of this recording, and its own may be missing.
            if without and (self.every or (self.given is not None and len(without) == len(frames))):
                raise SettingsError(
                    f"{len(without)} of {counted(len(frames), 'frame')} have no {self._origin} of camera "
                    f"{camera!r}; the first is frame {sequence.frame_ids[without[0]]}. Choose "
                    "others with --frames and --camera, or leave them to the network with --observe both."
                )

    @property
    def _origin(self) -> str:
        return "mask" if self.given is None else self.given.origin

    def _has_mask(self, sequence: "Sequence", index: int, camera: str, domain: str | None) -> bool:
        if self.given is None:
            return sequence.has_masks(camera, domain, index)
        return self.given.there(index, camera)

    def warnings(
        self, sequence: "Sequence", index: int, domain: str | None, cameras: tuple[str, ...], *, background: bool
    ) -> list[str]:
        """What speaks against the network for these arms and images, from one frame; where masks are fitted, whether
        some of the cameras that look together have none.

        Args:
            sequence, index, domain, cameras: which frame.
            background: whether the solver knows the empty background.
        """
        if self.masked:
            without = [camera for camera in cameras if not self._has_mask(sequence, index, camera, domain)]
            if not without or len(without) == len(cameras):
                return []
            return [
                f"Frame {sequence.frame_ids[index]} has no {self._origin} of camera {', '.join(without)}, so all "
                f"cameras that look together ({', '.join(cameras)}) are left to the network there, masks or not. "
                "Leave that camera out with --camera, or give it masks."
            ]
        from ..optimization import familiarity

        frame = sequence.frame(index, domain, cameras)
        found = familiarity(sequence.scene.with_cameras(cameras), frame, self.predictor)
        return found.warnings(", ".join(cameras), background=background)


@dataclass(frozen=True)
class Observing(Network):
    """What is fitted, the networks, and where they run."""

    observe: Literal["network", "masks", "both"] = "network"
    """What is fitted: predictions of the network, the sequence's masks (no network is loaded), or both: the masks, with
    parts and normals from the network, which serves frames without a mask alone."""
    masks: str = RECORDING
    """Which masks are fitted: `recording` for those of the sequence file, `imported` or `painted` for those of its
    project (`carts import-masks`, `carts view`) or, as in `other.carts:painted`, of another one, or a file or folder of
    masks (docs: masks)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.masks != RECORDING and self.observe == "network":
            raise SettingsError(f"--masks {self.masks} needs --observe masks or both. Add it, or leave both out.")
        if self.masks in (RECORDING, *LAYERS):
            return
        named = self._layer[0] or Path(self.masks)
        if not named.exists():
            raise SettingsError(
                f"--masks {self.masks} is missing. Give {RECORDING}, {', '.join(LAYERS)}, those of another project as "
                "in other.carts:painted, or a file or folder of masks."
            )

    def observer(self, settings: SolverSettings, sequence: "Sequence") -> Observer:
        """Who says what the images of a sequence show, for a solver.

        Raises:
            SettingsError: the solver compares features of images.
            WeightsError: weights cannot be used.
            ProjectError, SequenceError: masks cannot be read.
        """
        if self.observe != "network" and not isinstance(settings, SurfaceSolver):
            raise SettingsError(
                f"--observe {self.observe} needs the solver surface, occluded or none; the one given compares features "
                "of images. Leave out --solver or --observe."
            )
        if self.observe == "masks" and self.weights:
            raise SettingsError("--observe masks loads no network, but --weights was given. Leave one of them out.")
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
        """Project (None for the one beside the sequence) and its layer that are fitted; no layer where others are."""
        from ..project.place import SUFFIX

        project, _, name = self.masks.rpartition(":")
        layer = LAYERS.get(name)
        if layer is None or (project and not project.endswith(SUFFIX)):
            return None, None
        return Path(project) if project else None, layer

    def _given(self, sequence: "Sequence") -> "GivenMasks | None":
        """The masks to be fitted, where they are not those of the sequence file."""
        if self.masks == RECORDING:
            return None
        from ..project import Project
        from ..project.target_masks import file_masks, project_masks

        path, layer = self._layer
        if layer is None:
            return file_masks(Path(self.masks), sequence)
        with Project.open(sequence, path, read_only=True) as project:
            state = project.state
        return project_masks(layer, state, sequence)

    @property
    def observed(self) -> dict[str, str]:
        """What is fitted, for a file of results."""
        elsewhere = {} if self.masks == RECORDING else {"masks": self.masks}
        return {"observed": self.observe, **elsewhere}

    @property
    def caution(self) -> str | None:
        """What to know of Dice scores: whether they are against what was fitted."""
        if self.observe == "network":
            return None
        against = "the masks that were fitted" if self.masks == RECORDING else "them where the recording has no masks"
        return f"Dice is against {against}, so it says how well they fit and not how right they are."
