"""Fine-tuning of the shipped network on a recording, and comparison of fits before and after."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from ...errors import SettingsError
from ...files import locked_folder, output_path, remove_file, write_bytes, write_text
from ...files.reading import WEIGHTS, read_bytes
from ...model.camera import Camera
from ...model.keypoints import keypoints, project_keypoints
from ...model.parts import PARTS, link_parts
from ...model.perturbation import perturb
from ...model.robot import Robot
from ...model.scene import Arm, Scene, SceneState
from ...networks.extractor import FeatureExtractor
from ...optimization import Assessment, FrameOptimizer, Verdict
from ...recording import Frame, Sequence, evenly_spaced
from ...rendering import Renderer
from ...resources import shipped_weights
from ...settings import TrainingConfig
from ...settings.training import ADAPTATION_SETTINGS
from ..randomization.samples import Observer, to_uint8
from .digests import recording_digest
from .loop import checked_checkpoint
from .training import TrainingResult

JUDGING_STREAM = 2
"""Random stream of the synthetic images for comparison; streams 0 and 1 are used for training and validation."""
_SIZE = (320, 240)
"""Width and height of a synthetic image [px]."""
_OFF_DEG = 2.0
"""Initial error of every joint in synthetic images [deg; mm for prismatic joints]."""
_DICE, _PARTS, _TIPS, _EDGES = 0.002, 0.01, 0.2, 0.98
"""Thresholds of "worse": decrease of Dice and of the share of parts [1], increase of the tip error [px], and ratio of
edge strengths [1]."""
_MOVED = 3.0
"""Tip displacement in the recording beyond which edge strength must increase [px]."""

Progress = Callable[[str, int, int], None]
"""Callback with a description, the number of finished fits, and the total."""


@dataclass(frozen=True)
class Fits:
    """Metrics of fits to synthetic images with known joints and to frames of the recording."""

    dice: float
    """Mean Dice of synthetic images [1]."""
    made_parts: float
    """Mean share of true instrument pixels in synthetic images with the correct part in the fit [1]."""
    made_tips: float
    """Mean tip error in synthetic images [px]."""
    good: int
    """Number of frames of the recording with a good verdict."""
    edges: float
    """Mean image gradient along the outlines of arms and parts, relative to that of the whole images [1]."""
    parts: float
    """Mean over frames of the smaller of two shares: rendered wrist pixels predicted as wrist, and rendered jaw pixels
    predicted as jaws [1]."""
    tips: tuple[Float[np.ndarray, "tips 2"], ...]
    """Positions of the tips in the first camera, by frame [px]; NaN outside the image."""


@dataclass(frozen=True)
class Judgement:
    """Comparison of fits with the initial and the adapted weights, for the same images."""

    before: Fits
    after: Fits

    @property
    def tips_moved(self) -> float:
        """Mean distance between corresponding tips of both fits in the recording [px]."""
        pairs = zip(self.before.tips, self.after.tips, strict=True)
        steps = np.concatenate([*(np.linalg.norm(after - before, axis=1) for before, after in pairs), np.empty(0)])
        known = steps[np.isfinite(steps)]
        return float(known.mean()) if len(known) else 0.0

    def worse(self) -> list[str]:
        """Metrics that are worse with the adapted weights; empty if the weights are acceptable."""
        was, now, moved = self.before, self.after, self.tips_moved
        pixels, steady = "of the pixels", _EDGES * was.edges <= now.edges <= was.edges
        checks = {
            f"masks in synthetic images (Dice {was.dice:.3f} -> {now.dice:.3f})": now.dice < was.dice - _DICE,
            f"part accuracy in synthetic images ({was.made_parts:.3f} -> {now.made_parts:.3f} {pixels})": now.made_parts
            < was.made_parts - _PARTS,
            f"tip error in synthetic images ({was.made_tips:.1f} -> {now.made_tips:.1f} px)": now.made_tips
            > was.made_tips + _TIPS,
            f"verdicts on the recording ({was.good} -> {now.good} good)": now.good < was.good,
            f"predicted parts in the recording ({was.parts:.3f} -> {now.parts:.3f} {pixels})": now.parts
            < was.parts - _PARTS,
            f"edge strength in the recording ({was.edges:.2f} -> {now.edges:.2f})": now.edges < _EDGES * was.edges,
            f"tips in the recording (moved by {moved:.1f} px without stronger edges)": moved > _MOVED and steady,
        }
        return [text for text, worse in checks.items() if worse]

    def lines(self) -> list[str]:
        """Summary of the metrics before and after."""
        was, now = self.before, self.after
        return [
            f"fits of synthetic images: Dice {was.dice:.3f} -> {now.dice:.3f}, part accuracy {was.made_parts:.3f} -> "
            f"{now.made_parts:.3f}, tip error {was.made_tips:.1f} -> {now.made_tips:.1f} px",
            f"fits of {len(was.tips)} frames of the recording: {was.good} -> {now.good} good, "
            f"predicted parts {was.parts:.3f} -> {now.parts:.3f}, edge strength {was.edges:.2f} -> {now.edges:.2f}, "
            f"tips moved by {self.tips_moved:.1f} px",
        ]


def judge(
    config: TrainingConfig, before: Path, after: Path, *, made: int, own: int, progress: Progress = lambda *_: None
) -> Judgement:
    """Compare the fits that two weights files give on synthetic images and on frames of the recording.

    Args:
        config: settings of the adaptation run, with its recording, robots and images.
        before, after: weights files of the surface network.
        made, own: number of synthetic images, and of evenly spaced frames of the recording.
        progress: called before each fit.

    Raises:
        SequenceError: the recording cannot be read.
        WeightsError: weights cannot be read.
    """
    assert config.images.recording is not None
    networks = [FeatureExtractor.load(path) for path in (before, after)]
    images, recording = list(synthetic_images(config, made)), Sequence.open(config.images.recording)
    chosen = evenly_spaced(len(recording), min(own, len(recording)))
    total, done = 2 * (len(images) + len(chosen)), count()

    def fits(network: FeatureExtractor) -> Fits:
        scores, found = [], []
        for image in images:
            progress("comparing fits before and after", next(done), total)
            scores.append(image.score(network))
        for index in chosen:
            progress("comparing fits before and after", next(done), total)
            found.append(_own_fit(recording, recording.frame(index), network))
        good, edges, parts, tips = zip(*found, strict=True)
        dice, made_parts, made_tips = np.mean(scores, axis=0).tolist()
        means = float(np.mean(edges)), float(np.mean(parts))
        return Fits(dice, made_parts, made_tips, sum(good), *means, tuple(tips))

    return Judgement(fits(networks[0]), fits(networks[1]))


@dataclass(frozen=True)
class SyntheticImage:
    """Synthetic image of arms at known joint positions."""

    scene: Scene
    frame: Frame
    """Frame whose measured joint positions are the perturbed true joint positions."""

    def score(self, network: FeatureExtractor) -> tuple[float, float, float]:
        """Fit the image; returns Dice, share of correct parts, and mean tip error [px]."""
        found, _ = _solved(self.scene, self.frame, network)
        truth = self.scene.state(self.frame.truth or {})
        renderer = Renderer(self.scene, width=_SIZE[0], height=_SIZE[1])
        ours, theirs = _parts(self.scene, renderer, found), _parts(self.scene, renderer, truth)
        both, shown = int(((ours >= 0) & (theirs >= 0)).sum()), theirs >= 0
        dice = 2 * both / max(int((ours >= 0).sum() + shown.sum()), 1)
        tips = np.linalg.norm(_tips(self.scene, found) - _tips_in_view(self.scene, truth), axis=1)
        known = tips[np.isfinite(tips)]
        right = float((ours[shown] == theirs[shown]).mean()) if shown.any() else 1.0
        return dice, right, float(known.mean()) if len(known) else 0.0


def synthetic_images(config: TrainingConfig, number_of_images: int) -> Iterator[SyntheticImage]:
    """Uncropped images without occluders from the training distribution, which are not used in training or
    validation."""
    width, height = _SIZE
    images = replace(
        config.images, width=width, height=height, field_width=width, occluded=0.0, absent=0.0, coverage=(0.02, 0.5)
    )
    observer = Observer([Robot.load(path) for path in config.robots], images, (config.seed, JUDGING_STREAM))
    for number in range(number_of_images):
        seen = observer(number)
        # The model has the same varied proportions as the image, so that the ground truth is exact.
        robots = [geometry.robot for geometry in seen.variant.geometries]
        names = [f"arm{place}" for place in range(len(robots))]
        arms = tuple(
            Arm(name, robot, placement.T_camera_base)
            for name, robot, placement in zip(names, robots, seen.placements, strict=True)
        )
        scene = Scene(arms, (Camera("made", width, height, seen.intrinsics, np.eye(4)),))
        truth = {name: np.asarray(p.joint_positions, float) for name, p in zip(names, seen.placements, strict=True)}
        joints = {arm.name: arm.robot.joint_names for arm in arms}
        start = perturb(scene, truth, _OFF_DEG, (config.seed, JUDGING_STREAM, number), joints)
        frame = Frame(number, f"{number}", "made", {"made": to_uint8(seen.image)}, start, truth, None, None)
        yield SyntheticImage(scene, frame)


def _solved(scene: Scene, frame: Frame, network: FeatureExtractor) -> tuple[SceneState, Assessment | None]:
    optimizer = FrameOptimizer(scene, frame, {}, network, live=False)
    for _ in optimizer:
        pass
    assert optimizer.best is not None
    return optimizer.best.state.to("cpu"), optimizer.assessment


def _own_fit(recording: Sequence, frame: Frame, network: FeatureExtractor) -> tuple[bool, float, float, np.ndarray]:
    """Fit a frame; returns whether its verdict is good, edge support, predicted share of parts, and visible tips."""
    state, found = _solved(recording.scene, frame, network)
    edges = []
    for camera in recording.scene.cameras:
        renderer = Renderer(recording.scene, width=camera.width, height=camera.height, cameras=[camera.name])
        edges.append(edge_support(frame.images[camera.name], _parts(recording.scene, renderer, state)))
    parts = 1.0 if found is None else found.evidence.parts_predicted
    good = found is not None and found.verdict is Verdict.GOOD
    return good, float(np.mean(edges)), parts, _tips_in_view(recording.scene, state)


def edge_support(image: UInt8[np.ndarray, "h w 3"], parts: np.ndarray) -> float:
    """Mean image gradient along the outlines of parts, relative to the mean of the image [1]; 1 without outlines."""
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    gradient = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    outline = np.zeros(parts.shape, bool)
    outline[:, :-1] |= parts[:, :-1] != parts[:, 1:]
    outline[:-1] |= parts[:-1] != parts[1:]
    return float(gradient[outline].mean() / max(float(gradient.mean()), 1e-6)) if outline.any() else 1.0


def _parts(scene: Scene, renderer: Renderer, state: SceneState) -> np.ndarray:
    """Part index of every pixel, unique over all arms [h, w]; -1 for background."""
    links = renderer.segment_links(state)[0]
    classes = np.concatenate([link_parts(arm.robot) + 10 * place for place, arm in enumerate(scene.arms)])
    return np.where(links >= 0, classes[np.maximum(links, 0)], -1)


def _tips(scene: Scene, state: SceneState) -> Float[np.ndarray, "tips 2"]:
    """Image positions of all arms' tips in the first camera [px]; NaN behind the camera."""
    points = [point for arm in scene.arms for point in keypoints(arm) if point.name.endswith(" tip")]
    with torch.no_grad():
        return project_keypoints(scene, state, points, scene.cameras[0].name).double().numpy()


