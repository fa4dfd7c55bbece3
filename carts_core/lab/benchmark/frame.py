"""Single runs: a method on one frame or a sequence of frames, scored against the truth."""

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from ...evaluation import dice, joint_mae_deg, normalized_surface_distance
from ...model.keypoints import keypoints
from ...model.parts import COVERAGE
from ...model.perturbation import perturb
from ...model.scene import Arm, Scene, SceneState
from ...networks.extractor import FeatureExtractor
from ...optimization import (
    Backgrounds,
    CalibrationOptimizer,
    FrameOptimizer,
    FreeParameters,
    SequenceOptimizer,
    SolverSettings,
    SurfacePredictor,
    SurfaceSolver,
)
from ...optimization.observability import Uncertainty
from ...recording import Frame
from ...recording.background import spread
from ...rendering import Renderer
from ...settings import DescentSolver
from ..baselines.networks import TrainedBaseline
from .measurement import BEST_OF, TOLERANCE, WIDE_TOLERANCE, Measurement, Score, machine
from .scope import METHODS, RENDERING, Run
from .sources import Recording

_SEED = 0
"""Seed of the signs of initial offsets."""


@dataclass(frozen=True)
class Truth:
    """Truth of a frame in one camera."""

    camera: str
    mask: Bool[np.ndarray, "h w"]
    """Visible pixels of the instruments."""
    joint_positions: Mapping[str, np.ndarray]
    """Arm -> true joint positions [rad, m]; empty if not known."""
    measured_joints: Mapping[str, tuple[str, ...]]
    """Arm -> joints that count."""
    hidden: Bool[np.ndarray, "h w"] | None = None
    """Pixels of an occluder, which are not compared."""

    def score_mask(self, mask: Bool[np.ndarray, "h w"], seconds: float) -> Score:
        """Score of a mask without kinematics."""
        return Score(None, *self._overlap(mask), None, None, None, seconds, self._wide(mask))

    def score(
        self,
        state: SceneState,
        known: Uncertainty | None,
        loss: float | None,
        renderer: Renderer,
        seconds: float,
        *,
        whole: bool = True,
    ) -> Score:
        """The score of an estimate.

        Args:
            state: the estimate.
            known: its uncertainty, if the optimizer reports it.
            loss: of the optimizer.
            renderer: of the camera, at its size.
            seconds: until the estimate was known [s].
            whole: whether to compute the depth of the tips and the second surface distance, the slowest figures.
        """
        state, scene = state.to("cpu"), renderer.scene
        names = [arm.name for arm in scene.arms]
        estimate = dict(zip(names, (v.double().numpy() for v in state.joint_positions), strict=True))
        visible = visible_joints(known, self.measured_joints)
        mask = renderer.segment(state)[0] >= 0
        score = Score(
            loss,
            *self._overlap(mask),
            joint_mae_deg=joint_mae_deg(scene, estimate, self.joint_positions, self.measured_joints),
            visible_joint_mae_deg=None
            if visible is None
            else joint_mae_deg(scene, estimate, self.joint_positions, visible),
            tip_depth_mm=None,
            seconds=seconds,
        )
        if not whole:
            return score
        depth = tip_depth_error_mm(scene.with_cameras([self.camera]), estimate, self.joint_positions)
        return replace(score, tip_depth_mm=depth, nsd_wide=self._wide(mask))

    def with_wide(self, score: Score, state: SceneState, renderer: Renderer) -> Score:
        """The score of an estimate, with the second surface distance."""
        if score.nsd_wide is not None:
            return score
        return replace(score, nsd_wide=self._wide(renderer.segment(state.to("cpu"))[0] >= 0))

    def within(
        self, scene: Scene, found: Mapping[str, np.ndarray], std: Mapping[str, np.ndarray]
    ) -> tuple[int, int, int] | None:
        """Counts of measured joints with truth and deviation, and of errors within one and two of them; None without.

        Args:
            scene: with the arms.
            found: arm -> joint positions [rad, m].
            std: arm -> their standard deviations; NaN where not known.
        """
        ratios = []
        for arm in scene.arms:
            counts = np.isin(arm.robot.joint_names, self.measured_joints.get(arm.name, ()))
            if arm.name in self.joint_positions:
                errors = np.abs(found[arm.name] - self.joint_positions[arm.name]) / std[arm.name]
                ratios += errors[counts & (std[arm.name] > 0)].tolist()
        one, two = (sum(ratio <= bound for ratio in ratios) for bound in (1.0, 2.0))
        return (len(ratios), one, two) if ratios else None

    def _overlap(self, mask: np.ndarray) -> tuple[float, float]:
        seen, truth = self._compared(mask)
        return dice(seen, truth), normalized_surface_distance(seen, truth, TOLERANCE)

    def _wide(self, mask: np.ndarray) -> float:
        return normalized_surface_distance(*self._compared(mask), WIDE_TOLERANCE)

    def _compared(self, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.hidden is None:
            return mask, self.mask
        return mask & ~self.hidden, self.mask & ~self.hidden


def visible_joints(
    known: Uncertainty | None, measured_joints: Mapping[str, tuple[str, ...]]
) -> Mapping[str, tuple[str, ...]] | None:
    """Arm -> measured joints that the image determines ("visible joints" of the report); None if not reported."""
    if known is None:
        return None
    return {
        arm: tuple(
            joint
            for joint in joints
            if f"{arm}/{joint}" in known.names and known.observability(f"{arm}/{joint}") == "determined"
        )
        for arm, joints in measured_joints.items()
    }


def tip_depth_error_mm(
    scene: Scene, estimate: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray]
) -> float | None:
    """Mean absolute error [mm] of the jaw tips along the axis of the scene's camera; None without a truth."""
    errors = []
    for arm in scene.arms:
        if arm.name in truth:
            errors += (_tip_depths(scene, arm, estimate) - _tip_depths(scene, arm, truth)).tolist()
    return float(1e3 * np.mean(np.abs(errors))) if errors else None


