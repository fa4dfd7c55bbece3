"""Single runs: a method on one frame or a sequence of frames, scored against ground truth."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from rich.console import Console
from torch.nn import functional

from ...console import Bar
from ...evaluation import dice, joint_mae_deg, normalized_surface_distance
from ...imaging.working_image import Window
from ...model.keypoints import keypoints
from ...model.parts import COVERAGE
from ...model.perturbation import perturb
from ...model.scene import Arm, Scene, SceneState
from ...networks.extractor import FeatureExtractor
from ...optimization import (
    Assessment,
    Backgrounds,
    CalibrationOptimizer,
    FrameOptimizer,
    FreeParameters,
    MaskPredictor,
    MaskRefiner,
    NetworkPredictor,
    SequenceOptimizer,
    SurfaceSolver,
    Verdict,
)
from ...optimization.results import Uncertainty
from ...recording import Frame
from ...recording.background import evenly_spaced
from ...rendering import Renderer
from ...settings import DescentSolver
from ...wording import counted
from ..baselines.networks import TrainedBaseline
from .conditions import (
    CROSSING,
    OCCLUSION,
    OTHER_INSTRUMENT,
    WRONG,
    contradicting_frame,
    crossing_frame,
    occlude,
    with_other_instruments,
)
from .measurement import BEST_OF, TOLERANCE, WIDE_TOLERANCE, Measurement, Score, machine
from .scope import METHODS, RENDERING, Run, Scope
from .sources import Recording, Source

_SEED = 0
"""Seed of the signs of initial joint offsets."""


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth of a frame in one camera."""

    camera: str
    mask: Bool[np.ndarray, "h w"]
    """Visible pixels of the instruments."""
    joint_positions: Mapping[str, np.ndarray]
    """Arm -> true joint positions [rad, m]; empty if unknown."""
    measured_joints: Mapping[str, tuple[str, ...]]
    """Arm -> names of the joints whose errors are scored."""
    hidden: Bool[np.ndarray, "h w"] | None = None
    """Pixels of occluders, which are excluded from the comparison."""

    def score_mask(self, mask: Bool[np.ndarray, "h w"], seconds: float) -> Score:
        """Score a mask without kinematics."""
        return Score(None, *self._overlap(mask), None, None, None, seconds, self._wide(mask))

    def score(
        self,
        state: SceneState,
        renderer: Renderer,
        seconds: float = 0.0,
        known: Uncertainty | None = None,
        loss: float | None = None,
        *,
        whole: bool = True,
    ) -> Score:
        """Score an estimate.

        Args:
            state: the estimate.
            renderer: renderer at the camera's resolution.
            seconds: computation time of the estimate [s].
            known: uncertainty of the estimate, if the optimizer reports it.
            loss: final loss of the optimizer.
            whole: also compute the tip depth error and `nsd_wide`, the slowest metrics.
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
        """Add `nsd_wide` to the score of an estimate, if it is missing."""
        if score.nsd_wide is not None:
            return score
        return replace(score, nsd_wide=self._wide(renderer.segment(state.to("cpu"))[0] >= 0))

    def within(
        self, scene: Scene, found: Mapping[str, np.ndarray], std: Mapping[str, np.ndarray]
    ) -> tuple[int, int, int] | None:
        """Number of joints with ground truth and standard deviation, and numbers of errors within 1 and 2 standard
        deviations.

        `found` and `std` map arms to joint positions [rad, m] and their standard deviations, NaN if unknown. The result
        is None without such joints.
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
    """Arm -> measured joints that are determined by the image ("visible joints" of the report); None if not
    reported."""
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
    """Mean absolute depth error [mm] of the jaw tips in the scene's camera; None without ground truth."""
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
    """Initial joint positions of a run; see `Run.error_deg`.

    The perturbation is identical for all methods and domains, and for all frames corrected together.
    """
    error = run.error_deg
    if error is None:
        return frame.measured
    origin = {**frame.measured, **(frame.truth or {})}
    seed = (_SEED, round(1e3 * error)) if METHODS[run.method].as_sequence else (_SEED, frame.index)
    return perturb(scene, origin, error, seed, joints)