def _tips_in_view(scene: Scene, state: SceneState) -> Float[np.ndarray, "tips 2"]:
    """Image positions of all arms' tips in the first camera [px]; NaN outside the image."""
    tips, size = _tips(scene, state), (scene.cameras[0].width, scene.cameras[0].height)
    inside = ((tips >= 0) & (tips < size)).all(1, keepdims=True)
    return np.where(inside, tips, np.nan)


STEPS = 400
"""Default number of steps if neither steps nor a time limit is given."""
BACKGROUNDS = "backgrounds"
"""Name of the run's folder with backgrounds of the recording, without arms."""
FITS = "fits.json"
"""File name of the report that compares fits with the initial and the adapted weights."""
REFUSED = "refused.safetensors"
"""File name of weights that are not offered because a metric is worse."""


@dataclass(frozen=True)
class Offer:
    """Adapted weights with the result of the comparison."""

    weights: Path
    """Weights file, renamed if a metric is worse."""
    worse: list[str]
    """Metrics that are worse; empty if the weights are offered."""
    lines: list[str]
    """Summary of the metrics before and after."""


def adapted_to(recording: Path, output: Path, given: TrainingConfig) -> TrainingConfig:
    """Settings that adapt the surface network to a recording, whose backgrounds are written to `output` unless
    photographs are given.

    Args:
        recording: sequence file; its images are only used for the background without arms.
        output: folder of the run, created after the recording was read.
        given: other settings, usually changes of `ADAPTATION_SETTINGS`. The default robots are replaced by those of the
            recording, and the default steps by `STEPS` if there is no time limit.

    Raises:
        SettingsError: another network is to be trained, `given` names a recording or includes random robots, or
            `output` holds a run with another recording.
        SequenceError: the recording cannot be read.
        WeightsError: the checkpoint in `output` cannot be read.
        OutputError: `output` cannot be written to.
        BusyError: another run writes to `output`.
    """
    if given.network != "surface" or given.images.recording is not None:
        raise SettingsError(
            f"network is {given.network!r} and images.recording is {given.images.recording}, but an adaptation trains "
            "the surface network with its own recording. Leave out these settings."
        )
    sequence, photographs = Sequence.open(recording), given.images.photographs
    with locked_folder(output):
        checked_checkpoint(output, {"recording_digest": recording_digest(sequence)})
        if photographs is None and _write_backgrounds(sequence, output):
            photographs = output / BACKGROUNDS
    default = ADAPTATION_SETTINGS
    robots = tuple(dict.fromkeys(arm.robot.urdf for arm in sequence.scene.arms))
    images = replace(
        given.images,
        recording=recording.absolute(),
        photographs=photographs,
        two_arms=given.images.two_arms if len(sequence.scene.arms) > 1 else 0.0,
    )
    return replace(
        given,
        robots=robots if given.robots == default.robots else given.robots,
        start=given.start or shipped_weights()[1],
        steps=STEPS if given.minutes is None and given.steps == default.steps else given.steps,
        images=images,
    )