def _tip_depths(scene: Scene, arm: Arm, joint_positions: Mapping[str, np.ndarray]) -> Float[np.ndarray, " tips"]:
    links = arm.robot.forward_kinematics(torch.tensor(np.asarray(joint_positions[arm.name]), dtype=torch.float64))
    T_camera_base = scene.cameras[0].T_camera_world @ arm.T_world_base
    tips = [point for point in keypoints(arm) if point.name.endswith(" tip")]
    points = (T_camera_base @ links[tip.link].numpy() @ np.append(tip.position, 1.0) for tip in tips)
    return np.array([point[2] for point in points])


def start_of(scene: Scene, frame: Frame, run: Run, joints: Mapping[str, tuple[str, ...]]) -> dict[str, np.ndarray]:
    """Joint positions that a run starts from; see `Run.error_deg`.

    All methods and domains get the same error, and all frames that are corrected together.
    """
    error = run.error_deg
    if error is None:
        return frame.measured
    origin = {**frame.measured, **(frame.truth or {})}
    seed = (_SEED, round(1e3 * error)) if METHODS[run.method].together else (_SEED, frame.index)
    return perturb(scene, origin, error, seed, joints)


def optimize(
    run: Run,
    scene: Scene,
    frame: Frame,
    backgrounds: Backgrounds,
    networks: FeatureExtractor | SurfacePredictor,
    settings: SolverSettings,
    free: FreeParameters,
    truth: Truth,
    renderer: Renderer,
    ignore: dict[str, Bool[np.ndarray, "h w"]] | None = None,
) -> Measurement:
    """Run the optimizer on one frame, and score every iterate in one camera.

    Args:
        run: the run.
        scene: with the cameras that take part.
        frame: its images and kinematics.
        backgrounds: of these cameras.
        networks: the networks, or another predictor.
        settings: of the method.
        free: the unknowns.
        truth: for the scores.
        renderer: of the camera that is scored, at its size.
        ignore: camera name -> pixels of an occluder.
    """
    start = start_of(scene, frame, run, truth.measured_joints)
    began = time.perf_counter()
    optimizer = FrameOptimizer(
        scene, frame, backgrounds, networks, ignore=ignore, start=start, settings=settings, free=free, live=False
    )
    trace, best, seconds = _followed(optimizer, truth, renderer, time.perf_counter() - began)
    assert optimizer.best is not None and optimizer.stop_reason is not None
    end = optimizer.best
    final = truth.score(end.state, end.uncertainty, end.loss, renderer, seconds)
    assessment = optimizer.assessment
    # With given masks, the first iterate can be the result of a search.
    searched = METHODS[run.method].masks_given
    return Measurement(
        run,
        final,
        optimizer.stop_reason,
        machine(networks.device),
        tuple(trace),
        tuple(best),
        truth.score(scene.state(start), None, None, renderer, 0.0) if searched else None,
        verdict=assessment and assessment.verdict.value,
        probability=assessment and assessment.probability,
        within=truth.within(scene, end.joint_positions(), end.joint_std()),
    )