def _followed(
    optimizer: FrameOptimizer, truth: GroundTruth, renderer: Renderer, seconds: float
) -> tuple[list[Score], list[int], float]:
    """Step the optimizer to the end; returns the scores of all iterates, for each the index of the best iterate so far,
    and the total time [s]."""
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
        steps = len(trace)
        loss = None if isinstance(optimizer.settings, SurfaceSolver) else iterate.loss
        trace.append(truth.score(iterate.state, renderer, seconds, iterate.uncertainty, loss, whole=not steps))
        if steps in BEST_OF:
            complete()


def _judged(assessment: Assessment | None) -> dict[str, Any]:
    return {} if assessment is None else {"verdict": assessment.verdict.value, "probability": assessment.probability}


def calibrated_scene(recording: Recording, camera: str, frames: int, extractor: FeatureExtractor) -> Scene:
    """Scene with base frames calibrated from `frames` evenly spaced frames of one camera.

    Neither masks nor true joint positions are used.
    """
    chosen = [recording.frame(index, cameras=[camera]) for index in evenly_spaced(len(recording), frames)]
    backgrounds = Backgrounds.of(recording, [camera], "regular")
    optimizer = CalibrationOptimizer(recording.scene, chosen, extractor, cameras=[camera], backgrounds=backgrounds)
    for _ in optimizer:
        pass
    return optimizer.result().scene


def fitted(image: tuple[int, int], size: tuple[int, int]) -> tuple[Window, tuple[int, int, int, int]]:
    """Centred part of a network's input that an image fills with its aspect ratio, and the border on its left, right,
    top and bottom [px]; arguments are widths and heights [px]."""
    scale = min(size[0] / image[0], size[1] / image[1])
    width, height = (max(round(scale * side), 1) for side in image)
    left, top = (size[0] - width) // 2, (size[1] - height) // 2
    return Window(left, top, width, height), (left, size[0] - width - left, top, size[1] - height - top)


STEPS = 10
"""Number of steps for each frame after the first. TC-CaRTS (arXiv 2212.00072) reports far fewer steps than the 30 of
CaRTS."""
_OCCLUDERS_SEED = 20


def log(console: Console, line: str) -> None:
    """Print a progress line unless the output is a terminal."""
    if not console.is_terminal:
        console.print(line, soft_wrap=True, highlight=False, markup=False)


