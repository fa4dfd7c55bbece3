"""Whether adapted weights may be offered: what solving gives with them and with the weights that they come from.

On made images with a known truth that training never sees: masks, parts and tips. On frames of the recording itself,
which have no truth: verdicts, tips, image edges under the outlines, and parts.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from ...model.camera import Camera
from ...model.keypoints import keypoints, project_keypoints
from ...model.parts import link_parts
from ...model.perturbation import perturb
from ...model.robot import Robot
from ...model.scene import Arm, Scene, SceneState
from ...networks.extractor import FeatureExtractor
from ...optimization import FrameOptimizer, Verdict
from ...recording import Frame, spread
from ...recording import Sequence as Recording
from ...rendering import Renderer
from ...settings import TrainingConfig
from ..randomization.samples import Observer, to_uint8

JUDGING_STREAM = 2
"""Stream of random numbers of the made images; 0 and 1 are those of training and validation."""
_SIZE = (320, 240)
"""Of a made image [px]."""
_OFF_DEG = 2.0
"""How far off every joint of a made image starts [deg], sliding ones as many [mm]."""
_DICE, _PARTS, _TIPS, _EDGES = 0.002, 0.01, 0.2, 0.98
"""What counts as worse: a mean Dice or share of parts lower by this much, tips farther off by so many pixels, and edges
weaker than this share of before."""
_MOVED = 3.0
"""Tips of the recording that move farther than this have to find stronger edges [px]."""

Progress = Callable[[str, int, int], None]
"""Called with what is solved, and how many of how many."""


@dataclass(frozen=True)
class MadeFits:
    """Fits of made images: means over the images."""

    dice: float
    """Of masks [1]."""
    parts: float
    """Share of the instrument's true pixels where the fit shows the same part [1]."""
    tips: float
    """Distance of tips from the truth [px]."""


@dataclass(frozen=True)
class OwnFits:
    """Fits of frames of the recording: per frame."""

    good: int
    """Frames with a good verdict."""
    edges: float
    """Mean gradient of the images along the outlines of arms and parts, over that of the whole images [1]."""
    parts: float
    """Of rendered wrists and jaws, the smaller share that the network of the fit predicts as that part [1]."""
    tips: tuple[Float[np.ndarray, "tips 2"], ...]
    """Of each frame, where tips are in the first camera [px]; NaN out of view."""


@dataclass(frozen=True)
class Judgement:
    """Fits with the weights of the start and with adapted ones, on the same images."""

    made: tuple[MadeFits, MadeFits]
    own: tuple[OwnFits, OwnFits]

    @property
    def tips_moved(self) -> float:
        """How far tips of the recording's own fits have moved in the mean [px]."""
        pairs = zip(self.own[0].tips, self.own[1].tips, strict=True)
        steps = [np.linalg.norm(after - before, axis=1) for before, after in pairs]
        known = np.concatenate([*steps, np.empty(0)])
        known = known[np.isfinite(known)]
        return float(known.mean()) if len(known) else 0.0

    def worse(self) -> list[str]:
        """What is worse with the adapted weights, in words; nothing where they may be offered."""
        (before, after), (was, now), moved = self.made, self.own, self.tips_moved
        found = []
        if after.dice < before.dice - _DICE:
            found.append(f"masks of made images (Dice {before.dice:.3f} -> {after.dice:.3f})")
        if after.parts < before.parts - _PARTS:
            found.append(f"parts of made images ({before.parts:.3f} -> {after.parts:.3f} of the pixels)")
        if after.tips > before.tips + _TIPS:
            found.append(f"tips of made images ({before.tips:.1f} -> {after.tips:.1f} px)")
        if now.good < was.good:
            found.append(f"verdicts of the recording ({was.good} -> {now.good} good)")
        if now.parts < was.parts - _PARTS:
            found.append(f"parts of the recording ({was.parts:.3f} -> {now.parts:.3f} of the pixels)")
        if now.edges < _EDGES * was.edges:
            found.append(f"edges of the recording ({was.edges:.2f} -> {now.edges:.2f})")
        elif moved > _MOVED and now.edges <= was.edges:
            found.append(f"tips of the recording (moved by {moved:.1f} px without stronger edges)")
        return found

    def lines(self) -> list[str]:
        """The figures before and after, for people."""
        (before, after), (was, now) = self.made, self.own
        count = len(was.tips)
        return [
            f"fits of made images: Dice {before.dice:.3f} -> {after.dice:.3f}, parts {before.parts:.3f} -> "
            f"{after.parts:.3f}, tips {before.tips:.1f} -> {after.tips:.1f} px",
            f"fits of {count} frames of the recording: {was.good} -> {now.good} good, parts {was.parts:.3f} -> "
            f"{now.parts:.3f}, edges {was.edges:.2f} -> {now.edges:.2f}, tips moved by {self.tips_moved:.1f} px",
        ]


