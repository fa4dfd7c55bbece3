"""What is fitted: predictions of the network, given masks, or both."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from ..errors import SettingsError
from ..settings import SolverSettings, SurfaceSolver
from .selection import Network

if TYPE_CHECKING:
    from ..networks.extractor import FeatureExtractor
    from ..optimization import MaskPredictor
    from ..recording import Sequence


@dataclass(frozen=True)
class Observer:
    """Who says what images show."""

    predictor: "FeatureExtractor | MaskPredictor"
    weights: str
    """Fingerprint of the networks and of who runs them; empty without any."""
    masked: bool
    """Whether masks of the sequence are fitted."""

    def warnings(
        self, sequence: "Sequence", index: int, domain: str | None, cameras: tuple[str, ...], *, background: bool
    ) -> list[str]:
        """What speaks against the network for these arms and images, from one frame; nothing where masks are fitted.

        Args:
            sequence, index, domain, cameras: which frame.
            background: whether the solver knows the empty background.
        """
        if self.masked:
            return []
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

    def observer(self, settings: SolverSettings) -> Observer:
        """Who says what the images show, for a solver.

        Raises:
            SettingsError: the solver compares features of images.
            WeightsError: weights cannot be used.
        """
        if self.observe != "network" and not isinstance(settings, SurfaceSolver):
            raise SettingsError(
                f"--observe {self.observe} needs the solver surface, occluded or none; the one given compares features "
                "of images. Leave out --solver or --observe."
            )
        if self.observe == "masks" and self.weights:
            raise SettingsError("--observe masks loads no network, but --weights was given. Leave one of them out.")
        from ..networks.extractor import FeatureExtractor
        from ..optimization import MaskPredictor, NetworkPredictor

        if self.observe == "masks":
            return Observer(MaskPredictor(device=self.device), "", masked=True)
        extractor = FeatureExtractor.load(*self.weights, device=self.device, inference=self.inference)
        if self.observe == "both":
            return Observer(MaskPredictor(NetworkPredictor(extractor)), extractor.fingerprint, masked=True)
        return Observer(extractor, extractor.fingerprint, masked=False)

    @property
    def caution(self) -> str | None:
        """What to know of Dice scores: whether they are against what was fitted."""
        if self.observe == "network":
            return None
        return "Dice is against the masks that were fitted, so it says how well they fit and not how right they are."