class SourceBench:
    """Benchmark of runs on a source, which is opened at the first run.

    `baselines` maps names in `scope.BASELINES` to networks.
    """

    def __init__(
        self,
        source: Source,
        bar: Bar,
        scope: Scope,
        extractor: FeatureExtractor,
        baselines: Mapping[str, TrainedBaseline] | None = None,
    ) -> None:
        self._source, self._bar, self._scope = source, bar, scope
        self._extractor, self._baselines = extractor, baselines or {}
        self._machine = machine(extractor.device)

    def measure(self, runs: list[Run]) -> list[Measurement]:
        """Measure one run, or all runs whose frames a method corrects together."""
        method = METHODS[runs[0].method]
        if not method.as_sequence:
            return [self._measure_alone(runs[0])]
        first = method.settings(self._scope.steps(runs[0])) if method.settings else None
        return self._forwards(runs, first) if isinstance(first, DescentSolver) else self._together(runs)

    def _measure_alone(self, run: Run) -> Measurement:
        recording, method, camera = self._recording, METHODS[run.method], self._source.camera
        cameras = self._source.cameras if method.every_camera else (camera,)
        domain = "regular" if run.domain in (OCCLUSION, CROSSING, *WRONG) else run.domain
        if run.domain in WRONG:
            frame = contradicting_frame(recording, run.domain, run.frame, camera)
        elif run.domain == CROSSING:
            frame = crossing_frame(recording, run.frame, camera)
        else:
            frame = recording.frame(run.frame, None if run.domain == OCCLUSION else run.domain, cameras)
        truth = self._truth(frame)
        if run.domain == OCCLUSION:
            found = occlude(frame.images[camera], truth.mask, np.random.default_rng((_OCCLUDERS_SEED, frame.index)))
            frame, truth = replace(frame, images={camera: found.image}), replace(truth, hidden=found.hidden)
        if method.settings is None:
            return self._segment(run, frame, truth)
        settings = method.settings(self._scope.steps(run))
        networks, backgrounds = self._extractor, Backgrounds({})
        if method.masks_given:
            networks = MaskPredictor()
        else:
            backgrounds = Backgrounds.of(recording, cameras, domain, required=settings.needs_background)
        scene, renderer = self._calibrated if method.calibrated else recording.scene, self._renderer
        if run.domain == OTHER_INSTRUMENT:
            scene = with_other_instruments(scene, run.frame)
            renderer = Renderer(scene, cameras=[camera])
        scene = scene.with_cameras(cameras)
        start = start_of(scene, frame, run, truth.measured_joints)
        began = time.perf_counter()
        optimizer = FrameOptimizer(
            scene,
            frame,
            backgrounds,
            networks,
            ignore={camera: truth.hidden} if method.occluders_given and truth.hidden is not None else None,
            start=start,
            settings=settings,
            free=FreeParameters(extrinsics=method.poses, locked_cameras=(camera,)),
            live=False,
        )
        trace, best, seconds = _followed(optimizer, truth, renderer, time.perf_counter() - began)
        end = optimizer.best
        assert end is not None and optimizer.stop_reason is not None
        final = truth.score(end.state, renderer, seconds, end.uncertainty, end.loss)
        if method.refined and optimizer.assessment is not None and optimizer.assessment.verdict is Verdict.GOOD:
            refiner = MaskRefiner(NetworkPredictor(self._extractor), backgrounds)
            rendered = {camera: renderer.segment(end.state.to("cpu"))[0] >= 0}
            refined = refiner.refine(scene, frame, end.state, rendered)[camera]
            final = truth.score_mask(refined, time.perf_counter() - began)
        return Measurement(
            run,
            final,
            optimizer.stop_reason,
            machine(networks.device),
            tuple(trace),
            tuple(best),
            # With given masks, the first iterate may be the result of a search.
            truth.score(scene.state(start), renderer) if method.masks_given else None,
            within=truth.within(scene, end.joint_positions(), end.joint_std()),
            **_judged(optimizer.assessment),
        )

    def _segment(self, run: Run, frame: Frame, truth: GroundTruth) -> Measurement:
        """Score the mask that a network predicts for one image at its training resolution.

        The image is padded to the network's aspect ratio; the mask is scored at the resolution of the image. The input
        of networks with kinematics includes the rendering at the measured joint positions.
        """
        extractor, trained = self._extractor, self._baselines.get(run.method)
        device, image = extractor.device, frame.images[truth.camera]
        scene = self._recording.scene.with_cameras([truth.camera])
        if trained is None:
            network, kinematics = None, run.method == RENDERING
            size = extractor.weights["surface" if kinematics else "feature"].working_size
        else:
            network, settings = trained.network.to(device), trained.network.settings
            size, kinematics = settings.size, settings.uses_kinematics
        content, border = fitted(image.shape[1::-1], size)
        renderer = Renderer(scene, width=content.width, height=content.height) if kinematics else None
        began = time.perf_counter()
        given = renderer and renderer.surface_maps(scene.state(frame.measured, mounts=frame.mounts)).to(device)
        given = given if given is None else functional.pad(given, border, mode="replicate")
        small = cv2.resize(image, (content.width, content.height), interpolation=cv2.INTER_AREA)
        tensor = torch.from_numpy(small).to(device).permute(2, 0, 1)[None].float() / 255.0
        tensor = functional.pad(tensor, border, mode="replicate")
        with torch.no_grad():
            if network is not None:
                probability = network(tensor, given).sigmoid()
            elif given is not None:
                probability = extractor.surface(tensor, given)[:, COVERAGE].sum(1, keepdim=True)
            else:
                probability = extractor.probability(tensor)
        full = cv2.resize(
            content.of(probability[0, 0]).cpu().numpy(), image.shape[1::-1], interpolation=cv2.INTER_LINEAR
        )
        score = truth.score_mask(full >= 0.5, time.perf_counter() - began)
        return Measurement(run, score, "not iterative", self._machine)

    def _together(self, runs: list[Run]) -> list[Measurement]:
        """Correct the frames with the same domain and initial error in sequence mode, and score the final estimates.

        The time of a frame is the sum over all visits, including reading its image.
        """
        recording, renderer, domain = self._recording, self._renderer, runs[0].domain
        scene, by_frame = renderer.scene, {run.frame: run for run in runs}
        truths = {index: self._truth(recording.frame(index, cameras=[self._source.camera])) for index in by_frame}

        def frame_at(index: int) -> Frame:
            frame = recording.frame(index, domain, [self._source.camera])
            return replace(frame, measured=start_of(scene, frame, by_frame[index], truths[index].measured_joints))

        stamps = recording.timestamps
        optimizer = SequenceOptimizer(
            scene,
            frame_at,
            {index: None if stamps is None else float(stamps[index]) for index in by_frame},
            self._extractor,
            backgrounds=Backgrounds.of(recording, [self._source.camera], domain),
        )
        for _ in optimizer:
            pass
        return [
            Measurement(
                by_frame[index],
                truth.score(found.state, renderer, found.seconds, found.uncertainty, found.loss),
                found.start,
                self._machine,
                before=truth.score(scene.state(start.measured, mounts=start.mounts), renderer),
                within=truth.within(scene, found.joint_positions, found.joint_std),
                **_judged(found.assessment),
            )
            for index, found in sorted(optimizer.estimates.items())
            for truth, start in [(truths[index], frame_at(index))]
        ]

    def _forwards(self, runs: list[Run], first: DescentSolver) -> list[Measurement]:
        """Correct frames in order with ACS; each frame starts at its measured joints plus the correction of the
        previous frame.

        This is the first of the three modules of TC-CaRTS (arXiv 2212.00072). The other two modules, a network that
        corrects kinematics and a regularization, are not reproduced, since only the abstract was available. `first` are
        the settings of the first frame; later frames use `STEPS` steps of the same schedule.
        """
        renderer, cameras = self._renderer, [self._source.camera]
        scene, found, correction = renderer.scene, list[Measurement](), dict[str, np.ndarray]()
        for run in sorted(runs, key=lambda run: run.frame):
            frame = self._recording.frame(run.frame, run.domain, cameras)
            truth = self._truth(frame)
            backgrounds = Backgrounds.of(self._recording, cameras, run.domain, required=True)
            measured = start_of(scene, frame, run, truth.measured_joints)
            start = {arm: values + correction.get(arm, 0.0) for arm, values in measured.items()}
            settings = DescentSolver.paper(STEPS) if found else first
            began = time.perf_counter()
            optimizer = FrameOptimizer(
                scene, frame, backgrounds, self._extractor, start=start, settings=settings, live=False
            )
            for _ in optimizer:
                pass
            seconds, best = time.perf_counter() - began, optimizer.best
            assert best is not None
            correction = {arm: values - measured[arm] for arm, values in best.joint_positions().items()}
            before = truth.score(scene.state(measured), renderer)
            after = truth.score(best.state, renderer, seconds, best.uncertainty, best.loss)
            found.append(Measurement(run, after, "warm" if found else "cold", self._machine, before=before))
        return found

    def _truth(self, frame: Frame) -> GroundTruth:
        assert frame.masks is not None
        camera = self._source.camera
        return GroundTruth(camera, frame.masks[camera], frame.truth or {}, self._recording.measured_joints)

    @cached_property
    def _recording(self) -> Recording:
        task = self._bar.add_task("opening", total=None)

        def report(what: str, done: int, total: int) -> None:
            self._bar.update(task, description=what, completed=done, total=total)
            log(self._bar.console, f"{self._source.name}: {what}, {done} of {total}")

        recording = self._source.open(report)
        self._bar.remove_task(task)
        return recording

    @cached_property
    def _renderer(self) -> Renderer:
        """Renderer of the scored camera at its full resolution."""
        return Renderer(self._recording.scene, cameras=[self._source.camera])

    @cached_property
    def _calibrated(self) -> Scene:
        frames = self._scope.calibration_frames
        description = f"calibrating with {counted(frames, 'frame')}"
        task = self._bar.add_task(description, total=None)
        log(self._bar.console, f"{self._source.name}: {description}")
        scene = calibrated_scene(self._recording, self._source.camera, frames, self._extractor)
        self._bar.remove_task(task)
        return scene