def judge(
    config: TrainingConfig, before: Path, after: Path, *, made: int, own: int, progress: Progress = lambda *_: None
) -> Judgement:
    """Solve made images and frames of the recording with two weights files.

    Args:
        config: of the run that adapts, with its recording, robots and images.
        before, after: weights of the surface network.
        made, own: how many made images, and frames of the recording, spread over it.
        progress: called before every fit.

    Raises:
        SequenceError: the recording cannot be read.
        WeightsError: weights cannot be read.
    """
    assert config.images.recording is not None
    networks = [FeatureExtractor.load(path) for path in (before, after)]
    images, recording = list(made_images(config, made)), Recording.open(config.images.recording)
    chosen = spread(len(recording), min(own, len(recording)))
    total, done = 2 * (len(images) + len(chosen)), 0

    def say() -> None:
        nonlocal done
        progress("comparing fits before and after", done, total)
        done += 1

    of_made, of_own = [], []
    for network in networks:
        scores = []
        for image in images:
            say()
            scores.append(image.score(network))
        of_made.append(MadeFits(*np.mean(scores, axis=0).tolist()))
        found = []
        for index in chosen:
            say()
            found.append(_own_fit(recording, recording.frame(index), network))
        good, edges, parts, tips = zip(*found, strict=True)
        of_own.append(OwnFits(sum(good), float(np.mean(edges)), float(np.mean(parts)), tuple(tips)))
    return Judgement((of_made[0], of_made[1]), (of_own[0], of_own[1]))


@dataclass(frozen=True)
class MadeImage:
    """A made image of arms at known joint positions."""

    scene: Scene
    frame: Frame
    """Measured joint positions are the true ones, moved."""

    def score(self, network: FeatureExtractor) -> tuple[float, float, float]:
        """Dice, share of right parts and mean distance of tips [px] of a fit."""
        optimizer = FrameOptimizer(self.scene, self.frame, {}, network, live=False)
        for _ in optimizer:
            pass
        assert optimizer.best is not None
        found, truth = optimizer.best.state.to("cpu"), self.scene.state(self.frame.truth or {})
        renderer = Renderer(self.scene, width=_SIZE[0], height=_SIZE[1])
        ours, theirs = _parts(self.scene, renderer, found), _parts(self.scene, renderer, truth)
        both, shown = int(((ours >= 0) & (theirs >= 0)).sum()), theirs >= 0
        dice = 2 * both / max(int((ours >= 0).sum() + shown.sum()), 1)
        tips = np.linalg.norm(_tips(self.scene, found) - _tips_in_view(self.scene, truth), axis=1)
        known = tips[np.isfinite(tips)]
        right = float((ours[shown] == theirs[shown]).mean()) if shown.any() else 1.0
        return dice, right, float(known.mean()) if len(known) else 0.0


def made_images(config: TrainingConfig, count: int) -> Iterator[MadeImage]:
    """Images like those of training, whole and without occluders, that neither training nor validation sees."""
    width, height = _SIZE
    images = replace(
        config.images, width=width, height=height, field_width=width, occluded=0.0, absent=0.0, coverage=(0.02, 0.5)
    )
    observer = Observer([Robot.load(path) for path in config.robots], images, (config.seed, JUDGING_STREAM))
    for number in range(count):
        seen = observer(number)
        # The arms as they are, thickness and all, so that the truth is exact.
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
        yield MadeImage(scene, frame)


def _own_fit(recording: Recording, frame: Frame, network: FeatureExtractor) -> tuple[bool, float, float, np.ndarray]:
    """Whether a fit of a frame is good, its edges, its parts and its tips."""
    optimizer = FrameOptimizer(recording.scene, frame, {}, network, live=False)
    for _ in optimizer:
        pass
    assert optimizer.best is not None
    state, found = optimizer.best.state.to("cpu"), optimizer.assessment
    edges = [
        edge_support(frame.images[camera.name], _parts(recording.scene, _renderer(recording.scene, camera), state))
        for camera in recording.scene.cameras
    ]
    parts = 1.0 if found is None else found.evidence.parts_predicted
    good = found is not None and found.verdict is Verdict.GOOD
    return good, float(np.mean(edges)), parts, _tips_in_view(recording.scene, state)


def _renderer(scene: Scene, camera: Camera) -> Renderer:
    return Renderer(scene, width=camera.width, height=camera.height, cameras=[camera.name])


def edge_support(image: UInt8[np.ndarray, "h w 3"], parts: np.ndarray) -> float:
    """Mean gradient of an image along the outlines of parts, over its mean everywhere [1]; 1 where there is none."""
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    gradient = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    outline = _outlines(parts)
    return float(gradient[outline].mean() / max(float(gradient.mean()), 1e-6)) if outline.any() else 1.0


def _outlines(parts: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Pixels of a part whose right or lower neighbour is of another one."""
    outline = np.zeros(parts.shape, bool)
    outline[:, :-1] |= parts[:, :-1] != parts[:, 1:]
    outline[:-1] |= parts[:-1] != parts[1:]
    return outline


def _parts(scene: Scene, renderer: Renderer, state: SceneState) -> np.ndarray:
    """Part of every pixel, counted through all arms [h, w]; -1 for background."""
    links = renderer.segment_links(state)[0]
    classes = np.concatenate([link_parts(arm.robot) + 10 * place for place, arm in enumerate(scene.arms)])
    return np.where(links >= 0, classes[np.maximum(links, 0)], -1)


def _tips(scene: Scene, state: SceneState) -> Float[np.ndarray, "tips 2"]:
    """Tips of all arms in the first camera [px]; NaN behind it."""
    points = [point for arm in scene.arms for point in keypoints(arm) if point.name.endswith(" tip")]
    with torch.no_grad():
        return project_keypoints(scene, state, points, scene.cameras[0].name).double().numpy()


def _tips_in_view(scene: Scene, state: SceneState) -> Float[np.ndarray, "tips 2"]:
    """The same; NaN where they are not in the image."""
    tips, size = _tips(scene, state), (scene.cameras[0].width, scene.cameras[0].height)
    inside = ((tips >= 0) & (tips < size)).all(1, keepdims=True)
    return np.where(inside, tips, np.nan)