def _followed(
    optimizer: FrameOptimizer, truth: Truth, renderer: Renderer, seconds: float
) -> tuple[list[Score], list[int], float]:
    """Scores of all iterates, index of the best one at each iterate, and total seconds."""
    trace: list[Score] = []
    best: list[int] = []

    def complete() -> None:
        if optimizer.best is not None:
            trace[best[-1]] = truth.with_wide(trace[best[-1]], optimizer.best.state, renderer)

    while True:
        began = time.perf_counter()
        iterate = optimizer.step()
        seconds += time.perf_counter() - began
        if iterate is None:
            complete()
            return trace, best, seconds
        best.append(len(trace) if optimizer.best is iterate else best[-1])
        known, steps = iterate.uncertainty, len(trace)
        loss = None if isinstance(optimizer.settings, SurfaceSolver) else iterate.loss
        trace.append(truth.score(iterate.state, known, loss, renderer, seconds, whole=not steps))
        if steps in BEST_OF:
            complete()


def segment(
    run: Run, scene: Scene, frame: Frame, truth: Truth, extractor: FeatureExtractor, trained: TrainedBaseline | None
) -> Measurement:
    """A network's own mask of one image, at the size that it was trained for.

    Args:
        run: which.
        scene: with the camera that is scored.
        frame: its image, and the measured joint positions, which are rendered for networks with that input.
        truth: what the mask is compared with.
        extractor: the feature and the surface network, and the device.
        trained: a baseline in their place.
    """
    device, image, scene = extractor.device, frame.images[truth.camera], scene.with_cameras([truth.camera])
    if trained is None:
        network, size, kinematics = None, extractor.working_size, run.method == RENDERING
    else:
        network, settings = trained.network.to(device), trained.network.settings
        size, kinematics = settings.size, settings.looks_at_kinematics
    renderer = Renderer(scene, width=size[0], height=size[1]) if kinematics else None
    began = time.perf_counter()
    given = renderer and renderer.surface_maps(scene.state(frame.measured, mounts=frame.mounts)).to(device)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    tensor = torch.from_numpy(small).to(device).permute(2, 0, 1)[None].float() / 255.0
    with torch.no_grad():
        if network is not None:
            probability = network(tensor, given).sigmoid()
        elif given is not None:
            probability = extractor.surface(tensor, given)[:, COVERAGE].sum(1, keepdim=True)
        else:
            probability = extractor.probability(tensor)
    full = cv2.resize(probability[0, 0].cpu().numpy(), image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    score = truth.score_mask(full >= 0.5, time.perf_counter() - began)
    return Measurement(run, score, "not iterative", machine(device))


def calibrated_scene(recording: Recording, camera: str, frames: int, extractor: FeatureExtractor) -> Scene:
    """The scene with base frames from so many frames of the recording, evenly spread, as one camera sees them.

    Neither masks nor true joint positions are looked at.
    """
    chosen = [recording.frame(index, cameras=[camera]) for index in spread(len(recording), frames)]
    optimizer = CalibrationOptimizer(
        recording.scene,
        chosen,
        extractor,
        cameras=[camera],
        backgrounds=Backgrounds.of(recording, [camera], "regular"),
    )
    for _ in optimizer:
        pass
    return optimizer.result().scene


def correct_together(
    runs: Iterable[Run],
    recording: Recording,
    extractor: FeatureExtractor,
    truths: Mapping[int, Truth],
    renderer: Renderer,
) -> list[Measurement]:
    """Correct frames in sequence mode, and score the final estimates.

    Seconds are those spent on a frame over all visits, reading its image included.

    Args:
        runs: one per frame, of one domain and error at the start.
        recording: of the frames.
        extractor: the networks.
        truths: position of the frame -> truth.
        renderer: of the camera that takes part, at its size.
    """
    by_frame = {run.frame: run for run in runs}
    (domain,) = {run.domain for run in by_frame.values()}
    scene, cameras = renderer.scene, [camera.name for camera in renderer.scene.cameras]

    def frame_at(index: int) -> Frame:
        frame = recording.frame(index, domain, cameras)
        return replace(frame, measured=start_of(scene, frame, by_frame[index], truths[index].measured_joints))

    stamps = recording.timestamps
    optimizer = SequenceOptimizer(
        scene,
        frame_at,
        {index: None if stamps is None else float(stamps[index]) for index in by_frame},
        extractor,
        backgrounds=Backgrounds.of(recording, cameras, domain),
    )
    for _ in optimizer:
        pass
    found = []
    for index, estimate in sorted(optimizer.estimates.items()):
        truth, state = truths[index], scene.state(frame_at(index).measured, mounts=frame_at(index).mounts)
        before = truth.score(state, None, None, renderer, 0.0)
        after = truth.score(estimate.state, estimate.uncertainty, estimate.loss, renderer, estimate.seconds)
        assessment = estimate.assessment
        found.append(
            Measurement(
                by_frame[index],
                after,
                estimate.start,
                machine(extractor.device),
                before=before,
                verdict=assessment and assessment.verdict.value,
                probability=assessment and assessment.probability,
                within=truth.within(scene, estimate.joint_positions, estimate.joint_std),
            )
        )
    return found


STEPS = 10
"""Steps of each frame but the first. TC-CaRTS (arXiv 2212.00072) claims to need far fewer than CaRTS's 30."""


def correct_forwards(
    runs: Iterable[Run],
    recording: Recording,
    extractor: FeatureExtractor,
    truths: Mapping[int, Truth],
    renderer: Renderer,
    first: DescentSolver,
) -> list[Measurement]:
    """Correct frames in their order with ACS, each from its measured joints plus the previous frame's correction.

    This is the first of the three modules that TC-CaRTS adds (arXiv 2212.00072). Its abstract, all that we have of it,
    does not describe the others well enough: a network that corrects kinematics, and a regularization.

    Args:
        runs, recording, extractor, truths, renderer: as in `correct_together`.
        first: settings of the first frame; the others take `STEPS` steps of the same schedule.
    """
    scene, cameras = renderer.scene, [camera.name for camera in renderer.scene.cameras]
    found: list[Measurement] = []
    correction: dict[str, np.ndarray] = {}
    for run in sorted(runs, key=lambda run: run.frame):
        frame, truth = recording.frame(run.frame, run.domain, cameras), truths[run.frame]
        backgrounds = Backgrounds.of(recording, cameras, run.domain, required=True)
        measured = start_of(scene, frame, run, truth.measured_joints)
        start = {arm: values + correction.get(arm, 0.0) for arm, values in measured.items()}
        settings = DescentSolver.paper(STEPS) if found else first
        began = time.perf_counter()
        optimizer = FrameOptimizer(scene, frame, backgrounds, extractor, start=start, settings=settings, live=False)
        for _ in optimizer:
            pass
        seconds, best = time.perf_counter() - began, optimizer.best
        assert best is not None and optimizer.stop_reason is not None
        correction = {arm: values - measured[arm] for arm, values in best.joint_positions().items()}
        before = truth.score(scene.state(measured), None, None, renderer, 0.0)
        after = truth.score(best.state, best.uncertainty, best.loss, renderer, seconds)
        how = "warm" if found else "cold"
        found.append(Measurement(run, after, how, machine(extractor.device), before=before))
    return found
