"""Loads the networks, and says whether they know what they are to see."""

from collections.abc import Callable, Sequence
from pathlib import Path

from carts_core.errors import WeightsError
from carts_core.model.scene import Scene
from carts_core.networks import FeatureExtractor
from carts_core.networks.network import SurfaceNetwork
from carts_core.networks.weights import read_weights
from carts_core.optimization import Backgrounds, check_domain
from carts_core.recording import Sequence as Recording
from carts_core.segmentation import NetworkSegmenter, Segmenter
from carts_core.settings.optimization import Inference

REMEDY = "Fit masks (Fit to), or adapt the network to this recording."
"""What people can do where the network does not know what it sees."""


class NetworkLoader:
    """Has the networks; they are loaded once, when they are first needed."""

    def __init__(
        self,
        *,
        weights: Sequence[Path] = (),
        device: str = "cpu",
        inference: Inference = "auto",
        segmenter: Segmenter | None = None,
        report: Callable[[str], None],
    ) -> None:
        """
        Args:
            weights: Weights files; a network that none is given of is the shipped one.
            device: Where the networks run.
            inference: Who runs the surface network.
            segmenter: Segments what people point at; None for the one that ships.
            report: Called with a line for people about what takes long.
        """
        self._segmenter = segmenter
        self._own_segmenter: tuple[FeatureExtractor, Segmenter] | None = None
        self._weights = weights
        self._device = device
        self._inference: Inference = inference
        self.report = report
        self._surface: Path | None = None
        self._extractor: FeatureExtractor | None = None
        self._unfamiliar: dict[tuple[object, ...], tuple[str, ...]] = {}

    def given_surface(self) -> bool:
        """Whether a surface network is among the weights that were given.

        Raises:
            WeightsError: weights cannot be read.
        """
        return any(read_weights(path).network.kind == SurfaceNetwork.kind for path in self._weights)

    def use(self, surface: Path | None) -> None:
        """Run another surface network from now on; None: the one of the beginning.

        Raises:
            WeightsError: the weights cannot be read, or are no surface network's.
        """
        if surface is not None and read_weights(surface).network.kind != SurfaceNetwork.kind:
            raise WeightsError(f"{surface} holds no surface network. Adapt the network anew.")
        self._surface, self._extractor = surface, None

    def prepare(self) -> FeatureExtractor:
        """The networks.

        Raises:
            WeightsError: it cannot be loaded.
        """
        if self._extractor is None:
            self.report("Loading the networks")
            weights = list(self._weights)
            if self._surface is not None:
                others = [path for path in weights if read_weights(path).network.kind != SurfaceNetwork.kind]
                weights = [self._surface, *others]
            self._extractor = FeatureExtractor.load(*weights, device=self._device, inference=self._inference)
        return self._extractor

    def segmenter(self) -> Segmenter:
        """What segments what people point at.

        Raises:
            WeightsError: the networks cannot be loaded.
        """
        if self._segmenter is not None:
            return self._segmenter
        extractor = self.prepare()
        if self._own_segmenter is None or self._own_segmenter[0] is not extractor:
            self._own_segmenter = extractor, NetworkSegmenter.of(extractor)
        return self._own_segmenter[1]

    def unfamiliar(
        self, sequence: Recording, scene: Scene, index: int, domain: str, cameras: Sequence[str]
    ) -> tuple[str, ...]:
        """What speaks against the network for these arms and images, from one frame; asked once for each network.

        Raises:
            CartsError: weights or an image is not usable.
        """
        extractor = self.prepare()
        known = extractor.sha256, domain, *cameras
        if known not in self._unfamiliar:
            scene = scene.with_cameras(cameras)
            found = check_domain(scene, sequence.frame(index, domain, list(cameras)), extractor)
            background = Backgrounds.of(sequence, cameras, domain).covers(scene)
            self._unfamiliar[known] = tuple(found.warnings(", ".join(cameras), REMEDY, background=background))
        return self._unfamiliar[known]
