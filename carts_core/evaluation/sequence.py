"""Optimize the frames of a sequence together, and say how well it went."""

from collections.abc import Iterator
from collections.abc import Sequence as Names
from dataclasses import dataclass, replace

from ..networks.extractor import FeatureExtractor
from ..optimization import (
    Backgrounds,
    FreeParameters,
    GivenMasks,
    SequenceOptimizer,
    SequenceSettings,
    SolverSettings,
    SurfacePredictor,
)
from ..recording import Frame, Sequence
from ..rendering import Renderer
from .evaluate import FrameScore, camera_groups, frame_score, start_positions


def evaluate_sequence(
    sequence: Sequence,
    networks: FeatureExtractor | SurfacePredictor,
    *,
    frames: Names[int],
    cameras: Names[str],
    domains: Names[str],
    settings: SolverSettings,
    model: SequenceSettings,
    free: FreeParameters,
    perturb_deg: float = 0.0,
    seed: int = 0,
    together: bool = False,
    given: GivenMasks | None = None,
) -> Iterator[FrameScore]:
    """As `evaluate`, but the frames of a camera (or all) and domain inform each other; see `SequenceOptimizer`.

    A perturbation is the same in all frames, as an error of calibration is.
    """
    groups = camera_groups(cameras, together)
    for domain in domains:
        for group in groups:
            scene = sequence.scene.with_cameras(group)
            renderers = {camera: Renderer(scene, cameras=[camera]) for camera in group}
            starts = Starts(sequence, domain, group, perturb_deg, seed)
            optimizer = SequenceOptimizer(
                scene,
                starts.frame,
                starts.times(frames),
                networks,
                settings=settings,
                model=model,
                free=free,
                ignore=None if given is None else given.ignored,
                backgrounds=Backgrounds.of(sequence, group, domain),
            )
            for _ in optimizer:
                pass
            for index, estimate in sorted(optimizer.estimates.items()):
                frame = starts.frame(index)
                frame = frame if given is None else given.filled(frame)
                for camera, renderer in renderers.items():
                    yield frame_score(
                        sequence,
                        frame,
                        camera,
                        renderer,
                        frame.measured,
                        estimate.state,
                        estimate.joint_positions,
                        estimate.joint_std,
                        estimate.iterations,
                        estimate.seconds / len(group),
                        estimate.start,
                        assessment=estimate.assessment,
                    )


@dataclass(frozen=True)
class Starts:
    """Frames of cameras in a domain as sequence mode takes them: what is called measured is where it starts."""

    sequence: Sequence
    domain: str
    cameras: tuple[str, ...]
    perturb_deg: float
    seed: int
    """Of the perturbation, which is the same in all frames."""

    def frame(self, index: int) -> Frame:
        """The frame at a position of the sequence."""
        frame = self.sequence.frame(index, self.domain, self.cameras)
        return replace(frame, measured=start_positions(self.sequence, frame, self.perturb_deg, (self.seed,)))

    def times(self, frames: Names[int]) -> dict[int, float | None]:
        """Position -> time of chosen frames [s]."""
        stamps = self.sequence.timestamps
        return {index: None if stamps is None else float(stamps[index]) for index in frames}
