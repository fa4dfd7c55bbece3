"""Empty backgrounds: false detections, and the other background mode."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from carts_core.evaluation import dice
from carts_core.imaging.working_image import Window
from carts_core.lab.benchmark.rooms import AnotherRoom, synthetic_rooms
from carts_core.model.parts import COVERAGE
from carts_core.model.scene import Scene
from carts_core.networks import FeatureExtractor
from carts_core.optimization import Backgrounds, FrameOptimizer, ImagePredictor, SurfaceSolver, Verdict
from carts_core.optimization.observation import Background, FrameImages, without_background
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.settings.stages import Descend, Observe, RetryOtherBackground

DVRK = Path(__file__).parents[1] / "sequences" / "dvrk_stereo.toml"
SIZE = {"width": 320, "height": 240}
BAR, ARM = (slice(40, 120), slice(20, 200)), (slice(150, 200), slice(100, 240))


class DarkIsArm(ImagePredictor):
    """A predictor that takes whatever is dark for an arm."""

    device, stride = torch.device("cpu"), 16

    def predict(self, images: torch.Tensor, given: torch.Tensor, window: Window) -> torch.Tensor:
        found = torch.zeros_like(given)
        found[:, 0] = (images.amax(1) < 0.3).float()
        return window.of(found)


@pytest.fixture(scope="module")
def scene(shared_sequence: Callable[..., Path]) -> Scene:
    return Sequence.open(shared_sequence(frames=1, **SIZE)).scene.with_cameras(["left"])


def _room(bar: bool = True) -> np.ndarray:
    image = np.full((240, 320, 3), (190, 160, 120), np.uint8)
    image[::8] = (150, 120, 90)
    if bar:
        image[BAR] = 40
    return image


def _with_arm(room: np.ndarray) -> np.ndarray:
    image = room.copy()
    image[ARM] = (30, 20, 20)
    return image


def _seen(scene: Scene, image: np.ndarray, backgrounds: Backgrounds | None) -> tuple[FrameImages, np.ndarray]:
    predictor = DarkIsArm()
    settings = SurfaceSolver(dehaze=0.0)
    found = FrameImages.of(scene, {"left": image}, {}, settings, predictor, backgrounds=backgrounds)
    seen = predictor.predict(found.images, torch.zeros(1, 6, 240, 320), Window(0, 0, 320, 240))[0, 0]
    if found.explained is not None:
        seen = seen * (1 - found.explained[0, 0])
    return found, seen.numpy()


def _outline(found: FrameImages, place: tuple[slice, slice]) -> float:
    """The largest step from one row to the next across the upper and lower side of a rectangle [1]."""
    rows = slice(place[0].start - 10, place[0].stop + 10)
    return float(found.images[0, :, rows, place[1]].diff(dim=1).abs().max())


@pytest.mark.parametrize("gain, haze", [(1.0, 0.0), (0.8, 0.0), (1.15, 0.0), (0.7, 60.0)])
def test_what_is_in_the_background_too_is_no_arm_in_any_light(scene: Scene, gain: float, haze: float) -> None:
    image = np.clip(gain * _with_arm(_room()).astype(float) + haze, 0, 255).astype(np.uint8)
    found, _ = _seen(scene, image, Backgrounds({"left": _room()}))
    assert _outline(found, BAR) < 0.03, "an outline of the bar is left"
    arm = found.images[0, :, 155:195, 110:230].mean((1, 2)) - torch.from_numpy(image[170, 150] / 255.0)
    assert float(arm.abs().max()) < 0.02


def test_what_may_hide_an_arm_is_not_taken_for_background(scene: Scene) -> None:
    known = np.ones((240, 320), bool)
    known[ARM] = False
    contaminated = _with_arm(_room())
    assert _outline(_seen(scene, contaminated, Backgrounds({"left": contaminated}))[0], ARM) < 0.03
    kept, seen = _seen(scene, contaminated, Backgrounds({"left": contaminated}, {"left": known}))
    assert _outline(kept, ARM) > 0.3 and seen[ARM].all()


def test_where_the_network_sees_no_arm_in_the_background_images_stay_as_they_are(scene: Scene) -> None:
    image = _with_arm(_room(bar=False))
    alone, seen_alone = _seen(scene, image, None)
    found, seen = _seen(scene, image, Backgrounds({"left": _room(bar=False)}))
    assert torch.equal(found.images, alone.images) and np.array_equal(seen, seen_alone)


def test_the_background_of_another_scene_changes_nothing(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    other = np.kron(rng.integers(0, 256, (24, 32, 3)), np.ones((10, 10, 1))).astype(np.uint8)
    other[BAR] = 10
    image = _with_arm(_room())
    assert np.array_equal(
        _seen(scene, image, Backgrounds({"left": other}))[0].images, _seen(scene, image, None)[0].images
    )


def test_noise_does_not_count_as_a_change() -> None:
    generator = torch.Generator().manual_seed(0)
    room = torch.rand(1, 3, 8, 10, generator=generator).repeat_interleave(16, 2).repeat_interleave(16, 3)
    background = Background(room, torch.ones_like(room[:, :1]), torch.ones_like(room[:, :1]))
    noisy = room + 0.03 * torch.randn(room.shape, generator=generator)
    noisy[..., 40:60, 40:80] = 1 - room[..., 40:60, 40:80]
    changed = background.compared(noisy, 1.0).differs[0, 0]
    assert changed[43:57, 43:77].mean() > 0.7
    changed[36:64, 36:84] = 0
    assert changed.mean() < 0.01
    assert torch.equal(without_background(noisy, torch.ones_like(noisy[:, :1]), 1.0), noisy)


def test_arms_that_never_leave_say_so_once_and_nothing_is_explained_away(tiny_sequence: Callable[..., Path]) -> None:
    sequence = Sequence.open(tiny_sequence(frames=1, **SIZE))
    backgrounds = Backgrounds.of(sequence, ["left"], "regular")
    assert not backgrounds.images
    (problem,) = backgrounds.problems
    assert "camera 'left'" in problem and "hardly move" in problem and "`background` image" in problem
    assert Backgrounds.of(sequence, ["left"], "regular") is backgrounds
    assert set(Backgrounds.of(sequence, ["left"], "regular", required=True).images) == {"left"}


@pytest.mark.slow
def test_a_real_instrument_is_found_in_a_room_that_deceives_the_network(shared_dir: Path) -> None:
    sequence = Sequence.open(DVRK)
    room = next(room for room in synthetic_rooms() if room.name == "rods 1")
    recording = AnotherRoom(sequence, [room], seed=0)
    frame, extractor = recording.frame(22, room.domain, ["left"]), FeatureExtractor.load()
    assert frame.masks is not None
    scene, renderer = sequence.scene.with_cameras(["left"]), Renderer(sequence.scene, cameras=["left"])
    found = []
    for backgrounds in ({}, {"left": recording.background("left", room.domain)}):
        optimizer = FrameOptimizer(scene, frame, backgrounds, extractor, live=False)
        list(optimizer)
        assert optimizer.best is not None
        found.append(dice(renderer.segment(optimizer.best.state)[0] >= 0, frame.masks["left"]))
    assert found[1] > 0.95 > found[0]


ASIDE = 24
"""How far off the predictor sees arms before the room [px]."""


class SeesArmsAsideBeforeRooms(ImagePredictor):
    """Sees nothing in the empty room, and arms aside of where they are before it; in place before a blurred one, or
    `blurred` pixels aside."""

    device, stride = torch.device("cpu"), 16

    def __init__(self, parts: torch.Tensor, blurred: int = 0) -> None:
        self.parts, self.blurred = parts, blurred
        """Coverage of every part [1, parts, height, width]."""

    def predict(self, images: torch.Tensor, given: torch.Tensor, window: Window) -> torch.Tensor:
        """See the class."""
        found = torch.zeros_like(given)
        size = images.shape[-2:]
        parts = torch.nn.functional.interpolate(self.parts, size, mode="area")
        mask = parts[0].sum(0)
        if float(images[..., mask > 0.9].mean()) < 0.2:
            before_nothing = float(images[:, 0, :8, :8].std()) < 0.02
            aside = self.blurred if before_nothing else ASIDE
            found[:, COVERAGE] = parts.roll(aside * size[1] // SIZE["width"], -1)
        return window.of(found)


def before_a_room(path: Path, settings: SurfaceSolver, blurred: int = 0) -> tuple[FrameOptimizer, Renderer, np.ndarray]:
    """Finished optimizer of a dark arm before a room, its renderer, and the true mask."""
    sequence = Sequence.open(path)
    scene, frame = sequence.scene.with_cameras(["left"]), sequence.frame(0, cameras=["left"])
    assert frame.truth is not None
    renderer = Renderer(scene)
    mask = renderer.segment(scene.state(frame.truth))[0] >= 0
    rng = np.random.default_rng(0)
    room = rng.integers(70, 130, (SIZE["height"], SIZE["width"], 3)).astype(np.uint8)
    image = room.copy()
    image[mask] = 10
    optimizer = FrameOptimizer(
        scene,
        replace(frame, images={"left": image}),
        {"left": room},
        SeesArmsAsideBeforeRooms(renderer.surface_maps(scene.state(frame.truth))[:, COVERAGE], blurred),
        settings=settings,
        live=False,
    )
    list(optimizer)
    return optimizer, renderer, mask


FIRST_RUN = tuple(stage for stage in SurfaceSolver().stages if not isinstance(stage, RetryOtherBackground))


def test_a_rejected_retry_changes_nothing_even_if_it_uses_all_evaluations(
    tiny_sequence: Callable[..., Path],
) -> None:
    path, found = tiny_sequence(frames=1, **SIZE), []
    # Without `RejectFailed`, which would return to the start.
    *fitted, evaluate, _ = FIRST_RUN
    long = RetryOtherBackground(then=(Observe(), *20 * (Descend(3.0), Descend(1.5))))
    for stages in ((*fitted, evaluate), (*fitted, long, evaluate)):
        optimizer, _, _ = before_a_room(path, replace(SurfaceSolver(), stages=stages), 2 * ASIDE)
        assert optimizer.best is not None
        found.append((len(optimizer.history), optimizer.best.joint_positions()["PSM1"], optimizer.stop_reason))
    (first, *once), (with_retry, *both) = found
    assert with_retry > first and np.array_equal(once[0], both[0]) and once[1] == both[1]


@pytest.mark.parametrize("again", [True, False])
def test_the_fit_that_overlaps_more_with_the_change_is_kept(tiny_sequence: Callable[..., Path], again: bool) -> None:
    settings = SurfaceSolver() if again else replace(SurfaceSolver(), stages=FIRST_RUN)
    optimizer, renderer, mask = before_a_room(tiny_sequence(frames=1, **SIZE), settings)
    assert optimizer.best is not None and optimizer.assessment is not None
    found = dice(renderer.segment(optimizer.best.state)[0] >= 0, mask)
    assert (optimizer.assessment.verdict is Verdict.GOOD) == again
    assert (found > 0.95) == again
    optimizer.reset()
    list(optimizer)
    assert dice(renderer.segment(optimizer.best.state)[0] >= 0, mask) == found