def _write_backgrounds(sequence: Sequence, output: Path) -> int:
    """Write the backgrounds without arms of a sequence's cameras; returns the number of estimated backgrounds."""
    found = 0
    for camera in sequence.scene.cameras:
        background = sequence.mean_background(camera.name)
        if background.problem is None:
            _, content = cv2.imencode(".png", background.image[..., ::-1])
            write_bytes(output_path(output, BACKGROUNDS, f"{found}.png"), content.tobytes())
            found += 1
    return found


def gain(before: dict[str, float], now: dict[str, float]) -> str:
    """Summary of the improvement between two validations of the surface network."""
    share = (1 - now["dice"]) / (1 - before["dice"]) if before["dice"] < 1 else np.nan
    dice = f"Dice {before['dice']:.3f} -> {now['dice']:.3f}, remaining error {share:.0%}"
    parts = ", ".join(f"{part} {before[f'dice_{part}']:.3f} -> {now[f'dice_{part}']:.3f}" for part in PARTS)
    tips = f"tip error {before['tip_error']:.1f} -> {now['tip_error']:.1f} px"
    normals = f"normal error {before['normal_error_deg']:.1f} -> {now['normal_error_deg']:.1f} deg"
    return f"synthetic images of this recording: {dice}; {parts}; {tips}; {normals}"


def offer(config: TrainingConfig, result: TrainingResult, progress: Progress, made: int, own: int) -> Offer:
    """Compare fits with the initial and the adapted weights; if a metric is worse, reject the adapted weights.

    Rejected weights are stored under another name. `config` is the result of `adapted_to`, `result` the result of the
    run; other arguments are those of `judge`.
    """
    assert config.start is not None
    aside = output_path(result.weights.parent, REFUSED)
    if not result.weights.is_file():
        return Offer(aside.path, [f"the weights were rejected before; see report/{FITS}"], [])
    judgement = judge(config, config.start, result.weights, made=made, own=own, progress=progress)
    worse = judgement.worse()
    gained = "" if result.first is None else gain(result.first, result.validation)
    report = {"worse": worse, "gain": gained, "figures": judgement.lines(), "made": made, "own": own}
    write_text(output_path(result.weights.parent, "report") / FITS, json.dumps(report, indent=1))
    if worse:
        # The page and later commands load only weights with the usual name.
        write_bytes(aside, read_bytes(result.weights, WEIGHTS))
        remove_file(output_path(result.weights.parent, result.weights.name))
    return Offer(aside.path if worse else result.weights, worse, judgement.lines())
